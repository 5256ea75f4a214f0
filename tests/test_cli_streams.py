"""The command line where streams, names, memory, the terminal or the working directory are not as usual."""

import io
import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from kfgs import cli
from kfgs.cli import main
from kfgs.cli.files import END, LINE, say
from kfgs.formats import read_splats, write_splats

ESCAPES = "a\x1b[31m\x07\x9b\u202eb\udc80\r"
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


def test_what_is_not_printable_is_escaped_and_letters_stay():
    file = io.StringIO()
    say(f"Stühle 椅子: {ESCAPES}\n\tnext line", file)
    assert file.getvalue() == "Stühle 椅子: a\\x1b[31m\\x07\\x9b\\u202eb\\udc80\\r\n\tnext line\n"


def test_the_middle_of_a_long_line_is_left_out():
    file = io.StringIO()
    say("x" * 10_000 + "; do this\nshort", file)
    line, short, _ = file.getvalue().split("\n")
    assert len(line) < LINE + 60
    assert line.startswith("x" * (LINE - END))
    assert "(8009 characters left out)" in line
    assert line.endswith("x; do this")
    assert short == "short"
    say("y" * LINE, file)
    assert file.getvalue().endswith("\n" + "y" * LINE + "\n")


def test_class_names_of_a_stranger_reach_the_terminal_without_control_characters(desk, tmp_path, capsys):
    cloud, file = read_splats(desk / "my.ply").select(torch.arange(20)), tmp_path / "a.ply"
    names = ("wall\x1b]0;owned\x07", "chair\x9b2J")
    write_splats(cloud.replace(labels=torch.arange(20) % 2, names=names), file)
    assert main(["convert", str(file)]) == 0
    assert main(["select", "sofa", str(file), "--out", str(tmp_path / "b.ply")]) == 1
    said = capsys.readouterr()
    assert "wall\\x1b" in said.out
    assert "wall" in said.err
    assert not {"\x1b", "\x07", "\x9b"} & set(said.out + said.err)
