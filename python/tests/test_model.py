"""Trained networks on the program's own kernels, without PyTorch."""

import pathlib
from typing import Any

import numpy as np
import pytest

import picofarm

SIDE = 16
BINS = 64
SPOTS = 4


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A store with rooms, networks of a few steps, and what the farm predicts with them."""
    folder = tmp_path_factory.mktemp("models")
    store = folder / "store"

    def train(name: str, target: str, **fields: Any) -> dict[str, Any]:
        net = {"levels": 3, "width": 4}
        optimise = {"epochs": 1, "batch": 2}
        spec = {"target": target, "model": name, "net": net, "optimise": optimise, **fields}
        return {"name": name, "kind": "train", "source": "render", "train": spec}

    stages: list[dict[str, Any]] = [
        {
            "name": "render",
            "kind": "render",
            "scenes": {"kind": "primitive", "seed": 1, "count": 6, "spots": SPOTS},
            "render": {"resolution": SIDE, "bins": BINS, "bin_width_m": 0.3, "samples": 4},
            "output": {"store": store, "dataset": "rooms"},
        },
        {"name": "split", "kind": "split", "source": "render", "split": {"counts": [4, 1, 1]}},
        train("tof", "tof"),
        train("lit", "shadow"),
        train("all", "shadow", shadow={"variant": "all"}),
        train("mirror", "specular"),
        {
            "name": "predict",
            "kind": "infer",
            "source": "render",
            "infer": {"models": ["tof", "lit", "mirror"]},
            "output": {"store": store, "dataset": "predicted"},
        },
    ]
    with picofarm.local(folder / "farm") as farm:
        farm.submit({"name": "networks", "stage": stages}).wait(progress=False)
    return store


def test_predictions_are_those_of_the_farm(store: pathlib.Path) -> None:
    zarr = pytest.importorskip("zarr")
    predicted = zarr.open_group(store / "predicted", mode="r")
    tof, lit, mirror = (picofarm.Model(store, name) for name in ("tof", "lit", "mirror"))
    assert tof.question["target"] == "tof"
    assert "tof" in repr(tof)
    for scene in picofarm.open(store / "rooms"):
        k = scene["scene"]
        depth = tof.predict(scene["transient"])
        assert depth.shape == (SIDE, SIDE)
        assert np.array_equal(depth, predicted["depth"][k])
        assert np.array_equal(depth, tof.predict(scene["transient"], threads=1))
        masks = lit.predict(
            scene["transient"],
            depth=depth,
            spots=scene["spots"],
            intrinsics=scene["intrinsics"],
        )
        assert masks.shape == (SPOTS, SIDE, SIDE)
        assert np.abs(masks * 255 - predicted["lit"][k]).max() < 0.51
        shiny = mirror.predict(scene["transient"])
        assert np.abs(shiny * 255 - predicted["specular"][k]).max() < 0.51


def test_unusable_inputs_are_refused_by_name(store: pathlib.Path) -> None:
    scene = picofarm.open(store / "rooms")[0]
    transient = scene["transient"]
    tof, lit = picofarm.Model(store, "tof"), picofarm.Model(store, "lit")
    assert picofarm.Model(store, "all").predict(transient).shape == (SPOTS, SIDE, SIDE)
    with pytest.raises(ValueError, match="transient: has 63 bins"):
        tof.predict(transient[:, :, 1:])
    with pytest.raises(ValueError, match="transient: has 15x16 pixels"):
        tof.predict(transient[:, 1:])
    with pytest.raises(ValueError, match="transient: expected 3 dimensions"):
        tof.predict(transient[0])
    with pytest.raises(ValueError, match="transient: expected finite numbers"):
        tof.predict(np.full_like(transient, np.nan))
    with pytest.raises(ValueError, match="depth: the model needs two-bounce times"):
        lit.predict(transient)
    given = {"depth": scene["depth"], "spots": scene["spots"], "intrinsics": scene["intrinsics"]}
    for name, value, match in [
        ("depth", scene["depth"][1:], "depth: expected 16x16"),
        ("spots", scene["spots"][1:], "spots: expected 4 rows"),
        ("spots", scene["spots"][:, :3], "spots: expected at least 4 columns"),
        ("intrinsics", [1, 2], "intrinsics"),
        ("intrinsics", [0, 1, 8, 8], "intrinsics"),
    ]:
        with pytest.raises(ValueError, match=match):
            lit.predict(transient, **{**given, name: value})
    with pytest.raises(ValueError, match="threads"):
        tof.predict(transient, threads=0)


def test_a_missing_model_is_named(store: pathlib.Path) -> None:
    with pytest.raises(ValueError, match="absent"):
        picofarm.Model(store, "absent")
