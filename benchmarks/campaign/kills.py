"""Commands killed before each change of the file system that they begin, and at random times.

After each kill: what is there is old or new, whole, and readable; the user's files are untouched; the same command succeeds,
gives what an undisturbed run gives, and leaves nothing hidden.
"""

from __future__ import annotations

import shutil
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

from .jobs import NOTES, Job, all_jobs, make_fixture
from .processes import Ended, Process
from .record import Record
from .states import State, field_state, hidden_in, state_of

TIMED = 0.25  # share of kills at a random time instead of at an event


@dataclass(frozen=True)
class Reference:
    """What an undisturbed run starts from, and what it leaves."""

    old: State
    new: State
    fields: dict[str, tuple[str, str]]
    """Old and new state of each field."""
    hidden: list[str]
    events: int
    seconds: float


class Bench:
    """A folder in which jobs run, always the same one, because files remember paths."""

    def __init__(self, scratch: Path) -> None:
        self.place, self.fixture = scratch / "jobs" / "place", scratch / "jobs" / "fixture"
        self.work = self.place / "work"
        if not self.fixture.exists():
            _import_all()
            make_fixture(self.fixture)
        self.inputs = state_of(self.fixture)
        self.references: dict[str, Reference] = {}

    def fill(self, job: Job) -> None:
        """A fresh folder with `in/` and `work/`."""
        if self.place.exists():
            shutil.rmtree(self.place)
        self.work.mkdir(parents=True)
        (self.place / "in").symlink_to(self.fixture)
        job.prepare(self.fixture, self.work)

    def start(self, job: Job, **options: Any) -> Process:
        """Begin the job's command."""
        return Process(job.work, self.place, **options)

    def reference(self, job: Job) -> Reference:
        """Run the job undisturbed; raises if it fails."""
        if job.name not in self.references:
            self.fill(job)
            old = state_of(self.work, job.loose, job.fields)
            fields = {name: field_state(self.work / name) for name in job.fields}
            ended = self.start(job).wait()
            if ended.code:
                raise RuntimeError(f"{job.name}: failed undisturbed: {ended.said}")
            new = state_of(self.work, job.loose, job.fields)
            pairs = {name: (fields[name], field_state(self.work / name)) for name in job.fields}
            self.references[job.name] = Reference(old, new, pairs, hidden_in(self.work), ended.events, ended.seconds)
        return self.references[job.name]

    def disturbed(self, job: Job) -> Iterator[str]:
        """What is wrong after a run that was killed, told to end, or had no space."""
        known = self.reference(job)
        try:
            now = state_of(self.work, job.loose, job.fields)
            fields = {name: field_state(self.work / name) for name in job.fields}
        except Exception as error:  # something that cannot be read
            yield f"unreadable: {type(error).__name__}: {str(error)[:300]}"
            return
        for name, value in known.old.items():
            if name not in now and name in known.new and name not in job.shown:
                yield f"lost: {name}"
            elif name not in known.new and now.get(name) != value:
                yield f"changed a file that the command does not write: {name}"
        for name, value in now.items():
            grows = job.resumed and name.endswith("features.json")  # the list of the maps that are there
            if value not in (known.old.get(name), known.new.get(name)) and not (grows or self._between(job, name)):
                yield f"neither old nor new: {name}"
        for name, value in fields.items():
            if value not in known.fields[name]:
                yield f"neither the old nor the new field: {name}"
        yield from self._foreign()

    def repeated(self, job: Job, ended: Ended, *, idle: bool = False) -> Iterator[str]:
        """What is wrong after the command was given again. An `idle` one had nothing to write, and so swept nothing."""
        known = self.reference(job)
        if ended.code or ended.hung:
            yield f"the second run {'hung' if ended.hung else f'ended with {ended.code}'}: {ended.said[-400:]}"
            return
        now = state_of(self.work, job.loose, job.fields)
        fields = {name: field_state(self.work / name) for name in job.fields}
        for name in sorted(set(now) | set(known.new)):
            if now.get(name) != known.new.get(name) and not self._between(job, name):
                yield f"the second run gave other bytes: {name}"
        for name, value in fields.items():
            if value != known.fields[name][1]:
                yield f"the second run gave another field: {name}"
        more = sorted(set(hidden_in(self.work)) - set(known.hidden))
        if more and not idle:
            yield f"left hidden: {', '.join(more[:5])}"
        yield from self._foreign()

    def _between(self, job: Job, name: str) -> bool:
        """Whether a file is one that a resumed run keeps for itself while it works."""
        return job.resumed and ("unfinished/" in name or "stages/" in name)

    def _foreign(self) -> Iterator[str]:
        for path in (*self.work.rglob("*.txt"), *self.work.rglob("mine.ply")):
            if path.name in ("notes.txt", "a.txt", "mine.ply") and path.read_text() != NOTES:
                yield f"a file of the user was changed: {path.name}"
        if state_of(self.fixture) != self.inputs:
            yield "an input was changed"


