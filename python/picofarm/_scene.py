"""Scenes, renders and flashes that were taken apart."""

from __future__ import annotations

import base64
import html
import io
import json
import operator
import os
import pathlib
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _native

if TYPE_CHECKING:
    import matplotlib.figure
    import xarray

_METRES_PER_NS = 0.299792458
_Point = Sequence[float] | NDArray[np.floating[Any]]
_Spots = int | str | Sequence[tuple[float, float]]
_Floats = NDArray[np.float32]


class Scene:
    """Objects, a camera and a laser. A scene never changes.

    `source` is one of:

    - the path of a glTF, Mitsuba (XML, or its dict as JSON), OBJ, PLY or STL file,
    - a Mitsuba dict,
    - a list of meshes. Each is a dict with `vertices` (float, `[n, 3]`, metres), `triangles`
      (integer, `[m, 3]`), and optionally `rgb` (three numbers from 0 to 1) and `mirror` (the
      roughness of a mirror).

    Camera, laser and unit that the source does not have are chosen; `notes` says how.

    Args:
        camera: Name or number of the file's camera.
        look_from: Position of the camera, metres.
        look_at: Point in the middle of the image, metres.
        fov: Width of the view, degrees.
        up: Direction that is upwards in the image.
        spots: Laser spots in the camera's view: a grid of 1, 4, 16, 25 or 100, `"random:16"`, or
            a list of (x, y) from 0 to 1, right and down.
        unit: Unit of length of the file: m, cm, mm, in or ft.
        root: Folder that holds every file that the scene names.

    Raises:
        ValueError: An argument or the content of the source is unusable.
        OSError: A file cannot be read.
    """

    def __init__(
        self,
        source: str | os.PathLike[str] | Mapping[str, Any] | Sequence[Mapping[str, Any]],
        *,
        camera: str | int | None = None,
        look_from: _Point | None = None,
        look_at: _Point | None = None,
        fov: float | None = None,
        up: _Point | None = None,
        spots: _Spots | None = None,
        unit: str | None = None,
        root: str | os.PathLike[str] | None = None,
    ) -> None:
        view = (
            _point("look_from", look_from),
            _point("look_at", look_at),
            None if fov is None else float(fov),
            _point("up", up),
        )
        name = None if camera is None else str(camera)
        if isinstance(source, (str, os.PathLike)):
            self._native = _native.Scene.open(source, name, view, spots, unit, root)
        elif isinstance(source, Mapping):
            with tempfile.TemporaryDirectory() as folder:
                path = pathlib.Path(folder, "scene.json")
                path.write_text(json.dumps(_plain(source)))
                self._native = _native.Scene.open(path, name, view, spots, unit, root)
        else:
            for argument, value in {"camera": camera, "unit": unit, "root": root}.items():
                if value is not None:
                    raise ValueError(f"{argument}: only scene files have one; meshes are in metres")
            meshes = [_mesh(k, mesh) for k, mesh in enumerate(source)]
            self._native = _native.Scene.from_meshes(meshes, view, 25 if spots is None else spots)

    @classmethod
    def _of(cls, native: _native.Scene) -> Scene:
        scene = cls.__new__(cls)
        scene._native = native
        return scene

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self._native.name

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the image, pixels."""
        return self._native.shape

    @property
    def spots(self) -> int:
        """Number of laser beams."""
        return self._native.beams

    @property
    def triangles(self) -> int:
        """Number of triangles."""
        return self._native.triangles

    @property
    def objects(self) -> list[str]:
        """Names of the objects; `Render.instance` is the index plus one."""
        return self._native.objects

    @property
    def labels(self) -> list[str]:
        """Names of the categories; `Render.label` is the index plus one."""
        return self._native.labels

    @property
    def camera(self) -> dict[str, Any]:
        """`intrinsics` (pixels), `origin` (metres), and the axes `right`, `down` and `forward`."""
        return json.loads(self._native.facts())["camera"]

    @property
    def notes(self) -> dict[str, str]:
        """What was chosen for the scene and what was left out of its file."""
        return json.loads(self._native.facts())["provenance"]["notes"]

    def seen_from(
        self,
        look_from: _Point,
        look_at: _Point,
        *,
        fov: float | None = None,
        up: _Point | None = None,
    ) -> Scene:
        """Returns the scene with a camera elsewhere. The laser stays where it is.

        Args:
            look_from: Position of the camera, metres.
            look_at: Point in the middle of the image, metres.
            fov: Width of the view, degrees; that of the camera without it.
            up: Direction that is upwards in the image; that of the camera without it.
        """
        eye, target = _point("look_from", look_from), _point("look_at", look_at)
        upwards = _point("up", up) or tuple(-x for x in self.camera["down"])
        assert eye is not None and target is not None
        angle = None if fov is None else float(fov)
        return Scene._of(self._native.seen_from(eye, target, angle, upwards))

    def render(
        self,
        resolution: int | tuple[int, int] | None = None,
        *,
        error: float | None = None,
        samples: int = 64,
        bins: int = 637,
        gate: tuple[float, float] | None = None,
        seed: int = 0,
        max_bounces: int | None = None,
        split: bool = False,
        threads: int | None = None,
        progress: bool | Callable[[float], object] = False,
    ) -> Render:
        """Renders the scene. The same arguments give the same bits on any number of threads.

        Args:
            resolution: Width of the image in pixels, or (height, width); the scene's own without it.
            error: Render until the median error of a pixel is this share, such as 0.1.
            samples: Camera paths per pixel, if `error` is not given.
            bins: Number of time bins.
            gate: First and last optical path in metres. Without it, 38.4 mm bins from 1 m, or a
                gate that fits the scene if that would miss much of it.
            seed: Seed of the random numbers.
            max_bounces: Longest path in bounces; without it, until the gate ends.
            split: Also returns the light of two bounces and of more, with standard errors.
            threads: Number of threads; all cores without it.
            progress: Prints the progress to standard error, or is called with the share done.

        Raises:
            ValueError: An argument or the scene is unusable.
            MemoryError: The histograms do not fit into memory.
            KeyboardInterrupt: Ctrl-C was pressed. The render stops within 0.1 s.
        """
        native = self._native
        if resolution is not None:
            native = native.resized(*_size(resolution, native.shape))
        limits = None
        if gate is not None:
            first, last = (float(x) for x in gate)
            if not 0 <= first < last:
                raise ValueError(f"gate: expected 0 <= first < last in metres, found {gate}")
            limits = (first, (last - first) / bins)
        made = _native.render(
            native,
            _whole("samples", samples),
            None if error is None else float(error),
            _whole("bins", bins),
            limits,
            _whole("seed", seed),
            None if max_bounces is None else _whole("max_bounces", max_bounces),
            split,
            None if threads is None else _whole("threads", threads),
            _Percent() if progress is True else (progress or None),
        )
        if progress is True:
            print(file=sys.stderr)
        facts = json.loads(made.pop("facts"))
        return Render(scene=Scene._of(native), gate=Gate(**facts.pop("gate")), facts=facts, **made)

    def __repr__(self) -> str:
        height, width = self.shape
        return (
            f"<picofarm.Scene {self.name!r}: {self.triangles} triangles, {self.spots} spots, "
            f"{width}x{height} pixels>"
        )


def furnished(
    seed: int,
    *,
    resolution: int = 256,
    spots: _Spots = 25,
    fov: float = 90.0,
    mirrors: int = 0,
    assets: str = "parametric",
) -> Scene:
    """Returns the furnished room of a seed: the same room on every machine.

    Args:
        resolution: Width and height of the image, pixels.
        spots: See `Scene`.
        fov: Width of the view, degrees.
        mirrors: Least number of mirrors in view, 0 to 4.
        assets: Library of furniture: `parametric` or `sweethome3d`.
    """
    side = _whole("resolution", resolution)
    least = _whole("mirrors", mirrors)
    seed = _whole("seed", seed)
    return Scene._of(_native.Scene.furnished(seed, side, spots, float(fov), least, assets))


@dataclass(frozen=True)
class Gate:
    """The recorded interval of optical path: `bins` bins of `bin_width_m` from `start_m`."""

    start_m: float
    bin_width_m: float
    bins: int

    @property
    def paths_m(self) -> NDArray[np.float64]:
        """Optical path at the middle of each bin, metres."""
        middles = np.arange(self.bins, dtype=np.float64) + 0.5
        return np.asarray(self.start_m + middles * self.bin_width_m, np.float64)

    @property
    def times_ns(self) -> NDArray[np.float64]:
        """Time at the middle of each bin, nanoseconds."""
        return self.paths_m / _METRES_PER_NS


@dataclass(frozen=True, repr=False)
class Render:
    """Histograms of one scene and its ground truth. Rows count downwards."""

    scene: Scene
    gate: Gate
    transient: _Floats
    """All light, radiance per pulse energy, 1/(m² sr), `[row, column, bin]`."""
    depth: _Floats
    """z-depth, metres, 0 = nothing, `[row, column]`."""
    range: _Floats
    """Distance along the ray, metres, 0 = nothing, `[row, column]`."""
    normal: _Floats
    """Unit normals in the camera frame (x right, y down, z forward), `[row, column, 3]`."""
    instance: NDArray[np.uint32]
    """Object index + 1, 0 = nothing, `[row, column]`."""
    label: NDArray[np.uint16]
    """Category index + 1, 0 = nothing, `[row, column]`."""
    specular: NDArray[np.uint8]
    """1 = mirror, `[row, column]`."""
    visibility: NDArray[np.uint8]
    """1 = the spot lights what the pixel sees, `[spot, row, column]`."""
    rgb: _Floats
    """Companion image, linear, 0 to 1, `[row, column, 3]`."""
    spots: _Floats
    """x, y, z, nx, ny, nz (world frame) and the path from the laser, metres, `[spot, 7]`; NaN if
    the beam hits nothing."""
    intrinsics: _Floats
    """fx, fy, cx, cy, pixels."""
    facts: dict[str, Any] = field(repr=False)
    """Error estimates, the renderer's plan, energy outside the gate, rays and warnings."""
    two: _Floats | None = None
    """Light of exactly two bounces, with `split=True`."""
    two_se: _Floats | None = None
    """Standard error of `two`."""
    two_noise: _Floats | None = None
    """A draw of the error of `two`."""
    multi: _Floats | None = None
    """Light of three bounces and more, with `split=True`."""
    multi_se: _Floats | None = None
    """Standard error of `multi`."""
    multi_noise: _Floats | None = None
    """A draw of the error of `multi`."""

    @property
    def error(self) -> float:
        """Median over the pixels of the relative error of the histogram."""
        return self.facts["error"]["median_relative"]

    @property
    def plan(self) -> dict[str, list[str]]:
        """Techniques and approximations that the renderer chose."""
        return self.facts["plan"]

    @property
    def warnings(self) -> list[str]:
        """Beams that hit nothing, an image without light."""
        return self.facts["warnings"]

    def sense(
        self,
        sensor: Mapping[str, Any] | None = None,
        *,
        peak_photons: float | tuple[float, float] | None = None,
        seed: int = 0,
        number: int = 0,
        threads: int | None = None,
    ) -> Sensed:
        """Returns what a single-photon sensor counts. The same arguments give the same counts.

        Args:
            sensor: Settings as in a job file: `pulse`, `jitter`, `scale`, `dark_per_bin`,
                `poisson`, `rebin` and `dead_time`. Without them, a pulse of 128 ps, 50 ps of
                jitter and a peak of 10 to 400 photons.
            peak_photons: Photons in the brightest bin of the median pixel, or a range to draw
                from. Replaces `scale` of `sensor`.
            seed: Seed of the noise.
            number: Number of the scene, which selects its own noise.
            threads: Number of threads; all cores without it.

        Raises:
            ValueError: A setting is unusable.
        """
        spec = dict(sensor or {})
        if isinstance(peak_photons, Sequence):
            low, high = peak_photons
            spec["scale"] = {"kind": "peak_range", "low": float(low), "high": float(high)}
        elif peak_photons is not None:
            spec["scale"] = {"kind": "peak", "photons": float(peak_photons)}
        made = _native.sense(
            self.transient,
            self.two,
            self.gate.bin_width_m,
            json.dumps(spec),
            _whole("seed", seed),
            _whole("number", number),
            None if threads is None else _whole("threads", threads),
        )
        facts = json.loads(made["facts"])
        gate = Gate(self.gate.start_m, facts["bin_width_m"], facts["bins"])
        return Sensed(render=self, gate=gate, counts=made["counts"], facts=facts)

    def demultiplex(
        self,
        *,
        histogram: ArrayLike | None = None,
        shadows: str = "learned",
        threads: int | None = None,
    ) -> Flash:
        """Finds depth, shadows and mirrors in the light of all spots, without the ground truth.

        Args:
            histogram: Replaces `transient`, for example with a measured one.
            shadows: `learned` from rendered rooms, or `physics`.
            threads: Number of threads; all cores without it.
        """
        values = self.transient if histogram is None else histogram
        return self._demultiplex(values, self.gate, shadows, threads)

    def _demultiplex(
        self, values: ArrayLike, gate: Gate, shadows: str, threads: int | None
    ) -> Flash:
        light = _floats("histogram", values, 3)
        made = _native.demultiplex(
            light,
            self.scene._native,
            (gate.start_m, gate.bin_width_m),
            self.spots,
            shadows,
            None if threads is None else _whole("threads", threads),
        )
        return Flash(**made)

    def reconstruct(
        self,
        *,
        histogram: ArrayLike | None = None,
        nodes: int | None = None,
        seed: int = 0,
        threads: int | None = None,
        progress: bool | Callable[[float], object] = False,
    ) -> Reconstruction:
        """Returns the room in 3D from the light of all spots, and its errors against the scene.

        Args:
            histogram: Replaces `transient`, for example with a measured one.
            nodes: Nodes along the longest side of the grid, 16 to 512; 192 without it.
            seed: Seed of the random numbers.
            threads: Number of threads; all cores without it.
            progress: Prints the progress to standard error, or is called with the share done.

        Raises:
            ValueError: The histogram contradicts the scene's calibration, or an argument is wrong.
            KeyboardInterrupt: Ctrl-C was pressed.
        """
        values = self.transient if histogram is None else histogram
        return self._reconstruct(values, self.gate, nodes, seed, threads, progress)

    def _reconstruct(
        self,
        values: ArrayLike,
        gate: Gate,
        nodes: int | None,
        seed: int,
        threads: int | None,
        progress: bool | Callable[[float], object],
    ) -> Reconstruction:
        made = _native.reconstruct(
            _floats("histogram", values, 3),
            self.scene._native,
            (gate.start_m, gate.bin_width_m),
            self.spots,
            None if nodes is None else _whole("nodes", nodes),
            _whole("seed", seed),
            None if threads is None else _whole("threads", threads),
            _Percent("reconstructing") if progress is True else (progress or None),
        )
        if progress is True:
            print(file=sys.stderr)
        facts = json.loads(made.pop("facts"))
        return Reconstruction(scene=self.scene, facts=facts, **made)

    def to_xarray(self) -> xarray.Dataset:
        """Returns the arrays with dimensions, coordinates and units. Needs xarray."""
        xarray = _optional("xarray", "xarray")
        image = ("row", "column")
        dims: dict[str, tuple[tuple[str, ...], str]] = {
            "transient": ((*image, "bin"), "1/(m2 sr)"),
            "depth": (image, "m"),
            "range": (image, "m"),
            "normal": ((*image, "axis"), "1"),
            "instance": (image, "1"),
            "label": (image, "1"),
            "specular": (image, "1"),
            "visibility": (("spot", *image), "1"),
            "rgb": ((*image, "channel"), "1"),
        }
        arrays = {
            name: (axes, getattr(self, name), {"units": units})
            for name, (axes, units) in dims.items()
        }
        coordinates = {
            "path": ("bin", self.gate.paths_m, {"units": "m"}),
            "time": ("bin", self.gate.times_ns, {"units": "ns"}),
        }
        return xarray.Dataset(arrays, coords=coordinates, attrs={"scene": self.scene.name})

    def plot(self, pixel: tuple[int, int] | None = None) -> matplotlib.figure.Figure:
        """Draws the light summed over time, the depth and the histogram of a pixel. Needs
        matplotlib.

        Args:
            pixel: Row and column; the middle of the image without it.
        """
        plt = _optional("matplotlib.pyplot", "plot")
        height, width = self.depth.shape
        row, column = pixel or (height // 2, width // 2)
        if not (0 <= row < height and 0 <= column < width):
            raise ValueError(f"pixel: {(row, column)} is outside of {height} rows, {width} columns")
        figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
        light = self.transient.sum(axis=2)
        white = float(np.quantile(light, 0.99)) or 1.0
        axes[0].imshow(np.sqrt(np.minimum(light / white, 1.0)), cmap="inferno")
        axes[0].set_title("all light")
        seen = np.where(self.depth > 0, self.depth, np.nan)
        figure.colorbar(axes[1].imshow(seen, cmap="viridis"), ax=axes[1], label="depth, m")
        for panel in axes[:2]:
            panel.plot(column, row, "o", mfc="none", mec="white")
            panel.set_xticks([])
            panel.set_yticks([])
        axes[2].plot(self.gate.times_ns, self.transient[row, column], lw=0.8)
        axes[2].set_xlabel("time, ns")
        axes[2].set_ylabel("radiance, 1/(m² sr)")
        axes[2].set_title(f"pixel ({row}, {column})")
        return figure

    def animate(
        self, file: str | os.PathLike[str], *, frames: int = 100, fps: int = 20
    ) -> pathlib.Path:
        """Writes light in flight as a GIF (or MP4, with ffmpeg) and returns its path. Needs
        matplotlib.

        Args:
            file: Where to write. The extension selects the format.
            frames: Number of frames, from the first light to the last.
            fps: Frames per second.
        """
        plt = _optional("matplotlib.pyplot", "plot")
        animation = _optional("matplotlib.animation", "plot")
        lit = np.flatnonzero(self.transient.any(axis=(0, 1)))
        first, last = (int(lit[0]), int(lit[-1]) + 1) if len(lit) else (0, self.gate.bins)
        edges = np.unique(np.linspace(first, last, _whole("frames", frames) + 1).astype(int))
        white = float(np.quantile(self.transient[..., first:last].max(axis=2), 0.9)) or 1.0
        figure, axes = plt.subplots(figsize=(4, 4), layout="constrained")
        height, width = self.depth.shape
        image = axes.imshow(np.zeros((height, width)), cmap="inferno", vmin=0, vmax=1)
        axes.set_xticks([])
        axes.set_yticks([])
        times = self.gate.times_ns

        def draw(k: int) -> tuple[Any, ...]:
            light = self.transient[..., edges[k] : edges[k + 1]].max(axis=2)
            image.set_data(np.sqrt(np.minimum(light / white, 1.0)))
            axes.set_title(f"{times[edges[k]]:.2f} ns")
            return (image,)

        path = pathlib.Path(file)
        movie = animation.FuncAnimation(figure, draw, frames=len(edges) - 1)
        movie.save(path, writer="pillow" if path.suffix == ".gif" else None, fps=fps)
        plt.close(figure)
        return path

    def _repr_html_(self) -> str:
        try:
            figure = self.plot()
        except ImportError:
            return f"<p>{html.escape(repr(self))}</p>"
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=80)
        _optional("matplotlib.pyplot", "plot").close(figure)
        data = base64.b64encode(buffer.getvalue()).decode()
        title = html.escape(repr(self))
        return f'<p>{title}</p><img alt="{title}" src="data:image/png;base64,{data}">'

    def __repr__(self) -> str:
        height, width, bins = self.transient.shape
        return f"<picofarm.Render {width}x{height} pixels, {bins} bins, error {self.error:.1%}>"


