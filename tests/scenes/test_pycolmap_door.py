import signal
import subprocess
import sys

ASKED_TO_END = """
import os, signal
from kfgs.scenes._pycolmap import import_pycolmap
import_pycolmap()
os.kill(os.getpid(), signal.SIGTERM)
"""


def test_a_process_that_is_asked_to_end_says_nothing():
    ended = subprocess.run(
        [sys.executable, "-c", ASKED_TO_END], capture_output=True, text=True, timeout=60, check=False
    )
    assert ended.returncode == -signal.SIGTERM
    assert ended.stderr == ""  # pycolmap's log library would print a stack
