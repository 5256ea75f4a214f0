"""The benchmark of label transfer: one run on small clouds."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).resolve().parents[1] / "benchmarks" / "transfer.py"


@pytest.mark.skipif(not BENCHMARK.is_file(), reason=f"no {BENCHMARK}: a source distribution comes without benchmarks")
def test_small_run_prints_every_method():
    options = ["--sources", "4000", "--destinations", "5000", "--repeats", "1"]
    run = subprocess.run([sys.executable, BENCHMARK, *options], capture_output=True, text=True, timeout=120, check=True)
    assert "4,000 sources, 5,000 destinations, lambda 0." in run.stdout
    rows = dict(re.findall(r"^(.*?) {2,}\d.* ([\d.]+)% +[\d.]+%$", run.stdout, re.MULTILINE))
    assert set(rows) == {
        "nearest, lambda chosen",
        "nearest",
        *(f"{method}, {k} neighbours" for method in ("vote", "mahalanobis") for k in (8, 16)),
    }
    assert all(95 < float(share) <= 100 for share in rows.values())  # lambda covers 99.5 % of the destinations
