"""The fields of a run folder: the current one (`field`), and earlier ones (`field@<key>`), which are kept and can come back.

What shows a field to people, its report and pictures, lies in the run folder while the field is current. Before another one
takes its place, they are moved to the kept field, so that a kill leaves no report rather than another field's.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import time
import warnings
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .._check import one_line
from .._files import as_path, atomic_folder, atomic_path, current_file, digest_value
from .._files.fields import KEPT
from .._typed import typed
from ..fields.store import DESCRIPTION, TENSORS, check_place, describes_field, load_field, read_description
from .stages import Run

FIELD = "field"
KEY = 12  # hexadecimal digits of a key
UNDECIDED = ("seconds", "kfgs")  # notes that differ between two undisturbed fits
SHOWN = ("report.html", "preview.png", "codebook.png", "field.png")  # what `write_run_report` writes
LONGEST = 40  # characters of a value in a comparison


@dataclass(frozen=True)
class RunField:
    """A field of a run folder."""

    path: Path
    key: str
    """The first digits of a SHA-256 of its numbers and notes, except times and the version of kfgs."""
    current: bool
    """Whether `RUN/field` holds it."""
    saved: float
    """When it was written, in seconds since 1970."""
    gaussians: int
    info: dict[str, Any]

    def __str__(self) -> str:
        steps = self.info.get("steps")
        known = steps.items() if isinstance(steps, dict) else ()  # another program may have written the file
        parts = [
            str(self.info.get("method", "unknown method")),
            f"{self.gaussians:,} Gaussians",
            *(f"{count:,} steps ({stage})" for stage, count in known if isinstance(count, int)),
            f"of {time.strftime('%Y-%m-%d %H:%M', time.localtime(self.saved))}",
        ]
        return one_line(f"{self.key}  {', '.join(parts)}", 200)


def list_fields(folder: str | Path) -> list[RunField]:
    """The fields of a run folder, the current one first, then the earlier ones, the latest first.

    Damaged ones are left out, with a warning.

    Raises:
        FileNotFoundError: if the folder has none.
    """
    folder = as_path(folder)
    found, earlier = _read_all([folder / FIELD], current=True), _read_all(sorted(folder.glob(f"{KEPT}*")))
    found += sorted(earlier, key=lambda one: -one.saved)
    if not found:
        raise FileNotFoundError(f"{folder}: expected a run folder with a field, got none; make one with `kfgs fit`")
    first = dict[str, RunField]()  # a field that was restored lies in two places
    for one in found:
        first.setdefault(one.key, one)
    return list(first.values())


def find_run_field(folder: str | Path, key: str) -> RunField:
    """The field of a run folder whose key begins with `key`; a ValueError if there is none, or more than one."""
    fields, digits = list_fields(folder), key.removeprefix(KEPT)
    found = [one for one in fields if digits and one.key.startswith(digits)]
    if len(found) != 1:
        raise ValueError(
            f"key: expected the key of one field ({', '.join(one.key for one in fields)}), got {one_line(key)!r}; "
            f"give {'more of its digits' if found else 'one of them'}"
        )
    return found[0]


def check_current(folder: Path) -> None:
    """Check before the work that `RUN/field` is free, or holds a whole field, which can be kept.

    Raises:
        FileExistsError: if something else is there, or in the place where it is kept.
        ValueError: if it holds a damaged field.
    """
    check_place(folder / FIELD)
    if describes_field(folder / FIELD):
        _check_whole(folder / FIELD)
        kept = _place_of(_read(folder / FIELD))
        if kept.exists() and not kept.is_dir():
            raise FileExistsError(
                f"{kept}: expected a folder or nothing there, where the current field will be kept, got a file; move it away"
            )


def keep_field(folder: Path) -> RunField | None:
    """Copy the current field of a run folder to `field@<key>`, before another one takes its place, and move its report there.

    Returns:
        The kept field; None if there is no current one.
    """
    if not describes_field(folder / FIELD):
        return None
    now = _read(folder / FIELD, current=True)
    kept = _place_of(now)
    if not _holds(kept, now.key, whole=True):
        _copy(now.path, kept)
    for shown in _shown_in(folder):
        os.replace(shown, kept / shown.name)
    return _read(kept)


def say_kept(run: Run, before: RunField | None) -> None:
    """After another field became current, say so; if it is the same one, made again, drop the copy of the earlier one."""
    if before is None:
        return
    if _read(run.folder / FIELD).key == before.key:
        for shown in _shown_in(before.path):
            os.replace(shown, run.folder / shown.name)
        for name in (DESCRIPTION, TENSORS):
            current_file(before.path, name).unlink()
        with suppress(OSError):  # it holds files of the user
            before.path.rmdir()
        return
    run.say(
        f"field: another one is current now; the one before ({before}) is kept as {before.path} (`kfgs runs "
        f"{run.folder}` compares them and brings it back)"
    )


def restore_field(folder: str | Path, key: str) -> RunField:
    """Make an earlier field of a run folder the current one, which is kept.

    Args:
        folder: the run folder.
        key: of the field, or its first digits.

    Raises:
        ValueError: if no field has this key, it or the current one is damaged, or another process works in the folder.
    """
    folder = as_path(folder)
    wanted = find_run_field(folder, key)
    with Run(folder).locked():
        if not wanted.current:
            keep_field(folder)
            _copy(wanted.path, folder / FIELD)
        for shown in _shown_in(_place_of(wanted) if wanted.current else wanted.path):  # also after a kill
            with atomic_path(folder / shown.name) as new:
                shutil.copy2(shown, new)
    return _read(folder / FIELD, current=True)


@typed
def compare_fields(one: RunField, other: RunField) -> list[tuple[str, str, str]]:
    """What differs between two fields: (fact, value of the first, value of the second)."""
    facts = [_facts(field) for field in (one, other)]
    names = list(dict.fromkeys([*facts[0], *facts[1]]))
    rows = [(name, *(one_line(fact.get(name, "-"), LONGEST) for fact in facts)) for name in names]
    return [(name, a, b) for name, a, b in rows if a != b]


def _facts(field: RunField) -> dict[str, Any]:
    """What is known of a field by name; parts of parts have a dot in their names."""
    files = sum(current_file(field.path, name).stat().st_size for name in (TENSORS, DESCRIPTION))
    facts: dict[str, Any] = {"Gaussians": f"{field.gaussians:,}", "size": f"{files / 2**20:.2f} MiB"}
    for name, value in field.info.items():
        inside = value.items() if isinstance(value, dict) else [("", value)]
        facts |= {f"{name}.{part}".rstrip("."): one for part, one in inside}
    return {one_line(name): len(value) if isinstance(value, list) else value for name, value in facts.items()}


def _read(path: Path, *, current: bool = False) -> RunField:
    about = read_description(path)
    info, digest, count = (about.get(name) for name in ("info", "sha256", "gaussians"))
    if not (isinstance(info, dict) and isinstance(count, int) and re.fullmatch("[0-9a-f]{64}", str(digest))):
        raise ValueError(
            f"{path}: expected info, sha256 and a number of gaussians in {DESCRIPTION}; fit the field again"
        )
    notes = {name: value for name, value in info.items() if name not in UNDECIDED}
    key = digest_value(json.dumps({**about, "info": notes, "version": None}, sort_keys=True))[:KEY]
    return RunField(path, key, current, current_file(path, DESCRIPTION).stat().st_mtime, count, info)


def _read_all(paths: Iterable[Path], *, current: bool = False) -> list[RunField]:
    """Those of some folders that are fields; a warning for each damaged one."""
    found = []
    for path in paths:
        try:
            if describes_field(path):
                found.append(_read(path, current=current))
        except (OSError, ValueError) as error:
            warnings.warn(f"{error}; it is left out", stacklevel=3)
    return found


def _place_of(field: RunField) -> Path:
    """Where a field is kept while another one is current: a folder that holds it already, or a new one."""
    others = sorted(field.path.parent.glob(f"{KEPT}*"))
    return next((one for one in others if _holds(one, field.key)), field.path.with_name(f"{KEPT}{field.key}"))


def _holds(path: Path, key: str, *, whole: bool = False) -> bool:
    """Whether a folder describes the field with this key; with `whole`, whether its numbers are there, too."""
    try:
        if whole:
            _check_whole(path)
        return _read(path).key == key
    except (OSError, ValueError):
        return False


def _check_whole(path: Path) -> None:
    try:
        load_field(path)
    except (OSError, ValueError) as error:
        raise ValueError(
            f"{path}: expected a whole field, got a damaged one ({error}); rename the folder, or delete it"
        ) from error


def _shown_in(folder: Path) -> list[Path]:
    """The report and the pictures of a field."""
    return [folder / name for name in SHOWN if (folder / name).is_file()]


def _copy(source: Path, target: Path) -> None:
    """Copy a whole field with its date."""
    _check_whole(source)
    with atomic_folder(target) as new:
        for name in (TENSORS, DESCRIPTION):
            shutil.copy2(current_file(source, name), new / name)
