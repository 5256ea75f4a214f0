"""The command search: ask all fields below a folder at once."""

from __future__ import annotations

import csv as tables
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from .._card import say_coordinate
from .._files import InUseError, atomic_path, check_output, check_own, read_json, real_path, write_json
from .files import check_alone
from .options import Given, Positional, Teacher
from .output import LONG, lengths_odd, say, wrote

# Heavy imports happen inside the functions; a class that the fields know is found without torch.

SHOWN = 5  # parts of a scene in the table; all are in the files
COLUMNS = ["scene", "class", "number", "x", "y", "z", "size_x", "size_y", "size_z", "score", "photo", "Gaussians"]


def search(
    query: Positional[str],
    folder: Positional[Given[Path]] = None,
    *,
    like: Given[Path] = None,
    index: Given[int] = None,
    text: Given[Path] = None,
    threshold: Given[float] = None,
    exact: int = 0,
    top: int = 20,
    json: Given[Path] = None,
    csv: Given[Path] = None,
    teacher: Teacher,
) -> None:
    """Find a class, a phrase or an example in all fields below a folder: which scenes, where, how many, and the best view.

    The first search makes an index, FOLDER/search.kfgs; later ones extend it when fields are new or have changed. It may be
    deleted at any time. A class of a field's own table is answered exactly as `kfgs select` does. Other phrases, examples,
    and other thresholds are answered nearly exactly, from the index alone: groups of like Gaussians stand for their members
    (marked ~). With --exact, the fields themselves are asked.

    Examples:
        kfgs search chair runs/
        kfgs search "a red chair" runs/ --teacher lseg --weights demo_e200.ckpt --exact 5
        kfgs search runs/ --like runs/room_0/field --index 17    # what resembles Gaussian 17

    Args:
        query: A class name; with --teacher any phrase.
        folder: Folder with runs, fields or scenes in blocks in it, at any depth. With --like it is the only argument.
        like: A field folder, or a field in one file, that shows an example, instead of a query.
        index: Number of the example's Gaussian, from 0, for --like; `kfgs view` shows it when you click one.
        text: A table of `kfgs text` to look the class up, instead of each field's own classes.
        threshold: Gaussians with a higher score are found. By default 0.5, where Gaussians are as like the query as like its
            nearest negative; with --like 0.9, a cosine.
        exact: Number of scenes, the best first, whose fields are asked themselves; they are ranked again.
        top: Number of scenes that are printed.
        json: File for the whole answer.
        csv: File for a table with a row for each part: centre, size along x, y, z, score, best photo, Gaussians.
    """
    from ..scale import SearchIndex

    if like is not None and folder is None:
        folder, query = Path(query), ""
    if folder is None or (like is None) != (index is None) or (like is not None and query):
        raise ValueError(
            "query, folder, like, index: expected QUERY FOLDER, or FOLDER --like FIELD --index N, got something else; see "
            "`kfgs search --help`"
        )
    for name, given, least in (("exact", exact, 0), ("top", top, 1)):
        if given < least:
            raise ValueError(f"{name}: expected a whole number from {least}, got {given}; give another")
    if like is not None:
        for name, other in (("text", text), ("teacher", teacher.teacher)):
            check_alone(name, other, "with --like, which needs no words")
    teacher.check_weights()
    if json is not None and csv is not None and real_path(json) == real_path(csv):
        raise ValueError(f"csv: expected another file than that of --json, got {csv} for both; give another name")
    if json is not None:
        check_output("json", json, "a file")
        check_own(json, lambda path: "query" in read_json(path), "kfgs search")
    if csv is not None:
        check_output("csv", csv, "a file")
        check_own(csv, lambda path: path.read_text(encoding="utf-8").startswith(",".join(COLUMNS)), "kfgs search")
    known = _up_to_date(SearchIndex.open(folder))
    if len(known) == 0:
        raise ValueError(f"folder: expected fields below {folder}, got none that can be read; make one with `kfgs fit`")
    found = _ask(known, query, like, index, text, threshold, exact, teacher)
    what = f"like {like}:{index}" if like is not None else query
    count = sum(scene.count for scene in found.scenes)
    parts = sum(len(scene.parts) for scene in found.scenes)
    if json is not None:
        write_json(json, {"query": what, "folder": str(folder)} | found.to_json())
    if csv is not None:
        _write_table(csv, what, found.scenes)
    said = f"{count} Gaussians in {parts} part{'s' if parts != 1 else ''}"
    say(f"{what}: in {len(found.scenes)} of {found.searched} scenes, {said}")
    _say_table(found.scenes[:top])
    if len(found.scenes) > top:
        say(f"  and {len(found.scenes) - top} more scenes; --top {len(found.scenes)} shows all")
    if any(not scene.exact for scene in found.scenes[:top]):
        say(
            "~: from the index, where groups of like Gaussians have one score; --exact N asks the N best scenes themselves"
        )
    for name, why in list(found.unasked.items())[:SHOWN]:
        say(f"note: not asked: {name} ({why})")
    if len(found.unasked) > SHOWN:
        say(f"note: not asked: {len(found.unasked) - SHOWN} more")
    if json is not None:
        wrote([json])
    if csv is not None:
        wrote([csv])


