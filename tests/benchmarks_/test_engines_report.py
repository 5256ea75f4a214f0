"""The engines' benchmark: its tables from numbers known in advance, and one run of the smallest configuration."""

import importlib
import json
from itertools import dropwhile, takewhile
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
if not (BENCHMARKS / "engines.py").is_file():  # a source distribution comes without them
    pytest.skip(f"no folder {BENCHMARKS}", allow_module_level=True)
pytest.importorskip("numba", reason="the benchmark counts pairs with numba: `pip install numba`")

SIZES = [[1_000, 9, 40, 30], [4_000, 9, 40, 30], [16_000, 9, 40, 30]]


@pytest.fixture
def report_module(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return pytest.importorskip("engines_report")


def _times(seconds):
    return {"median": seconds, "least": 0.5 * seconds, "runs": 3}


def _report():
    """Forward grows as N, backward as sqrt(N), a frame as N^2; the second engine takes three times as long."""
    cases = []
    for case in SIZES:
        N = case[0] / 1_000
        parts = {"forward": 2e-3 * N, "backward": 4e-3 * N**0.5, "frame": 5e-3 * N**2}
        seconds = {
            engine: {part: _times(factor * value) for part, value in parts.items()}
            for engine, factor in (("kfgs numba", 1), ("kfgs reference", 3))
        }
        pairs = {"visible": 500, "listed": 7_000, "composited": 3_000_000}
        off = {"kfgs numba": 0.0, "kfgs reference": 3e-6}
        cases.append(
            {"case": case, "threads": 1, "pairs": pairs, "left_out": {}, "seconds": seconds, "difference": off}
        )
    cases[2]["left_out"]["kfgs reference"] = "about 99 s"
    for name in ("seconds", "difference"):
        del cases[2][name]["kfgs reference"]
    names = ("processor", "system", "python", "torch", "numba")
    machine = dict.fromkeys(names, "any") | {"cores": 2, "flags": ["avx2"]}
    step = {"case": SIZES[0], "threads": 1, "step": {"kfgs numba": _times(0.05)}, "stages": {}}
    step["stages"]["kfgs numba"] = {"project": _times(0.012), "bin": _times(0.03)}
    return {
        "machine": machine,
        "quick": True,
        "repeats": 3,
        "peak": {"1": {"flops": 1e11, "bandwidth": 2e10}},
        "slices": {"Gaussians": SIZES},
        "steps": [step],
        "cases": cases,
        "memory": [{"engine": "kfgs numba", "case": SIZES[0], "bytes": 5 * 2**20}],
    }


def _rows(text, title):
    """The cells of the first table below a title, without its head."""
    below = text.split(f"## {title}", 1)[1].splitlines()
    table = takewhile(lambda line: line.startswith("|"), dropwhile(lambda line: not line.startswith("|"), below))
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table]
    assert set(rows[1]) == {"---"}
    assert {len(row) for row in rows} == {len(rows[0])}
    return rows[2:]


@pytest.mark.parametrize(("part", "slope"), [("forward", "1.00"), ("backward", "0.50"), ("frame", "2.00")])
@pytest.mark.parametrize("engine", ["kfgs numba", "kfgs reference"])  # the latter from two of the three sizes
def test_slope_is_the_exponent(report_module, engine, part, slope):
    assert report_module._slope(_report(), "Gaussians", engine, part, 1) == slope


def test_tables_hold_what_the_numbers_say(report_module):
    text = report_module.write_tables(_report())
    assert "100 GFLOP/s (float32 matrix product), 20.0 GB/s" in text
    assert "further than 3e-06 from" in text
    assert _rows(text, "A whole training step")[0] == ["1k, 40x30, 9", "1", "kfgs numba", "50.0 (25.0)", "-"]
    assert "| 1 | kfgs numba | 12.0 (6.0) | 30.0 (15.0) | 42.0 (21.0) |" in text
    compositing = _rows(text, "Compositing against Gaussians, 1 thread")
    assert compositing[0] == ["1k, 40x30, 9", "7k", "3.0M", "2.0 (1.0) / 4.0 (2.0)", "6.0 (3.0) / 12.0 (6.0)"]
    assert [row[-1] for row in compositing[1:]] == ["24.0 (12.0) / 24.0 (12.0)", "about 99 s"]
    # 3e6 pairs in 2 ms are 1500 million a second, of 28 + 2 * 9 operations each: 0.69 of the peak; 45 + 4 * 9 in 4 ms
    assert _rows(text, "Pairs per second")[0][2:] == ["1500 (69%)", "750 (61%)"]
    assert [row[-1] for row in _rows(text, "Times as long as kfgs numba")] == ["3.00", "3.00", "-"]
    growth = _rows(text, "Growth")
    assert [row[:5] for row in growth] == [["1", e, "1.00", "0.50", "2.00"] for e in ("kfgs numba", "kfgs reference")]
    assert _rows(text, "Peak memory") == [["1k, 40x30, 9", "5"]]


# a real run -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def smallest_run(tmp_path_factory):
    """The report on 200 Gaussians in a picture of 32 x 24, as it comes back from the file, and the tables."""
    out = tmp_path_factory.mktemp("benchmark")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        engines, runners = importlib.import_module("engines"), importlib.import_module("engines_runners")
        patch.setattr(runners, "PROTOTYPE", out / "none")  # only what is part of kfgs: the peers may be there or not
        case, rates = engines.Case(200, 3, 32, 24), {}
        report = {"machine": engines.describe(), "quick": True, "repeats": 1, "peak": {}, "memory": []}
        report["peak"]["1"] = {"flops": 1e9, "bandwidth": 1e9}  # the real ones take 512 MiB
        report["slices"] = {"Gaussians": [list(case)]}
        report["steps"] = [engines.time_step(case, 1, 1)]
        report["cases"] = [engines.time_case(case, 1, 1, 20.0, rates), engines.time_case(case, 1, 1, 0.0, rates)]
        engines.save(report, out)
    return json.loads((out / "engines.json").read_text()), (out / "engines.md").read_text()


def test_smallest_run_measures_every_engine(smallest_run):
    report, _ = smallest_run
    (step,), (case, _) = report["steps"], report["cases"]
    assert list(case["seconds"]) == list(case["difference"]) == list(step["step"]) == ["kfgs numba", "kfgs reference"]
    for parts in case["seconds"].values():
        assert list(parts) == ["forward", "backward", "frame", "step", "labels", "uplift"]
        assert all(0 < times["least"] <= times["median"] for times in parts.values())
    assert max(case["difference"].values()) < 1e-2
    assert all(0 < times["least"] <= times["median"] for times in step["step"].values())
    assert len(step["stages"]["kfgs numba"]) == 7
    assert all(times["least"] > 0 for times in step["stages"]["kfgs numba"].values())
    pairs = case["pairs"]
    assert 0 < pairs["visible"] <= 200
    assert pairs["visible"] <= pairs["listed"] <= 4 * pairs["visible"]  # the picture has four tiles
    assert pairs["listed"] < pairs["composited"] <= 256 * pairs["listed"]
