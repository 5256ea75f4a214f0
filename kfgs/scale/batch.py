"""Many scenes through all stages: the plan of a scene, its record in the run folder, and the calls for Python."""

from __future__ import annotations

import json
import pickle
import re
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from .._files import check_output, locked
from .driver import Engine, Event, Failure, Plan, Task, drive, limit
from .options import BatchOptions, Job
from .places import Place, StoredPlace, begun_at
from .scene_list import SceneEntry, as_entries, check_apart, is_url

STAGES = ("scene", "features", "fit", "segment", "evaluate")
LOOK = 1.0  # seconds between two looks at what workers have begun
STATE, LOG, LOCK, FORMAT = "state.json", "log.txt", ".batch.lock", "kfgs-batch/1"
LOGGED = re.compile(rf"\d{{4}}-\d\d-\d\d \d\d:\d\d:\d\d ({'|'.join(STAGES)}): ")  # begins every log.txt
WRITTEN = ("done", "features", "scene/sparse/0", "segmented")  # folders of a run; the fit checks its own


@dataclass(frozen=True)
class SceneResult:
    """The result of one scene, or why there is none."""

    name: str
    value: Any
    """What the function returned; of a batch, `gaussians`, `latents` and `miou`, as far as they exist. None if it failed."""
    failure: Failure | None
    seconds: float
    """Of all its tasks, together. Of a batch, what was found counts with the seconds of the start that made it."""


@dataclass
class Row:
    """A scene in the table of a batch, and in its `state.json`."""

    name: str
    source: str
    stages: dict[str, str] = field(default_factory=dict)
    """waits (for a worker), running, done, found (made earlier), failed or stopped, by stage; one that is not there comes later,
    or is not needed."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Of the work that made each stage, by whichever start of the batch."""
    value: dict[str, Any] | None = None
    failure: Failure | None = None

    @property
    def ended(self) -> bool:
        """Whether there is nothing left to do."""
        return self.failure is not None or self.value is not None


def map_scenes(
    function: Callable[[str], Any],
    scenes: Iterable[str | Path | SceneEntry],
    *,
    client: Engine | Callable[[], Engine],
    at_once: int | Callable[[], int] = 64,
    report: Callable[[Event], None] | None = None,
) -> list[SceneResult]:
    """Call a function for many scenes, in the workers of any engine.

    A call that dies with its worker is repeated, at most 3 times. A call that raises is a failure in its result; the others
    go on.

    Args:
        function: receives a scene's place, an absolute path or a URL; returns something small. It is sent by cloudpickle, so
            it may be a lambda, or defined in a notebook.
        scenes: folders, URLs, or entries; see `read_scenes` for a file.
        client: a `dask.distributed.Client`, or anything with `submit(function, *arguments)` whose results have `done()` and
            `result()`: executors of concurrent.futures, submitit, Ray or MPI. Or a function that makes one: a process pool is
            of no use any more when one of its processes has died, and then another one is made.
        at_once: calls in progress at the same time, or a function that says how many; 0 from it means: wait.
        report: receives an event when a call begins, ends or is repeated.

    Returns:
        A result per scene, in their order.

    Raises:
        ValueError: if there are no scenes, or two have the same name.
        ImportError: if cloudpickle is missing.

    Example:
        >>> from concurrent.futures import ThreadPoolExecutor
        >>> with ThreadPoolExecutor(2) as pool:
        ...     found = map_scenes(len, ["s3://a/kitchen", "s3://a/hall"], client=pool)
        >>> [(one.name, one.value) for one in found]
        [('kitchen', 14), ('hall', 11)]
    """
    try:
        import cloudpickle
    except ImportError as error:
        raise ImportError(f"map_scenes: expected cloudpickle, got {error}; pip install 'kfgs[scale]'") from error
    entries, sent = as_entries(scenes), cloudpickle.dumps(function)
    found: dict[str, SceneResult] = {}
    seconds: dict[str, float] = {}

    def note(event: Event) -> None:
        seconds[event.name] = seconds.get(event.name, 0.0) + event.seconds
        if event.kind in ("failed", "finished"):
            value = event.results[0] if event.results else None
            found[event.name] = SceneResult(event.name, value, event.failure, seconds[event.name])
        if report is not None:
            report(event)

    def plan(entry: SceneEntry) -> Plan:
        return (yield "call", [Task(_call, (sent, entry.source))])[0]

    drive({entry.name: plan(entry) for entry in entries}, client, note, at_once=at_once)
    return [found[entry.name] for entry in entries]


