"""Runs one task of a worker. The worker calls it with `PICOFARM_RUN`, the folder of the task.

The first process supervises. When the worker closes its socket, or ends, the supervisor ends all
processes of the task and removes the folder. The second process runs the code. The file needs no
other file of the package than `run.py`, so that a worker can bring both along.
"""

from __future__ import annotations

import ctypes
import importlib
import importlib.metadata
import importlib.util
import json
import os
import re
import runpy
import select
import shutil
import signal
import socket
import sys
import time
import traceback
import types
from typing import Any, NoReturn

# Exit status of a task whose requirements are not installed.
UNMET = 78
# Seconds in which killed processes are waited for.
_END_WITHIN = 3.0
# Numbers of Linux's prctl.
_PARENT_DEATH, _CHILD_SUBREAPER, _NO_NEW_PRIVILEGES = 1, 36, 38


def _prctl(option: int, value: int) -> None:
    """Sets an option of the kernel. Other systems than Linux have none."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


def _descendants() -> list[int]:
    """Returns the processes below this one. Without `/proc`, there are none to find."""
    parents: dict[int, list[int]] = {}
    try:
        names = [name for name in os.listdir("/proc") if name.isdigit()]
    except OSError:
        return []
    for name in names:
        try:
            with open(f"/proc/{name}/stat", "rb") as file:
                parent = int(file.read().rpartition(b")")[2].split()[1])
        except (OSError, IndexError, ValueError):
            continue
        parents.setdefault(parent, []).append(int(name))
    found: list[int] = []
    todo = [os.getpid()]
    while todo:
        below = parents.get(todo.pop(), [])
        found += below
        todo += below
    return found


def _end_all() -> None:
    """Kills the processes below this one, and waits until they are gone."""
    until = time.monotonic() + _END_WITHIN
    while (found := _descendants()) and time.monotonic() < until:
        for pid in found:
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                pass
        # As the subreaper, this process is the parent of all that have lost theirs.
        _reap(0)
        time.sleep(0.01)


def _reap(work: int) -> int | None:
    """Returns the status of the process `work` if it has ended. Reaps all ended processes."""
    found = None
    while True:
        try:
            pid, status = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return found
        if pid == 0:
            return found
        if pid == work:
            found = status


def _go_on(_signal: int, _frame: object) -> None:
    """Handles a signal: the wake-up pipe has told of it."""


def _supervise(watch: socket.socket, work: int, folder: str) -> NoReturn:
    """Waits for the end of the code or of the worker, whichever is first."""
    signal.signal(signal.SIGTERM, _go_on)
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    os.set_blocking(reading, False)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, _go_on)
    while True:
        status = _reap(work)
        if status is not None:
            break
        ready, _, _ = select.select([watch, reading], [], [], 5)
        if watch in ready and not watch.recv(1):
            _end_all()
            shutil.rmtree(folder, ignore_errors=True)
            if os.getpgrp() == os.getpid():
                # Where there is no /proc, this ends at least the group.
                os.killpg(0, signal.SIGKILL)
            os._exit(1)
        if reading in ready:
            os.read(reading, 4096)
    _end_all()
    code = os.waitstatus_to_exitcode(status)
    os._exit(code if code >= 0 else 128 - code)


def _load_run(folder: str) -> types.ModuleType:
    """Makes `picofarm.run` the file that the worker brought, also where no picofarm is installed."""
    try:
        package = importlib.import_module("picofarm")
    except ImportError:
        package = types.ModuleType("picofarm", "Without data sets: picofarm is not installed.")
        package.__path__ = []
        sys.modules["picofarm"] = package
    path = os.path.join(folder, "run.py")
    spec = importlib.util.spec_from_file_location("picofarm.run", path)
    assert spec is not None and spec.loader is not None
    run = importlib.util.module_from_spec(spec)
    sys.modules["picofarm.run"] = run
    package.run = run  # type: ignore[attr-defined]
    spec.loader.exec_module(run)
    return run


def _name(requirement: str) -> str:
    """Returns the name of a distribution, without its extras."""
    return re.sub(r"\[.*\]", "", requirement.partition("==")[0]).strip()


def _unmet(requirements: list[str]) -> list[str]:
    """Returns the requirements (`name==version`) that are not installed."""
    found: list[str] = []
    for requirement in requirements:
        # Hashes may follow.
        requirement = requirement.split()[0]
        wanted = requirement.partition("==")[2]
        name = _name(requirement)
        try:
            have = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found.append(f"{requirement} is not installed")
            continue
        # A local version, as in 2.9.0+cpu, satisfies its public one.
        if have != wanted and have.partition("+")[0] != wanted:
            found.append(f"{requirement} is not installed, but {name} {have} is")
    return found


def _facts(requirements: list[str], built: bool) -> dict[str, Any]:
    """Describes the environment of the task, for its manifest."""
    names = {_name(text) for text in requirements}
    if built:
        # With everything that the requirements brought along.
        names |= {found.name for found in importlib.metadata.distributions()}
    names |= {name for name in ("numpy", "torch", "jax", "picofarm") if name in sys.modules}
    versions: dict[str, str] = {}
    for name in sorted(names):
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {
        "python": sys.version.split()[0],
        "interpreter": sys.executable,
        "host": socket.gethostname(),
        "versions": versions,
    }


def _call(entry: str) -> Any:
    """Calls `module:function`, or runs `file.py` as a script."""
    module, colon, function = entry.partition(":")
    if not colon:
        runpy.run_path(os.path.join(sys.path[0], module), run_name="__main__")
        return None
    loaded = importlib.import_module(module)
    found = getattr(loaded, function, None)
    if not callable(found):
        raise SystemExit(f"entry: {module} has no function {function!r}; define it, or correct python.entry")
    return found()


def _print_trace(error: BaseException, folder: str) -> None:
    """Prints the traceback without the frames of this file."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        name = trace.tb_frame.f_code.co_filename
        if name != __file__ and "runpy" not in name and "importlib" not in name:
            break
        trace = trace.tb_next
    text = "".join(traceback.format_exception(type(error), error, trace))
    print(text.replace(os.path.join(folder, "code", ""), ""), end="", file=sys.stderr)


