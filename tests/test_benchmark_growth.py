"""The benchmark of growing sizes: one run of its smallest cases."""

import importlib
import json
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
if not (BENCHMARKS / "growth.py").is_file():  # a source distribution comes without them
    pytest.skip(f"no folder {BENCHMARKS}", allow_module_level=True)


def test_quick_run(monkeypatch, capsys, tmp_path):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setattr(sys, "argv", ["growth.py", str(tmp_path / "out"), "--quick"])
    growth = importlib.import_module("growth")
    growth.main()
    found = json.loads((tmp_path / "out" / "growth.json").read_text())
    assert list(found) == ["Gaussians", "pixels", "channels", "classes", "views"]
    assert all(len(rows) == 2 and all(value > 0 for row in rows for value in row.values()) for rows in found.values())
    assert (tmp_path / "out" / "growth.png").stat().st_size > 10_000
    assert capsys.readouterr().out.count("| ") > 30
    rows = [{"size": 10, "a": 0.5}, {"size": 1000, "a": 5.0}]
    assert growth.table("views", ("a",), rows).splitlines()[-1] == "| 1,000 | 5,000.0 (0.5) |"
