"""One process for a long time: fits, pages that are opened and closed, queries. Memory and threads must stay flat."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from .record import Record

PARTS = {"fits": 1000, "views": 200, "queries": 10_000}
"""How often each is done, if the time suffices."""
FIRST = 0.3  # share that is not counted: caches fill, the allocator learns
MEMORY = 8 << 20  # bytes that may be added by all the counted rounds together, whatever their number
SAMPLES = 200


def run_long(record: Record, *, seed: int, seconds: float, only: str = "", most: int | None = None) -> None:
    """Each part in a process of its own."""
    parts = [name for name in PARTS if only in name]
    for name in parts:
        count = PARTS[name] if most is None else min(most, PARTS[name])
        words = [sys.executable, "-m", "campaign.long", name, str(count), str(seconds / len(parts)), str(seed)]
        path = os.pathsep.join([str(Path(__file__).resolve().parents[1]), *sys.path])
        done = subprocess.run(words, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": path})
        base = {"kind": "long", "case": name, "seed": seed}
        if done.returncode:
            record.add(base)
            record.add(base | {"kind": "long finding", "what": "failed", "why": done.stderr[-500:]})
            continue
        facts = json.loads(done.stdout.splitlines()[-1])
        record.add(base | facts)
        for fault in faults_of(facts):
            record.add(base | {"kind": "long finding", "what": fault.partition(":")[0], "why": fault})


def faults_of(facts: dict[str, float]) -> list[str]:
    """What is wrong with the slopes of a long run."""
    faults = []
    grown = facts["bytes_per_round"] * facts["counted"]
    if grown > MEMORY:
        faults.append(f"memory grows: {facts['bytes_per_round']:.0f} bytes a round, {grown / 2**20:.1f} MiB in all")
    if facts["threads_last"] > facts["threads_first"]:
        faults.append(f"threads grow: {facts['threads_first']} to {facts['threads_last']}")
    if facts["files_last"] > facts["files_first"]:
        faults.append(f"open files grow: {facts['files_first']} to {facts['files_last']}")
    return faults


def measure(do: Callable[[int], object], count: int, seconds: float) -> dict[str, float]:
    """Call `do` up to `count` times, and fit a line through memory against the round; the first rounds do not count.

    The line is Theil and Sen's: the median of the slopes between points, which single jumps do not move.
    """
    rounds, memory, threads, files = [], [], [], []
    end, done, every = time.monotonic() + seconds, 0, max(1, count // SAMPLES)
    while done < count and (time.monotonic() < end or done < 10):
        do(done)
        done += 1
        if done % every == 0 or done <= 10:
            gc.collect()
            rounds.append(done)
            memory.append(_resident())
            threads.append(len(os.listdir("/proc/self/task")))
            files.append(len(os.listdir("/proc/self/fd")))
    first = int(len(rounds) * FIRST)
    x, y = np.array(rounds[first:], float), np.array(memory[first:], float)
    i, j = np.triu_indices(len(x), 1)
    slope = float(np.median((y[j] - y[i]) / (x[j] - x[i]))) if len(x) > 1 else 0.0
    return {
        "rounds": done, "counted": int(x[-1] - x[0]), "bytes_per_round": round(slope, 1),
        "mib_first": round(memory[first] / 2**20, 1), "mib_last": round(memory[-1] / 2**20, 1),
        "threads_first": threads[first], "threads_last": threads[-1], "files_first": files[first], "files_last": files[-1],
    }  # fmt: skip


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _fits(folder: Path, seed: int) -> Callable[[int], object]:
    from kfgs import FeatureFolder, load_scene, make_toy_room, uplift

    from .corpus_scenes import ROOM
    from .corpus_splats import cloud

    scene = load_scene(make_toy_room(folder / "room", ROOM))
    maps = FeatureFolder(folder / "room/features").of(scene, "train")
    return lambda i: uplift(scene, maps, cloud(60)).save(folder / "field.kfgs")


def _views(folder: Path, seed: int) -> Callable[[int], object]:
    from urllib.request import urlopen

    from kfgs import explore

    from .corpus_fields import tiny_field

    field = tiny_field()
    viewer = explore(field, classes=field.classes, where="notebook")

    def do(i: int) -> None:
        with viewer.open_page() as page, urlopen(page.url, timeout=60) as answer:
            answer.read()

    return do


def _queries(folder: Path, seed: int) -> Callable[[int], object]:
    from .corpus_fields import tiny_field

    field = tiny_field(n=2000)
    return lambda i: (field.query(("wall", "chair")[i % 2]), field.classify())


def _main() -> None:
    name, count, seconds, seed = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])
    make = {"fits": _fits, "views": _views, "queries": _queries}[name]
    with tempfile.TemporaryDirectory() as folder:
        facts = measure(make(Path(folder), seed), count, seconds)
    print(json.dumps(facts))


if __name__ == "__main__":
    _main()
