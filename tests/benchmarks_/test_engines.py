"""The engines' benchmark: one run of the smallest configuration."""

import importlib
import json
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
if not (BENCHMARKS / "engines.py").is_file():  # a source distribution comes without them
    pytest.skip(f"no folder {BENCHMARKS}", allow_module_level=True)
pytest.importorskip("numba", reason="the benchmark counts pairs with numba: `pip install numba`")


@pytest.fixture(scope="module")
def smallest_run(tmp_path_factory):
    """The report on 200 Gaussians in a picture of 32 x 24, as it comes back from the file, and the tables."""
    out = tmp_path_factory.mktemp("benchmark")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        engines = importlib.import_module("engines")
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
