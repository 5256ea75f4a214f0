"""The fields of a run folder: the current one (`field`), and earlier ones (`field@<key>`), which are kept and can come back."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .._check import one_line
from .._files import as_path, atomic_folder, current_file
from ..fields.store import DESCRIPTION, TENSORS, describes_field, read_description
from .stages import Run

FIELD, KEPT = "field", "field@"
KEY = 12  # hexadecimal digits of a key
LONGEST = 40  # characters of a value in a comparison


@dataclass(frozen=True)
class RunField:
    """A field of a run folder."""

    path: Path
    key: str
    """The first digits of the SHA-256 of its numbers."""
    current: bool
    """Whether `RUN/field` holds it."""
    saved: float
    """When it was written, in seconds since 1970."""
    gaussians: int
    info: dict[str, Any]

    def __str__(self) -> str:
        steps = (self.info.get("steps") or {}).items()
        parts = [
            str(self.info.get("method", "unknown method")),
            f"{self.gaussians:,} Gaussians",
            *(f"{count:,} steps ({stage})" for stage, count in steps),
            f"of {time.strftime('%Y-%m-%d %H:%M', time.localtime(self.saved))}",
        ]
        return one_line(f"{self.key}  {', '.join(parts)}", 200)


def list_fields(folder: str | Path) -> list[RunField]:
    """The fields of a run folder, the current one first, then the earlier ones, the latest first.

    Raises:
        FileNotFoundError: if the folder has none.
        ValueError: if one is damaged.
    """
    folder = as_path(folder)
    current = folder / FIELD
    found = [_read(current, current=True)] if describes_field(current) else []
    earlier = [_read(path) for path in folder.glob(f"{KEPT}*") if describes_field(path)]
    known = {one.key for one in found}
    found += sorted((one for one in earlier if one.key not in known), key=lambda one: -one.saved)
    if not found:
        raise FileNotFoundError(f"{folder}: expected a run folder with a field, got none; make one with `kfgs fit`")
    return found


def find_run_field(folder: str | Path, key: str) -> RunField:
    """The field of a run folder whose key begins with `key`; a ValueError if there is none, or more than one."""
    fields = list_fields(folder)
    found = [one for one in fields if key and one.key.startswith(key.removeprefix(KEPT))]
    if len(found) != 1:
        raise ValueError(
            f"key: expected the key of one field ({', '.join(one.key for one in fields)}), got {one_line(key)!r}; "
            f"give {'more of its digits' if found else 'one of them'}"
        )
    return found[0]


def keep_field(folder: Path) -> RunField | None:
    """Copy the current field of a run folder to `field@<key>`, before another one takes its place; None if there is none."""
    if not describes_field(folder / FIELD):
        return None
    now = _read(folder / FIELD, current=True)
    kept = folder / f"{KEPT}{now.key}"
    if not describes_field(kept):
        _copy(now.path, kept)
    return _read(kept)


def say_kept(run: Run, before: RunField | None) -> None:
    """After another field became current, say so; if it has the same numbers, drop the copy of the earlier one."""
    if before is None:
        return
    if _read(run.folder / FIELD).key == before.key:
        shutil.rmtree(before.path)
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
        ValueError: if no field has this key, or another process works in the folder.
    """
    folder = as_path(folder)
    wanted = find_run_field(folder, key)
    if not wanted.current:
        with Run(folder).locked():
            keep_field(folder)
            _copy(wanted.path, folder / FIELD)
    return _read(folder / FIELD, current=True)


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
    info = about.get("info")
    saved = current_file(path, DESCRIPTION).stat().st_mtime
    count = about.get("gaussians", 0)
    return RunField(path, str(about["sha256"])[:KEY], current, saved, count, info if isinstance(info, dict) else {})


def _copy(source: Path, target: Path) -> None:
    """Copy a field with its date."""
    with atomic_folder(target) as new:
        for name in (TENSORS, DESCRIPTION):
            shutil.copy2(current_file(source, name), new / name)
