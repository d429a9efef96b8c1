"""Networks by the names of job files, and the losses of the paper."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn
from torch.nn import functional as F

from ._embeddings import Embeddings
from ._nlost import Nlost
from ._swinir import SwinIR
from ._unets import Unet2d, Unet25d

ARCHITECTURES: dict[str, type[nn.Module]] = {
    "unet2d": Unet2d,
    "unet25d": Unet25d,
    "swinir": SwinIR,
    "embeddings": Embeddings,
    "nlost": Nlost,
}
"""Networks by the names that job files use."""


def network(spec: Mapping[str, Any]) -> nn.Module:
    """Returns an untrained network.

    Args:
        spec: `architecture`, `dense` (channels of the input: bins), `one_hot` (bins of the shadow
            transient, 0 without it), `outputs`, and the fields of `net` in a job file.
            `picofarm model show --json` prints that of a trained network.

    Raises:
        ValueError: The architecture is unknown.
    """
    name = spec.get("architecture")
    if name not in ARCHITECTURES:
        known = ", ".join(ARCHITECTURES)
        raise ValueError(f"architecture: expected one of {known}, found {name!r}")
    whole = {"width": 128, "levels": 6, "stem": 0, "time": 0, "one_hot": 0, "outputs": 1, **spec}
    module = ARCHITECTURES[name](whole)
    if spec.get("added", False):
        # A network over evidence corrects the log odds in the last channel.
        module.register_forward_hook(lambda _, inputs, output: output + inputs[0][:, -1:])
    return module


def loss(target: str, output: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Returns the loss of the paper: L1 for `tof`, cross-entropy for `shadow` and `specular`.

    `truth` is z-depth over `depth_scale_m`, or a mask.
    """
    if target == "tof":
        return F.l1_loss(output, truth)
    return F.binary_cross_entropy_with_logits(output, truth)
