"""The demo as a story: what it says, and how it ends. Its scores are those of `.ci/run`, which runs all of it."""

import sys

import pytest

from kfgs import cli
from kfgs.pipeline import demo
from kfgs.viz import plotter

fit = sys.modules["kfgs.cli.fit"]  # kfgs.cli.fit is the command


@pytest.fixture
def opened(monkeypatch):
    """What the demo starts at its end; it makes nothing here."""
    started = []
    monkeypatch.setattr(demo, "run", lambda out, *_, **__: [])
    monkeypatch.setattr(fit.subprocess, "run", lambda command, **_: started.append(command))
    return started


def test_in_a_terminal_with_a_display_it_ends_by_opening_the_viewer(opened, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(plotter, "has_display", lambda: True)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    assert cli.main(["demo", "--out", str(tmp_path / "out")]) == 0
    [command] = opened
    assert command[:4] == [sys.executable, "-m", "kfgs", "view"]
    assert f"kfgs {' '.join(command[3:])}" in capsys.readouterr().out


@pytest.mark.parametrize("missing", ["display", "terminal"])
def test_elsewhere_it_says_how_to_look(opened, tmp_path, monkeypatch, capsys, missing):
    monkeypatch.setattr(plotter, "has_display", lambda: missing != "display")
    monkeypatch.setattr(sys.stdin, "isatty", lambda: missing != "terminal", raising=False)
    assert cli.main(["demo", "--out", str(tmp_path / "out")]) == 0
    assert not opened
    assert f"kfgs view {tmp_path / 'out' / 'run' / 'field'}" in capsys.readouterr().out
