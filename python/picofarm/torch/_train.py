"""Computes the steps of a training for a worker, which starts this module as a program.

The worker reads the scenes, chooses their order and makes the batches, as it does for its embedded
networks. It keeps the history, validates and saves checkpoints. This program has the weights and
the optimiser.

The worker sends commands over a Unix socket, one JSON object a line, and each has one answer.
Numbers are in files. A batch is the dense channels (f32), the bins of the one-hot channels (i32, -1
= none) and the true outputs (f32), one after another. A state is a file in the format of
safetensors.
"""

# PyTorch states some of its types only in part.
# pyright: reportUnknownMemberType=false
from __future__ import annotations

import contextlib
import json
import math
import mmap
import os
import platform
import queue
import socket
import struct
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

import torch
from torch import Tensor, distributed, nn

from ._networks import loss, network

ENCODER = ("stem", "encoders", "time_projection", "time_projections")
"""Parts of a U-Net that `frozen` excludes from training."""

MAY_LEAVE_OUT = ("embeddings", "nlost")
"""Architectures with parameters that a batch may not reach."""


def mapped(path: str, size: int | None) -> mmap.mmap:
    """Returns a file as bytes in memory. It becomes `size` bytes long, if that is given."""
    with open(path, "r+b" if size is None else "w+b") as file:
        if size is not None:
            file.truncate(size)
        return mmap.mmap(file.fileno(), 0)


def read_state(path: str) -> dict[str, Tensor]:
    """Returns the tensors of a file in the format of safetensors, in f32."""
    content = mapped(path, None)
    (length,) = struct.unpack("<Q", content[:8])
    header: dict[str, dict[str, Any]] = json.loads(content[8 : 8 + length])
    tensors: dict[str, Tensor] = {}
    for name, entry in header.items():
        if name == "__metadata__":
            continue
        if entry["dtype"] != "F32":
            raise ValueError(f"{name}: expected F32, found {entry['dtype']}")
        shape, count = entry["shape"], math.prod(entry["shape"])
        at = 8 + length + entry["data_offsets"][0]
        values = torch.frombuffer(content, dtype=torch.float32, count=count, offset=at)
        tensors[name] = values.clone().reshape(shape)
    return tensors


def write_state(path: str, tensors: Mapping[str, Tensor]) -> None:
    """Writes tensors in f32 in the format of safetensors."""
    header: dict[str, dict[str, Any]] = {}
    at = 0
    for name, tensor in tensors.items():
        size = 4 * tensor.numel()
        shape = list(tensor.shape) or [1]
        header[name] = {"dtype": "F32", "shape": shape, "data_offsets": [at, at + size]}
        at += size
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    content = mapped(path, 8 + len(text) + at)
    content[:8] = struct.pack("<Q", len(text))
    content[8 : 8 + len(text)] = text
    at = 8 + len(text)
    for tensor in tensors.values():
        count = tensor.numel()
        into = torch.frombuffer(content, dtype=torch.float32, count=count, offset=at)
        into.copy_(tensor.detach().reshape(-1))
        at += 4 * count


class Batch:
    """A batch of a file, on a device."""

    def __init__(
        self, content: mmap.mmap, shape: Mapping[str, Any], one_hot: int, device: torch.device
    ) -> None:
        n, h, w = shape["images"], shape["height"], shape["width"]
        at = 0

        def take(channels: int, dtype: torch.dtype = torch.float32) -> Tensor:
            nonlocal at
            count = n * channels * h * w
            values = torch.frombuffer(content, dtype=dtype, count=count, offset=at)
            at += 4 * count
            return values.reshape(n, channels, h, w).to(device, copy=True)

        self.dense = take(shape["dense"])
        self.one_hot = None
        if shape["one_hot"]:
            bins = take(1, torch.int32).long()
            planes = torch.zeros(n, one_hot, h, w, device=device)
            self.one_hot = planes.scatter_(1, bins.clamp_min(0), (bins >= 0).float())
        self.target = take(shape["outputs"]) if shape["outputs"] else None

    def truth(self) -> Tensor:
        """The true outputs."""
        if self.target is None:
            raise ValueError("outputs: a batch of a step has no true outputs")
        return self.target

    def inputs(self) -> tuple[Tensor, ...]:
        return (self.dense,) if self.one_hot is None else (self.dense, self.one_hot)


