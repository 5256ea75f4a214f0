"""Two processes at once on one output, signals at random times, disks that are full and folders that are read-only."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any

from .jobs import Job, all_jobs
from .kills import Bench
from .processes import Ended
from .record import Record

IN_USE = "no other process"  # in the message of a command that finds its folder locked
TRACEBACK = "Traceback (most recent call last)"


def run_pairs(record: Record, *, seed: int, seconds: float, only: str = "", most: int | None = None) -> None:
    """Two or four equal commands at once. Each succeeds or says who works there; the result is that of one command."""
    bench, end, rounds = Bench(record.scratch), time.monotonic() + seconds, 0
    done = len([line for line in record.of("pairs") if line["seed"] == seed])
    for number, job in _turns(seed, only):
        if time.monotonic() > end or (most is not None and rounds >= most):
            return
        if number < done:
            continue
        rng = Random(f"pairs/{seed}/{number}")
        bench.reference(job)
        bench.fill(job)
        running = []
        for _ in range(rng.choice((2, 2, 4))):
            running.append(bench.start(job))
            time.sleep(rng.choice((0.0, 0.0, rng.random() * bench.reference(job).seconds)))
        ended = [process.wait() for process in running]
        faults = [fault for one in ended for fault in _refusal(one, (0, 1), IN_USE)]
        if all(one.code for one in ended):
            faults.append("no process succeeded")
        faults += bench.repeated(job, next((one for one in ended if not one.code), ended[0]))
        _note(record, "pairs", job, seed, number, faults, processes=len(ended), codes=[one.code for one in ended])
        rounds += 1


def run_signals(record: Record, *, seed: int, seconds: float, only: str = "", most: int | None = None) -> None:
    """SIGINT or SIGTERM at a random time: an exit code that says so, at most one line, and nothing half-written."""
    bench, end, rounds = Bench(record.scratch), time.monotonic() + seconds, 0
    done = len([line for line in record.of("signals") if line["seed"] == seed])
    for number, job in _turns(seed, only):
        if time.monotonic() > end or (most is not None and rounds >= most):
            return
        if number < done:
            continue
        rng = Random(f"signals/{seed}/{number}")
        sent = rng.choice((signal.SIGINT, signal.SIGINT, signal.SIGTERM))
        known = bench.reference(job)
        bench.fill(job)
        process = bench.start(job)
        wait, began = rng.random() * known.seconds, time.monotonic()
        while process.running() and (time.monotonic() - began < wait or not process.ready()):
            time.sleep(0.0005)
        if process.running():
            process.signal(sent)
        ended = process.wait()
        faults = list(_interrupted(ended, sent))
        faults += bench.disturbed(job)
        faults += bench.repeated(job, bench.start(job).wait())
        _note(record, "signals", job, seed, number, faults, signal=sent.name, code=ended.code)
        rounds += 1


def run_full(record: Record, *, seed: int, seconds: float, only: str = "", most: int | None = None) -> None:
    """Outputs on a small disk that gets full, or is read-only (or, where nothing can be mounted, a limit on files).

    The command ends with 1 and one line; the old result stays; with space it succeeds.
    """
    bench, end, rounds = Bench(record.scratch), time.monotonic() + seconds, 0
    done = len([line for line in record.of("full") if line["seed"] == seed])
    for number, job in _turns(seed, only):
        if time.monotonic() > end or (most is not None and rounds >= most):
            return
        if number < done:
            continue
        rng = Random(f"full/{seed}/{number}")
        bench.reference(job)
        how = rng.choice(("full", "full", "full", "read-only")) if _mounts() else "limit"
        faults = list(_without_space(bench, job, how, rng))
        _note(record, "full", job, seed, number, faults, how=how)
        rounds += 1


def _without_space(bench: Bench, job: Job, how: str, rng: Random) -> Iterator[str]:
    bench.fill(job)
    if how == "limit":
        ended = bench.start(job, limit=rng.choice((0, 100, 1000, 5000))).wait()
        yield from _refusal(ended, (0, 1), "")
        yield from bench.disturbed(job)
        yield from bench.repeated(job, bench.start(job).wait())
        return
    filled = bench.place / "filled"
    bench.work.rename(filled)
    bench.work.mkdir()
    _mount("mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(bench.work))
    try:
        shutil.copytree(filled, bench.work, dirs_exist_ok=True)
        used = shutil.disk_usage(bench.work).used
        room = "ro" if how == "read-only" else f"size={(used >> 10) + 4 * rng.randrange(1, 16)}k"
        _mount("mount", "-o", f"remount,{room}", str(bench.work))
        ended = bench.start(job).wait()
        yield from _refusal(ended, (0, 1) if how == "full" else (1,), "")
        yield from bench.disturbed(job)
        _mount("mount", "-o", "remount,rw,size=64m", str(bench.work))
        yield from bench.repeated(job, bench.start(job).wait())
    finally:
        _mount("umount", str(bench.work))


def _turns(seed: int, only: str) -> Iterator[tuple[int, Job]]:
    """Jobs in a random order, again and again, with a running number."""
    rng, number = Random(f"turns/{seed}"), 0
    jobs = [job for job in all_jobs() if only in job.name]
    while jobs:
        rng.shuffle(jobs)
        for job in jobs:
            yield number, job
            number += 1


def _refusal(ended: Ended, codes: tuple[int, ...], word: str) -> Iterator[str]:
    """What is wrong with how a command refused; nothing if it succeeded and may."""
    if ended.hung:
        yield "hung"
    elif ended.code not in codes:
        yield f"exit code {ended.code}: {ended.said[-400:]}"
    elif ended.code and (TRACEBACK in ended.said or len(_errors(ended.said)) != 1 or word not in ended.said):
        yield f"refused otherwise than with one line: {ended.said[-400:]}"


def _errors(said: str) -> list[str]:
    return re.findall(r"^error: .*$|^\w*Error: .*$", said, re.MULTILINE)


def _interrupted(ended: Ended, sent: signal.Signals) -> Iterator[str]:
    good = (0, 130) if sent == signal.SIGINT else (0, 143, -signal.SIGTERM)
    if ended.hung:
        yield "hung"
    elif ended.code not in good:
        yield f"exit code {ended.code} after {sent.name}: {ended.said[-400:]}"
    elif TRACEBACK in ended.said or (ended.code == 130 and ended.said.count("interrupted") != 1):
        yield f"more than one line after {sent.name}: {ended.said[-400:]}"


def _mounts() -> bool:
    return sys.platform == "linux" and os.geteuid() == 0 and shutil.which("mount") is not None and _can_mount()


def _can_mount() -> bool:
    place = Path("/tmp") / f"kfgs-campaign-mount-{os.getpid()}"
    place.mkdir(exist_ok=True)
    try:
        _mount("mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(place))
        _mount("umount", str(place))
    except subprocess.CalledProcessError:
        return False
    finally:
        place.rmdir()
    return True


def _mount(*words: str) -> None:
    subprocess.run(words, check=True, capture_output=True)


def _note(record: Record, kind: str, job: Job, seed: int, number: int, faults: list[str], **facts: Any) -> None:
    base = {"kind": kind, "case": job.name, "seed": seed, "number": number} | facts
    record.add(base)
    for fault in faults:
        record.add(base | {"kind": f"{kind} finding", "what": fault.partition(":")[0], "why": fault})