@dataclass(frozen=True, repr=False)
class Sensed:
    """What a sensor counted."""

    render: Render
    """The measured light."""
    gate: Gate
    """The gate of the counts."""
    counts: NDArray[np.uint32] | _Floats
    """Photons, `[row, column, bin]`; expected photons if `poisson` is off."""
    facts: dict[str, Any] = field(repr=False)
    """Settings, photons that the gate or pile-up dropped, and what set the scale."""

    @property
    def scale(self) -> float:
        """Photons per unit of `Render.transient`."""
        return self.facts["scale"]

    def demultiplex(self, *, shadows: str = "learned", threads: int | None = None) -> Flash:
        """Finds depth, shadows and mirrors in the counts. See `Render.demultiplex`."""
        return self.render._demultiplex(self.counts, self.gate, shadows, threads)

    def reconstruct(
        self,
        *,
        nodes: int | None = None,
        seed: int = 0,
        threads: int | None = None,
        progress: bool | Callable[[float], object] = False,
    ) -> Reconstruction:
        """Returns the room in 3D from the counts. See `Render.reconstruct`."""
        counts = self.counts
        return self.render._reconstruct(counts, self.gate, nodes, seed, threads, progress)

    def __repr__(self) -> str:
        height, width, bins = self.counts.shape
        photons = float(self.counts.sum(dtype=np.float64)) / (height * width)
        return f"<picofarm.Sensed {width}x{height} pixels, {bins} bins, {photons:.0f} photons each>"


