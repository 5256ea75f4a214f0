"""`kfgs` and `python -m kfgs`: the command line."""

import os
import re
import signal
import sys

from ._interrupts import end_at_once


def run() -> int:
    """Run the command of this process; return the exit code."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(
            signal.SIGINT, end_at_once
        )  # outside the command, too: while it is imported, and when it has ended
    if sys.flags.optimize > 1 and {"-h", "--help"} & {*sys.argv[1:]} and os.environ.get("PYTHONOPTIMIZE") != "1":
        # the help is in docstrings, which Python leaves out (-OO): ask a Python that keeps them
        kept = [word for word in sys.orig_argv[1:] if not re.fullmatch("-O+", word)]
        os.execve(sys.executable, [sys.executable, *kept], {**os.environ, "PYTHONOPTIMIZE": "1"})
    from .cli import main

    return main()


if __name__ == "__main__":
    sys.exit(run())
