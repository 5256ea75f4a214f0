"""Mutated files for every reader: a file is read, or refused by a documented error that names it, quickly and in little memory.

Mutants run in forked processes, a few hundred in each, so that a crash or a hang ends only its process and is attributed to
its mutant. The seed, the case and the number of a mutant give its bytes, so that a second start goes on with the next number.
"""

from __future__ import annotations

import gc
import json
import mmap
import os
import resource
import shutil
import signal
import struct
import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any

from .corpus import Case, make_corpus
from .mutate import mutate
from .readers import MAY_RAISE_TYPE_ERROR, READERS
from .record import Record

BATCH = 400  # mutants of a process
SECONDS = 5.0  # of processor time for one mutant
WALL = 600.0  # seconds: a mutant that takes longer waits for something, or other programs leave it no processor
MEMORY = 300 << 20  # bytes beside twice the file
SPACE = 16 << 30  # bytes of addresses: more is refused by the system, so that the machine lives
PLACES = {"read": 8, "refused": 16}  # of these counts in the shared memory of a batch
KEPT = 5  # stored mutants of one case and kind of finding


def run_files(
    record: Record,
    *,
    seed: int,
    seconds: float,
    workers: int = 1,
    only: str = "",
    most: int | None = None,
    batch: int = BATCH,
) -> None:
    """Run batches, each of the case with the fewest mutants so far, until the time is over or `most` mutants are done."""
    work = record.scratch / "files"
    cases = [case for case in make_corpus(work / "corpus") if only in case.name or only == case.reader]
    done = dict.fromkeys((case.name for case in cases), 0)
    for line in record.of("files"):
        if line["seed"] == seed and line["case"] in done:
            done[line["case"]] += line["mutants"]
    end, begun, running = time.monotonic() + seconds, 0, {}
    _warm_up(cases)
    while True:
        while len(running) < workers and time.monotonic() < end and (most is None or begun < most):
            case = min(cases, key=lambda case: done[case.name])
            count = batch if most is None else min(batch, most - begun)
            one = _Batch(case, seed, done[case.name], count, work / f"place{len(running)}-{begun}")
            running[one.start()] = one
            done[case.name] += count
            begun += count
        if not running:
            return
        for pid, one in list(running.items()):
            if one.ended(pid):
                del running[pid]
                for line in one.results():
                    record.add(line)
                    if "number" in line:
                        _keep(record, one.case, seed, line)
        time.sleep(0.005)


def _keep(record: Record, case: Case, seed: int, line: dict[str, Any]) -> None:
    """Store the mutant of a finding, up to `KEPT` of one case and kind."""
    place = record.folder / "findings" / f"{case.name.replace('/', '_')}-{line['what']}"
    place.mkdir(parents=True, exist_ok=True)
    if len(list(place.iterdir())) < KEPT:
        mutant = make_mutant((case.folder / case.file).read_bytes(), case.name, seed, line["number"])
        (place / f"{seed}-{line['number']}-{Path(case.file).name}").write_bytes(mutant)


def _warm_up(cases: list[Case]) -> None:
    """Read each sound file once, so that imports and caches are there before processes are forked."""
    for case in cases:
        _judge(case, case.folder, case.folder / case.opens)
    gc.collect()
    gc.freeze()


