"""What the command line prints of names that others chose."""

import io
import signal
import sys
from pathlib import Path

import pytest
import torch

from kfgs import cli
from kfgs.cli import main
from kfgs.cli.output import END, LINE, say
from kfgs.formats import write_splats
from kfgs.gaussians import Gaussians

ESCAPES = "a\x1b[31m\x07\x9b\u202eb\udc80\r"


def splat(path, classes):
    rng = torch.Generator().manual_seed(0)
    n = 20
    cloud = Gaussians(
        torch.randn(n, 3, generator=rng),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.full((n, 3), 0.1),
        torch.full((n,), 0.5),
        sh=torch.zeros(n, 1, 3),
        labels=torch.arange(n) % 2,
    )
    write_splats(cloud.replace(names=classes), path)
    return path


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


def test_class_names_of_a_stranger_reach_the_terminal_without_control_characters(tmp_path, capsys):
    file = splat(tmp_path / "a.ply", ("wall\x1b]0;owned\x07", "chair\x9b2J"))
    assert main(["convert", str(file)]) == 0
    assert main(["select", "sofa", str(file), "--out", str(tmp_path / "b.ply")]) == 1
    said = capsys.readouterr()
    assert "wall\\x1b" in said.out
    assert "wall" in said.err
    assert not {"\x1b", "\x07", "\x9b"} & set(said.out + said.err)


def test_a_list_of_thousands_of_classes_is_shortened_in_an_error(tmp_path, capsys):
    names = tuple(f"class number {i}" for i in range(3000))
    file = splat(tmp_path / "a.ply", names)
    assert main(["edit", str(file), "--out", str(tmp_path / "b.ply"), "--remove", "sofa"]) == 1
    error = capsys.readouterr().err
    assert "sofa" in error
    assert len(error) < LINE + 100


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_half_a_surrogate_pair_can_be_printed(stream, monkeypatch):
    raw = io.BytesIO()
    monkeypatch.setattr(sys, stream, io.TextIOWrapper(raw, encoding="utf-8", errors="strict"))
    say("\udc80", getattr(sys, stream))
    assert raw.getvalue() == b"\\udc80\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's full device")
@pytest.mark.parametrize(
    ("stream", "name"), [("stdout", "standard output"), ("stderr", "standard error"), ("", "/dev/full")]
)
def test_a_stream_that_takes_nothing_is_named(stream, name, monkeypatch):
    with Path("/dev/full").open("w") as full:
        if stream:
            monkeypatch.setattr(sys, stream, full)
        with pytest.raises(OSError, match=f"^{name} cannot be written"):
            say("hello", full)


@pytest.mark.parametrize("error", [AttributeError, ImportError, SystemError])
def test_an_interrupt_that_a_loading_module_turns_into_another_error_is_one(error, monkeypatch, capsys):
    def probe() -> None:
        """Load a module."""
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise error("partially initialized module") from None

    monkeypatch.setitem(cli.COMMANDS, "probe", probe)
    assert cli.main(["probe"]) == 130
    assert capsys.readouterr().err == "interrupted\n"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
