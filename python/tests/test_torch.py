"""Networks of a farm in PyTorch. Skipped without PyTorch."""

import pathlib
from typing import Any

import numpy as np
import pytest

import picofarm

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")
import picofarm.torch  # noqa: E402

SIDE = 16
BINS = 64


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A store with rooms, three networks of a few steps, and what the farm predicts with them."""
    folder = tmp_path_factory.mktemp("networks")
    store = folder / "store"
    render = {"resolution": SIDE, "bins": BINS, "bin_width_m": 0.3, "samples": 4}
    optimise = {"epochs": 1, "batch": 2}

    def train(name: str, target: str, **net: Any) -> dict[str, Any]:
        spec = {"target": target, "model": name, "net": {"levels": 3, **net}, "optimise": optimise}
        return {"name": name, "kind": "train", "source": "render", "train": spec}

    output = {"store": store, "dataset": "rooms"}
    stages: list[dict[str, Any]] = [
        {
            "name": "render",
            "kind": "render",
            "scenes": {"kind": "primitive", "seed": 1, "count": 6, "spots": 4},
            "render": render,
            "output": output,
        },
        {"name": "split", "kind": "split", "source": "render", "split": {"counts": [4, 1, 1]}},
        train("tof", "tof", width=4),
        train("lit", "shadow", width=4),
        train("volume", "tof", architecture="unet25d", width=2, time_features=8),
        {
            "name": "predict",
            "kind": "infer",
            "source": "render",
            "infer": {"models": ["tof"]},
            "output": {"store": store, "dataset": "predicted"},
        },
    ]
    with picofarm.local(folder / "farm") as farm:
        farm.submit({"name": "networks", "stage": stages}).wait(progress=False)
    return store


def test_a_loaded_network_predicts_what_the_farm_predicts(store: pathlib.Path) -> None:
    import json

    model = picofarm.torch.load(store, "tof")
    assert model.question["target"] == "tof"
    data = picofarm.open(store / "rooms")
    metadata = json.loads((store / "predicted" / "depth" / "zarr.json").read_text())
    assert metadata["shape"][1:] == [SIDE, SIDE]
    zarr = pytest.importorskip("zarr")
    predicted = zarr.open_group(store / "predicted", mode="r")["depth"]
    for scene in data:
        with torch.no_grad():
            depth = model(scene["transient"]).numpy()
        assert np.allclose(depth, predicted[scene["scene"]], atol=1e-4)


def test_networks_of_each_kind_are_loaded(store: pathlib.Path) -> None:
    scene = picofarm.open(store / "rooms")[0]
    volume = picofarm.torch.load(store, "volume")
    assert isinstance(volume.network, picofarm.torch.Unet25d)
    assert volume(scene["transient"]).shape == (SIDE, SIDE)
    lit = picofarm.torch.load(store, "lit")
    with pytest.raises(ValueError, match="depth_path"):
        lit(scene["transient"])
    probability = lit(scene["transient"], np.full((SIDE, SIDE), 20))
    assert probability.shape == (SIDE, SIDE)
    assert 0 <= float(probability.detach().min()) <= float(probability.detach().max()) <= 1


def test_histograms_are_normalised_as_in_the_paper() -> None:
    h = np.random.default_rng(1).random((3, 4, 10)).astype(np.float32)
    h[0, 0] = 7
    planes = picofarm.torch.normalised(h, 5)
    assert planes.shape == (5, 3, 4)
    assert float(planes[:, 0, 0].abs().max()) == 0
    assert torch.allclose(planes.amin(0), torch.zeros(3, 4))
    assert float(planes.amax(0)[1, 1]) == 1
    logarithm = picofarm.torch.normalised(h, 0, {"log": {"greatest": 7.0}})
    assert torch.allclose(logarithm[:, 0, 0], torch.ones(10))
    index = np.array([[2, -1]])
    one_hot = picofarm.torch.shadow_transient(index, 4)
    assert one_hot[:, 0, 0].tolist() == [0, 0, 1, 0]
    assert float(one_hot[:, 0, 1].sum()) == 0
    assert picofarm.torch.metrics("tof", [1, 2], [1, 4]) == {"mae_m": 1.0, "rmse_m": 2**0.5}
    assert picofarm.torch.metrics("shadow", [0.9, 0.2], [1, 1])["iou"] == 0.5
    spec = {"architecture": "unet2d", "dense": 5, "width": 4, "levels": 2}
    evidence = torch.randn(1, 5, 8, 8)
    plain = picofarm.torch.network(spec).eval()
    added = picofarm.torch.network({**spec, "added": True}).eval()
    added.load_state_dict(plain.state_dict())
    assert torch.allclose(added(evidence), plain(evidence) + evidence[:, -1:])
    with pytest.raises(ValueError, match="architecture"):
        picofarm.torch.network({"architecture": "unet4d"})


def test_loader_processes_share_an_epoch(dataset: str) -> None:
    data = picofarm.open(dataset, arrays=["transient", "depth"], threads=1)
    for workers in (0, 2):
        scenes = picofarm.torch.Scenes(data, seed=4)
        loader = torch.utils.data.DataLoader(scenes, batch_size=None, num_workers=workers)
        assert sorted(int(scene["scene"]) for scene in loader) == data.scenes
