"""Scenes, renders and hostile arguments."""

import json
import os
import pathlib
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

import picofarm

SQUARE = {
    "vertices": [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]],
    "triangles": [[0, 1, 2], [0, 2, 3]],
}
FRONT = {"look_from": (0, 0, 2), "look_at": (0, 0, 0), "fov": 40, "spots": 1}


def test_arrays_have_the_stated_shapes_and_types(render: picofarm.Render) -> None:
    assert render.transient.shape == (16, 16, 128)
    assert render.transient.dtype == np.float32
    assert render.transient.sum() > 0
    assert render.normal.shape == (16, 16, 3)
    assert render.visibility.shape == (25, 16, 16)
    assert render.spots.shape == (25, 7)
    assert set(np.unique(render.visibility)) <= {0, 1}
    assert render.two is None
    assert render.gate.times_ns.shape == (128,)
    assert 0 < render.error < 1


def test_light_of_a_wall_arrives_when_geometry_says() -> None:
    render = picofarm.Scene([SQUARE], **FRONT).render(9, samples=4, bins=1000, gate=(3.0, 6.0))
    middle = render.transient[4, 4]
    # One bounce: 2 m there and 2 m back, in bins of 3 mm.
    assert abs(render.gate.paths_m[middle.argmax()] - 4.0) < 0.02
    assert render.depth[4, 4] == pytest.approx(2.0, abs=1e-5)


def test_any_number_of_threads_gives_the_same_bits(room: picofarm.Scene) -> None:
    one = room.render(samples=2, bins=64, threads=1)
    two = room.render(samples=2, bins=64, threads=2)
    assert np.array_equal(one.transient, two.transient)


def test_the_parts_add_up_to_the_whole(room: picofarm.Scene) -> None:
    r = room.render(samples=2, bins=64, gate=(1.0, 25.0), split=True, max_bounces=3)
    assert r.two is not None and r.multi is not None and r.two_se is not None
    parts = r.two + r.multi
    assert np.all(parts <= r.transient * (1 + 1e-4) + 1e-12)


def test_the_program_renders_the_same_bits(tmp_path: pathlib.Path) -> None:
    file = tmp_path / "square.obj"
    file.write_text("v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nf 1 2 3\nf 1 3 4\n")
    view = ["--look-from=0,0,2", "--look-at=0,0,0", "--fov=40", "--spots=4", "--unit=m"]
    gate = ["--gate=3,6", "--bins=50", "--samples=4", "--resolution=8"]
    out = tmp_path / "out"
    command = [sys.executable, "-m", "picofarm", "--json", "scene", "render", file, "--out", out]
    done = subprocess.run([*command, *view, *gate], capture_output=True, text=True, check=True)
    scene = picofarm.Scene(file, look_from=(0, 0, 2), look_at=(0, 0, 0), fov=40, spots=4, unit="m")
    mine = scene.render(8, samples=4, bins=50, gate=(3.0, 6.0))
    assert json.loads(done.stdout)["error"] == mine.facts["error"]
    assert json.loads(done.stdout)["rays"] == mine.facts["rays"]


def test_a_mitsuba_dict_is_a_scene() -> None:
    matrix = np.eye(4)
    matrix[2, 3] = -2.0
    dictionary = {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 60.0, "to_world": np.eye(4)},
        "wall": {
            "type": "rectangle",
            "to_world": matrix @ np.diag([3.0, 3.0, 1.0, 1.0]),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.5, 0.5]}},
        },
    }
    matrix[2, 3] = 2.0
    dictionary["wall"]["to_world"] = matrix @ np.diag([3.0, 3.0, -1.0, 1.0])
    scene = picofarm.Scene(dictionary, spots=4)
    assert scene.triangles == 2
    assert scene.render(8, samples=2, bins=32).depth.max() == pytest.approx(2.0, abs=1e-4)


