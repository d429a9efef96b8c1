"""The farm, as a training of one's own sees it: parameters, data, reports, checkpoints, artefacts.

    from picofarm import run

    data = run.dataset("rooms", split="train")
    state = run.resume() or {"epoch": 0, "weights": start()}
    while state["epoch"] < run.parameters.get("epochs", 10):
        loss = train_epoch(state, data, run.parameters["lr"])
        state["epoch"] += 1
        run.report(epoch=state["epoch"], loss=loss)
        run.checkpoint(state, step=state["epoch"])
    run.artifact("weights.npz")

A stage of kind `python` runs such a file on a worker. Outside of a farm, `report` prints, and
`checkpoint` and `artifact` do nothing, so that the same file also runs on its own.
"""

from __future__ import annotations

import io
import json
import math
import os
import pickle
import shutil
import socket
import sys
import tarfile
import threading
import time
from collections.abc import Callable
from typing import Any, cast

__all__ = [
    "Stopped",
    "artifact",
    "checkpoint",
    "dataset",
    "inside",
    "parameters",
    "progress",
    "report",
    "resume",
    "stopped",
]

_FORMAT = "picofarm-run-1"


class Stopped(Exception):
    """The training must end: its trial is pruned, or the worker stops. Let it pass: the worker
    knows how to go on."""


def _task() -> dict[str, Any] | None:
    folder = os.environ.get("PICOFARM_RUN")
    if folder is None:
        return None
    with open(os.path.join(folder, "task.json"), encoding="utf-8") as file:
        return json.load(file)


_TASK = _task()
_FOLDER = os.environ.get("PICOFARM_RUN", "")

inside: bool = _TASK is not None
"""Whether a worker runs this process."""
parameters: dict[str, Any] = dict((_TASK or {}).get("parameters") or {})
"""The stage's `python.parameters`. A sweep sets them for each trial."""