class _Batch:
    """Some mutants of one case in processes of their own; after a crash another process takes the rest."""

    def __init__(self, case: Case, seed: int, first: int, count: int, place: Path) -> None:
        self.case, self.seed, self.first, self.count, self.place = case, seed, first, count, place
        self.shared = mmap.mmap(-1, 24)  # the number of the mutant at work, how many were read and refused
        self.out = place.with_suffix(".jsonl")
        self.at, self.since, self.began, self.cpu = first, time.monotonic(), time.monotonic(), 0.0
        self.extra: list[dict[str, Any]] = []
        self.out.parent.mkdir(parents=True, exist_ok=True)
        self.out.unlink(missing_ok=True)

    def start(self) -> int:
        sys.stdout.flush()
        sys.stderr.flush()
        struct.pack_into("<q", self.shared, 0, self.at)
        pid = os.fork()
        if pid:
            self.since, self.cpu = time.monotonic(), 0.0
            return pid
        code = 1
        try:
            self._work()
            code = 0
        finally:
            os._exit(code)

    def _work(self) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        resource.setrlimit(resource.RLIMIT_AS, (SPACE, SPACE))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        warnings.simplefilter("ignore")
        shutil.rmtree(self.place, ignore_errors=True)
        shutil.copytree(self.case.folder, self.place)
        target, data = self.place / self.case.file, (self.case.folder / self.case.file).read_bytes()
        target.unlink()
        with self.out.open("a") as out:
            for number in range(self.at, self.first + self.count):
                struct.pack_into("<q", self.shared, 0, number)
                mutant = make_mutant(data, self.case.name, self.seed, number)
                target.write_bytes(mutant)
                verdict, why = self._try(target, len(mutant))
                if verdict in PLACES:
                    (count,) = struct.unpack_from("<q", self.shared, PLACES[verdict])
                    struct.pack_into("<q", self.shared, PLACES[verdict], count + 1)
                else:
                    out.write(json.dumps({"number": number, "what": verdict, "why": why}) + "\n")
                    out.flush()
        shutil.rmtree(self.place, ignore_errors=True)

    def _try(self, target: Path, size: int) -> tuple[str, str]:
        with open("/proc/self/clear_refs", "w") as file:
            file.write("5")  # the peak of memory starts again
        before, start = _memory("VmRSS"), time.process_time()
        verdict, why = _judge(self.case, self.place, self.place / self.case.opens)
        seconds, grown = time.process_time() - start, _memory("VmHWM") - before
        if seconds > SECONDS:
            return "slow", f"{seconds:.1f} s; {verdict}: {why}"
        if grown > 2 * size + MEMORY:
            return "memory", f"{grown >> 20} MiB for {size} bytes; {verdict}: {why}"
        return verdict, why

    def ended(self, pid: int) -> bool:
        """Whether all mutants are done; a process that hangs is killed, one that crashed gets a successor."""
        found, status = os.waitpid(pid, os.WNOHANG)
        (number,) = struct.unpack_from("<q", self.shared, 0)
        if not found:
            if number != self.at:
                self.at, self.since, self.cpu = number, time.monotonic(), _cpu(pid)
            elif time.monotonic() - self.since > 1 and (
                _cpu(pid) - self.cpu > 2 * SECONDS or time.monotonic() - self.since > WALL
            ):
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
                return self._after("hang", f"more than {2 * SECONDS:g} s of processor time or {WALL:g} s", number)
            return False
        if status:
            code = os.waitstatus_to_exitcode(status)
            return self._after("crash", f"exit code {code}", number)
        return True

    def _after(self, what: str, why: str, number: int) -> bool:
        self.extra.append({"number": number, "what": what, "why": why})
        self.at = number + 1
        if self.at >= self.first + self.count:
            return True
        rest = self.start()
        while not self.ended(rest):
            time.sleep(0.01)
        return True

    def results(self) -> Iterator[dict[str, Any]]:
        """A line of the batch, and a line for each finding."""
        lines = [json.loads(line) for line in self.out.read_text().splitlines()] if self.out.exists() else []
        self.out.unlink(missing_ok=True)
        shutil.rmtree(self.place, ignore_errors=True)
        _, read, refused = struct.unpack("<3q", self.shared)
        base = {"kind": "files", "case": self.case.name, "reader": self.case.reader, "seed": self.seed}
        yield base | {
            "first": self.first, "mutants": self.count, "read": read, "refused": refused,
            "seconds": round(time.monotonic() - self.began, 2),
        }  # fmt: skip
        for found in lines + self.extra:
            yield base | {"kind": "files finding"} | found


def make_mutant(data: bytes, case: str, seed: int, number: int) -> bytes:
    """The mutant of this number; the same each time."""
    return mutate(data, Random(f"{seed}/{case}/{number}"))


def _judge(case: Case, folder: Path, opened: Path) -> tuple[str, str]:
    """`read`, `refused`, or what is wrong with how it was refused."""
    allowed = (ValueError, OSError, TypeError) if case.reader in MAY_RAISE_TYPE_ERROR else (ValueError, OSError)
    try:
        READERS[case.reader](opened)
    except allowed as error:
        text = str(error)
        if folder.name not in text and Path(case.file).name not in text:
            return "nameless", f"{type(error).__name__}: {text[:300]}"
        if isinstance(error, UnicodeError) or (isinstance(error, OSError) and error.errno == 12):
            return "error", f"{type(error).__name__}: {text[:300]}"
        return "refused", f"{type(error).__name__}: {text[:300]}"
    except BaseException as error:  # MemoryError, RecursionError, a panic of Rust: all are findings
        return "error", f"{type(error).__name__}: {str(error)[:300]} at {_where(error)}"
    return "read", ""


def _where(error: BaseException) -> str:
    """The innermost line of kfgs that the error passed."""
    place, found = error.__traceback__, "?"
    while place is not None:
        name = place.tb_frame.f_code.co_filename
        if f"{os.sep}kfgs{os.sep}" in name:
            found = f"{name.rpartition(os.sep + 'kfgs' + os.sep)[2]}:{place.tb_lineno}"
        place = place.tb_next
    return found


def _memory(name: str) -> int:
    with open("/proc/self/status") as file:
        for line in file:
            if line.startswith(name):
                return int(line.split()[1]) << 10
    return 0


def _cpu(pid: int) -> float:
    """Processor seconds of a process."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