def test_one_flash_gives_depth_and_shadows() -> None:
    room = picofarm.furnished(5, resolution=32)
    render = room.render(samples=16)
    flash = render.demultiplex()
    assert flash.depth.shape == (32, 32)
    assert flash.lit.shape[0] == len(flash.beams)
    assert np.median(np.abs(flash.depth - render.depth)) < 0.05
    again = render.demultiplex(histogram=np.asfortranarray(render.transient), threads=1)
    assert np.array_equal(flash.depth, again.depth)


def test_progress_is_reported_and_may_fail(room: picofarm.Scene) -> None:
    shares: list[float] = []
    room.render(64, samples=32, progress=shares.append)
    assert shares and all(0 <= share <= 1 for share in shares)

    def refuse(_: float) -> None:
        raise LookupError("enough")

    with pytest.raises(LookupError, match="enough"):
        room.render(128, samples=4096, progress=refuse)


def test_ctrl_c_ends_a_render(room: picofarm.Scene) -> None:
    timer = threading.Timer(0.3, lambda: os.kill(os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        room.render(256, samples=1 << 16)


def test_other_threads_run_during_a_render(room: picofarm.Scene) -> None:
    ticks: list[float] = []
    done = threading.Event()

    def count() -> None:
        while not done.wait(0.01):
            ticks.append(time.monotonic())

    thread = threading.Thread(target=count)
    thread.start()
    room.render(64, samples=64)
    done.set()
    thread.join()
    assert len(ticks) > 3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"vertices": [[0, 0], [1, 0], [1, 1], [0, 1]]}, r"meshes\[0\].vertices: .*\(4, 2\)"),
        ({"vertices": [[0, 0, np.nan]] * 4}, r"meshes\[0\].vertices: row 0 .*finite"),
        ({"vertices": np.zeros((4, 3), "complex64")}, r"meshes\[0\].vertices: .*complex64"),
        ({"vertices": [["a", "b", "c"]] * 4}, r"meshes\[0\].vertices"),
        ({"vertices": np.zeros(12)}, r"meshes\[0\].vertices: expected 2 dimensions"),
        ({"triangles": [[0, 1, 4]]}, r"meshes\[0\].triangles: .*from 0 to 3"),
        ({"triangles": [[0, 1, -1]]}, r"meshes\[0\].triangles"),
        ({"triangles": [[0.0, 1.0, 2.0]]}, r"meshes\[0\].triangles: .*float64"),
        ({"triangles": [[0, 1]]}, r"meshes\[0\].triangles"),
        ({"triangles": np.zeros((0, 3), int)}, "no triangles"),
        ({"rgb": (0.5, 2.0, 0.5)}, r"meshes\[0\].rgb"),
        ({"colour": (1, 1, 1)}, r"meshes\[0\]: unknown 'colour'"),
        ({"mirror": -1.0}, "alpha|rough"),
    ],
)
def test_unusable_meshes_are_refused_by_name(change: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        picofarm.Scene([{**SQUARE, **change}], **FRONT)


@pytest.mark.parametrize(
    "array",
    [
        np.asfortranarray(np.array(SQUARE["vertices"], "float32")),
        np.array(SQUARE["vertices"], ">f8"),
        np.repeat(np.array(SQUARE["vertices"], "float32"), 2, axis=0)[::2],
        np.array(SQUARE["vertices"], "int8"),
    ],
)
def test_any_layout_of_the_same_mesh_is_the_same_scene(array: np.ndarray) -> None:
    array.setflags(write=False)
    usual = picofarm.Scene([SQUARE], **FRONT).render(8, samples=2, bins=32)
    other = picofarm.Scene([{**SQUARE, "vertices": array}], **FRONT).render(8, samples=2, bins=32)
    assert np.array_equal(usual.transient, other.transient)


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"error": 0.0}, ValueError, "error: "),
        ({"error": float("nan")}, ValueError, "error: "),
        ({"bins": 0}, ValueError, "bins: "),
        ({"bins": 1.5}, TypeError, "bins: "),
        ({"samples": -1}, ValueError, "samples: "),
        ({"samples": 0}, ValueError, "samples"),
        ({"gate": (5.0, 1.0)}, ValueError, "gate: "),
        ({"resolution": 0}, ValueError, "resolution: "),
        ({"resolution": (8, 8, 8)}, ValueError, "resolution: "),
        ({"threads": 0}, ValueError, "threads: "),
        ({"max_bounces": 1}, ValueError, "max_bounces"),
        ({"resolution": 4096, "bins": 65536}, MemoryError, "memory"),
    ],
)
def test_unusable_arguments_are_refused_by_name(
    room: picofarm.Scene, arguments: dict[str, object], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        room.render(**arguments)


def test_missing_files_and_wrong_spots_are_named(tmp_path: pathlib.Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere.glb"):
        picofarm.Scene(tmp_path / "nowhere.glb")
    with pytest.raises(ValueError, match="spots: "):
        picofarm.furnished(1, spots=7)
    with pytest.raises(ValueError, match="look_at: "):
        picofarm.Scene([SQUARE], look_from=(0, 0, 2), look_at=(0, 0), spots=1)


def test_many_renders_take_no_more_memory() -> None:
    resource = pytest.importorskip("resource")
    scene = picofarm.furnished(3, resolution=8)

    def peak(count: int) -> int:
        for _ in range(count):
            scene.render(samples=2, bins=16, threads=1)
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    before = peak(20)
    assert peak(100) < before + 20_000


def test_plots_and_xarray_show_the_render(render: picofarm.Render) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("agg")
    assert len(render.plot().axes) >= 3
    with pytest.raises(ValueError, match="pixel: "):
        render.plot((99, 0))
    pytest.importorskip("xarray")
    data = render.to_xarray()
    assert data["transient"].dims == ("row", "column", "bin")
    assert data["time"].attrs["units"] == "ns"


def test_a_sensor_counts_photons(render: picofarm.Render) -> None:
    sensed = render.sense(peak_photons=100, seed=3)
    assert sensed.counts.dtype == np.uint32
    assert sensed.counts.shape == render.transient.shape
    assert np.array_equal(sensed.counts, render.sense(peak_photons=100, seed=3, threads=1).counts)
    assert not np.array_equal(sensed.counts, render.sense(peak_photons=100, seed=4).counts)
    quiet = {"poisson": False, "pulse": {"kind": "none"}, "rebin": 2}
    expected = render.sense({**quiet, "jitter": {"kind": "gaussian", "fwhm_ps": 0}})
    assert expected.gate.bins == render.gate.bins // 2
    assert expected.gate.bin_width_m == 2 * render.gate.bin_width_m
    pairs = render.transient.reshape(*render.depth.shape, -1, 2).sum(axis=3)
    assert np.allclose(expected.counts, expected.scale * pairs, rtol=1e-4, atol=1e-4)
    height, width, _ = render.transient.shape
    zones = {"rows": 2, "columns": 2}
    still = {**quiet, "jitter": {"kind": "gaussian", "fwhm_ps": 0}, "rebin": 1}
    wide = render.sense({**still, "zones": zones})
    means = render.transient.reshape(2, height // 2, 2, width // 2, -1).mean(axis=(1, 3))
    assert np.allclose(wide.counts, wide.scale * means, rtol=1e-4, atol=1e-4)
    bought = render.sense({"preset": "tmf8828", "zones": zones})
    assert bought.counts.shape == (2, 2, 128)
    assert abs(bought.gate.bin_width_m - 88e-12 * 299_792_458) < 1e-9
    assert "photons each" in repr(sensed)
    flash = sensed.demultiplex()
    assert flash.depth.shape == render.depth.shape
    pytest.importorskip("matplotlib").use("agg")
    assert len(flash.plot(spot=1).axes) == 8
    with pytest.raises(ValueError, match="spot"):
        flash.plot(spot=99)
    for bad in ({"dark": 1}, {"rebin": 0}, {"dark_per_bin": -1}):
        with pytest.raises(ValueError, match="sensor: "):
            render.sense(bad)
    with pytest.raises(ValueError, match="photons"):
        render.sense(peak_photons=-1)


def test_light_in_flight_and_notebooks_show_the_render(
    render: picofarm.Render, tmp_path: pathlib.Path
) -> None:
    pytest.importorskip("matplotlib").use("agg")
    file = render.animate(tmp_path / "light.gif", frames=5)
    assert file.read_bytes()[:3] == b"GIF"
    page = render._repr_html_()
    assert "data:image/png" in page and "16x16 pixels" in page


def test_a_room_is_reconstructed_from_one_flash(tmp_path: pathlib.Path) -> None:
    room = picofarm.furnished(11, resolution=32)
    render = room.render(samples=16, bins=637)
    shares: list[float] = []
    made = render.reconstruct(nodes=32, progress=shares.append)
    assert made.vertices.shape[1] == 3 and made.triangles.max() < len(made.vertices)
    assert 0 < made.error < 1
    assert shares == sorted(shares)
    again = render.reconstruct(nodes=32, threads=1)
    assert again.glb == made.glb
    file = made.save(tmp_path / "room.glb")
    assert picofarm.Scene(file).triangles == len(made.triangles)
    pytest.importorskip("matplotlib").use("agg")
    made.plot().savefig(tmp_path / "behind.png")
    with pytest.raises(ValueError, match="nodes"):
        render.reconstruct(nodes=3)


def test_a_scene_is_seen_from_elsewhere(room: picofarm.Scene) -> None:
    camera = room.camera
    ahead = np.add(camera["origin"], camera["forward"])
    same = room.seen_from(camera["origin"], ahead)
    assert np.allclose(same.camera["down"], camera["down"], atol=1e-5)
    turned = room.seen_from(ahead, camera["origin"], fov=60).render(16, samples=2, bins=16)
    assert turned.depth.max() > 0
    with pytest.raises(ValueError, match="look_at"):
        room.seen_from((0, 0, 0), (0, 0, 0))
    with pytest.raises(ValueError, match="up"):
        room.seen_from((0, 0, 0), (0, 0, 1), up=(0, 0, 1))


def test_a_capture_needs_no_scene() -> None:
    room = picofarm.furnished(11, resolution=32)
    render = room.render(samples=16, bins=637)
    flash = render.demultiplex()
    # World to camera.
    camera = room.camera
    axes = np.array([camera["right"], camera["down"], camera["forward"]])
    spots = (render.spots[:, :3] - camera["origin"]) @ axes.T
    laser = (0.0, 0.0, 0.0)
    measured = {"gate": render.gate, "laser": laser, "fov": 90}
    capture = picofarm.Capture(render.transient, spots=spots, **measured)
    found = capture.demultiplex()
    assert np.median(np.abs(found.depth - flash.depth)) < 1e-3
    seen = picofarm.Capture(render.transient, directions=spots, **measured).demultiplex()
    assert np.median(np.abs(seen.depth - render.depth)) < 0.05
    halves = np.stack([render.transient * 0.25, render.transient * 0.75])
    with pytest.raises(ValueError, match="spots: has 25 rows, but there are 2"):
        picofarm.Capture(halves, spots=spots, **measured)
    made = capture.reconstruct(nodes=32)
    assert len(made.triangles) > 100 and np.isnan(made.error)
    pytest.importorskip("matplotlib").use("agg")
    made.plot()
    for name, bad in {
        "spots": {"spots": spots[:, :2]},
        "directions": {"spots": spots, "directions": spots},
        "fov": {"spots": spots, "fov": 200},
        "intrinsics": {"spots": spots, "fov": None, "intrinsics": [1, 2]},
        "gate": {"spots": spots, "gate": picofarm.Gate(1.0, 0.1, 3)},
        "laser": {"spots": spots, "laser": (np.nan, 0, 0)},
    }.items():
        with pytest.raises(ValueError, match=name):
            picofarm.Capture(render.transient, **{**measured, **bad})


def test_a_varied_floor_plan_is_another_room_and_an_unknown_one_is_refused() -> None:
    box = picofarm.furnished(3, resolution=32)
    varied = picofarm.furnished(3, resolution=32, floor_plan="varied")
    assert repr(box) != repr(varied)
    with pytest.raises(ValueError, match="floor_plan"):
        picofarm.furnished(3, resolution=32, floor_plan="round")
