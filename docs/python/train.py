"""Trains depth from histograms, pixel by pixel, for some steps: a skeleton to put a real network into.

    python train.py DATASET [--split train] [--steps 60] [--batch 4] [--workers 2] [--crop 16] [--numpy]

With PyTorch it uses its DataLoader with spawned workers. Without it, or with --numpy, the same loop runs with
multiprocessing and numpy. Prints one line of JSON at the end.
"""

import argparse
import collections
import concurrent.futures
import itertools
import json
import multiprocessing
import time

import numpy

import picofarm

try:
    import torch
except ImportError:
    torch = None


class RandomCrops(picofarm.Dataset):
    """Another square of each scene each time; what a network is fed, and no more."""

    def __init__(self, url, side, **rest):
        super().__init__(url, arrays=("transient", "depth"), threads=1, **rest)
        self.side = side
        if not 0 < side <= min(self.shape):
            raise ValueError(f"crop {side}: expected 1 to {min(self.shape)} pixels")

    def __getitem__(self, index):
        rng = numpy.random.default_rng()
        corner = (int(rng.integers(length - self.side + 1)) for length in self.shape)
        scene = self.read(self.scenes[index], crop=(*corner, self.side, self.side))
        h = scene["transient"].reshape(self.side**2, -1)
        # When light comes tells the distance, not how much of it.
        h /= h.max(axis=1, keepdims=True).clip(1e-20)
        return {"x": numpy.sqrt(h, out=h), "y": scene["depth"].reshape(-1)}


def torch_batches(scenes, batch, workers, steps):
    draw = torch.utils.data.RandomSampler(scenes, replacement=True, num_samples=batch * steps)
    yield from torch.utils.data.DataLoader(
        scenes, batch_size=batch, sampler=draw, num_workers=workers,
        multiprocessing_context="spawn" if workers else None, persistent_workers=workers > 0, prefetch_factor=2 if workers else None,
    )


def numpy_batches(scenes, batch, workers, steps):
    """What the DataLoader does, in a few lines: workers are spawned, and two batches a worker are under way."""
    order = numpy.random.default_rng(0).integers(len(scenes), size=(steps, batch)).tolist()
    if not workers:
        yield from (collate([scenes[i] for i in indices]) for indices in order)
        return
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(workers, spawn, initializer=adopt, initargs=(scenes,)) as pool:
        order, ahead = iter(order), collections.deque()
        for indices in itertools.islice(order, 2 * workers):
            ahead.append(pool.submit(load, indices))
        while ahead:
            yield ahead.popleft().result()
            ahead.extend(pool.submit(load, indices) for indices in itertools.islice(order, 1))


def adopt(scenes):
    global mine
    mine = scenes


def load(indices):
    return collate([mine[i] for i in indices])


def collate(samples):
    return {key: numpy.stack([sample[key] for sample in samples]) for key in samples[0]}


class TorchModel:
    """One hidden layer, as a network of 1x1 convolutions would have it."""

    def __init__(self, bins):
        torch.manual_seed(0)
        self.net = torch.nn.Sequential(torch.nn.Linear(bins, 32), torch.nn.ReLU(), torch.nn.Linear(32, 1))
        self.adam = torch.optim.Adam(self.net.parameters(), lr=1e-2)

    def step(self, x, y):
        loss = ((self.net(x).squeeze(-1) - y) ** 2).mean()
        self.adam.zero_grad()
        loss.backward()
        self.adam.step()
        return loss.item()


class NumpyModel:
    """Linear, with Adam by hand."""

    def __init__(self, bins):
        self.w, self.m, self.v, self.t = *numpy.zeros((3, bins + 1)), 0

    def step(self, x, y):
        x = numpy.concatenate([x.reshape(-1, x.shape[-1]), numpy.ones((y.size, 1))], axis=1)
        error = x @ self.w - y.ravel()
        gradient = 2 * x.T @ error / y.size
        self.t += 1
        self.m += 0.1 * (gradient - self.m)
        self.v += 0.001 * (gradient**2 - self.v)
        self.w -= 1e-2 * (self.m / (1 - 0.9**self.t)) / (numpy.sqrt(self.v / (1 - 0.999**self.t)) + 1e-8)
        return float((error**2).mean())


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", help="folder or s3:// URL")
    parser.add_argument("--split", help="train, validation or test; all published scenes without it")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--batch", type=int, default=4, help="scenes a step")
    parser.add_argument("--workers", type=int, default=2, help="processes that load; 0 = this one")
    parser.add_argument("--crop", type=int, default=16, help="side of the squares in pixels")
    parser.add_argument("--numpy", action="store_true", help="without PyTorch, even if it is there")
    args = parser.parse_args()
    use_torch = torch is not None and not args.numpy
    print("training with", f"PyTorch {torch.__version__}" if use_torch else "numpy: PyTorch is not installed or not wanted", flush=True)

    scenes = RandomCrops(args.dataset, args.crop, split=args.split)
    if not len(scenes):
        raise SystemExit(f"{args.dataset}: no scenes" + (f" in the split {args.split}" if args.split else ""))
    batches = (torch_batches if use_torch else numpy_batches)(scenes, args.batch, args.workers, args.steps)
    model, losses, waited = None, [], 0.0
    while True:
        asked = time.perf_counter()
        batch = next(batches, None)
        if batch is None:
            break
        if model is None:
            # The first one waits for the workers to start.
            model, start = (TorchModel if use_torch else NumpyModel)(batch["x"].shape[-1]), time.perf_counter()
        else:
            waited += time.perf_counter() - asked
        losses.append(model.step(batch["x"], batch["y"]))
        if len(losses) % max(args.steps // 6, 1) == 0:
            print(f"step {len(losses)}: loss {losses[-1]:.4f} m2", flush=True)
    seconds = time.perf_counter() - start
    rate = args.batch * (len(losses) - 1) / seconds
    few = max(len(losses) // 10, 1)
    print(f"{rate:.1f} scenes/s, {100 * waited / seconds:.0f} % of the time spent waiting for data")
    print(json.dumps({
        "with": "torch" if use_torch else "numpy", "scenes": len(scenes), "steps": len(losses), "scenes_per_s": rate,
        "waiting": waited / seconds, "first_loss": float(numpy.mean(losses[:few])), "last_loss": float(numpy.mean(losses[-few:])),
    }))


if __name__ == "__main__":
    main()
