"""The benchmark of label transfer: one run on small clouds."""

import re
import runpy
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).resolve().parents[1] / "benchmarks" / "transfer.py"


@pytest.mark.skipif(not BENCHMARK.is_file(), reason=f"no {BENCHMARK}: a source distribution comes without benchmarks")
def test_small_run_prints_every_row(monkeypatch, capsys):
    options = ["--sources", "4000", "--destinations", "5000", "--repeats", "1"]
    monkeypatch.setattr("sys.argv", [str(BENCHMARK), *options])
    runpy.run_path(str(BENCHMARK), run_name="__main__")
    said = capsys.readouterr().out
    assert "4,000 sources, 5,000 destinations, lambda 0." in said
    rows = dict(re.findall(r"^(.*?) {2,}\d.* ([\d.]+)% +[\d.]+%$", said, re.MULTILINE))
    assert set(rows) == {"nearest, lambda chosen", "nearest"}
    assert all(95 < float(share) <= 100 for share in rows.values())  # lambda covers 99.5 % of the destinations
