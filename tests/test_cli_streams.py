"""The command line where streams, memory, the terminal or the working directory are not as usual."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from small_room import make_desk

from kfgs import cli
from kfgs.formats.ply import write_ply

KFGS = f"{sys.executable} -m kfgs"


def shell(line, folder, **variables):
    """Run a line of bash; its exit code, and what it says on both streams."""
    here = os.path.dirname(os.path.dirname(cli.__file__.removesuffix("/__init__.py")))
    env = os.environ | {"PYTHONPATH": here} | variables
    done = subprocess.run(["bash", "-c", line], cwd=folder, capture_output=True, text=True, timeout=200, env=env)
    return done.returncode, done.stdout, done.stderr


@pytest.fixture
def cloud(tmp_path):
    write_ply(tmp_path / "a.ply", {"x": np.zeros(3, np.float32)})
    return tmp_path


@pytest.mark.parametrize("words", ["--help", "--version", "convert --help"])
def test_a_reader_that_ends_is_no_error(words, tmp_path):
    line = f"{{ sleep 0.1; {KFGS} {words}; echo $? >&2; }} | true"
    assert shell(line, tmp_path) == (0, "", "141\n")


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    folder = make_desk(tmp_path_factory.mktemp("desk"))
    for words in ("attach {0}/run/field.kfgs {0}/my.ply --out {0}/labelled.ply",):
        assert cli.main(words.format(folder).split()) == 0
    return folder


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


@pytest.mark.parametrize("words", ["--help", "--version", "convert a.ply"])
def test_output_that_cannot_be_written_is_named(words, cloud):
    code, _, said = shell(f"{KFGS} {words} > /dev/full", cloud)
    assert (code, said.count("\n")) == (1, 1)
    assert said.startswith("error: standard output cannot be written (No space left on device); choose")


def test_closed_streams_change_nothing_and_no_file_gets_their_numbers(cloud):
    code, said, _ = shell(f"{KFGS} convert a.ply 2>&-", cloud)
    assert (code, "3 vertices" in said) == (0, True)
    assert shell(f"{KFGS} convert a.ply >&- <&-", cloud) == (0, "", "")
    assert shell(f"{KFGS} convert missing.ply 2>&-", cloud)[0] == 1
    code = "import os; from kfgs.cli import main; main(['--version']); print(os.open('a.ply', os.O_RDONLY) > 2)"
    assert shell(f'{sys.executable} -c "{code}" 2>&- <&-', cloud)[1].endswith("True\n")


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


def test_another_runtime_error_stays_a_bug(monkeypatch):
    def probe() -> None:
        raise RuntimeError("a bug of ours")

    monkeypatch.setitem(cli.COMMANDS, "probe", probe)
    with pytest.raises(RuntimeError, match="a bug of ours"):
        cli.main(["probe"])


@pytest.mark.parametrize("words", [["--help"], ["fit", "--help"]])
def test_a_terminal_of_one_column(words, tmp_path):
    code, said, errors = shell(f"{KFGS} {' '.join(words)}", tmp_path, COLUMNS="1")
    assert (code, errors) == (0, "")
    assert "usage: kfgs" in said


def test_a_deleted_working_directory_is_named_before_torch_loads(tmp_path):
    (tmp_path / "gone").mkdir()
    run = f"{sys.executable} -c 'import os; from kfgs.cli import main; os.rmdir(os.getcwd()); exit(main([\"demo\"]))'"
    code, said, errors = shell(run, tmp_path / "gone")
    assert (code, said) == (1, "")
    assert errors == "error: expected a working directory, got one that was deleted; change to another (cd)\n"
