"""The one loop of a batch: it submits what is ready to any executor, and asks the results whether they are done.

A scene is a generator, its *plan*: it yields a stage with tasks that may run at the same time, and receives their results.
The loop knows nothing about scenes or engines. An engine is anything with `submit(function, *arguments)` whose results have
`done()` and `result()`.
"""

from __future__ import annotations

import asyncio
import time
import traceback
import uuid
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Protocol

from .._card import error_line
from .._check import check_whole

AGAIN = 3
"""How often a task is submitted again after its worker died."""
PAUSE = 0.05  # seconds between two looks at the futures


class Engine(Protocol):
    """What runs tasks: a Dask client, an executor of concurrent.futures, submitit, Ray, MPI."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Any:
        """Run a function elsewhere; the result has `done()` and `result()`."""
        ...


@dataclass(frozen=True)
class Task:
    """A call in a worker, which imports the function: `function(*arguments, report=...)`."""  # a tuple would be Dask's

    function: Callable[..., Any]
    arguments: tuple[Any, ...]


Plan = Generator[tuple[str, list[Task]], list[Any], Any]
"""Yields (stage, tasks), receives the tasks' results, and returns the scene's."""


@dataclass(frozen=True)
class Failure:
    """Why a scene failed."""

    stage: str
    message: str
    traceback: str = ""


@dataclass(frozen=True)
class Event:
    """What happened to a scene."""

    name: str
    kind: str
    """submitted, started (by a worker, where that can be seen) or done (a stage); lost (a task, which is submitted again);
    failed or finished (the scene)."""
    stage: str = ""
    seconds: float = 0.0
    """Of the tasks of a stage, together."""
    lines: tuple[str, ...] = ()
    """What the tasks reported."""
    times: tuple[float, ...] = ()
    """When each line was reported: seconds since 1970, by the clock of the worker."""
    results: tuple[Any, ...] = ()
    """Of the tasks of a stage; of a finished scene, what its plan returned."""
    failure: Failure | None = None


def attempt(task: Task, ticket: str) -> dict[str, Any]:
    """Run a task in a worker. An error of the task is part of the result: what the future raises is the engine's alone.

    `ticket` makes two calls differ, for engines that keep the results of equal calls.
    """
    lines: list[tuple[float, str]] = []
    start = time.perf_counter()
    about: dict[str, Any] = {"value": None, "error": None}
    try:
        about["value"] = task.function(*task.arguments, report=lambda line: lines.append((time.time(), line)))
    except Exception as error:
        about["error"] = (str(error) or error_line(error), traceback.format_exc())
    return {**about, "lines": lines, "seconds": time.perf_counter() - start}


@dataclass
class _Lane:
    """A scene in progress: its plan, and the tasks of its stage."""

    name: str
    plan: Plan
    stage: str = ""
    tasks: list[Task] = field(default_factory=list)
    futures: dict[int, Any] = field(default_factory=dict)
    deaths: dict[int, int] = field(default_factory=dict)
    done: dict[int, dict[str, Any]] = field(default_factory=dict)


class _Submitter:
    """Submits tasks; if a process pool broke, to a new one, if it knows how to make one."""

    def __init__(self, client: Engine | Callable[[], Engine]) -> None:
        self.make = None if hasattr(client, "submit") else client
        self.client: Any = client if self.make is None else self.make()  # type: ignore[operator]

    def submit(self, task: Task, place: str) -> Any:
        ticket = f"{place}/{uuid.uuid4().hex[:8]}"
        try:
            return self.client.submit(attempt, task, ticket)
        except BrokenExecutor:
            if self.make is None:
                raise
            self.close()
            self.client = self.make()
            return self.client.submit(attempt, task, ticket)

    def close(self) -> None:
        """End a client that was made here."""
        if self.make is not None and hasattr(self.client, "shutdown"):
            self.client.shutdown(wait=False, cancel_futures=True)


def drive(
    plans: Mapping[str, Plan],
    client: Engine | Callable[[], Engine],
    report: Callable[[Event], None],
    *,
    at_once: int | Callable[[], int] = 64,
    idle: Callable[[], None] | None = None,
) -> None:
    """Take all plans to their ends; a failed one does not hold up the others.

    Args:
        plans: by the names of their scenes; they begin in this order.
        client: an engine, or a function that makes one: then it is made again when it broke, as a process pool does when
            one of its processes dies.
        report: called for each event, in this thread.
        at_once: scenes in progress at the same time; a function is asked each time, for workers that come and go.
        idle: called while nothing happens, some times a second.
    """
    most = limit(at_once)
    engine, waiting, lanes = _Submitter(client), list(plans.items())[::-1], list[_Lane]()
    try:
        while waiting or lanes:
            moved = False
            while waiting and len(lanes) < most():
                lane = _Lane(*waiting.pop())
                if _advance(lane, None, engine, report):
                    lanes.append(lane)
            for lane in list(lanes):
                moved = _look(lane, engine, report) or moved
                if not lane.futures:
                    moved = True
                    if not _end_stage(lane, engine, report):
                        lanes.remove(lane)
            if not moved:
                if idle is not None:
                    idle()
                time.sleep(PAUSE)
    finally:
        for future in (future for lane in lanes for future in lane.futures.values()):
            with suppress(Exception):
                future.cancel()
        engine.close()


def limit(at_once: int | Callable[[], int]) -> Callable[[], int]:
    """How many scenes may be in progress, as a function.

    Raises:
        ValueError: if it is no whole number, or less than 1; a function may say 0, for instance before workers have come.
    """
    if not callable(at_once):
        check_whole("at_once", at_once, 1)

    def asked() -> int:
        most = at_once() if callable(at_once) else at_once
        check_whole("at_once", most, 0)
        return most

    return asked


def _advance(lane: _Lane, results: list[Any] | None, engine: _Submitter, report: Callable[[Event], None]) -> bool:
    """Submit the next stage of a plan; False if it has none. A stage that goes on with more tasks is reported once."""
    before = lane.stage
    try:
        lane.stage, lane.tasks = next(lane.plan) if results is None else lane.plan.send(results)
    except StopIteration as end:
        report(Event(lane.name, "finished", results=(end.value,)))
        return False
    except Exception as error:  # of the plan: results that it cannot use end this scene only
        why = Failure(lane.stage, error_line(error), traceback.format_exc())
        report(Event(lane.name, "failed", lane.stage, failure=why))
        return False
    if lane.stage != before:
        report(Event(lane.name, "submitted", lane.stage))
    lane.deaths, lane.done = {}, {}
    lane.futures = {i: engine.submit(task, f"{lane.name}/{lane.stage}/{i}") for i, task in enumerate(lane.tasks)}
    return True


def _look(lane: _Lane, engine: _Submitter, report: Callable[[Event], None]) -> bool:
    """Take the results of tasks that are done; submit those again whose worker died."""
    finished = [i for i, future in lane.futures.items() if future.done()]
    for i in finished:
        future = lane.futures.pop(i)
        try:
            lane.done[i] = future.result()
            continue
        except (Exception, asyncio.CancelledError) as error:  # the engine's
            died = error
        lane.deaths[i] = lane.deaths.get(i, 0) + 1 + int(getattr(died, "allowed_failures", 0))  # Dask tried it itself
        if lane.deaths[i] > AGAIN:
            message = f"its worker died {lane.deaths[i]} times; the last time: {error_line(died)}"
            lane.done[i] = {"value": None, "error": (message, ""), "lines": [], "seconds": 0.0}
        else:
            line = f"a worker died ({error_line(died)}); the task is submitted again ({lane.deaths[i]} of {AGAIN})"
            report(Event(lane.name, "lost", lane.stage, lines=(line,), times=(time.time(),)))
            lane.futures[i] = engine.submit(lane.tasks[i], f"{lane.name}/{lane.stage}/{i}")
    return bool(finished)


def _end_stage(lane: _Lane, engine: _Submitter, report: Callable[[Event], None]) -> bool:
    """All tasks of a stage have ended: go on with the next; False if the scene has ended."""
    done = [lane.done[i] for i in range(len(lane.tasks))]
    said = [line for one in done for line in one["lines"]]
    times, lines = tuple(when for when, _ in said), tuple(line for _, line in said)
    seconds = sum(one["seconds"] for one in done)
    error = next((one["error"] for one in done if one["error"] is not None), None)
    if error is not None:
        lane.plan.close()
        report(Event(lane.name, "failed", lane.stage, seconds, lines, times, failure=Failure(lane.stage, *error)))
        return False
    values = [one["value"] for one in done]
    report(Event(lane.name, "done", lane.stage, seconds, lines, times, tuple(values)))
    return _advance(lane, values, engine, report)
