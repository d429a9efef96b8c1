"""The networks of picofarm in PyTorch: the same numbers, and how long they take.

usage: model_torch.py parity FILE...
       model_torch.py bench [--channels-last] [--device cuda [--tf32]] FILE

FILE comes from `just lab model --record FILE`: weights, a batch, and what picofarm made of them. `parity` computes
the same and fails where outputs differ by more than 1e-4, a gradient by more than 1e-3 of its norm, or the losses of the
steps of AdamW by more than 1e-3 (NLOST: 1e-2); in bfloat16 (`--precision bf16`, autocast here), where the gradient as a whole differs by
more than rounding moves PyTorch's own. `bench` takes steps when told to: it reads numbers of steps line by line and answers with
seconds (`just lab model --peer` does that between its own); on an NVIDIA card with `--device cuda`, in 32 bits there unless
`--tf32` lets products be rounded to 19 bits. Needs torch and safetensors.
"""

import argparse
import json
import sys
import time

import torch
from safetensors import safe_open
from torch import nn
from torch.nn import functional as F


class SingleConv(nn.Sequential):
    def __init__(self, inputs, outputs, three=False):
        super().__init__()
        conv, norm = (nn.Conv3d, nn.BatchNorm3d) if three else (nn.Conv2d, nn.BatchNorm2d)
        self.add_module("conv", conv(inputs, outputs, 3, padding=1, bias=False))
        self.add_module("batchnorm", norm(outputs))
        self.add_module("ReLU", nn.ReLU(inplace=True))


class Block(nn.Module):
    def __init__(self, inputs, outputs, encoder, three=False):
        super().__init__()
        between = max(outputs // 2, inputs) if encoder else outputs
        self.basic_module = nn.Sequential()
        self.basic_module.add_module("SingleConv1", SingleConv(inputs, between, three))
        self.basic_module.add_module("SingleConv2", SingleConv(between, outputs, three))

    def forward(self, x):
        return self.basic_module(x)


class Decoding(nn.Module):
    """The 2D decoder that both networks have."""

    def declare(self, widths, outputs):
        pairs = list(zip(widths, widths[1:]))[::-1]
        self.decoders = nn.ModuleList(Block(fine + coarse, fine, encoder=False) for fine, coarse in pairs)
        self.final_conv = nn.Conv2d(widths[0], outputs, 1)

    def decode(self, features):
        x = features.pop()
        for block in self.decoders:
            skip = features.pop()
            x = block(torch.cat((skip, F.interpolate(x, size=skip.shape[-2:], mode="nearest")), 1))
        return self.final_conv(x)


class Unet2d(Decoding):
    def __init__(self, spec):
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

    def train(self, mode=True):
        super().train(mode)
        if self.frozen:
            for part in (self.encoders, self.stem):
                if part is not None:
                    part.eval().requires_grad_(False)
        return self

    def forward(self, dense, one_hot=None):
        x = dense if one_hot is None else torch.cat((dense, one_hot), 1)
        if self.stem is not None:
            x = self.stem(x)
        features = []
        for i, block in enumerate(self.encoders):
            x = block(F.max_pool2d(x, 2) if i else x)
            features.append(x)
        return self.decode(features)


class Unet25d(Decoding):
    """Written from the description of the network, not from picofarm's code.

    A 1x1 convolution takes each stream's bins to T moments: one layer for both streams, as released; a layer each where the
    trial says so. The streams are channels of a volume of T x H x W. The encoder is the 2D one with three-dimensional
    convolutions, norms and pooling. Linear layers over time with ReLU between them take each level's moments to one, and
    the 2D decoder goes on from there.
    """

    # Appendix B: a level's moments, and the widths of its layers from there to one.
    OVER_TIME = {160: (128, 32, 1), 80: (64, 32, 1), 40: (32, 1), 20: (16, 1)}

    def __init__(self, spec):
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
            Block(inputs, outputs, encoder=True, three=True) for inputs, outputs in zip([streams] + widths, widths)
        )
        self.skip_projections = nn.ModuleList(self.over_time(moments >> level) for level in range(levels))
        self.declare(widths, spec["outputs"])

    @classmethod
    def over_time(cls, moments):
        if moments in cls.OVER_TIME:
            widths = cls.OVER_TIME[moments]
        elif moments <= 2:
            widths = (1,)
        else:
            # The same rule for other lengths: the greatest power of two below, then 32 where that is greater, then one.
            power = max(p for p in (1 << k for k in range(13)) if p < moments)
            widths = (power, 32, 1) if power > 32 else (power, 1)
        layers, last = [], moments
        for width in widths:
            layers += [nn.ReLU(), nn.Linear(last, width)]
            last = width
        return nn.Sequential(*layers[1:])

    def to_moments(self, streams):
        if hasattr(self, "time_projection"):
            return [self.time_projection(stream) for stream in streams]
        return [layer(stream) for layer, stream in zip(self.time_projections, streams)]

    def forward(self, dense, one_hot=None):
        streams = [dense] if one_hot is None else [dense, one_hot]
        volume = torch.stack(self.to_moments(streams), dim=1)  # N, streams, T, H, W
        features = []
        for level, block in enumerate(self.encoders):
            volume = block(F.max_pool3d(volume, 2) if level else volume)
            flat = self.skip_projections[level](volume.permute(0, 1, 3, 4, 2))
            features.append(flat[..., 0])
        return self.decode(features)


