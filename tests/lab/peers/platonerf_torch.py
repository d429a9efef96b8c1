"""Times PyTorch's steps of PlatoNeRF's networks at the paper's size, by CPU time: the peer of `--field mlp`.

    python platonerf_torch.py [WIDTH RAYS COARSE FINE STEPS]

The networks, rays and losses are those of worker/platonerf/tests/twin/twin.py; rays are random, which changes no time.
"""

import pathlib
import sys
import time

import torch

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "worker/platonerf/tests/twin"))
from twin import Network, loss_of  # noqa: E402


def batch(rays, coarse, fine):
    direction = torch.randn(rays, 3)
    drawn = {
        "direction": direction / direction.norm(dim=1, keepdim=True),
        "spot": 2 * torch.rand(rays, 3) + torch.tensor([0.0, 0.0, 1.0]),
        "tau": 5 + 5 * torch.rand(rays),
        "lit": (torch.rand(rays) < 0.7).float(),
        "path": 2 + torch.rand(rays),
    }
    for k in range(3):
        drawn[f"jitter{k}"] = torch.rand(rays, coarse)
        drawn[f"share{k}"] = torch.sort(torch.rand(rays, fine), 1)[0]
    return drawn


def main(width=256, rays=1024, coarse=64, fine=128, steps=3):
    torch.manual_seed(0)
    config = {"origin": [0.0, 0.0, 0.0], "far": 6.0, "near": 0.1, "scale": 15.0, "weight": 6000.0}
    networks = [Network(width, 8) for _ in range(2)]
    parameters = [p for network in networks for p in network.parameters()]
    adam = torch.optim.Adam(parameters, lr=5e-4)
    print(f"PyTorch {torch.__version__}, {torch.get_num_threads()} threads, width {width}, {rays} rays, {coarse} + {fine} samples")
    for stage in (1, 2):
        seconds = []
        for _ in range(steps + 1):
            drawn = batch(rays, coarse, fine)
            begun = time.process_time()
            loss, _ = loss_of(config, stage, networks, drawn)
            adam.zero_grad()
            loss.backward()
            adam.step()
            seconds.append(time.process_time() - begun)
        # The first one warms up.
        print(f"stage {stage}: {sorted(seconds[1:])[steps // 2]:.2f} CPU s a step (median of {steps}; {min(seconds[1:]):.2f} to {max(seconds[1:]):.2f})")


main(*map(int, sys.argv[1:]))
