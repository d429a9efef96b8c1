"""Builds the virtual environment of a worker's tasks: `_environment.py FOLDER REQUIREMENTS`.

It uses `uv` if that is in PATH, otherwise `venv` and `pip`. Only wheels are installed, so that no
code of a package runs during the build. When the worker closes the input, or dies, the build ends.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
from typing import NoReturn


def _end_with_worker() -> None:
    """Waits for the end of the input, then kills the group of processes, which this one leads."""
    while os.read(0, 4096):
        pass
    os.killpg(0, signal.SIGKILL)


def _run(*command: str) -> None:
    """Runs a program, whose output becomes that of this process."""
    status = subprocess.run(command, stdin=subprocess.DEVNULL, check=False).returncode
    if status:
        raise SystemExit(status if status > 0 else 1)


def main(folder: str, requirements: str) -> None:
    threading.Thread(target=_end_with_worker, daemon=True).start()
    with open(requirements, encoding="utf-8") as file:
        hashed = ["--require-hashes"] if "--hash=" in file.read() else []
    wanted = ["--only-binary", ":all:", *hashed, "--requirement", requirements]
    python = os.path.join(folder, "bin", "python")
    if uv := shutil.which("uv"):
        _run(uv, "venv", "--quiet", "--no-project", "--python", sys.executable, folder)
        _run(uv, "pip", "install", "--no-progress", "--python", python, *wanted)
        return
    _run(sys.executable, "-m", "venv", folder)
    quiet = ["--no-input", "--disable-pip-version-check", "--progress-bar", "off"]
    _run(python, "-m", "pip", "install", *quiet, *wanted)


def _end(status: int) -> NoReturn:
    sys.stdout.flush()
    sys.stderr.flush()
    # The thread that waits for the worker does not hold up the end.
    os._exit(status)


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except SystemExit as exit:
        _end(exit.code if isinstance(exit.code, int) else 1)
    _end(0)