class _Worker:
    """The connection to the worker: one message, one answer."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._stream: Any = None
        self._pid = 0
        self.stopping: str | None = None
        self.saved = time.monotonic()
        self.count = 0

    def ask(self, message: dict[str, Any]) -> dict[str, Any]:
        text = json.dumps(message, allow_nan=False) + "\n"
        with self._lock:
            if self._stream is None or self._pid != os.getpid():
                link = socket.socket(socket.AF_UNIX)
                link.connect(os.path.join(_FOLDER, "socket"))
                self._stream, self._pid = link.makefile("rwb"), os.getpid()
            try:
                self._stream.write(text.encode())
                self._stream.flush()
                line = self._stream.readline()
            except OSError:
                line = b""
        if not line:
            # Without its worker, nobody wants the work.
            os._exit(1)
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise RuntimeError(answer["error"])
        if "stopping" in answer:
            self.stopping = answer["stopping"]
        if "stop" in answer:
            self.stopping = answer["stop"]
            raise Stopped(answer["stop"])
        return answer


_worker = _Worker()


def report(*, step: int | None = None, epoch: int | None = None, **metrics: float) -> None:
    """Reports metrics after a step or an epoch. Sweeps compare trials by them.

    Args:
        step: Number of completed steps.
        epoch: Number of completed epochs, from 1. A sweep's rungs are epochs.
        metrics: Numbers by name. NaN and infinity are reported as missing.

    Raises:
        Stopped: The trial is pruned, or the worker stops.
    """
    numbers = {name: float(value) for name, value in metrics.items()}
    if not inside:
        at = {"step": step, "epoch": epoch}
        shown = {k: v for k, v in (at | numbers).items() if v is not None}
        print(", ".join(f"{k} {v:g}" for k, v in shown.items()), file=sys.stderr)
        return
    finite = {k: v if math.isfinite(v) else None for k, v in numbers.items()}
    _worker.ask({"report": {"step": step, "epoch": epoch, "metrics": finite}})


def progress(share: float) -> None:
    """Reports the completed share of the training, from 0 to 1."""
    if inside:
        _worker.ask({"progress": float(share)})


def checkpoint(state: Any, *, step: int, now: bool = False) -> bool:
    """Saves a checkpoint in the farm's store if one is due; returns whether it did.

    One is due `python.checkpoint_minutes` after the last, and when the worker is about to stop.
    Call it often: it is cheap while none is due.

    Args:
        state: Bytes, the path of a folder or file (`pathlib.Path`), anything that `torch.save` or
            `pickle` can write, or a function that returns one of these.
        step: Number of completed steps or epochs; grows from checkpoint to checkpoint.
        now: Saves in any case.

    Raises:
        Stopped: The worker stops; the checkpoint is saved.
    """
    if _TASK is None:
        return False
    every = 60 * float(_TASK.get("checkpoint_minutes", 5))
    due = now or _worker.stopping is not None or time.monotonic() - _worker.saved >= every
    if not due:
        return False
    if callable(state):
        state = state()
    _worker.count += 1
    path = os.path.join(_FOLDER, f"checkpoint-{os.getpid()}-{_worker.count}")
    with open(path, "wb") as file:
        _write(file, state)
    _worker.saved = time.monotonic()
    _worker.ask({"checkpoint": {"step": int(step), "path": path}})
    return True


def resume(default: Any = None) -> Any:
    """Returns the state of the newest checkpoint, as it was given to `checkpoint`: bytes, an
    object, or the `pathlib.Path` of a folder or file. Without a checkpoint, returns `default`."""
    path = (_TASK or {}).get("checkpoint")
    if path is None:
        return default
    with open(path, "rb") as file:
        return _read(file)


def dataset(name: str | None = None, **options: Any) -> Any:
    """Opens an input of the stage as a `picofarm.Dataset`.

    Args:
        name: The folder of the stage's `source`; may be left out.
        options: As for `picofarm.open`: `split`, `arrays`, `crop`, … A side of a split
            (`split="train"`) is that of the stage's `python.split`.
    """
    inputs: dict[str, Any] = (_TASK or {}).get("inputs") or {}
    if not inputs:
        raise ValueError("dataset: the stage has no source; give it one, or use picofarm.open")
    if name is None:
        name = next(iter(inputs))
    if name not in inputs:
        raise ValueError(f"dataset: the stage reads {', '.join(inputs)}, not {name!r}")
    import picofarm

    if not hasattr(picofarm, "open"):
        raise ImportError("dataset: needs picofarm in the worker's Python; install its wheel there")
    place = inputs[name]
    if "split" in options and "split_name" not in options:
        if not place["split"]:
            what = "name the split as python.split, so that the job pins it"
            raise ValueError(f"dataset: split = {options['split']!r}: {what}")
        options["split_name"] = place["split"]
        options.setdefault("split_version", place["split_version"])
    elif "scenes" not in options:
        options["scenes"] = place["scenes"]
    return picofarm.open(place["url"], **options)


def artifact(path: str | os.PathLike[str], name: str | None = None) -> None:
    """Publishes a file with the model when the training ends.

    Args:
        path: The file. It is copied now.
        name: Its name in the model; the file's name without it. A second file of the same name
            replaces the first.
    """
    path = os.fspath(path)
    if not os.path.isfile(path):
        raise FileNotFoundError(f"artifact: {path} is no file; pack a folder first")
    if _TASK is None:
        return
    _worker.count += 1
    copy = os.path.join(_FOLDER, f"artifact-{os.getpid()}-{_worker.count}")
    shutil.copyfile(path, copy)
    _worker.ask({"artifact": {"name": name or os.path.basename(path), "path": copy}})


def finish(ended: dict[str, Any]) -> None:
    """Reports the end. The runner calls it."""
    try:
        json.dumps(ended, allow_nan=False)
    except (TypeError, ValueError):
        ended.pop("result", None)
    try:
        _worker.ask({"done": ended})
    except Stopped:
        pass


def _write(file: Any, state: Any) -> None:
    """Writes a state: a line that describes it, then its bytes."""

    def head(form: str, **more: Any) -> None:
        file.write(json.dumps({"format": _FORMAT, "form": form, **more}).encode() + b"\n")

    if isinstance(state, (bytes, bytearray, memoryview)):
        head("bytes")
        file.write(state)
    elif isinstance(state, os.PathLike):
        path = str(os.fspath(cast("os.PathLike[str]", state)))
        head("path", name=os.path.basename(os.path.normpath(path)))
        with tarfile.open(fileobj=file, mode="w|") as archive:
            archive.add(path, arcname="state")
    elif "torch" in sys.modules:
        import torch  # pyright: ignore

        head("torch")
        torch.save(state, file)  # pyright: ignore
    else:
        head("pickle")
        pickle.dump(state, file)


def _read(file: Any) -> Any:
    head: dict[str, Any] = json.loads(file.readline())
    if head.get("format") != _FORMAT:
        raise ValueError(f"resume: the checkpoint has format {head.get('format')!r}, not {_FORMAT!r}")
    if head["form"] == "bytes":
        return file.read()
    if head["form"] == "torch":
        import torch  # pyright: ignore

        # torch.load seeks, and must begin at the state.
        return torch.load(io.BytesIO(file.read()), map_location="cpu", weights_only=False)  # pyright: ignore
    if head["form"] == "pickle":
        return pickle.load(file)
    import pathlib

    folder = os.path.join(_FOLDER, "resumed")
    with tarfile.open(fileobj=file, mode="r|") as archive:
        archive.extractall(folder, filter="data")
    kept = os.path.join(folder, head["name"])
    os.rename(os.path.join(folder, "state"), kept)
    return pathlib.Path(kept)


def _is_stopped() -> bool:
    if not inside:
        return False
    if _worker.stopping is None:
        try:
            _worker.ask({"poll": {}})
        except Stopped:
            pass
    return _worker.stopping is not None


_dynamic: dict[str, Callable[[], Any]] = {"stopped": _is_stopped}
stopped: bool
"""Whether the training should end soon; asks the worker."""


def __getattr__(name: str) -> Any:
    if name in _dynamic:
        return _dynamic[name]()
    raise AttributeError(f"module 'picofarm.run' has no attribute {name!r}")
