"""`kfgs` and `python -m kfgs`: the command line."""

import signal
import sys

from ._interrupts import end_at_once


def run() -> int:
    """Run the command of this process; return the exit code."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end_at_once)  # also while the command is imported, and when it has ended
    from .cli import main

    return main()


if __name__ == "__main__":
    sys.exit(run())
