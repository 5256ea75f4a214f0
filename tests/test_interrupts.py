import subprocess
import sys

import pytest

RUN = "import sys; from kfgs.__main__ import run; sys.argv = ['kfgs', *sys.argv[1:]]; sys.exit(run())"


def run(folder, *words, code=RUN):
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, words)], cwd=folder, capture_output=True, text=True, timeout=250
    )
    return done.returncode, done.stderr


CPP = """
import os, signal
try:
    os.kill(os.getpid(), signal.SIGINT)
    for _ in range(1000):
        pass
except BaseException:  # as a module in C++ does
    os.abort()
def encode(picture):
    raise AssertionError("it was to end before")
"""


def test_while_a_module_loads_the_process_ends_at_once(room, tmp_path):
    (tmp_path / "native.py").write_text(CPP)
    words = ["features", room, "--teacher", "native:encode", "--out", tmp_path / "maps"]
    assert run(tmp_path, *words) == (130, "interrupted\n")


def test_while_the_command_line_itself_loads(tmp_path):
    (tmp_path / "tyro.py").write_text(CPP)
    assert run(tmp_path, "--help") == (130, "interrupted\n")


def test_a_shell_that_ignores_ctrl_c_for_its_jobs_is_obeyed():
    code = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\n" + RUN
    end = "\nassert signal.getsignal(signal.SIGINT) is signal.SIG_IGN"
    code = code.replace("sys.exit(run())", "run()") + end
    assert subprocess.run([sys.executable, "-c", code, "--version"], capture_output=True).returncode == 0


ASKED = """
import os, signal
from kfgs import cli
def probe() -> None:
    "Load pycolmap, and be asked to end."
    from kfgs.scenes.colmap import import_pycolmap
    import_pycolmap()
    os.kill(os.getpid(), signal.SIGTERM)
    print("went on")
cli.COMMANDS["probe"] = probe
"""


@pytest.mark.skipif(sys.platform == "win32", reason="SIGTERM")
def test_a_process_that_is_asked_to_end_says_one_line(tmp_path):
    assert run(tmp_path, "probe", code=ASKED + RUN) == (130, "interrupted\n")