@dataclass(frozen=True, repr=False)
class Flash:
    """What the light of all spots together reveals. Spots are those that hit something, in order."""

    beams: list[int]
    """Index of each spot's beam."""
    depth: _Floats
    """z-depth, metres, `[row, column]`."""
    confidence: _Floats
    """0 to 1: how well the histogram supports the depth, `[row, column]`."""
    albedo: _Floats
    """Relative to the median pixel, `[row, column]`."""
    mirror: _Floats
    """Probability that the pixel sees a mirror, `[row, column]`."""
    lit: _Floats
    """Probability that the spot lights what the pixel sees, `[spot, row, column]`."""
    ground: NDArray[np.uint8]
    """What `lit` rests on: 0 = light, 1 = geometry alone, 2 = light of other spots arrives at the
    same time; `[spot, row, column]`."""

    def __repr__(self) -> str:
        height, width = self.depth.shape
        return f"<picofarm.Flash {width}x{height} pixels, {len(self.beams)} spots>"


@dataclass(frozen=True, repr=False)
class Reconstruction:
    """A room in 3D."""

    scene: Scene
    """The scene that was measured."""
    vertices: _Floats
    """World axes, metres, `[n, 3]`."""
    triangles: NDArray[np.uint32]
    """Indices of vertices, counter-clockwise seen from empty space, `[m, 3]`."""
    glb: bytes = field(repr=False)
    """A glTF file with the surface, the camera and the laser."""
    facts: dict[str, Any] = field(repr=False)
    """Errors against the scene, planes, spots that were left out, and a verdict."""

    @property
    def error(self) -> float:
        """Mean error of depth in 24 views from other places in the room, metres."""
        return self.facts["novel_views"]["all"]["l1_m"]

    def save(self, file: str | os.PathLike[str]) -> pathlib.Path:
        """Writes the surface as `.glb` and returns its path."""
        path = pathlib.Path(file)
        path.write_bytes(self.glb)
        return path

    def plot(
        self, *, look_from: _Point | None = None, look_at: _Point | None = None, fov: float = 90.0
    ) -> matplotlib.figure.Figure:
        """Draws the surface and the true scene from another place. Needs matplotlib.

        Args:
            look_from: Where to stand, metres; without it, across the room, above the middle.
            look_at: Point in the middle of the picture; without it, the middle of the room.
            fov: Width of the view, degrees.
        """
        plt = _optional("matplotlib.pyplot", "plot")
        camera = self.scene.camera
        eye, ahead, up = (
            np.array(camera["origin"]),
            np.array(camera["forward"]),
            -np.array(camera["down"]),
        )
        middle = (self.vertices.min(axis=0) + self.vertices.max(axis=0)) / 2
        target = middle if look_at is None else np.asarray(look_at, float)
        if look_from is None:
            farthest = float(((self.vertices - eye) @ ahead).max())
            place = eye + 0.8 * farthest * ahead + 0.3 * up
        else:
            place = np.asarray(look_from, float)
        mesh = {"vertices": self.vertices, "triangles": self.triangles}
        surface = Scene([mesh], look_from=place, look_at=target, fov=fov, up=up, spots=1)
        truth = self.scene.seen_from(place, target, fov=fov)
        figure, axes = plt.subplots(1, 2, figsize=(10, 4.6), layout="constrained")
        for panel, scene, title in zip(axes, (surface, truth), ("one flash", "truth"), strict=True):
            seen = scene.render((256, 256), samples=2, bins=16)
            shade = np.where(seen.depth > 0, 0.15 + 0.85 * np.abs(seen.normal[..., 2]), 0)
            panel.imshow(shade, cmap="bone", vmin=0, vmax=1)
            panel.set_title(title)
            panel.set_xticks([])
            panel.set_yticks([])
        return figure

    def __repr__(self) -> str:
        size = f"{len(self.triangles)} triangles, error {self.error:.3f} m"
        return f"<picofarm.Reconstruction {self.scene.name!r}: {size}>"