def _work(folder: str) -> int:
    with open(os.path.join(folder, "task.json"), encoding="utf-8") as file:
        task: dict[str, Any] = json.load(file)
    requirements: list[str] = task.get("requirements") or []
    unmet = _unmet(requirements)
    if unmet:
        print("requirements: " + "; ".join(unmet), file=sys.stderr)
        return UNMET
    sys.path[:] = [os.path.join(folder, "code"), *(p for p in sys.path if p != folder)]
    os.chdir(os.path.join(folder, "work"))
    sys.argv = [task["entry"]]
    run = _load_run(folder)
    ended: dict[str, Any] = {}
    try:
        result = _call(task["entry"])
        if result is not None:
            ended["result"] = result
    except run.Stopped as stopped:
        ended["stopped"] = str(stopped)
    except SystemExit as exit:
        if exit.code not in (None, 0):
            print(exit.code, file=sys.stderr)
            return exit.code if isinstance(exit.code, int) else 1
    except BaseException as error:
        _print_trace(error, folder)
        return 1
    ended["facts"] = _facts(requirements, bool(task.get("environment")))
    sys.stdout.flush()
    sys.stderr.flush()
    run.finish(ended)
    return 0


def main() -> NoReturn:
    folder = os.environ["PICOFARM_RUN"]
    watch = socket.socket(socket.AF_UNIX)
    watch.connect(os.path.join(folder, "socket"))
    _prctl(_NO_NEW_PRIVILEGES, 1)
    _prctl(_CHILD_SUBREAPER, 1)
    work = os.fork()
    if work:
        _supervise(watch, work, folder)
    _prctl(_PARENT_DEATH, signal.SIGKILL)
    watch.close()
    status = 1
    try:
        status = _work(folder)
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    # Threads of the code do not hold up the end.
    os._exit(status)


if __name__ == "__main__":
    main()
