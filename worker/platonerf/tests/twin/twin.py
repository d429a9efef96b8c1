"""PlatoNeRF's networks, rays, losses and Adam in plain PyTorch: what the Rust side must agree with.

Reads weights, ray batches and random draws (input.safetensors, which a test of the crate writes), and writes the loss of each
step, what the first step's rays give, the first gradients and the last weights, computed in 64 bits. Prints how far the same
program in 32 bits is from that.

    python twin.py input.safetensors twin.safetensors
"""

import json
import sys

import torch
from safetensors import safe_open
from safetensors.torch import save_file


class Network(torch.nn.Module):
    def __init__(self, width, layers):
        super().__init__()
        self.joined = layers // 2
        sizes = [63] + [width + (63 if k == self.joined else 0) for k in range(layers)]
        self.layers = torch.nn.ModuleList(torch.nn.Linear(i, width) for i in sizes[:-1])
        self.density = torch.nn.Linear(width, 1)

    def set(self, flat):
        for parameter in self.parameters():
            count = parameter.numel()
            parameter.data = flat[:count].reshape(parameter.shape).clone()
            flat = flat[count:]
        assert flat.numel() == 0

    def flat(self, of=lambda p: p):
        return torch.cat([of(p).detach().reshape(-1) for p in self.parameters()])

    def forward(self, x):
        encoded = [x]
        for k in range(10):
            encoded += [torch.sin(2.0**k * x), torch.cos(2.0**k * x)]
        encoded = torch.cat(encoded, -1)
        h = encoded
        for k, layer in enumerate(self.layers):
            h = torch.relu(layer(h))
            if k == self.joined:
                h = torch.cat([encoded, h], -1)
        return torch.relu(self.density(h))[..., 0]


def volume(network, origin, direction, z):
    density = network(origin[:, None] + direction[:, None] * z[..., None])
    length = torch.cat([z[:, 1:] - z[:, :-1], torch.full_like(z[:, :1], 1e10)], 1)
    alpha = 1 - torch.exp(-density * length)
    ones = torch.ones_like(alpha[:, :1])
    light = torch.cumprod(torch.cat([ones, 1 - alpha + 1e-10], 1), 1)[:, :-1]
    weights = alpha * light
    return (weights * z).sum(1), light[:, -2], weights


def by_importance(z, weights, share):
    middles = 0.5 * (z[:, 1:] + z[:, :-1])
    weights = weights[:, 1:-1] + 1e-5
    sums = torch.cumsum(weights / weights.sum(1, keepdim=True), 1)
    sums = torch.cat([torch.zeros_like(sums[:, :1]), sums], 1)
    index = torch.searchsorted(sums, share, right=True)
    below = (index - 1).clamp_min(0)
    above = index.clamp_max(sums.shape[1] - 1)
    width = torch.gather(sums, 1, above) - torch.gather(sums, 1, below)
    width = torch.where(width < 1e-5, torch.ones_like(width), width)
    t = (share - torch.gather(sums, 1, below)) / width
    low, high = torch.gather(middles, 1, below), torch.gather(middles, 1, above)
    return low + t * (high - low)


def render(networks, origin, direction, far, near, jitter, share):
    even = torch.linspace(0, 1, jitter.shape[1], dtype=jitter.dtype)
    z = near * (1 - even) + far[:, None] * even
    middles = 0.5 * (z[:, 1:] + z[:, :-1])
    lower, upper = torch.cat([z[:, :1], middles], 1), torch.cat([middles, z[:, -1:]], 1)
    z = lower + (upper - lower) * jitter
    coarse = volume(networks[0], origin, direction, z)
    more = by_importance(z.detach(), coarse[2].detach(), share)
    z = torch.sort(torch.cat([z, more], 1), 1)[0]
    return coarse[:2], volume(networks[1], origin, direction, z)[:2]


def mean(values):
    return values.mean() if values.numel() else values.sum()


def loss_of(config, stage, networks, batch):
    direction, spot, tau = batch["direction"], batch["spot"], batch["tau"]
    lit = batch["lit"] > 0
    origin = torch.zeros_like(direction) + torch.tensor(config["origin"], dtype=tau.dtype)
    far = torch.full_like(tau, config["far"])
    near = config["near"]
    of = lambda time: (batch[f"jitter{time}"], batch[f"share{time}"])
    coarse, fine = render(networks, origin, direction, far, near, *of(0))
    total, seen = 0.0, [coarse[0], fine[0]]
    for time, (depth, _) in ((1, fine), (2, coarse)):
        point = origin + direction * depth[:, None]
        length = torch.linalg.norm(spot - point, dim=1)
        error = (depth + length + batch["path"] - tau) / config["scale"]
        distance = mean(error[lit] ** 2)
        if stage == 1:
            total = total + distance
            continue
        way = (spot - point) / length[:, None]
        both = render(networks, point, way, length.clamp_min(near + 1e-3), near, *of(time))
        total = total + config["weight"] * distance
        for _, through in both:
            total = total + mean(through[~lit] ** 2) + mean((through[lit] - 1) ** 2)
            seen.append(through)
    return 100 * total, torch.stack(seen).detach()


def run(config, tensors, stage, dtype):
    networks = [Network(config["width"], config["layers"]).to(dtype) for _ in range(2)]
    for k, network in enumerate(networks):
        network.set(tensors[f"weights{k}"].to(dtype))
    parameters = [p for network in networks for p in network.parameters()]
    adam = torch.optim.Adam(parameters, lr=config["rate"], betas=(0.9, 0.999), eps=1e-8)
    losses, out = [], {}
    for step in range(config["steps"]):
        names = [n for n in tensors if n.startswith(f"{stage}.")]
        batch = {n.split(".")[1]: tensors[n][step].to(dtype) for n in names}
        for group in adam.param_groups:
            group["lr"] = config["rate"] * 0.1 ** (step / config["decay"])
        loss, seen = loss_of(config, stage, networks, batch)
        adam.zero_grad()
        loss.backward()
        if step == 0:
            out["seen"] = seen
            for k, network in enumerate(networks):
                out[f"gradient{k}"] = network.flat(lambda p: p.grad)
        adam.step()
        losses.append(loss.item())
    out["losses"] = torch.tensor(losses, dtype=dtype)
    for k, network in enumerate(networks):
        out[f"weights{k}"] = network.flat()
    return out


def main(source, target):
    with safe_open(source, "pt") as file:
        config = json.loads(file.metadata()["config"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}
    torch.set_num_threads(1)
    result = {}
    for stage in (1, 2):
        exact, single = (run(config, tensors, stage, d) for d in (torch.float64, torch.float32))
        for name, value in exact.items():
            other = single[name].double()
            worst = (other - value).abs().max().item()
            relative = ((other - value).norm() / value.norm()).item()
            print(f"stage {stage} {name}: 32 bits differ by {worst:.2e} at most, {relative:.2e} of the norm")
            result[f"{stage}.{name}"] = value.float().contiguous()
    save_file(result, target)


if __name__ == "__main__":
    main(*sys.argv[1:])
