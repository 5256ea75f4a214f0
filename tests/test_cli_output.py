"""What the command line prints of names that others chose."""

import io

import torch

from kfgs.cli import main
from kfgs.cli.files import END, LINE, say
from kfgs.formats import read_splats, write_splats

ESCAPES = "a\x1b[31m\x07\x9b\u202eb\udc80\r"


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