class Learner:
    """A network, its optimiser, and the average of its weights. One process of a group."""

    def __init__(self, task: Mapping[str, Any], rank: int, world: int) -> None:
        self.plan: dict[str, Any] = task["plan"]
        self.rank, self.world = rank, world
        spec: dict[str, Any] = self.plan["net"]
        self.target: str = self.plan["question"]["target"]
        self.device = torch.device("cpu")
        if task["gpus"]:
            if world > torch.cuda.device_count():
                cards = torch.cuda.device_count()
                raise ValueError(f"train.processes: {world}, but PyTorch sees {cards} CUDA cards")
            self.device = torch.device("cuda", rank)
            torch.cuda.set_device(self.device)
        self.half = spec.get("precision", "f32") == "bf16"
        self.network = network(spec).to(self.device)
        if task["channels_last"]:
            for value in self.network.parameters():
                if value.dim() == 4:
                    value.data = value.data.contiguous(memory_format=torch.channels_last)
        frozen = [getattr(self.network, part, None) for part in ENCODER]
        self.frozen = [part for part in frozen if part is not None and spec.get("frozen", False)]
        for part in self.frozen:
            part.requires_grad_(False)
        self.learned = {n: p for n, p in self.network.named_parameters() if p.requires_grad}
        self.decay: float = self.plan["decay"]
        self.clip: float | None = self.plan.get("clip_norm")
        self.ema: float | None = self.plan.get("ema")
        self.average: dict[str, Tensor] | None = None
        self.losses = torch.zeros((), device=self.device)
        self.parallel: nn.parallel.DistributedDataParallel | None = None
        if world > 1:
            backend = "nccl" if task["gpus"] else "gloo"
            distributed.init_process_group(backend)
            self.parallel = nn.parallel.DistributedDataParallel(
                self.network,
                broadcast_buffers=False,
                gradient_as_bucket_view=True,
                find_unused_parameters=spec["architecture"] in MAY_LEAVE_OUT,
            )
        forward = self.parallel or self.network
        self.forward: Callable[..., Tensor] = torch.compile(forward) if task["compile"] else forward
        self.learns()

    def learns(self) -> None:
        """Switches to training. A frozen encoder stays in evaluation."""
        self.network.train()
        for part in self.frozen:
            part.eval()
        every = self.network.modules()
        norms = [m for m in every if isinstance(m, nn.modules.batchnorm._BatchNorm)]
        self.norms = [norm for norm in norms if norm.training]

    def load(self, path: str, steps: int) -> None:
        """Takes over a state after so many steps."""
        state, here = read_state(path), self.network.state_dict()
        names = ("weights", "average", "adamw.m", "adamw.v")
        parts: dict[str, dict[str, Tensor]] = {name: {} for name in names}
        for name, tensor in state.items():
            part, name = name.split("/", 1)
            parts[part][name] = tensor.reshape(here[name].shape).to(here[name])
        self.network.load_state_dict(parts["weights"])
        self.average = None
        if self.ema is not None and self.rank == 0:
            self.average = {name: value.float() for name, value in parts["average"].items()}
        self.optimiser = torch.optim.AdamW(
            list(self.learned.values()), weight_decay=self.decay, eps=1e-8, fused=True
        )
        for name, value in self.learned.items():
            self.optimiser.state[value] = {
                "step": torch.tensor(float(steps), device=value.device),
                "exp_avg": torch.empty_like(value).copy_(parts["adamw.m"][name]),
                "exp_avg_sq": torch.empty_like(value).copy_(parts["adamw.v"][name]),
            }
        self.steps = steps

    def state(self, path: str, moments: bool) -> None:
        """Writes the weights, and with `moments` also the optimiser's state."""
        tensors = {f"weights/{name}": v for name, v in self.network.state_dict().items()}
        if self.average is not None:
            tensors |= {f"average/{name}": v for name, v in self.average.items()}
        for name, value in (self.learned if moments else {}).items():
            state = self.optimiser.state[value]
            tensors[f"adamw.m/{name}"] = state["exp_avg"]
            tensors[f"adamw.v/{name}"] = state["exp_avg_sq"]
        write_state(path, tensors)

    def computing(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.half)

    def add(self, batch: Batch, first: bool, last: bool) -> None:
        """Adds the gradients of a batch to those of the step. Running statistics follow the first
        batch of a step."""
        for norm in self.norms:
            norm.track_running_stats = first
        waits = None if last else self.parallel
        with contextlib.nullcontext() if waits is None else waits.no_sync():
            with self.computing():
                output = self.forward(*batch.inputs())
            value = loss(self.target, output.float(), batch.truth())
            # The gradients of all processes are averaged.
            (value * (self.world / self.plan["accumulate"])).backward()
        self.losses += value.detach()

    def step(self, rate: float, beta: float) -> float | None:
        """Takes a step of the optimiser, and returns the mean loss of its batches."""
        if self.clip is not None:
            nn.utils.clip_grad_norm_(self.learned.values(), self.clip)
        for group in self.optimiser.param_groups:
            group["lr"], group["betas"] = rate, (beta, 0.999)
        self.optimiser.step()
        self.optimiser.zero_grad(set_to_none=True)
        self.steps += 1
        self.follow()
        if self.world > 1:
            distributed.all_reduce(self.losses)
        mean = float(self.losses) / self.plan["accumulate"]
        self.losses.zero_()
        # JSON has no other numbers.
        return mean if math.isfinite(mean) else None

    def follow(self) -> None:
        """Updates the average after a step."""
        if self.average is None or self.ema is None:
            return
        decay = min(self.ema, (1 + self.steps) / (10 + self.steps))
        with torch.no_grad():
            for name, value in self.network.state_dict().items():
                self.average[name].mul_(decay).add_(value.float(), alpha=1 - decay)

    def predict(self, batch: Batch) -> Tensor:
        """Returns the output in evaluation, by the average if there is one."""
        self.network.eval()
        for norm in self.norms:
            norm.track_running_stats = True
        with torch.no_grad(), self.computing():
            if self.average is None:
                output = self.network(*batch.inputs())
            else:
                whole = {n: v for n, v in self.average.items() if not n.endswith("_tracked")}
                output = torch.func.functional_call(self.network, whole, batch.inputs())
        self.learns()
        return output.float()


