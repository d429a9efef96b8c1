"""Learned feature embeddings: a volume of features, and images of their greatest values."""

# PyTorch states some of its types only in part.
# pyright: reportUnknownMemberType=false
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class Residual(nn.Module):
    def __init__(self, channels: int, three: bool = False) -> None:
        super().__init__()
        pad, conv = (nn.ReplicationPad3d, nn.Conv3d) if three else (nn.ReplicationPad2d, nn.Conv2d)
        self.tmp = nn.Sequential(
            pad(1),
            conv(channels, channels, 3),
            nn.LeakyReLU(0.2),
            pad(1),
            conv(channels, channels, 3),
        )

    def forward(self, x: Tensor) -> Tensor:
        return F.leaky_relu(self.tmp(x) + x, 0.2)


class Downnet(nn.Module):
    """Halves time, rows and columns, by a filter and by convolutions."""

    def __init__(self, streams: int, width: int) -> None:
        super().__init__()
        box = torch.zeros(streams, 1, 3, 3, 3)
        box[..., 1:, 1:, 1:] = 1 / 8
        self.weights = nn.Parameter(box)
        self.conv1 = nn.Sequential(
            nn.ReplicationPad3d(1),
            nn.Conv3d(streams, width, 3, stride=2),
            Residual(width, True),
            Residual(width, True),
        )

    def forward(self, x: Tensor) -> Tensor:
        filtered = F.conv3d(x, self.weights, stride=2, padding=1, groups=x.shape[1])
        return torch.cat((filtered, self.conv1(x)), 1)


class Rendering(nn.Module):
    """Network over images of the greatest values over time, and of their moments."""

    def __init__(self, channels: int, outputs: int) -> None:
        super().__init__()
        self.weights = nn.Parameter(torch.tensor([0.0, 1.0]).repeat(outputs, 1)[..., None, None])
        self.conv1 = nn.Sequential(
            nn.ReplicationPad2d(1),
            nn.Conv2d(channels, channels, 3),
            Residual(channels),
            Residual(channels),
        )
        twice = 2 * channels
        self.conv2 = nn.Sequential(
            nn.ReplicationPad2d(1),
            nn.Conv2d(channels + outputs, twice, 3),
            Residual(twice),
            Residual(twice),
            nn.ReplicationPad2d(1),
            nn.Conv2d(twice, outputs, 3),
        )

    def forward(self, x: Tensor) -> Tensor:
        def double(y: Tensor) -> Tensor:
            return F.interpolate(y, scale_factor=2, mode="bilinear", align_corners=False)

        raw = F.conv2d(double(x[:, [0, x.shape[1] // 2]]), self.weights)
        return raw + self.conv2(torch.cat((raw, double(self.conv1(x))), 1))


class Embeddings(nn.Module):
    """Learned feature embeddings (Chen et al., SIGGRAPH Asia 2020) without migration of light.
    Parameters have the names of the released code.
    """

    def __init__(self, spec: Mapping[str, Any]) -> None:
        super().__init__()
        streams = 2 if spec["one_hot"] else 1
        self.downnet = Downnet(streams, spec["width"])
        self.depth = Rendering(2 * (spec["width"] + streams), spec["outputs"])

    def forward(self, dense: Tensor, one_hot: Tensor | None = None) -> Tensor:
        x = torch.stack([dense] if one_hot is None else [dense, one_hot], 1)
        return self.depth(greatest(normalised(self.downnet(x))))


def normalised(x: Tensor) -> Tensor:
    flat = F.relu(x).reshape(*x.shape[:2], -1)
    flat = flat - flat.min(2, keepdim=True)[0]
    flat = flat / (flat.max(2, keepdim=True)[0] + 1e-15)
    return flat.view(x.shape)


def greatest(x: Tensor) -> Tensor:
    values, moments = x.max(2)
    return torch.cat((values, moments / max(x.shape[2] - 1, 1)), 1)