class WindowAttention(nn.Module):
    def __init__(self, channels, window, heads):
        super().__init__()
        self.heads, self.scale = heads, (channels // heads) ** -0.5
        self.relative_position_bias_table = nn.Parameter(torch.zeros((2 * window - 1) ** 2, heads))
        coords = torch.stack(torch.meshgrid(torch.arange(window), torch.arange(window), indexing="ij")).flatten(1)
        relative = (coords[:, :, None] - coords[:, None, :]).permute(1, 2, 0) + window - 1
        self.index = relative[..., 0] * (2 * window - 1) + relative[..., 1]
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)

    def forward(self, x, mask=None):
        windows, tokens, channels = x.shape
        qkv = self.qkv(x).view(windows, tokens, 3, self.heads, channels // self.heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        attention = (q * self.scale) @ k.transpose(-2, -1)
        bias = self.relative_position_bias_table[self.index.flatten()].view(tokens, tokens, self.heads)
        attention = attention + bias.permute(2, 0, 1)
        if mask is not None:
            attention = attention.view(-1, len(mask), self.heads, tokens, tokens) + mask[:, None]
            attention = attention.view(windows, self.heads, tokens, tokens)
        x = attention.softmax(-1) @ v
        return self.proj(x.transpose(1, 2).reshape(windows, tokens, channels))


def to_windows(x, window):
    n, h, w, c = x.shape
    x = x.view(n, h // window, window, w // window, window, c)
    return x.permute(0, 1, 3, 2, 4, 5).reshape(-1, window * window, c)


def from_windows(x, window, h, w):
    x = x.view(-1, h // window, w // window, window, window, x.shape[-1])
    return x.permute(0, 1, 3, 2, 4, 5).reshape(-1, h, w, x.shape[-1])


class SwinBlock(nn.Module):
    def __init__(self, channels, window, heads, shifted):
        super().__init__()
        self.window, self.shifted = window, shifted
        self.norm1 = nn.LayerNorm(channels)
        self.attn = WindowAttention(channels, window, heads)
        self.norm2 = nn.LayerNorm(channels)
        self.mlp = nn.Module()
        self.mlp.fc1 = nn.Linear(channels, 2 * channels)
        self.mlp.fc2 = nn.Linear(2 * channels, channels)

    def mask(self, h, w, shift):
        image = torch.zeros(1, h, w, 1)
        parts = (slice(0, -self.window), slice(-self.window, -shift), slice(-shift, None))
        for i, rows in enumerate(parts):
            for j, columns in enumerate(parts):
                image[:, rows, columns] = 3 * i + j
        windows = to_windows(image, self.window).squeeze(-1)
        apart = windows[:, None, :] - windows[:, :, None]
        return apart.masked_fill(apart != 0, -100.0)

    def forward(self, x):
        _, h, w, _ = x.shape
        shift = self.window // 2 if self.shifted and min(h, w) > self.window else 0
        y = torch.roll(self.norm1(x), (-shift, -shift), (1, 2))
        y = self.attn(to_windows(y, self.window), self.mask(h, w, shift).to(y.device) if shift else None)
        y = torch.roll(from_windows(y, self.window, h, w), (shift, shift), (1, 2))
        x = x + y
        return x + self.mlp.fc2(F.gelu(self.mlp.fc1(self.norm2(x))))


class SwinGroup(nn.Module):
    def __init__(self, channels, depth, window, heads):
        super().__init__()
        self.residual_group = nn.Module()
        self.residual_group.blocks = nn.ModuleList(
            SwinBlock(channels, window, heads, shifted=bool(i % 2)) for i in range(depth)
        )
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x):
        y = x
        for block in self.residual_group.blocks:
            y = block(y)
        return self.conv(y.permute(0, 3, 1, 2)).permute(0, 2, 3, 1) + x


class SwinIR(nn.Module):
    """Written from the paper and its released code, whose names the parameters have; without upsampling, and without the
    input in the output."""

    def __init__(self, spec):
        super().__init__()
        swin = {"groups": 4, "depth": 6, "heads": 6, "window": 8} | spec.get("swin", {})
        width = spec["width"]
        self.conv_first = nn.Conv2d(spec["dense"] + spec["one_hot"], width, 3, padding=1)
        self.patch_embed = nn.Module()
        self.patch_embed.norm = nn.LayerNorm(width)
        self.layers = nn.ModuleList(
            SwinGroup(width, swin["depth"], swin["window"], swin["heads"]) for _ in range(swin["groups"])
        )
        self.norm = nn.LayerNorm(width)
        self.conv_after_body = nn.Conv2d(width, width, 3, padding=1)
        self.conv_last = nn.Conv2d(width, spec["outputs"], 3, padding=1)

    def forward(self, dense, one_hot=None):
        first = self.conv_first(dense if one_hot is None else torch.cat((dense, one_hot), 1))
        x = self.patch_embed.norm(first.permute(0, 2, 3, 1))
        for layer in self.layers:
            x = layer(x)
        x = self.norm(x).permute(0, 3, 1, 2)
        return self.conv_last(self.conv_after_body(x) + first)


class Residual(nn.Module):
    def __init__(self, channels, three=False):
        super().__init__()
        pad, conv = (nn.ReplicationPad3d, nn.Conv3d) if three else (nn.ReplicationPad2d, nn.Conv2d)
        self.tmp = nn.Sequential(
            pad(1), conv(channels, channels, 3), nn.LeakyReLU(0.2), pad(1), conv(channels, channels, 3)
        )

    def forward(self, x):
        return F.leaky_relu(self.tmp(x) + x, 0.2)


class Downnet(nn.Module):
    """Half of time, rows and columns: filtered, and convolved."""

    def __init__(self, streams, width):
        super().__init__()
        box = torch.zeros(streams, 1, 3, 3, 3)
        box[..., 1:, 1:, 1:] = 1 / 8
        self.weights = nn.Parameter(box)
        self.conv1 = nn.Sequential(
            nn.ReplicationPad3d(1), nn.Conv3d(streams, width, 3, stride=2), Residual(width, True), Residual(width, True)
        )

    def forward(self, x):
        filtered = F.conv3d(x, self.weights, stride=2, padding=1, groups=x.shape[1])
        return torch.cat((filtered, self.conv1(x)), 1)


class Rendering(nn.Module):
    """A network over images of the greatest values and of the moments of those."""

    def __init__(self, channels, outputs):
        super().__init__()
        self.weights = nn.Parameter(torch.tensor([0.0, 1.0]).repeat(outputs, 1)[..., None, None])
        self.conv1 = nn.Sequential(
            nn.ReplicationPad2d(1), nn.Conv2d(channels, channels, 3), Residual(channels), Residual(channels)
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

    def forward(self, x):
        def double(y):
            return F.interpolate(y, scale_factor=2, mode="bilinear", align_corners=False)

        raw = F.conv2d(double(x[:, [0, x.shape[1] // 2]]), self.weights)
        return raw + self.conv2(torch.cat((raw, double(self.conv1(x))), 1))


class Embeddings(nn.Module):
    """Written from the released code of learned feature embeddings, whose names the parameters have; the transform of light
    is the identity, all depths are kept, depth grows with time, and nothing is clamped."""

    def __init__(self, spec):
        super().__init__()
        streams = 2 if spec["one_hot"] else 1
        self.downnet = Downnet(streams, spec["width"])
        self.depth = Rendering(2 * (spec["width"] + streams), spec["outputs"])

    def forward(self, dense, one_hot=None):
        x = torch.stack([dense] if one_hot is None else [dense, one_hot], 1)
        return self.depth(greatest(normalised(self.downnet(x))))


def normalised(x):
    flat = F.relu(x).reshape(*x.shape[:2], -1)
    flat = flat - flat.min(2, keepdim=True)[0]
    flat = flat / (flat.max(2, keepdim=True)[0] + 1e-15)
    return flat.view(x.shape)


def greatest(x):
    values, moments = x.max(2)
    return torch.cat((values, moments / max(x.shape[2] - 1, 1)), 1)


class Nlost(nn.Module):
    """Written from the paper and notes on its released code, whose names the parameters have, with PyTorch's own
    three-dimensional convolutions; worker/model/src/net/nlost lists what is not as released."""

    def __init__(self, spec):
        super().__init__()
        streams = 2 if spec["one_hot"] else 1
        width, features = spec["width"], streams + 3
        moments = -(-spec["dense"] // 32)
        self.sig_expand = Downnet(streams, 3)
        self.msfeat = Scales(features, width // 4)
        self.sig_feat = HalfTime(width)
        self.dsfusion = nn.Module()
        self.dsfusion.ds = nn.Sequential(
            nn.Conv3d(width, width, 5, stride=(2, 1, 1), padding=2),
            nn.ReLU(),
            nn.Conv3d(width, width, 5, stride=(2, 1, 1), padding=2),
            nn.ReLU(),
        )
        self.dsfusion.fusion = nn.Sequential(nn.Conv3d(width, width, 1), nn.ReLU())
        self.spds = nn.Module()
        self.spds.dsop = nn.Sequential(nn.Conv3d(width, width, 5, stride=(1, 2, 2), padding=2), nn.ReLU())
        self.posenc_l, self.posenc_g = Positions(width), Positions(width)
        self.loc_encds = nn.ModuleList([SeparateEncoder(width, 16, moments)])
        self.glb_encds = nn.ModuleList([SeparateEncoder(width)])
        self.locglb_inte = nn.Module()
        self.locglb_inte.upop_G = nn.Module()
        up = nn.ConvTranspose3d(width, width, (3, 6, 6), stride=(1, 2, 2), padding=(1, 2, 2), bias=False)
        self.locglb_inte.upop_G.upop = nn.Sequential(nn.Sequential(up, nn.ReLU()))
        self.locglb_inte.loc_decs = nn.ModuleList([CrossDecoder(width)])
        self.locglb_inte.glb_decs = nn.ModuleList([CrossDecoder(width)])
        self.inte_rec = nn.Module()
        self.inte_rec.tmup1, self.inte_rec.tmup2 = MoreMoments(width), MoreMoments(width)
        self.inte_rec.fuse = nn.Sequential(
            nn.Conv3d(3 * width, width, 3, padding=1), nn.LeakyReLU(0.2), nn.Conv3d(width, features, 3, padding=1)
        )
        self.dep_refine = Rendering(2 * features, spec["outputs"])

    def forward(self, dense, one_hot=None):
        x = torch.stack([dense] if one_hot is None else [dense, one_hot], 1)
        shallow = self.msfeat(normalised(self.sig_expand(x)))
        fine = self.dsfusion.fusion(self.dsfusion.ds(self.sig_feat(shallow)))
        coarse = self.spds.dsop(fine)
        near = self.loc_encds[0](self.posenc_l(fine))
        far = self.locglb_inte.upop_G.upop(self.glb_encds[0](self.posenc_g(coarse)))
        near, far = self.locglb_inte.loc_decs[0](near, far), self.locglb_inte.glb_decs[0](far, near)
        moments = shallow.shape[2]
        near, far = self.inte_rec.tmup1(near)[:, :, :moments], self.inte_rec.tmup2(far)[:, :, :moments]
        return self.dep_refine(greatest(self.inte_rec.fuse(torch.cat((shallow, far, near), 1))))


class Scales(nn.Module):
    def __init__(self, inputs, outputs):
        super().__init__()

        def conv(inputs, dilation, stride):
            layer = nn.Conv3d(inputs, outputs, 3, stride=(stride, 1, 1), padding=dilation, dilation=dilation)
            return nn.Sequential(layer, nn.ReLU())

        self.conv1, self.conv2 = conv(inputs, 1, 2), conv(inputs, 2, 2)
        self.conv3, self.conv4 = conv(outputs, 1, 1), conv(outputs, 2, 1)

    def forward(self, x):
        one, two = self.conv1(x), self.conv2(x)
        return torch.cat((one, two, self.conv3(two), self.conv4(one)), 1)


class HalfTime(nn.Module):
    def __init__(self, width):
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

    def forward(self, x):
        return F.conv3d(x, self.weights, stride=(2, 1, 1), padding=1) + self.conv1(x)


class Positions(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.proj = nn.Conv3d(width, width, 3, padding=1)

    def forward(self, x):
        return x + self.proj(x)


class MoreMoments(nn.Module):
    def __init__(self, width):
        super().__init__()

        def up(inputs, outputs):
            return nn.ConvTranspose3d(inputs, outputs, (6, 3, 3), stride=(2, 1, 1), padding=(2, 1, 1), bias=False)

        self.temup = nn.Sequential(
            nn.Sequential(up(width, width // 2), nn.ReLU()),
            nn.Sequential(up(width // 2, width // 4), nn.ReLU()),
            nn.Sequential(up(width // 4, width)),
        )

    def forward(self, x):
        return self.temup(x)


class Perceptron(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, x):
        return self.fc2(F.gelu(self.fc1(x)))


class MomentAttention(WindowAttention):
    """With a bias for each difference of moments, the second less the first."""

    def __init__(self, channels, moments, heads):
        super().__init__(channels, 1, heads)
        self.relative_position_bias_table = nn.Parameter(torch.zeros(2 * moments - 1, heads))
        at = torch.arange(moments)
        self.index = at[None, :] - at[:, None] + moments - 1


class PlainAttention(nn.Module):
    def __init__(self, channels, heads):
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(channels, 3 * channels, bias=False)
        self.proj = nn.Linear(channels, channels)

    def forward(self, x):
        rows, tokens, channels = x.shape
        q, k, v = self.qkv(x).view(rows, tokens, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        x = F.scaled_dot_product_attention(q, k, v)
        return self.proj(x.transpose(1, 2).reshape(rows, tokens, channels))


class SeparateEncoder(nn.Module):
    """Attention over the image, then over time."""

    def __init__(self, width, window=None, moments=None, heads=4):
        super().__init__()
        self.window = window
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        if window:
            self.attn_hw, self.attn_t = WindowAttention(width, window, heads), MomentAttention(width, moments, heads)
        else:
            self.attn_hw, self.attn_t = PlainAttention(width, heads), PlainAttention(width, heads)
        self.mlp = Perceptron(width)

    def forward(self, x):
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
    """Compact generalised non-local attention: rows of (channels, places)."""

    def __init__(self, channels, scale):
        super().__init__()
        self.groups = 8 if channels % 8 == 0 else 4
        self.t, self.p, self.g = (nn.Conv1d(channels, channels, 1, bias=False) for _ in range(3))
        self.z = nn.Conv1d(channels, channels, 1, groups=self.groups, bias=False)
        self.gn = nn.GroupNorm(self.groups, channels)
        nn.init.constant_(self.gn.weight, scale)
        nn.init.constant_(self.gn.bias, 0)

    def forward(self, asks, keys, values):
        rows, channels, places = values.shape
        t, p, g = self.t(values), self.p(asks), self.g(keys)
        grouped = (rows, self.groups, -1)
        product = (p.reshape(grouped) * g.reshape(grouped)).sum(2, keepdim=True) * (channels // self.groups) ** -0.5
        return self.gn(self.z((t.reshape(grouped) * product).reshape(t.shape)))


class CrossDecoder(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.norm1, self.norm12, self.norm2 = (nn.LayerNorm(width) for _ in range(3))
        self.attn_hw, self.attn_t = nn.Module(), nn.Module()
        self.attn_hw.attn, self.attn_t.attn = GroupedSums(width, 1.0), GroupedSums(width, 0.0)
        self.mlp = Perceptron(width)

    def forward(self, x, asks):
        n, c, t, h, w = x.shape
        x, asks = x.permute(0, 2, 3, 4, 1), asks.permute(0, 2, 3, 4, 1)
        own, asks = self.norm1(x), self.norm12(asks)

        def over_image(y):
            return y.reshape(n * t, h * w, c).transpose(1, 2)

        def over_time(y):
            return y.reshape(n, t, h * w, c).permute(0, 2, 3, 1).reshape(n * h * w, c, t)

        said = self.attn_hw.attn(over_image(asks), over_image(own), over_image(own)).transpose(1, 2)
        said = self.attn_t.attn(over_time(asks), over_time(said), over_time(said))
        x = x + said.reshape(n, h, w, c, t).permute(0, 4, 1, 2, 3)
        x = x + self.mlp(self.norm2(x))
        return x.permute(0, 4, 1, 2, 3)


NETWORKS = {"unet2d": Unet2d, "unet25d": Unet25d, "swinir": SwinIR, "embeddings": Embeddings, "nlost": Nlost}


class Trial:
    def __init__(self, path, device="cpu"):
        self.device = device
        with safe_open(path, "pt", device) as file:
            self.spec = json.loads(file.metadata()["trial"])
            self.tensors = {name: file.get_tensor(name) for name in file.keys()}
        net = self.spec["net"]
        self.bf16 = net.get("precision") == "bf16"
        self.model = NETWORKS[net["architecture"]](net).to(device)
        self.reset()
        self.dense, self.target = self.tensors["input/dense"], self.tensors["target"]
        self.one_hot = None
        if net["one_hot"]:
            bins = self.tensors["input/one_hot"].long()
            self.one_hot = (bins[:, None] == torch.arange(net["one_hot"], device=device)[:, None, None]).float()

    def part(self, name):
        return {k[len(name) + 1 :]: v for k, v in self.tensors.items() if k.startswith(name + "/")}

    def reset(self):
        state = self.part("weights")
        for name in state:
            if name.endswith("num_batches_tracked"):
                state[name] = state[name].reshape(()).long()
        self.model.load_state_dict(state)
        self.model.train()
        learned = [p for p in self.model.parameters() if p.requires_grad]
        self.optimiser = torch.optim.AdamW(learned, lr=self.spec["learning_rate"], weight_decay=self.spec["decay"])

    def ask(self):
        with torch.autocast(self.device, dtype=torch.bfloat16, enabled=self.bf16):
            return self.model(self.dense, self.one_hot).float()

    def loss(self):
        output = self.ask()
        if self.spec["target"] == "tof":
            return output, F.l1_loss(output, self.target)
        return output, F.binary_cross_entropy_with_logits(output, self.target)

    def step(self):
        self.optimiser.zero_grad()
        _, loss = self.loss()
        loss.backward()
        self.optimiser.step()
        return loss.item()


def rounding(trial):
    """How far the gradient in bfloat16 lies from that in 32 bits, of its norm."""
    gradients = []
    for bf16 in (False, True):
        trial.bf16 = bf16
        trial.reset()
        trial.optimiser.zero_grad()
        trial.loss()[1].backward()
        gradients.append(torch.cat([p.grad.flatten() for p in trial.model.parameters() if p.grad is not None]))
    return ((gradients[1] - gradients[0]).norm() / gradients[0].norm()).item()


def parity(path):
    trial = Trial(path)
    trial.model.eval()
    with torch.no_grad():
        evaluated = trial.ask()
    trial.model.train()
    output, loss = trial.loss()
    loss.backward()
    worst, off_all, all_of = ("", 0.0), 0.0, 0.0
    gradients = trial.part("gradient")
    for name, parameter in trial.model.named_parameters():
        if parameter.grad is None:
            assert name not in gradients, f"{name} has no gradient here"
            continue
        theirs, ours = parameter.grad, gradients.pop(name)
        off = ((theirs - ours).norm() / theirs.norm().clamp_min(1e-12)).item()
        off_all += (theirs - ours).square().sum().item()
        all_of += theirs.square().sum().item()
        worst = max(worst, (name, off), key=lambda pair: pair[1])
    state = {k: v.clone() for k, v in trial.model.state_dict().items()}
    assert not gradients, f"gradients of {sorted(gradients)} are unknown here"
    trial.reset()
    if trial.bf16:
        # Rounding alone moves single gradients that nearly cancel by their own size.
        worst = ("all together", (off_all / all_of) ** 0.5)
    ours = trial.tensors["losses"]
    losses = torch.tensor([trial.step() for _ in ours])
    figures = {
        "output": (output - trial.tensors["output"]).abs().max().item(),
        "evaluated": (evaluated - trial.tensors["evaluated"]).abs().max().item(),
        "gradient": worst[1],
        "losses": (losses - ours).abs().max().item(),
        "statistics": max(((state[k] - v).abs().max().item() for k, v in trial.part("after").items()), default=0.0),
    }
    limits = {"output": 1e-4, "evaluated": 1e-4, "gradient": 1e-3, "losses": 1e-3, "statistics": 1e-4}
    if trial.spec["net"]["architecture"] == "nlost":
        # The moment of a greatest value jumps where two are nearly equal, and a pixel's depth with it.
        limits["losses"] = 1e-2
    if trial.bf16:
        # As far as rounding moves PyTorch itself.
        limits |= {"output": 1e-1, "evaluated": 1e-2, "gradient": rounding(trial), "losses": 1e-2, "statistics": 1e-3}
    parameters = sum(p.numel() for p in trial.model.parameters())
    print(f"{path}: {trial.spec['target']}, {trial.spec['net']['architecture']}, {parameters} parameters, torch {torch.__version__}")
    for name, value in figures.items():
        verdict = "ok" if value <= limits[name] else "TOO FAR OFF"
        more = f" ({worst[0]})" if name == "gradient" else ""
        print(f"  {name:10} {value:.2e} of {limits[name]:.0e} allowed  {verdict}{more}")
    print(f"  loss {losses[0]:.6f} to {losses[-1]:.6f} in {len(losses)} steps, ours {ours[0]:.6f} to {ours[-1]:.6f}")
    return all(value <= limits[name] for name, value in figures.items())


def with_channels_last(tensor):
    """The tensor with its channels last in memory: of images and of volumes; others as they are."""
    form = {4: torch.channels_last, 5: torch.channels_last_3d}.get(tensor.dim())
    return tensor if form is None else tensor.contiguous(memory_format=form)


def bench(path, channels_last, device, tf32):
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = tf32
    torch.backends.cudnn.benchmark = True
    trial = Trial(path, device)
    if channels_last:
        for held in [*trial.model.parameters(), *trial.model.buffers()]:
            held.data = with_channels_last(held.data)
        trial.dense = with_channels_last(trial.dense)
        trial.reset()
    # A step brings its batch to the card, as picofarm's does; from pinned memory, as a loader gives it.
    host = trial.dense.cpu().pin_memory() if device == "cuda" else None
    more = (", " + device if device != "cpu" else "") + (", TF32" if tf32 else "") + (", channels last" if channels_last else "")
    name = f"PyTorch {torch.__version__}{more}"
    print(json.dumps({"tool": name, "threads": torch.get_num_threads()}), flush=True)
    for line in sys.stdin:
        begun = time.perf_counter()
        for _ in range(int(line)):
            if host is not None:
                trial.dense = host.to(device, non_blocking=True)
            trial.step()
        print(time.perf_counter() - begun, flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True, dest="command")
    commands.add_parser("parity").add_argument("files", nargs="+")
    timed = commands.add_parser("bench")
    timed.add_argument("--channels-last", action="store_true")
    timed.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    timed.add_argument("--tf32", action="store_true")
    timed.add_argument("file")
    asked = parser.parse_args()
    if asked.command == "parity":
        sys.exit(0 if all([parity(path) for path in asked.files]) else 1)
    bench(asked.file, asked.channels_last, asked.device, asked.tf32)
