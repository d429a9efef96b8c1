"""Runs the program until standard input closes, so that it ends with the process that started it."""

import os
import signal
import sys
import threading

from . import _native


def _end_with_input() -> None:
    while sys.stdin.buffer.read(1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    threading.Thread(target=_end_with_input, daemon=True).start()
    sys.exit(_native.main(sys.executable, sys.argv[1:]))
