"""Benchmarks that print tables: one small run of each."""

import ast
import importlib
import json
import re
import runpy
from argparse import Namespace
from importlib.util import find_spec
from pathlib import Path

import pytest

from kfgs.fields import gaussians_from_points
from kfgs.formats import write_splats
from kfgs.quant.maps import IndexMaps
from kfgs.scenes import load_scene

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


def rows_of(said):
    return [line.split(" | ") for line in said.splitlines() if line.startswith("| ")][1:]


def test_color_field_fits_scores_and_draws(room, tmp_path, monkeypatch, capsys):
    words = [room, tmp_path / "out", "--preset", "quick", "--steps", 20, "--pictures", 2]
    start(monkeypatch, "color_field", *words).main()
    facts = json.loads((tmp_path / "out" / "scores.json").read_text())
    assert (facts["steps"], facts["preset"], len(facts["scores"]["views"])) == (20, "quick", 3)
    assert facts["scores"]["psnr"] > 8
    assert len(list((tmp_path / "out" / "views").glob("*.png"))) == 2
    assert "kfgs-color/1" in capsys.readouterr().out


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


def test_growth(monkeypatch, capsys, tmp_path):
    growth = start(monkeypatch, "growth", tmp_path / "out", "--quick")
    growth.main()
    facts = json.loads((tmp_path / "out" / "growth.json").read_text())
    assert list(facts) == ["Gaussians", "pixels", "channels", "classes", "views"]
    assert (tmp_path / "out" / "growth.png").stat().st_size > 10_000
    assert capsys.readouterr().out.count("| ") > 30
    rows = [{"size": 10, "a": 0.5}, {"size": 1000, "a": 5.0}]
    assert growth.table("views", ("a",), rows).splitlines()[-1] == "| 1,000 | 5,000.0 (0.5) |"


def test_old_and_new_label_maps_are_equal(monkeypatch, capsys):
    start(monkeypatch, "labels", "--quick").main()
    rows = rows_of(capsys.readouterr().out)
    assert len(rows) == 6
    assert [row[-1] for row in rows if "query" not in row[0]] == ["yes |"] * 5


def test_transfer_prints_every_row(monkeypatch, capsys):
    options = ["--sources", "4000", "--destinations", "5000", "--repeats", "1"]
    monkeypatch.setattr("sys.argv", ["transfer.py", *options])
    runpy.run_path(str(BENCHMARKS / "transfer.py"), run_name="__main__")
    rows = dict(re.findall(r"^(.*?) {2,}\d.* ([\d.]+)%$", capsys.readouterr().out, re.MULTILINE))
    assert set(rows) == {"nearest, lambda chosen", "nearest"}
    assert all(95 < float(share) <= 100 for share in rows.values())  # lambda covers 99.5 % of the destinations


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the highest memory is read from /proc")
def test_streaming_measures_each_stage(room, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    read, table = load_scene(room), tmp_path / "table.json"
    write_splats(gaussians_from_points(read.points, colors=read.colors, sh_degree=0), tmp_path / "a.ply")
    words = ["--images", 11, "--size", 12, 16, "--channels", 7, "--epochs", 2, "--json", table]
    words += ["--splat", tmp_path / "a.ply", "--folder", tmp_path / "kept"]
    streaming = start(monkeypatch, "streaming", room, *words)
    apart = streaming.run_apart  # a process costs seconds of imports

    def run(args, stage):
        return (
            apart(args, stage) if stage == "start" else streaming.run_stage(Namespace(**vars(args) | {"stage": stage}))
        )

    monkeypatch.setattr(streaming, "run_apart", run)
    streaming.main()
    facts = json.loads(table.read_text())
    assert [row["stage"] for row in facts["stages"]] == ["start", "extract", "codebook", "index maps", "uplift"]
    assert 5e7 < facts["stages"][0]["peak"] < 2e9
    maps = IndexMaps.load(tmp_path / "kept" / "index_maps.safetensors")
    assert (len(maps), maps[0].shape) == (11, (12, 16))
    assert "| extract |" in capsys.readouterr().out
