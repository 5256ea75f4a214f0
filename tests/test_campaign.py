"""The campaign in short: its mutants find nothing in kfgs, and find each kind of fault that is put in."""

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
from contextlib import suppress
from pathlib import Path
sys.path.insert(0, {benchmarks!r})
from campaign import files, readers
from campaign.record import Record
record = Record(Path({out!r}), Path({scratch!r}))
"""


def run(code, folder, *, minutes=4):
    """Run code in a process of its own, from which the campaign may fork; the lines of its record."""
    start = START.format(benchmarks=str(BENCHMARKS), out=str(folder / "out"), scratch=str(folder / "scratch"))
    alone = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")  # forks with threads would wait
    done = subprocess.run(
        [sys.executable, "-c", start + code], capture_output=True, text=True, timeout=60 * minutes, env=alone
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return [json.loads(line) for line in (folder / "out" / "results.jsonl").read_text().splitlines()]


def findings(lines):
    return [line for line in lines if line["kind"].endswith("finding")]


def test_mutants_of_every_file_are_read_or_refused(tmp_path):
    lines = run("files.run_files(record, seed=18, seconds=3000, most=570, batch=5)", tmp_path, minutes=8)
    assert findings(lines) == []
    readers = {line["reader"] for line in lines}
    assert len(readers) == 23
    assert sum(line.get("mutants", 0) for line in lines) == 570
    assert sum(line.get("refused", 0) for line in lines) > 120
    assert sum(line.get("read", 0) for line in lines) > 40


BROKEN = """
files.SECONDS = 1
def broken(path):
    data = path.read_bytes()
    exec(dict({faults!r}).get(len(data), ""))
readers.READERS["words"] = broken
files.run_files(record, seed=1, seconds=60, only="words.txt", most=20, batch=20)
"""
FAULTS = {  # of a mutant of so many bytes
    "error": (13, "raise KeyError('wall')"),
    "crash": (21, "import os; os.abort()"),
    "hang": (15, "while True: pass"),
    "memory": (22, "bytearray(b'x') * (320 << 20)"),
    "slow": (24, "import time; end = time.process_time() + 1.2\nwhile time.process_time() < end: pass"),
    "nameless": (17, "raise ValueError('something is wrong')"),
}


def test_each_fault_of_a_reader_is_found_with_its_mutant(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from campaign.files import make_mutant

    lines = run(BROKEN.format(faults=list(FAULTS.values())), tmp_path)
    sound = b"wall\nchair;armchair\n"
    mutants = [make_mutant(sound, "fields/classes/words.txt", 1, number) for number in range(20)]
    expected = {(i, what) for i, data in enumerate(mutants) for what, (size, _) in FAULTS.items() if len(data) == size}
    found = findings(lines)
    assert {(line["number"], line["what"]) for line in found} == expected
    assert {what for _, what in expected} == set(FAULTS)
    (batch,) = [line for line in lines if line["kind"] == "files"]
    assert batch["read"] + batch["refused"] + len(found) == batch["mutants"] == 20  # also after crashes
    kept = {path.name: path.read_bytes() for path in (tmp_path / "out" / "findings").rglob("*words.txt")}
    assert all(data == mutants[int(name.split("-")[1])] for name, data in kept.items())
    assert len(kept) >= len(FAULTS)