def _call(sent: bytes, source: str, *, report: Callable[[str], None]) -> Any:
    return pickle.loads(sent)(source)


def run_batch(
    scenes: Iterable[str | Path | SceneEntry],
    out: str | Path,
    options: BatchOptions | None = None,
    *,
    client: Engine | Callable[[], Engine],
    retry_failed: bool = False,
    at_once: int | Callable[[], int] = 64,
    report: Callable[[Event, Sequence[Row]], None] | None = None,
) -> list[SceneResult]:
    """Take scenes through sfm, features, fit, segment and evaluate. What is done is not repeated, whoever did it.

    Each scene gets a folder `out/<name>`: `scene/` (if its cameras had to be found), `features/`, `field/`, `segmented/`,
    `scores.json` (if it has true labels), `log.txt`, `state.json`. A task that dies with its worker is repeated, at most 3
    times. A scene that fails is recorded, and the others go on.

    Args:
        scenes: folders or URLs of fsspec, or entries (`read_scenes`); each with a COLMAP model, a transforms.json, or photos.
        out: folder or URL of the runs. Paths must be the same in all workers.
        options: what is done with each.
        client: see `map_scenes`. A worker should run one task at a time.
        retry_failed: also try scenes that failed before; without it their old failure is returned.
        at_once: scenes in progress at the same time, or a function that says how many. Fewer need less disk for feature maps.
        report: receives each event, and the state of all scenes.

    Returns:
        A result per scene, in their order.

    Raises:
        ValueError: if there are no scenes, two have the same name, a run would be in the folder of a scene, a link is in the
            way, or another batch works in the folder `out`. A URL has no lock: start one batch at a time.
        OSError: if `out` cannot be written to, or a run's `state.json`, `log.txt`, `scores.json` or `done/*.json` was written by
            something else (FileExistsError).
    """
    limit(at_once)
    options, entries = options or BatchOptions(), as_entries(scenes)
    local = check_runs(entries, out)
    root = str(out).rstrip("/") if local is None else str(local)
    jobs = {entry.name: Job(entry.source, f"{root}/{entry.name}", options) for entry in entries}
    with nullcontext() if local is None else locked(local, LOCK):
        records = {entry.name: _Record(entry, jobs[entry.name].out) for entry in entries}
        rows = [record.row for record in records.values()]

        def note(event: Event) -> None:
            records[event.name].add(event)
            if report is not None:
                report(event, rows)

        looked = time.monotonic()

        def look() -> None:
            nonlocal looked
            if time.monotonic() - looked > LOOK:
                for event in filter(None, [record.look() for record in records.values()]):
                    note(event)
                looked = time.monotonic()

        plans = {name: _plan(jobs[name]) for name, record in records.items() if record.begin(retry_failed)}
        drive(plans, client, note, at_once=at_once, idle=look)
    return [SceneResult(row.name, row.value, row.failure, sum(row.seconds.values())) for row in rows]


def check_runs(entries: Sequence[SceneEntry], out: str | Path) -> Path | None:
    """Check before the work that runs can be written; the folder `out`, or None if it is a URL."""
    check_apart(entries, out)
    if is_url(str(out)):
        return None
    return check_output("out", out, "a folder").absolute()


def _plan(job: Job) -> Generator[tuple[str, list[Task]], list[Any], Any]:
    """The stages of a scene that are not done yet."""
    from . import stages  # torch and all, which the options of a command do not need

    found = (yield "scene", [Task(stages.find_scene, (job,))])[0]
    keys, done = found["keys"], dict(found["done"])
    if "fit" not in done:
        if job.options.teacher is not None and "features" not in done:
            pictures, share = found["pictures"], job.options.share
            parts = [pictures[i : i + share] for i in range(0, len(pictures), share)]
            made = yield "features", [Task(stages.encode_part, (job, part)) for part in parts]
            stems, seconds = [stem for stem, _ in pictures], sum(one["seconds"] for one in made)
            yield "features", [Task(stages.join_parts, (job, keys["features"], stems, seconds))]
        done["fit"] = (yield "fit", [Task(stages.fit, (job, keys["fit"]))])[0]
    if found["classes"] and "segment" not in done:
        yield "segment", [Task(stages.segment, (job, keys["segment"], found["split"]))]
    if found["classes"] and found["labels"] and "evaluate" not in done:
        done["evaluate"] = (yield "evaluate", [Task(stages.score, (job, keys["evaluate"]))])[0]
    return {name: done["fit"][name] for name in ("gaussians", "latents")} | {
        "miou": done.get("evaluate", {}).get("miou")
    }