def run_kills(record: Record, *, seed: int, seconds: float, only: str = "", most: int | None = None) -> None:
    """Kill jobs at their next places until the time is over. Each job gets the same time, so the quick ones more kills."""
    bench, end, count = Bench(record.scratch), time.monotonic() + seconds, 0
    done = {(line["case"], str(line["at"])) for line in record.of("kills") if line["seed"] == seed}
    jobs = [job for job in all_jobs() if only in job.name]
    plans = {job.name: _plan(job, seed, done, bench) for job in jobs}
    spent = dict.fromkeys(plans, 0.0)
    while time.monotonic() < end and jobs and (most is None or count < most):
        job = min(jobs, key=lambda one: spent[one.name])
        began, at = time.monotonic(), next(plans[job.name], None)
        if at is None:
            jobs.remove(job)
        else:
            _kill(record, bench, job, seed, at)
            spent[job.name] += time.monotonic() - began
            count += 1


def _plan(job: Job, seed: int, done: set[tuple[str, str]], bench: Bench) -> Iterator[int | float]:
    """Events in a random order without repetition, and shares of the time (floats) in between; without those that are done."""
    rng = Random(f"{seed}/{job.name}")
    events = list(range(bench.reference(job).events))
    rng.shuffle(events)
    timed = 0
    while events or timed < 200:
        if not events or rng.random() < TIMED:
            at: int | float = round(rng.random(), 6)
            timed += 1
        else:
            at = events.pop()
        if (job.name, str(at)) not in done:
            yield at


def _kill(record: Record, bench: Bench, job: Job, seed: int, at: int | float) -> None:
    known = bench.reference(job)
    bench.fill(job)
    began = time.monotonic()
    if isinstance(at, int):
        first = bench.start(job, kill_at=at).wait()
    else:
        process = bench.start(job)
        while process.running() and time.monotonic() - began < at * known.seconds:
            time.sleep(0.0005)
        process.signal(signal.SIGKILL)
        first = process.wait()
    faults = [f"the first run ended with {first.code}: {first.said[-300:]}"] if first.code not in (0, -9) else []
    faults += bench.disturbed(job)
    idle = job.idle and not faults and state_of(bench.work, job.loose, job.fields) == known.new
    faults += bench.repeated(job, bench.start(job).wait(), idle=idle)
    base = {"kind": "kills", "case": job.name, "seed": seed, "at": at}
    record.add(base | {"killed": first.code == -9, "seconds": round(time.monotonic() - began, 2)})
    for fault in faults:
        record.add(base | {"kind": "kills finding", "what": fault.partition(":")[0], "why": fault})
    if faults:
        kept = record.folder / "findings" / f"kills-{job.name.replace(' ', '-')}-{at}"
        if not kept.exists():
            shutil.copytree(bench.work, kept, symlinks=True)


def _import_all() -> None:
    """Import what commands import when first needed, without using it: processes are forked from here."""
    import importlib

    names = ("torch", "kornia", "numba", "PIL.Image", "safetensors.torch", "skimage.io", "scipy.spatial", "tyro", "zstandard",
             "matplotlib.pyplot", "pycolmap", "kfgs.cli", "kfgs.pipeline", "kfgs.fields", "kfgs.formats.table", "kfgs.scenes",
             "kfgs.toy.room_folder", "kfgs.viz", "kfgs.teachers", "kfgs.evaluation",
             "kfgs.splat.engines.table", "kfgs.cli.splats", "kfgs.labels", "campaign.jobs")  # fmt: skip
    for name in names:
        try:
            importlib.import_module(name)
        except ImportError:
            continue
