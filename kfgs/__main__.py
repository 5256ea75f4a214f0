"""`kfgs` and `python -m kfgs`: the command line."""

import os
import signal
import sys

from ._interrupts import end_at_once


def run() -> int:
    """Run the command of this process; return the exit code."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:  # closed streams (`2>&-`): else a file gets their numbers
        os.set_inheritable(number, True)
    os.close(number)
    sys.stdout = sys.stdout or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 (it lives as long as the process)
    sys.stderr = sys.stderr or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end_at_once)  # also while the command is imported, and when it has ended
    from .cli import main

    return main()


if __name__ == "__main__":
    sys.exit(run())