class _Record:
    """A scene's `state.json` and `log.txt`, written by the driver alone."""

    def __init__(self, entry: SceneEntry, out: str) -> None:
        self.place = StoredPlace(out, Path()) if is_url(out) else Place(Path(out))
        self.row = Row(entry.name, entry.source)
        self._log = ""

    def begin(self, retry_failed: bool) -> bool:
        """Read what an earlier batch left; whether its failure is to be forgotten."""
        self._log = self.place.read_text(LOG) or ""
        before = self.place.read_json(STATE)
        failure = before.get("failure") if before.get("format") == FORMAT else None
        if isinstance(failure, dict) and {"stage", "message"} <= set(failure) and not retry_failed:
            self.row.failure = Failure(*(str(failure.get(name, "")) for name in ("stage", "message", "traceback")))
            self.row.stages = {self.row.failure.stage: "failed"}
            self.row.seconds = _seconds(before.get("seconds"))
            return False
        return True

    def look(self) -> Event | None:
        """An event if a worker has begun the stage that waits; in an object store this is not known."""
        stage = next((name for name, word in self.row.stages.items() if word == "waits"), None)
        when = begun_at(self.place.path, STATE) if stage is not None and type(self.place) is Place else None
        return None if when is None else Event(self.row.name, "started", stage or "", lines=("started",), times=(when,))

    def add(self, event: Event) -> None:
        """Note an event."""
        row, stage = self.row, event.stage
        if event.kind in ("submitted", "started"):
            row.stages[stage] = "waits" if event.kind == "submitted" else "running"
        elif event.kind == "done":
            row.stages[stage] = "found" if all(one.get("reused") for one in event.results) else "done"
            row.seconds[stage] = round(sum(one["seconds"] for one in event.results), 3)
            if stage == "scene":
                found = {name: one for name, one in event.results[0]["done"].items() if name in STAGES}
                row.stages |= dict.fromkeys(found, "found")
                row.seconds |= {name: round(one["seconds"], 3) for name, one in found.items()}
        elif event.kind == "failed":
            row.stages[stage], row.failure = "failed", event.failure
            row.seconds[stage] = round(row.seconds.get(stage, 0.0) + event.seconds, 3)
        elif event.kind == "finished":
            row.value = event.results[0]
        now = time.time()
        lines = [(when, line.removeprefix(f"{stage}: ")) for when, line in zip(event.times, event.lines, strict=True)]
        if event.kind == "submitted":
            lines.append((now, event.kind))
        if event.kind in ("done", "failed"):
            lines.append((now, f"{row.stages[stage]} in {event.seconds:.1f} s"))
        if event.failure is not None:
            lines += [(now, event.failure.message), (now, event.failure.traceback)]
        if lines:
            self._log += "".join(f"{_clock(when)} {stage}: {line}\n" for when, line in lines)
            self.place.write_text(LOG, self._log)
        if event.kind != "lost":
            self.place.write_json(STATE, json.loads(json.dumps({"format": FORMAT, **asdict(row)})))


def read_rows(folder: Path) -> list[Row]:
    """The scenes of the batch that wrote to a folder, by their `state.json`; those that are damaged or not ours are left out."""
    rows = []
    for file in sorted(folder.glob(f"*/{STATE}")):
        about = Place(file.parent).read_json(STATE)
        if about.pop("format", None) != FORMAT:
            continue
        failure = about.get("failure")
        with suppress(TypeError, AttributeError):
            about["seconds"] = _seconds(about.get("seconds"))
            about["failure"] = None if failure is None else Failure(**failure)
            about["stages"] = {str(name): str(word) for name, word in about.get("stages", {}).items()}
            if begun_at(file.parent, STATE) is not None:
                about["stages"] = {
                    name: "running" if word == "waits" else word for name, word in about["stages"].items()
                }
            if about.get("value") is None or isinstance(about["value"], dict):
                rows.append(Row(**about))
    return rows


def _clock(when: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(when))


def _seconds(noted: Any) -> dict[str, float]:
    """The seconds of stages in a `state.json`; none if they are damaged."""
    whole = isinstance(noted, dict) and all(isinstance(one, int | float) for one in noted.values())
    return dict(noted) if whole else {}
