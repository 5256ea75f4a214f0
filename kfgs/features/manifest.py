"""The manifest of a folder of feature maps: the teacher, the pictures, and a record of each map file."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from dataclasses import field as default
from pathlib import Path, PurePosixPath
from typing import Any

from .._check import one_line
from .._files import as_path, digest_file, read_json, write_json

MANIFEST = "features.json"
FORMAT = "kfgs-features/1"
LARGEST = 2**63 - 1  # largest number in a record: file systems and tensors have none beyond it
LEVELS = 100  # deepest nesting of a teacher's identity, which needs about three levels


@dataclass(frozen=True)
class MapRecord:
    """One map that was written, and the picture it was made from."""

    file: str  # name of the map within the folder: "rgb_1.npy"
    shape: tuple[int, int, int]  # (h, w, D)
    bytes: int
    mtime_ns: int  # of the map's file
    digest: str  # SHA-256 of the map's file
    image: str  # name of the picture
    image_digest: str  # SHA-256 of the picture's file
    seconds: float  # that the teacher took

    def doubt(self, file: Path, *, read: bool = True) -> str | None:
        """Why `file` is not the recorded map; None if it is.

        If only the time differs, the file was copied, touched or changed. With `read` its digest decides; without, it
        counts as changed.
        """
        info = file.stat()
        if info.st_size != self.bytes:
            return f"has changed ({info.st_size} bytes instead of {self.bytes})"
        if info.st_mtime_ns == self.mtime_ns or (read and digest_file(file) == self.digest):
            return None
        return "has changed" if read else "was copied or changed"


@dataclass(frozen=True, repr=False)
class Manifest:
    """The maps of one teacher, by the stem of their picture. The maps may have been deleted since (`discarded`)."""

    teacher: dict[str, Any]  # teachers.identify
    maps: dict[str, MapRecord] = default(default_factory=dict)
    discarded: bool = False  # maps were deleted on purpose, after index maps had been made from them

    def __repr__(self) -> str:
        name, discarded = one_line(self.teacher.get("name", "unknown")), ", discarded" if self.discarded else ""
        return f"Manifest({len(self.maps)} maps by {name}{discarded})"

    def save(self, folder: Path, part: str | None = None) -> None:
        """Write `features.json`, or the manifest of a part, atomically."""
        write_json(manifest_file(folder, part), {"format": FORMAT, **asdict(self)})


def manifest_file(folder: Path, part: str | None = None) -> Path:
    """The manifest of a folder, or that of a part of its maps, which other processes do not write to."""
    return folder / (MANIFEST if part is None else f"features.part-{part}.json")


def read_manifest(folder: str | Path, part: str | None = None) -> Manifest | None:
    """The manifest of a folder of maps; None if it has none, because another program wrote the maps.

    Args:
        folder: the folder.
        part: read the manifest of this part instead, see `extract_features`; None if it has not begun, or was joined.

    Raises:
        ValueError: if the manifest is damaged, or of another version.
    """
    path = manifest_file(as_path(folder), part)
    if not path.is_file():
        return None
    try:
        found = read_json(path)
        if not isinstance(found, dict) or found.get("format") != FORMAT:
            raise ValueError(f"expected format {FORMAT!r}, got something else")
        teacher, maps, discarded = (found.get(name) for name in ("teacher", "maps", "discarded"))
        if not isinstance(teacher, dict) or not isinstance(maps, dict) or not isinstance(discarded, bool):
            raise ValueError("teacher, maps or discarded is missing or of another type")
        if not _is_plain(teacher, LEVELS):
            raise ValueError("teacher holds NaN or infinity, or is nested too deeply")
        return Manifest(teacher, {stem: _read_record(stem, entry) for stem, entry in maps.items()}, discarded)
    except ValueError as error:
        raise ValueError(
            f"{path}: expected a manifest of kfgs, but it is damaged "
            f"({str(error).removeprefix(f'{path}: ')}); "
            "delete it to use the maps without it, or delete it and the maps and run `kfgs features`, which makes them again"
        ) from error


def part_manifests(folder: Path) -> dict[Path, Manifest]:
    """The manifests of all parts that were not joined yet, by their files."""
    files = sorted(folder.glob(manifest_file(folder, "*").name))
    found = {file: read_manifest(folder, file.stem.partition("-")[2]) for file in files}
    return {file: manifest for file, manifest in found.items() if manifest is not None}


def latest_records(manifests: Iterable[Manifest]) -> dict[str, MapRecord]:
    """The records of several manifests. Of a picture with several records, that of the map that was written last."""
    found: dict[str, MapRecord] = {}
    for stem, record in (pair for manifest in manifests for pair in manifest.maps.items()):
        if stem not in found or found[stem].mtime_ns <= record.mtime_ns:
            found[stem] = record
    return found


def _read_record(stem: str, found: Any) -> MapRecord:
    """One map's record from JSON; a ValueError says what is wrong with it."""
    found = found if isinstance(found, dict) else {}
    file, shape = found.get("file"), found.get("shape")
    path, sizes = PurePosixPath(str(file)), shape if isinstance(shape, list) else []
    inside = path.name and not path.is_absolute() and ".." not in path.parts and "\0" not in str(file)
    good = {
        "file": isinstance(file, str) and inside,
        "shape": len(sizes) == 3 and all(type(size) is int and 0 < size <= LARGEST for size in sizes),
        "bytes": type(found.get("bytes")) is int and 0 <= found["bytes"] <= LARGEST,
        "seconds": type(found.get("seconds")) in (int, float) and 0 <= found["seconds"] <= LARGEST,  # NaN fails
        "mtime_ns": type(found.get("mtime_ns")) is int,
        **{name: isinstance(found.get(name), str) for name in ("digest", "image", "image_digest")},
    }
    for name, is_good in good.items():
        if not is_good:
            raise ValueError(f"{one_line(stem)}: {name} cannot be {one_line(found.get(name, 'missing'))}")
    return MapRecord(shape=tuple(sizes), **{name: found[name] for name in good if name != "shape"})


def _is_plain(value: Any, levels: int) -> bool:
    """Whether a value from JSON can be written back: its numbers are finite, and it is nested at most `levels` deep."""
    if isinstance(value, float):
        return math.isfinite(value)
    if not isinstance(value, dict | list):
        return True
    return levels > 0 and all(
        _is_plain(one, levels - 1) for one in (value.values() if isinstance(value, dict) else value)
    )


def plain_identity(identity: Mapping[str, Any]) -> dict[str, Any]:
    """A teacher's identity as it comes back from a JSON file: tuples are lists.

    Raises:
        TypeError: if JSON cannot hold it.
    """
    try:
        return dict(json.loads(json.dumps(dict(identity), allow_nan=False)))
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"teacher.identity: expected plain values that JSON can hold, got {identity!r} ({error}); leave out the rest"
        ) from error


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Where two identities differ: `weights: 'a81f...' there, '77c0...' now`."""

    def short(value: Any) -> str:
        # one identity comes from a file, so nothing in it is shown raw; JSON is escaped already
        text = one_line(value, 1000) if isinstance(value, str) else json.dumps(value)
        return text if len(text) <= 40 else text[:12] + "..."

    parts = []
    for key in dict.fromkeys([*old, *new]):
        a, b = old.get(key), new.get(key)
        if isinstance(a, dict) and isinstance(b, dict) and a != b:
            parts.append(differences(a, b))
        elif a != b:
            there, now = (short(side[key]) if key in side else "none" for side in (old, new))
            parts.append(f"{one_line(key)}: {there} there, {now} now")
    return "; ".join(parts)
