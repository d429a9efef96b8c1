"""U-Nets of Shoot-Bounce-3D. Parameters have the names of the released code."""

# PyTorch states some of its types only in part.
# pyright: reportUnknownMemberType=false
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class SingleConv(nn.Sequential):
    """Convolution, batch norm and ReLU."""

    def __init__(self, inputs: int, outputs: int, three: bool = False) -> None:
        super().__init__()
        conv, norm = (nn.Conv3d, nn.BatchNorm3d) if three else (nn.Conv2d, nn.BatchNorm2d)
        self.add_module("conv", conv(inputs, outputs, 3, padding=1, bias=False))
        self.add_module("batchnorm", norm(outputs))
        self.add_module("ReLU", nn.ReLU(inplace=True))


class Block(nn.Module):
    """Two convolutions of a level."""

    def __init__(self, inputs: int, outputs: int, encoder: bool, three: bool = False) -> None:
        super().__init__()
        between = max(outputs // 2, inputs) if encoder else outputs
        self.basic_module = nn.Sequential()
        self.basic_module.add_module("SingleConv1", SingleConv(inputs, between, three))
        self.basic_module.add_module("SingleConv2", SingleConv(between, outputs, three))

    def forward(self, x: Tensor) -> Tensor:
        return self.basic_module(x)


class Decoding(nn.Module):
    """The two-dimensional decoder of both U-Nets."""

    def declare(self, widths: list[int], outputs: int) -> None:
        pairs = list(zip(widths, widths[1:]))[::-1]
        self.decoders = nn.ModuleList(
            Block(fine + coarse, fine, encoder=False) for fine, coarse in pairs
        )
        self.final_conv = nn.Conv2d(widths[0], outputs, 1)

    def decode(self, features: list[Tensor]) -> Tensor:
        x = features.pop()
        for block in self.decoders:
            skip = features.pop()
            x = block(torch.cat((skip, F.interpolate(x, size=skip.shape[-2:], mode="nearest")), 1))
        return self.final_conv(x)


class Unet2d(Decoding):
    """U-Net over images whose channels are the bins (Shoot-Bounce-3D, released code)."""

    def __init__(self, spec: Mapping[str, Any]) -> None:
        super().__init__()
        inputs = spec["dense"] + spec["one_hot"]
        widths = [spec["width"] << k for k in range(spec["levels"])]
        self.stem = None
        if spec["stem"] and spec.get("stem_form", "block") == "linear":
            self.stem = nn.Conv2d(inputs, spec["stem"], 1)
        elif spec["stem"]:
            self.stem = SingleConv(inputs, spec["stem"])
        inputs = spec["stem"] or inputs
        self.encoders = nn.ModuleList()
        for width in widths:
            self.encoders.append(Block(inputs, width, encoder=True))
            inputs = width
        self.declare(widths, spec["outputs"])
        self.frozen = spec.get("frozen", False)

    def train(self, mode: bool = True) -> Unet2d:
        super().train(mode)
        if self.frozen:
            for part in (self.encoders, self.stem):
                if part is not None:
                    part.eval().requires_grad_(False)
        return self

    def forward(self, dense: Tensor, one_hot: Tensor | None = None) -> Tensor:
        x = dense if one_hot is None else torch.cat((dense, one_hot), 1)
        if self.stem is not None:
            x = self.stem(x)
        features: list[Tensor] = []
        for i, block in enumerate(self.encoders):
            x = block(F.max_pool2d(x, 2) if i else x)
            features.append(x)
        return self.decode(features)


class Unet25d(Decoding):
    """U-Net with a three-dimensional encoder and a two-dimensional decoder (Shoot-Bounce-3D,
    appendix B).

    A 1×1 convolution projects the bins of each input to `time` moments. The inputs are channels of
    a volume of moments × rows × columns. Linear layers over time reduce the moments of each level
    to one for the decoder.
    """

    # Appendix B: the moments of a level, and the widths of its layers.
    OVER_TIME: Mapping[int, tuple[int, ...]] = {160: (128, 32, 1), 80: (64, 32, 1), 40: (32, 1), 20: (16, 1)}

    def __init__(self, spec: Mapping[str, Any]) -> None:
        super().__init__()
        moments, levels = spec["time"], spec["levels"]
        streams = 2 if spec["one_hot"] else 1
        widths = [spec["width"] << k for k in range(levels)]
        if spec.get("time_projection", "shared") == "shared":
            self.time_projection = nn.Conv2d(spec["dense"], moments, kernel_size=1)
        else:
            self.time_projections = nn.ModuleList(
                nn.Conv2d(spec["dense"], moments, kernel_size=1) for _ in range(streams)
            )
        self.encoders = nn.ModuleList(
            Block(inputs, outputs, encoder=True, three=True)
            for inputs, outputs in zip([streams] + widths, widths)
        )
        self.skip_projections = nn.ModuleList(
            self.over_time(moments >> level) for level in range(levels)
        )
        self.declare(widths, spec["outputs"])

    @classmethod
    def over_time(cls, moments: int) -> nn.Sequential:
        if moments in cls.OVER_TIME:
            widths = cls.OVER_TIME[moments]
        elif moments <= 2:
            widths = (1,)
        else:
            # The same rule for other lengths: the greatest smaller power of two, 32, one.
            power = max(p for p in (1 << k for k in range(13)) if p < moments)
            widths = (power, 32, 1) if power > 32 else (power, 1)
        layers: list[nn.Module] = []
        last = moments
        for width in widths:
            layers += [nn.ReLU(), nn.Linear(last, width)]
            last = width
        return nn.Sequential(*layers[1:])

    def to_moments(self, streams: list[Tensor]) -> list[Tensor]:
        if hasattr(self, "time_projection"):
            return [self.time_projection(stream) for stream in streams]
        return [layer(stream) for layer, stream in zip(self.time_projections, streams)]

    def forward(self, dense: Tensor, one_hot: Tensor | None = None) -> Tensor:
        streams = [dense] if one_hot is None else [dense, one_hot]
        volume = torch.stack(self.to_moments(streams), dim=1)  # N, streams, T, H, W
        features: list[Tensor] = []
        for level, block in enumerate(self.encoders):
            volume = block(F.max_pool3d(volume, 2) if level else volume)
            flat = self.skip_projections[level](volume.permute(0, 1, 3, 4, 2))
            features.append(flat[..., 0])
        return self.decode(features)
