"""Work in a forked child: a new process without the seconds of imports."""

import json
import multiprocessing
import os
import signal
import time
import warnings

import pytest

forks = pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="this system does not fork")


def in_fork(work, seconds=300):
    """What `work` returns in a forked child, as JSON; the child is ended if it hangs."""
    read, write = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # from Python 3.12 on: a fork of a process with threads
        child = os.fork()
    if child == 0:
        try:
            os.write(write, json.dumps(work()).encode())
        finally:
            os._exit(0)
    os.close(write)
    deadline = time.monotonic() + seconds
    while os.waitpid(child, os.WNOHANG) == (0, 0):
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            pytest.fail(f"the forked child hangs for more than {seconds} s")
        time.sleep(0.01)
    with os.fdopen(read, "rb") as pipe:
        return json.loads(pipe.read())
