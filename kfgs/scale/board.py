"""The table of a batch: a row per scene, with its stages, seconds and score."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from .._card import cut
from .._files import InUseError, locked, seconds_in_words
from .batch import LOCK, STAGES, Row, read_rows
from .driver import Event

STOPPED = dict.fromkeys(("waits", "running"), "stopped")
LONGEST = 24  # characters of a name
MESSAGE = 600  # characters of a failure: what sfm says is long, and its end is advice


def event_line(event: Event, rows: Sequence[Row]) -> str | None:
    """A line for an event, and one for each note of its tasks; None for a scene that is finished."""
    row = next(row for row in rows if row.name == event.name)
    if event.kind == "started":
        return f"{event.name}: {event.stage} started"
    if event.kind == "done":
        done = f"{event.name}: {event.stage} {row.stages[event.stage]} in {seconds_in_words(event.seconds)}"
        return "\n".join([done, *(f"{event.name}: {line}" for line in event.lines if line.startswith("note: "))])
    if event.kind == "lost":
        return f"{event.name}: {event.stage}: {event.lines[0]}"
    if event.failure is not None:
        return f"{event.name}: {event.stage} failed: {cut(event.failure.message, MESSAGE)}"
    return None


def table(rows: Sequence[Row], most: int | None = None) -> str:
    """All scenes with their stages, and a line that counts them.

    Args:
        rows: of a batch.
        most: show at most this many scenes: those that failed first, then those at work, then those that wait for a worker, then
            the others.
    """
    shown = list(rows)
    if most is not None and len(shown) > most:
        order = sorted(
            rows, key=lambda row: 0 if row.failure else 3 if row.ended or not row.stages else 2 - _at_work(row)
        )
        chosen = {id(row) for row in order[: max(most, 0)]}
        shown = [row for row in rows if id(row) in chosen]
    width = max([5, *(min(len(row.name), LONGEST) for row in shown)])
    lines = [" ".join(["name".ljust(width), *(stage.ljust(8) for stage in STAGES), "seconds", " mIoU"]).rstrip()]
    for row in shown:
        miou = (row.value or {}).get("miou")
        score = "    -" if miou is None else f"{miou:5.3f}"
        cells = [cut(row.name, LONGEST).ljust(width), *(row.stages.get(stage, "-").ljust(8) for stage in STAGES)]
        lines.append(" ".join([*cells, f"{sum(row.seconds.values()):7.1f}", score]))
        if row.failure is not None:
            lines.append(f"  {row.failure.stage}: {cut(row.failure.message, MESSAGE if most is None else 90)}")
    counts = {
        "finished": sum(row.value is not None for row in rows),
        "failed": sum(row.failure is not None for row in rows),
        "at work": sum(_at_work(row) for row in rows),
        "stopped": sum("stopped" in row.stages.values() for row in rows),
    }
    counts["waiting"] = len(rows) - sum(counts.values())
    scores = [row.value["miou"] for row in rows if row.value is not None and row.value.get("miou") is not None]
    words = [f"{count} {what}" for what, count in counts.items() if count]
    words += [f"mean mIoU {sum(scores) / len(scores):.3f} of {len(scores)}"] if scores else []
    return "\n".join([*lines, f"{len(rows)} scene{'s' if len(rows) != 1 else ''}: {', '.join(words)}"])


def _at_work(row: Row) -> bool:
    return "running" in row.stages.values()


def describe_batch(folder: Path) -> str | None:
    """What the --out folder of a batch has, as its table; None if it is none."""
    rows = read_rows(folder) if (folder / LOCK).is_file() else []
    if not rows:
        return None
    file = folder / LOCK
    head = f"{folder}: a batch"
    try:
        with locked(file.parent, file.name):
            works = False
    except InUseError:
        works = True
    if works:
        head += " at work"
    elif not all(row.ended for row in rows):
        head += " that was stopped"
        for row in rows:
            row.stages = {stage: STOPPED.get(word, word) for stage, word in row.stages.items()}
    advice = ["the same `kfgs batch` again goes on with scenes that are not done"]
    advice += ["with --retry-failed also with failed ones"] if any(row.failure for row in rows) else []
    advice = [f"kfgs select WORD {folder}/NAME"] if all(row.value is not None for row in rows) else advice
    return "\n".join([f"{head}; scenes that have not begun are not listed", table(rows), f"next: {', '.join(advice)}"])