def _up_to_date(known: Any) -> Any:
    """The index, extended if fields are new or have changed. If that is impossible now, the old one answers."""
    if known.is_current():
        return known
    try:
        known, changes = known.update(progress=True, report=lambda line: say(f"note: {line}"))
    except (InUseError, OSError) as error:  # another process extends it, or the folder is read-only
        if len(known) == 0:
            raise
        say(f"note: the index is not extended now: {error}")
        return known
    gone = f", {len(changes.removed)} removed" if changes.removed else ""
    if changes.added or changes.removed or changes.failed:  # else copied files only got their new times
        added = "1 field" if len(changes.added) == 1 else f"{len(changes.added)} fields"
        say(f"index: {added} added{gone}; {len(known)} in {known.file}")
    return known


def _ask(
    known: Any,
    query: str,
    like: Path | None,
    index: int | None,
    text: Path | None,
    threshold: float | None,
    exact: int,
    teacher: Teacher,
) -> Any:
    if like is not None:
        return known.like(like, index, threshold, exact=exact)
    classes = None
    if teacher.teacher is not None:
        from .text import text_encoder

        check_alone("text", text, "with --teacher, which embeds the query itself")
        templates = next((one.info["templates"] for one in known.contents.tables if "templates" in one.info), None)
        classes = text_encoder(teacher)([query], templates=templates)
        query = classes.names[0]
    elif text is not None:
        from ..labels import load_label_set

        classes = load_label_set(text)
    try:
        return known.search(query, classes, threshold, exact=exact)
    except ValueError as error:
        if classes is not None or not str(error).startswith("class: "):
            raise
        raise ValueError(f"{error}; for any other phrase pass --teacher and --weights") from error


def _write_table(file: Path, what: str, scenes: Iterable[Any]) -> None:
    """A row for each part of each scene."""
    with atomic_path(file) as temporary, temporary.open("w", newline="", encoding="utf-8") as out:
        rows = tables.writer(out)
        rows.writerow(COLUMNS)
        for scene in scenes:
            for number, part in enumerate(scene.parts, start=1):
                size = [high - low for low, high in zip(part.low, part.high, strict=True)]
                rows.writerow([scene.path, what, number, *part.center, *size, part.score, part.view or "", part.count])


def _say_table(scenes: Iterable[Any]) -> None:
    """A line for each part of each scene, the largest first."""
    rows, long = [("scene", "parts", "score", "Gaussians", "center", "size", "best view")], False
    for scene in scenes:
        mark = "" if scene.exact else "~"
        if not scene.parts:
            rows.append((scene.path, "0", f"{mark}{scene.score:.3f}", f"{mark}{scene.count}", "scattered", "", ""))
        sides = [[high - low for low, high in zip(part.low, part.high, strict=True)] for part in scene.parts]
        odd = [times is not None for times in lengths_odd([max(one) for one in sides])]
        for i, part in enumerate(scene.parts[:SHOWN]):
            size = " x ".join(f"{side:.3g}" for side in sides[i]) + (" ?" if odd[i] else "")
            long = long or odd[i]
            center = ", ".join(say_coordinate(x, 3) for x in part.center)
            view = "" if part.view is None else f"{part.share:.1%} of {part.view}"
            name, parts = (scene.path, str(len(scene.parts))) if i == 0 else ("", "")
            rows.append((name, parts, f"{mark}{part.score:.3f}", f"{mark}{part.count}", f"({center})", size, view))
        if (left := len(scene.parts) - SHOWN) > 0:
            rows.append(("", "", "", "", f"and {left} more part{'s' if left > 1 else ''}", "", ""))
    if len(rows) == 1:
        return
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        say("  " + "  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip())
    if long:
        say(f"?: more than {LONG} times as long as the median of the parts of its scene: two in one?")