class Program:
    """Answers the commands of the worker."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.files: dict[str, mmap.mmap] = {}
        self.begun: Learner | None = None
        self.rank = int(os.environ.get("RANK", "0"))
        self.world = int(os.environ.get("WORLD_SIZE", "1"))

    def say(self, answer: Mapping[str, Any]) -> None:
        self.connection.sendall(json.dumps(answer).encode() + b"\n")

    @property
    def learner(self) -> Learner:
        if self.begun is None:
            raise ValueError("do: the first command must be 'begin'")
        return self.begun

    def batch(self, command: Mapping[str, Any]) -> Batch:
        path, size = command["file"], command["bytes"]
        content = self.files.get(path)
        if content is None or len(content) < size:
            content = self.files[path] = mapped(path, None)
        one_hot = self.learner.plan["net"]["one_hot"]
        return Batch(content, command, one_hot, self.learner.device)

    def answer(self, command: Mapping[str, Any]) -> dict[str, Any]:
        what = command["do"]
        if what == "begin":
            self.begun = Learner(command["task"], self.rank, self.world)
            return {}
        learner = self.learner
        if what == "load":
            learner.load(command["path"], command["steps"])
        elif what == "state":
            learner.state(command["path"], command["moments"])
        elif what == "add":
            learner.add(self.batch(command), command["first"], command["last"])
        elif what == "step":
            return {"loss": learner.step(command["learning_rate"], command["beta1"])}
        elif what == "predict":
            output = learner.predict(self.batch(command))
            content = mapped(command["answer"], 4 * output.numel())
            into = torch.frombuffer(content, dtype=torch.float32)
            into.copy_(output.reshape(-1))
            return {"count": output.numel()}
        else:
            raise ValueError(f"do: {what!r} is no command")
        return {}

    def versions(self) -> dict[str, Any]:
        cuda = torch.version.cuda if torch.cuda.is_available() else None
        return {
            "python": platform.python_version(),
            "torch": torch.__version__,
            **({"cuda": cuda, "gpu": torch.cuda.get_device_name(0)} if cuda else {}),
        }


def listen(connection: socket.socket, commands: queue.SimpleQueue[dict[str, Any]]) -> NoReturn:
    """Passes commands on. The program ends when the worker does, whatever it computes."""
    with connection.makefile("rb") as lines:
        for line in lines:
            commands.put(json.loads(line))
    os._exit(0)


def main() -> NoReturn:
    """Serves the worker."""
    connection = socket.socket(socket.AF_UNIX)
    connection.connect(os.environ["PICOFARM_TORCH_SOCKET"])
    commands: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    threading.Thread(target=listen, args=(connection, commands), daemon=True).start()
    program = Program(connection)
    program.say({"rank": program.rank, "versions": program.versions()})
    while True:
        command = commands.get()
        try:
            program.say(program.answer(command))
        except Exception:
            program.say({"error": traceback.format_exc(limit=-4)})
            raise


def start() -> None:
    """Serves the worker with one process, or with a group of several."""
    processes = int(os.environ["PICOFARM_TORCH_PROCESSES"])
    if processes == 1:
        return main()
    from torch.distributed import run

    paths = (sys.path[0], os.environ.get("PYTHONPATH"))
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    # All processes are on this machine.
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    run.main(["--standalone", "--nproc-per-node", str(processes), "-m", __name__])


if __name__ == "__main__":
    main()