class _Percent:
    """Prints a share to standard error whenever its percentage changes."""

    def __init__(self, what: str = "rendering") -> None:
        self.what = what
        self.last = -1

    def __call__(self, share: float) -> None:
        percent = int(100 * share)
        if percent != self.last:
            self.last = percent
            print(f"\r{self.what}: {percent} %", end="", file=sys.stderr, flush=True)


def _point(name: str, value: _Point | None) -> tuple[float, float, float] | None:
    if value is None:
        return None
    numbers = tuple(float(x) for x in value)
    if len(numbers) != 3:
        raise ValueError(f"{name}: expected three numbers, found {len(numbers)}")
    return numbers


def _whole(name: str, value: Any) -> int:
    try:
        number = operator.index(value)
    except TypeError:
        raise TypeError(f"{name}: expected a whole number, found {value!r}") from None
    if not 0 <= number < 2**32 and not (name == "seed" and 0 <= number < 2**64):
        raise ValueError(f"{name}: {number} is out of range")
    return number


def _size(resolution: int | tuple[int, int], shape: tuple[int, int]) -> tuple[int, int]:
    if isinstance(resolution, Sequence):
        if len(resolution) != 2:
            raise ValueError("resolution: expected a width, or (height, width)")
        height, width = (_whole("resolution", n) for n in resolution)
    else:
        width = _whole("resolution", resolution)
        height = max(1, round(width * shape[0] / shape[1]))
    if not (1 <= height <= 4096 and 1 <= width <= 4096):
        raise ValueError(f"resolution: expected 1 to 4096 pixels, found {height}x{width}")
    return height, width


