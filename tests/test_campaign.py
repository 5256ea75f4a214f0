"""The campaign in short: its mutants find nothing in kfgs."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
if not (BENCHMARKS / "campaign").is_dir():  # a source distribution comes without them
    pytest.skip(f"no folder {BENCHMARKS}", allow_module_level=True)
if not Path("/proc/self/clear_refs").exists():
    pytest.skip("the campaign watches its processes through Linux's /proc", allow_module_level=True)

START = """
import sys
from pathlib import Path
sys.path.insert(0, {benchmarks!r})
from campaign import files, readers
from campaign.record import Record
record = Record(Path({out!r}), Path({scratch!r}))
"""


def run(code, folder):
    """Run code in a process of its own, from which the campaign may fork; the lines of its record."""
    start = START.format(benchmarks=str(BENCHMARKS), out=str(folder / "out"), scratch=str(folder / "scratch"))
    alone = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")  # forks with threads would wait
    done = subprocess.run([sys.executable, "-c", start + code], capture_output=True, text=True, timeout=480, env=alone)
    assert done.returncode == 0, done.stderr[-3000:]
    return [json.loads(line) for line in (folder / "out" / "results.jsonl").read_text().splitlines()]


def test_mutants_of_every_file_are_read_or_refused(tmp_path):
    lines = run("files.run_files(record, seed=18, seconds=3000, most=570, batch=5)", tmp_path)
    assert [line for line in lines if line["kind"].endswith("finding")] == []
    readers = {line["reader"] for line in lines}
    assert len(readers) == 23
    assert sum(line.get("mutants", 0) for line in lines) == 570
    assert sum(line.get("refused", 0) for line in lines) > 120
    assert sum(line.get("read", 0) for line in lines) > 40
