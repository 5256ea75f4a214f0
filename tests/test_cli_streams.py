"""The command line where streams, memory, the terminal or the working directory are not as usual."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from kfgs import cli

KFGS = f"{sys.executable} -m kfgs"


def shell(line, folder, **variables):
    """Run a line of bash; its exit code, and what it says on both streams."""
    here = os.path.dirname(os.path.dirname(cli.__file__.removesuffix("/__init__.py")))
    env = os.environ | {"PYTHONPATH": here} | variables
    done = subprocess.run(["bash", "-c", line], cwd=folder, capture_output=True, text=True, timeout=200, env=env)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("words", ["--help", "--version", "convert --help"])
def test_a_reader_that_ends_is_no_error(words, tmp_path):
    line = f"{{ sleep 0.1; {KFGS} {words}; echo $? >&2; }} | true"
    assert shell(line, tmp_path) == (0, "", "141\n")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="Linux")
def test_a_full_disk_below_the_output_is_named(tmp_path):
    code, _, error = shell(f"{KFGS} --help > /dev/full", tmp_path)
    assert (code, error) == (1, "error: [Errno 28] No space left on device: 'standard output'\n")


@pytest.mark.parametrize(
    ("words", "written"),
    [
        ("attach {0}/run/field.kfgs {0}/my.ply --out {1}/a.ply", "a.ply"),
        ("convert {0}/run/field.kfgs {1}/a.ply", "a.ply"),
        ("convert {0}/run/field.kfgs {1}/a.kfgs", "a.kfgs"),
        ("select floor {0}/run/field.kfgs --out {1}/a", "a/selection.json"),
        ("edit {0}/labelled.ply --remove floor --out {1}/a.ply", "a.ply.edits.json"),
        ("convert {0}/labelled.ply {1}/a.splat", "a.splat"),
        ("convert {0}/labelled.ply {1}/a --by-class", "a"),
        ("evaluate {0}/run --out {1}/a.json", "a.json"),
    ],
)
def test_what_is_asked_for_is_written_though_nobody_reads_what_is_said(words, written, desk, tmp_path, monkeypatch):
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as unread:
        monkeypatch.setattr(sys, "stdout", unread)
        assert cli.main(words.format(desk, tmp_path).split()) == 141
    assert (tmp_path / written).exists()


SHORT = {
    "Python": lambda: bytearray(1 << 60),
    "NumPy": lambda: np.empty(1 << 58),
    "torch": lambda: torch.empty(1 << 55),
}


@pytest.mark.parametrize("who", SHORT)
def test_too_little_memory_is_one_line(who, monkeypatch, capsys):
    def probe() -> None:
        SHORT[who]()

    monkeypatch.setitem(cli.COMMANDS, "probe", probe)
    assert cli.main(["probe"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("error: expected enough memory, but it ran out (")
    assert "use a larger machine" in said
