"""The labels' benchmark: one run of its smallest case, in which old and new labels are equal."""

import importlib
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
if not (BENCHMARKS / "labels.py").is_file():  # a source distribution comes without them
    pytest.skip(f"no folder {BENCHMARKS}", allow_module_level=True)
pytest.importorskip("numba", reason="the kernels need `pip install numba`")


def test_quick_run(monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setattr(sys, "argv", ["labels.py", "--quick"])
    importlib.import_module("labels").main()
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines() if line.startswith("| ")][1:]
    assert [row[0] for row in rows] == [
        "| label map",
        "| label map by rendered features",
        "| label map, another text each time",
        "| text query, score of each pixel",
        "| 5 best classes",
        "| exact decode",
    ]
    assert [row[-1] for row in rows if "query" not in row[0]] == ["yes |"] * 5


def test_too_few_classes_for_its_rows_are_an_error_in_one_line(monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setattr(sys, "argv", ["labels.py", "--quick", "--classes", "3"])
    with pytest.raises(SystemExit):
        importlib.import_module("labels").main()
    assert "--classes: expected at least 5" in capsys.readouterr().err


@pytest.mark.parametrize("classes", [3, None])
def test_a_field_with_too_few_classes_or_without_classes(classes, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    labels = importlib.import_module("labels")
    own = None if classes is None else SimpleNamespace(embeddings=torch.ones(classes, 8))
    camera = SimpleNamespace(resized=lambda height, width: None)
    field = SimpleNamespace(cameras=[camera], dim=8, classes=own, to=lambda device: exit("as many as asked for"))
    monkeypatch.setattr(labels.SemanticField, "load", lambda path: field)
    monkeypatch.setattr(sys, "argv", ["labels.py", "--quick", "--field", "F"])
    with pytest.raises(SystemExit) as end:
        labels.main()
    if classes == 3:
        assert "--field: expected a field of at least 5 classes" in capsys.readouterr().err
    else:
        assert end.value.code == "as many as asked for"