def _floats(name: str, value: ArrayLike, dimensions: int) -> _Floats:
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name}: expected numbers, found dtype {array.dtype}")
    if array.ndim != dimensions:
        raise ValueError(f"{name}: expected {dimensions} dimensions, found shape {array.shape}")
    return np.ascontiguousarray(array, dtype=np.float32)


def _mesh(
    k: int, mesh: Mapping[str, Any]
) -> tuple[_Floats, NDArray[np.uint32], tuple[float, float, float], float | None]:
    if not isinstance(mesh, Mapping):
        raise ValueError(f"meshes[{k}]: expected a dict with vertices and triangles")
    unknown = set(mesh) - {"vertices", "triangles", "rgb", "mirror"}
    if unknown:
        raise ValueError(f"meshes[{k}]: unknown {', '.join(map(repr, sorted(unknown)))}")
    for needed in ("vertices", "triangles"):
        if needed not in mesh:
            raise ValueError(f"meshes[{k}]: {needed} are missing")
    vertices = _floats(f"meshes[{k}].vertices", mesh["vertices"], 2)
    triangles = np.asarray(mesh["triangles"])
    if triangles.dtype.kind not in "iu":
        what = f"expected whole numbers, found dtype {triangles.dtype}"
        raise ValueError(f"meshes[{k}].triangles: {what}")
    if triangles.ndim != 2:
        what = f"expected 2 dimensions, found shape {triangles.shape}"
        raise ValueError(f"meshes[{k}].triangles: {what}")
    if triangles.size and (triangles.min() < 0 or triangles.max() >= len(vertices)):
        what = f"expected indices from 0 to {len(vertices) - 1}"
        raise ValueError(f"meshes[{k}].triangles: {what}")
    rgb = _point(f"meshes[{k}].rgb", mesh.get("rgb", (0.7, 0.7, 0.7)))
    mirror = mesh.get("mirror")
    corners = np.ascontiguousarray(triangles, dtype=np.uint32)
    return vertices, corners, rgb or (0.7, 0.7, 0.7), None if mirror is None else float(mirror)


def _plain(value: Any) -> Any:
    """Returns a Mitsuba dict with lists in place of arrays and transforms."""
    if hasattr(value, "matrix"):
        rows: Any = np.asarray(value.matrix, dtype=np.float64)
        return rows.reshape(4, 4).tolist()
    if isinstance(value, Mapping):
        items = cast("Mapping[object, Any]", value).items()
        return {str(key): _plain(item) for key, item in items}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in cast("Sequence[Any]", value)]
    if isinstance(value, (str, bool, int, float)) or value is None:
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(cast("os.PathLike[str]", value))
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"the Mitsuba dict holds {type(value).__name__}, which is not plain data")
    return array.tolist()


def _optional(module: str, extra: str) -> Any:
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError as e:
        raise ImportError(f"{e}; pip install 'picofarm[{extra}]'") from None
