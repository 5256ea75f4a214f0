"""Benchmarks that print tables: a small run of those that no other test runs."""

import ast
import importlib
import json
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BENCHMARKS = ROOT / "benchmarks"


def test_what_they_import_from_kfgs_exists():
    asked, missing = 0, []
    for path in [*BENCHMARKS.rglob("*.py"), *(ROOT / "docs").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "kfgs":
                module = importlib.import_module(node.module)
                asked += len(node.names)
                missing += [f"{path}: {node.module}.{one.name}" for one in node.names if not has(module, one.name)]
    assert missing == []
    assert asked > 300


def has(module, name):
    """Whether something can be imported from a module, or package, by this name."""
    return hasattr(module, name) or (hasattr(module, "__path__") and find_spec(f"{module.__name__}.{name}") is not None)


def start(monkeypatch, name, *words):
    monkeypatch.setattr("sys.argv", [f"{name}.py", *map(str, words)])
    return importlib.import_module(name)


def test_engines_are_measured_side_by_side(monkeypatch, tmp_path):
    """On 200 Gaussians in a picture of 32 x 24."""
    engines = start(monkeypatch, "engines")
    case = engines.Case(200, 3, 32, 24)
    report = {"machine": engines.describe(), "quick": True, "repeats": 1, "peak": {}, "memory": []}
    report["peak"]["1"] = {"flops": 1e9, "bandwidth": 1e9}  # the real ones take 512 MiB
    report["slices"] = {"Gaussians": [list(case)]}
    report["steps"] = [engines.time_step(case, 1, 1)]
    report["cases"] = [engines.time_case(case, 1, 1, seconds, {}) for seconds in (20.0, 0.0)]
    engines.save(report, tmp_path)
    report = json.loads((tmp_path / "engines.json").read_text())
    (step,), (timed, _) = report["steps"], report["cases"]
    assert list(timed["seconds"]) == list(timed["difference"]) == list(step["step"]) == ["kfgs numba", "kfgs reference"]
    times = [each for parts in timed["seconds"].values() for each in parts.values()]
    assert len(times) == 2 * 6  # forward, backward, frame, step, labels, uplift
    assert all(0 < each["least"] <= each["median"] for each in times + list(step["step"].values()))
    assert max(timed["difference"].values()) < 1e-2
    assert 0 < timed["pairs"]["visible"] <= timed["pairs"]["listed"] <= 4 * timed["pairs"]["visible"]  # of four tiles
