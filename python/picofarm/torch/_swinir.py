"""SwinIR: attention in windows of an image."""

# PyTorch states some of its types only in part.
# pyright: reportUnknownMemberType=false
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class WindowAttention(nn.Module):
    def __init__(self, channels: int, window: int, heads: int) -> None:
        super().__init__()
        self.heads, self.scale = heads, (channels // heads) ** -0.5
        self.relative_position_bias_table = nn.Parameter(torch.zeros((2 * window - 1) ** 2, heads))
        coords = torch.stack(
            torch.meshgrid(torch.arange(window), torch.arange(window), indexing="ij")
        ).flatten(1)
        relative = (coords[:, :, None] - coords[:, None, :]).permute(1, 2, 0) + window - 1
        self.index = relative[..., 0] * (2 * window - 1) + relative[..., 1]
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        windows, tokens, channels = x.shape
        qkv = self.qkv(x).view(windows, tokens, 3, self.heads, channels // self.heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        attention = (q * self.scale) @ k.transpose(-2, -1)
        bias = self.relative_position_bias_table[self.index.flatten()].view(
            tokens, tokens, self.heads
        )
        attention = attention + bias.permute(2, 0, 1)
        if mask is not None:
            attention = attention.view(-1, len(mask), self.heads, tokens, tokens) + mask[:, None]
            attention = attention.view(windows, self.heads, tokens, tokens)
        x = attention.softmax(-1) @ v
        return self.proj(x.transpose(1, 2).reshape(windows, tokens, channels))


def to_windows(x: Tensor, window: int) -> Tensor:
    n, h, w, c = x.shape
    x = x.view(n, h // window, window, w // window, window, c)
    return x.permute(0, 1, 3, 2, 4, 5).reshape(-1, window * window, c)


def from_windows(x: Tensor, window: int, h: int, w: int) -> Tensor:
    x = x.view(-1, h // window, w // window, window, window, x.shape[-1])
    return x.permute(0, 1, 3, 2, 4, 5).reshape(-1, h, w, x.shape[-1])


class Perceptron(nn.Module):
    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(channels, hidden), nn.Linear(hidden, channels)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(x)))


class SwinBlock(nn.Module):
    def __init__(self, channels: int, window: int, heads: int, shifted: bool) -> None:
        super().__init__()
        self.window, self.shifted = window, shifted
        self.norm1 = nn.LayerNorm(channels)
        self.attn = WindowAttention(channels, window, heads)
        self.norm2 = nn.LayerNorm(channels)
        self.mlp = Perceptron(channels, 2 * channels)

    def mask(self, h: int, w: int, shift: int) -> Tensor:
        image = torch.zeros(1, h, w, 1)
        parts = (slice(0, -self.window), slice(-self.window, -shift), slice(-shift, None))
        for i, rows in enumerate(parts):
            for j, columns in enumerate(parts):
                image[:, rows, columns] = 3 * i + j
        windows = to_windows(image, self.window).squeeze(-1)
        apart = windows[:, None, :] - windows[:, :, None]
        return apart.masked_fill(apart != 0, -100.0)

    def forward(self, x: Tensor) -> Tensor:
        _, h, w, _ = x.shape
        shift = self.window // 2 if self.shifted and min(h, w) > self.window else 0
        y = torch.roll(self.norm1(x), (-shift, -shift), (1, 2))
        y = self.attn(
            to_windows(y, self.window), self.mask(h, w, shift).to(y.device) if shift else None
        )
        y = torch.roll(from_windows(y, self.window, h, w), (shift, shift), (1, 2))
        x = x + y
        return x + self.mlp(self.norm2(x))


class SwinBlocks(nn.Module):
    def __init__(self, channels: int, depth: int, window: int, heads: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(
            SwinBlock(channels, window, heads, shifted=bool(i % 2)) for i in range(depth)
        )

    def forward(self, x: Tensor) -> Tensor:
        for block in self.blocks:
            x = block(x)
        return x


class SwinGroup(nn.Module):
    def __init__(self, channels: int, depth: int, window: int, heads: int) -> None:
        super().__init__()
        self.residual_group = SwinBlocks(channels, depth, window, heads)
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        y = self.residual_group(x)
        return self.conv(y.permute(0, 3, 1, 2)).permute(0, 2, 3, 1) + x


class Norm(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        return self.norm(x)


class SwinIR(nn.Module):
    """SwinIR (Liang et al., ICCVW 2021) without upsampling, and without the sum of input and output.
    Parameters have the names of the released code.
    """

    def __init__(self, spec: Mapping[str, Any]) -> None:
        super().__init__()
        swin = {"groups": 4, "depth": 6, "heads": 6, "window": 8} | spec.get("swin", {})
        width = spec["width"]
        self.conv_first = nn.Conv2d(spec["dense"] + spec["one_hot"], width, 3, padding=1)
        self.patch_embed = Norm(width)
        self.layers = nn.ModuleList(
            SwinGroup(width, swin["depth"], swin["window"], swin["heads"])
            for _ in range(swin["groups"])
        )
        self.norm = nn.LayerNorm(width)
        self.conv_after_body = nn.Conv2d(width, width, 3, padding=1)
        self.conv_last = nn.Conv2d(width, spec["outputs"], 3, padding=1)

    def forward(self, dense: Tensor, one_hot: Tensor | None = None) -> Tensor:
        first = self.conv_first(dense if one_hot is None else torch.cat((dense, one_hot), 1))
        x = self.patch_embed(first.permute(0, 2, 3, 1))
        for layer in self.layers:
            x = layer(x)
        x = self.norm(x).permute(0, 3, 1, 2)
        return self.conv_last(self.conv_after_body(x) + first)
