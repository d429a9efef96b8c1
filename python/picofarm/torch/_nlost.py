"""NLOST: attention over image and time, near and far."""

# PyTorch states some of its types only in part.
# pyright: reportUnknownMemberType=false
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ._embeddings import Downnet, Rendering, Residual, greatest, normalised
from ._swinir import Perceptron, WindowAttention, from_windows, to_windows


class Nlost(nn.Module):
    """NLOST (Li et al., CVPR 2023) without migration of light. Halves rows and columns. Parameters
    have the names of the released code.
    """

    def __init__(self, spec: Mapping[str, Any]) -> None:
        super().__init__()
        streams = 2 if spec["one_hot"] else 1
        width, features = spec["width"], streams + 3
        moments = -(-spec["dense"] // 32)
        self.sig_expand = Downnet(streams, 3)
        self.msfeat = Scales(features, width // 4)
        self.sig_feat = HalfTime(width)
        self.dsfusion = Fusion(width)
        self.spds = HalfImage(width)
        self.posenc_l, self.posenc_g = Positions(width), Positions(width)
        self.loc_encds = nn.ModuleList([SeparateEncoder(width, 16, moments)])
        self.glb_encds = nn.ModuleList([SeparateEncoder(width)])
        self.locglb_inte = NearAndFar(width)
        self.inte_rec = Joining(width, features)
        self.dep_refine = Rendering(2 * features, spec["outputs"])

    def forward(self, dense: Tensor, one_hot: Tensor | None = None) -> Tensor:
        x = torch.stack([dense] if one_hot is None else [dense, one_hot], 1)
        shallow = self.msfeat(normalised(self.sig_expand(x)))
        fine = self.dsfusion(self.sig_feat(shallow))
        coarse = self.spds(fine)
        near = self.loc_encds[0](self.posenc_l(fine))
        far = self.glb_encds[0](self.posenc_g(coarse))
        near, far = self.locglb_inte(near, far)
        return self.dep_refine(greatest(self.inte_rec(shallow, near, far)))


class Fusion(nn.Module):
    """Quarters time."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.ds = nn.Sequential(
            nn.Conv3d(width, width, 5, stride=(2, 1, 1), padding=2),
            nn.ReLU(),
            nn.Conv3d(width, width, 5, stride=(2, 1, 1), padding=2),
            nn.ReLU(),
        )
        self.fusion = nn.Sequential(nn.Conv3d(width, width, 1), nn.ReLU())

    def forward(self, x: Tensor) -> Tensor:
        return self.fusion(self.ds(x))


class HalfImage(nn.Module):
    """Halves rows and columns."""

    def __init__(self, width: int) -> None:
        super().__init__()
        conv = nn.Conv3d(width, width, 5, stride=(1, 2, 2), padding=2)
        self.dsop = nn.Sequential(conv, nn.ReLU())

    def forward(self, x: Tensor) -> Tensor:
        return self.dsop(x)


class TwiceImage(nn.Module):
    """Doubles rows and columns."""

    def __init__(self, width: int) -> None:
        super().__init__()
        up = nn.ConvTranspose3d(
            width, width, (3, 6, 6), stride=(1, 2, 2), padding=(1, 2, 2), bias=False
        )
        self.upop = nn.Sequential(nn.Sequential(up, nn.ReLU()))

    def forward(self, x: Tensor) -> Tensor:
        return self.upop(x)


class NearAndFar(nn.Module):
    """Lets the features of windows and those of the whole image ask each other."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.upop_G = TwiceImage(width)
        self.loc_decs = nn.ModuleList([CrossDecoder(width)])
        self.glb_decs = nn.ModuleList([CrossDecoder(width)])

    def forward(self, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
        far = self.upop_G(far)
        return self.loc_decs[0](near, far), self.glb_decs[0](far, near)


class Joining(nn.Module):
    """Joins all features, at the moments of the shallow ones."""

    def __init__(self, width: int, features: int) -> None:
        super().__init__()
        self.tmup1, self.tmup2 = MoreMoments(width), MoreMoments(width)
        self.fuse = nn.Sequential(
            nn.Conv3d(3 * width, width, 3, padding=1),
            nn.LeakyReLU(0.2),
            nn.Conv3d(width, features, 3, padding=1),
        )

    def forward(self, shallow: Tensor, near: Tensor, far: Tensor) -> Tensor:
        moments = shallow.shape[2]
        near, far = self.tmup1(near)[:, :, :moments], self.tmup2(far)[:, :, :moments]
        return self.fuse(torch.cat((shallow, far, near), 1))


class Scales(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()

        def conv(inputs: int, dilation: int, stride: int) -> nn.Sequential:
            layer = nn.Conv3d(
                inputs, outputs, 3, stride=(stride, 1, 1), padding=dilation, dilation=dilation
            )
            return nn.Sequential(layer, nn.ReLU())

        self.conv1, self.conv2 = conv(inputs, 1, 2), conv(inputs, 2, 2)
        self.conv3, self.conv4 = conv(outputs, 1, 1), conv(outputs, 2, 1)

    def forward(self, x: Tensor) -> Tensor:
        one, two = self.conv1(x), self.conv2(x)
        return torch.cat((one, two, self.conv3(two), self.conv4(one)), 1)


class HalfTime(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        box = torch.zeros(width, width, 3, 3, 3)
        box[..., 1:, 1:, 1:] = 1
        self.weights = nn.Parameter(box / box.sum())
        self.conv1 = nn.Sequential(
            nn.ReplicationPad3d(1),
            nn.Conv3d(width, width, 3, stride=(2, 1, 1)),
            Residual(width, True),
            Residual(width, True),
        )

    def forward(self, x: Tensor) -> Tensor:
        return F.conv3d(x, self.weights, stride=(2, 1, 1), padding=1) + self.conv1(x)


class Positions(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.proj = nn.Conv3d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.proj(x)


class MoreMoments(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()

        def up(inputs: int, outputs: int) -> nn.ConvTranspose3d:
            return nn.ConvTranspose3d(
                inputs, outputs, (6, 3, 3), stride=(2, 1, 1), padding=(2, 1, 1), bias=False
            )

        self.temup = nn.Sequential(
            nn.Sequential(up(width, width // 2), nn.ReLU()),
            nn.Sequential(up(width // 2, width // 4), nn.ReLU()),
            nn.Sequential(up(width // 4, width)),
        )

    def forward(self, x: Tensor) -> Tensor:
        return self.temup(x)


class MomentAttention(WindowAttention):
    """Attention over time with a bias for each difference of moments."""

    def __init__(self, channels: int, moments: int, heads: int) -> None:
        super().__init__(channels, 1, heads)
        self.relative_position_bias_table = nn.Parameter(torch.zeros(2 * moments - 1, heads))
        moment = torch.arange(moments)
        self.index = moment[None, :] - moment[:, None] + moments - 1


class PlainAttention(nn.Module):
    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(channels, 3 * channels, bias=False)
        self.proj = nn.Linear(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        rows, tokens, channels = x.shape
        q, k, v = self.qkv(x).view(rows, tokens, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        x = F.scaled_dot_product_attention(q, k, v)
        return self.proj(x.transpose(1, 2).reshape(rows, tokens, channels))


class SeparateEncoder(nn.Module):
    """Attention over the image, then over time."""

    def __init__(self, width: int, window: int = 0, moments: int = 0, heads: int = 4) -> None:
        super().__init__()
        self.window = window
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        if window:
            self.attn_hw, self.attn_t = (
                WindowAttention(width, window, heads),
                MomentAttention(width, moments, heads),
            )
        else:
            self.attn_hw, self.attn_t = PlainAttention(width, heads), PlainAttention(width, heads)
        self.mlp = Perceptron(width, 4 * width)

    def forward(self, x: Tensor) -> Tensor:
        n, c, t, h, w = x.shape
        x = x.permute(0, 2, 3, 4, 1)
        y = self.norm1(x).reshape(n * t, h, w, c)
        if self.window:
            y = from_windows(self.attn_hw(to_windows(y, self.window)), self.window, h, w)
        else:
            y = self.attn_hw(y.reshape(n * t, h * w, c))
        y = y.reshape(n, t, h * w, c).transpose(1, 2).reshape(n * h * w, t, c)
        y = self.attn_t(y).reshape(n, h, w, t, c).permute(0, 3, 1, 2, 4)
        x = x + y
        x = x + self.mlp(self.norm2(x))
        return x.permute(0, 4, 1, 2, 3)


class GroupedSums(nn.Module):
    """Compact generalised non-local attention. Inputs are (rows, channels, places)."""

    def __init__(self, channels: int, scale: float) -> None:
        super().__init__()
        self.groups = 8 if channels % 8 == 0 else 4
        self.t, self.p, self.g = (nn.Conv1d(channels, channels, 1, bias=False) for _ in range(3))
        self.z = nn.Conv1d(channels, channels, 1, groups=self.groups, bias=False)
        self.gn = nn.GroupNorm(self.groups, channels)
        nn.init.constant_(self.gn.weight, scale)
        nn.init.constant_(self.gn.bias, 0)

    def forward(self, asks: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        rows, channels, _ = values.shape
        t, p, g = self.t(values), self.p(asks), self.g(keys)
        grouped = (rows, self.groups, -1)
        product = (p.reshape(grouped) * g.reshape(grouped)).sum(2, keepdim=True) * (
            channels // self.groups
        ) ** -0.5
        return self.gn(self.z((t.reshape(grouped) * product).reshape(t.shape)))


class Sums(nn.Module):
    def __init__(self, channels: int, scale: float) -> None:
        super().__init__()
        self.attn = GroupedSums(channels, scale)

    def forward(self, asks: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        return self.attn(asks, keys, values)


class CrossDecoder(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm1, self.norm12, self.norm2 = (nn.LayerNorm(width) for _ in range(3))
        self.attn_hw, self.attn_t = Sums(width, 1.0), Sums(width, 0.0)
        self.mlp = Perceptron(width, 4 * width)

    def forward(self, x: Tensor, asks: Tensor) -> Tensor:
        n, c, t, h, w = x.shape
        x, asks = x.permute(0, 2, 3, 4, 1), asks.permute(0, 2, 3, 4, 1)
        own, asks = self.norm1(x), self.norm12(asks)

        def over_image(y: Tensor) -> Tensor:
            return y.reshape(n * t, h * w, c).transpose(1, 2)

        def over_time(y: Tensor) -> Tensor:
            return y.reshape(n, t, h * w, c).permute(0, 2, 3, 1).reshape(n * h * w, c, t)

        said = self.attn_hw(over_image(asks), over_image(own), over_image(own)).transpose(1, 2)
        said = self.attn_t(over_time(asks), over_time(said), over_time(said))
        x = x + said.reshape(n, h, w, c, t).permute(0, 4, 1, 2, 3)
        x = x + self.mlp(self.norm2(x))
        return x.permute(0, 4, 1, 2, 3)
