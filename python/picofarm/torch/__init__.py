"""Networks of the farm as PyTorch modules, and data for their training. Needs `picofarm[torch]`.

    import picofarm.torch

    model = picofarm.torch.load("picofarm-data/store", "tof")
    depth = model(render.transient)            # metres, [row, column]

Parameters have the names of the released code, so that weights fit both ways.
"""

# PyTorch states some of its types only in part.
# pyright: reportUnknownMemberType=false
from __future__ import annotations

import os
import pathlib
import tempfile
from collections.abc import Iterator, Mapping
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import nn

from .._data import Dataset, Stream
from .._farm import run
from ._networks import ARCHITECTURES, Embeddings, Nlost, SwinIR, Unet2d, Unet25d, loss, network

__all__ = [
    "ARCHITECTURES",
    "Embeddings",
    "Model",
    "Nlost",
    "Scenes",
    "SwinIR",
    "Unet2d",
    "Unet25d",
    "load",
    "loss",
    "metrics",
    "network",
    "normalised",
    "shadow_transient",
]

class Model(nn.Module):
    """A trained network with its input form."""

    def __init__(self, network: nn.Module, manifest: Mapping[str, Any]) -> None:
        super().__init__()
        self.network = network
        """The network alone."""
        self.manifest = dict(manifest)
        """Settings, plan, lineage and metrics of the model."""
        self.question: dict[str, Any] = manifest["plan"]["plan"]["question"]
        """Target and form of the input."""

    def forward(self, transient: ArrayLike, depth_path: ArrayLike | None = None) -> torch.Tensor:
        """Returns the prediction: z-depth in metres for `tof`, and otherwise a probability.

        Args:
            transient: Histograms of one scene, `[row, column, bin]`.
            depth_path: For shadows of a spot by `concat` or `difference`, the index of the bin of
                its two-bounce time, `[row, column]`; -1 outside of the gate.
        """
        question = self.question
        if question["variant"] == "evidence":
            raise ValueError("transient: the model reads evidence, not histograms; call `network`")
        planes = normalised(transient, question["bins"], question["normalise"])
        if question.get("intensity_only", False):
            raise ValueError("transient: the model reads intensities; call `network` with them")
        dense = planes[None]
        one_hot = None
        if question["target"] == "shadow" and question["variant"] in ("concat", "difference"):
            if depth_path is None:
                raise ValueError("depth_path: the model needs two-bounce times")
            one_hot = shadow_transient(depth_path, question["bins"])[None]
            if question["variant"] == "difference":
                dense, one_hot = (one_hot - dense).abs(), None
        elif question["target"] == "shadow" and question["variant"] == "index":
            raise ValueError("transient: the model is asked with planes of spots; call `network`")
        output = self.network(dense) if one_hot is None else self.network(dense, one_hot)
        if question["target"] == "tof":
            return output[0, 0] * question.get("depth_scale_m", 4.5)
        return torch.sigmoid(output[0] if question.get("variant") == "all" else output[0, 0])


def load(store: str | os.PathLike[str], name: str, *, device: str = "cpu") -> Model:
    """Returns a trained model of a store, in evaluation mode. Needs safetensors.

    Raises:
        FarmError: There is no such model.
    """
    from safetensors.torch import load_file  # pyright: ignore[reportUnknownVariableType]

    store = os.fspath(store)
    manifest = cast("dict[str, Any]", run(["model", "show", store, name])["manifest"])
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder, "weights.safetensors")
        run(["model", "export", store, name, "--out", str(file)])
        tensors = load_file(str(file))
    for key, tensor in tensors.items():
        if key.endswith("num_batches_tracked"):
            tensors[key] = tensor.reshape(()).long()
    module = network(manifest["plan"]["plan"]["net"])
    module.load_state_dict(tensors)
    return Model(module, manifest).to(device).eval()


def normalised(
    transient: ArrayLike, bins: int = 0, normalise: str | Mapping[str, Any] = "minmax"
) -> torch.Tensor:
    """Returns histograms as the networks read them: `[..., bin, row, column]`.

    Args:
        transient: `[..., row, column, bin]`.
        bins: Adjacent bins are summed to this number, and the rest is dropped; 0 = all.
        normalise: `minmax` of each pixel, or `{"log": {"greatest": value}}` with the greatest value
            of the data set (Shoot-Bounce-3D, appendix B).
    """
    h = torch.as_tensor(np.asarray(transient, np.float32))
    stored = h.shape[-1]
    bins = bins or stored
    if not 0 < bins <= stored:
        raise ValueError(f"bins: expected 0 to {stored}, found {bins}")
    merged = stored // bins
    if merged > 1:
        h = h[..., : merged * bins].unflatten(-1, (bins, merged)).sum(-1)
    else:
        h = h[..., :bins]
    if isinstance(normalise, Mapping):
        greatest = float(normalise["log"]["greatest"])
        h = ((torch.log10(h + 1e-8) + 8) / (np.log10(greatest) + 8)).clip(0, 1)
    else:
        least = h.amin(-1, keepdim=True)
        span = h.amax(-1, keepdim=True) - least
        h = torch.where(span > 0, (h - least) / span, torch.zeros(()))
    return h.movedim(-1, -3)


def shadow_transient(bin_index: ArrayLike, bins: int) -> torch.Tensor:
    """Returns two-bounce times as one-hot histograms, `[..., bin, row, column]`.

    Args:
        bin_index: Bin of the two-bounce time, `[..., row, column]`; -1 outside of the gate.
        bins: Number of bins.
    """
    index = torch.as_tensor(np.asarray(bin_index, np.int64))
    return (index[..., None, :, :] == torch.arange(bins)[:, None, None]).float()


def metrics(target: str, predicted: ArrayLike, truth: ArrayLike) -> dict[str, float]:
    """Returns `mae_m` and `rmse_m` of depths in metres, or `mae`, `iou` and `f1` of masks at a
    threshold of one half. The overlap of two empty masks is 1."""
    p, t = np.asarray(predicted, np.float64), np.asarray(truth, np.float64)
    if target == "tof":
        apart = p - t
        return {
            "mae_m": float(np.abs(apart).mean()),
            "rmse_m": float(np.sqrt(np.square(apart).mean())),
        }
    said, true = p > 0.5, t > 0.5
    both, either = int((said & true).sum()), int((said | true).sum())
    total = int(said.sum()) + int(true.sum())
    return {
        "mae": float((said != true).mean()),
        "iou": both / either if either else 1.0,
        "f1": 2 * both / total if total else 1.0,
    }


class Scenes(torch.utils.data.IterableDataset[dict[str, Any]]):
    """The scenes of a data set in a shuffled order, for a `DataLoader` with any number of workers.

    Each worker and each rank gets its own scenes. Threads read ahead. `state_dict` is supported by
    `StatefulDataLoader` of torchdata.

    Args:
        data: A data set of `picofarm.open`.
        options: Those of `picofarm.Dataset.stream`.
    """

    def __init__(self, data: Dataset, **options: Any) -> None:
        super().__init__()
        self.stream: Stream = data.stream(**options)

    def set_epoch(self, epoch: int) -> None:
        """Selects the order of an epoch."""
        self.stream.set_epoch(epoch)

    def state_dict(self) -> dict[str, int]:
        """Returns the position."""
        return self.stream.state_dict()

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Continues at a position."""
        self.stream.load_state_dict(state)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        worker = torch.utils.data.get_worker_info()
        if worker is not None:
            self.stream.share_among_workers(worker.id, worker.num_workers)
        return iter(self.stream)
