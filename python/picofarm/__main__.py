"""The command line: `picofarm …` or `python -m picofarm …`."""

import sys
from typing import NoReturn

from ._native import main as _main


def main() -> NoReturn:
    sys.exit(_main(sys.executable, sys.argv[1:]))


if __name__ == "__main__":
    main()
