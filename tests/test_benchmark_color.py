"""The benchmark of colour fields runs, on the smallest room."""

import json
import runpy
from pathlib import Path

import pytest
from small_room import make_room

SCRIPT = Path(__file__).resolve().parents[1] / "benchmarks" / "color_field.py"
if not SCRIPT.is_file():  # a source distribution comes without it
    pytest.skip(f"no file {SCRIPT}", allow_module_level=True)


def test_it_fits_scores_and_draws(tmp_path, monkeypatch, capsys):
    room = make_room(tmp_path / "room")
    arguments = [
        "color_field.py",
        str(room),
        str(tmp_path / "out"),
        "--preset",
        "quick",
        "--steps",
        "20",
        "--pictures",
        "2",
    ]
    monkeypatch.setattr("sys.argv", arguments)
    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    runpy.run_path(str(SCRIPT), run_name="__main__")
    facts = json.loads((tmp_path / "out" / "scores.json").read_text())
    assert (facts["steps"], facts["preset"]) == (20, "quick")
    assert len(facts["scores"]["views"]) == 3
    assert facts["scores"]["psnr"] > 8
    assert len(list((tmp_path / "out" / "views").glob("*.png"))) == 2
    assert (tmp_path / "out" / "color.ply").is_file()
    assert "kfgs-color/1" in capsys.readouterr().out
