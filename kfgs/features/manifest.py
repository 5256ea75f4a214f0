"""What a folder of feature maps says about itself: which teacher made them, of which pictures, and what was written."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from dataclasses import field as default
from pathlib import Path, PurePosixPath
from typing import Any

from .._check import one_line
from .._files import read_json, write_json

MANIFEST = "features.json"
FORMAT = "kfgs-features/1"
LARGEST = 2**63 - 1  # of a number in a record: file systems and tensors know none beyond it
LEVELS = 100  # of dicts and lists within a teacher's identity, which needs about three


@dataclass(frozen=True)
class MapRecord:
    """One map that was written, and the picture it was made of."""

    file: str  # name of the map within the folder: "rgb_1.npy"
    shape: tuple[int, int, int]  # (h, w, D)
    bytes: int
    mtime_ns: int  # of the map's file
    digest: str  # SHA-256 of the map's file
    image: str  # name of the picture
    image_digest: str  # SHA-256 of the picture's file
    seconds: float  # that the teacher took


_KINDS: dict[str, type | tuple[type, ...]] = {  # in JSON
    "file": str,
    "shape": list,
    "bytes": int,
    "mtime_ns": int,
    "digest": str,
    "image": str,
    "image_digest": str,
    "seconds": (int, float),
}


@dataclass(frozen=True)
class Manifest:
    """The maps of one teacher, by the stem of their picture. Maps may have been deleted since (`discarded`)."""

    teacher: dict[str, Any]  # teachers.identify
    maps: dict[str, MapRecord] = default(default_factory=dict)
    discarded: bool = False  # the maps were deleted on purpose, once index maps had been made of them

    def files(self, folder: Path) -> frozenset[Path]:
        """The maps that are recorded, which a folder of this manifest holds, or held."""
        return frozenset(folder / record.file for record in self.maps.values())

    def gone(self, folder: Path) -> dict[str, Path]:
        """By stem, where the maps were that have been discarded."""
        files = {stem: folder / record.file for stem, record in self.maps.items()} if self.discarded else {}
        return {stem: file for stem, file in files.items() if not file.is_file()}

    def save(self, folder: Path) -> None:
        """Write `features.json`, atomically."""
        write_json(folder / MANIFEST, {"format": FORMAT, **asdict(self)})


def read_manifest(folder: str | Path) -> Manifest | None:
    """The manifest of a folder of maps; None if it has none, as those of other programs.

    Raises:
        ValueError: if there is one that is damaged, or of another version.
    """
    path = Path(folder) / MANIFEST
    if not path.is_file():
        return None
    hint = "delete it to use the maps without it, or delete it and run `kfgs features` with --overwrite, which makes them again"
    try:
        found = read_json(path)
    except ValueError as error:
        raise ValueError(f"{error}; {hint}") from error
    except RecursionError as error:
        raise ValueError(f"{path}: expected a manifest of kfgs, but it is nested too deeply; {hint}") from error
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise ValueError(f"{path}: expected format {FORMAT!r}, got something else; {hint}")
    try:
        kinds = {"teacher": dict, "maps": dict, "discarded": bool}
        teacher, maps, discarded = (_entry(found, name, kind) for name, kind in kinds.items())
        if not _is_plain(teacher, LEVELS):
            raise ValueError("teacher holds NaN or infinity, or is nested too deeply")
        return Manifest(teacher, {stem: _read_record(stem, entry) for stem, entry in maps.items()}, discarded)
    except ValueError as error:
        raise ValueError(f"{path}: expected a manifest of kfgs, but it is damaged ({error}); {hint}") from error


def _read_record(stem: str, found: Any) -> MapRecord:
    """One map's record out of JSON; a ValueError tells what in it cannot be."""
    if not isinstance(found, dict):
        raise ValueError(f"{one_line(stem)}: a record is a {type(found).__name__}")
    try:
        values = {name: _entry(found, name, kind) for name, kind in _KINDS.items()}
    except ValueError as error:
        raise ValueError(f"{one_line(stem)}: {error}") from error
    file, shape = PurePosixPath(values["file"]), values["shape"]
    if not file.name or file.is_absolute() or ".." in file.parts or "\0" in str(file):
        raise ValueError(f"{one_line(stem)}: file {str(file)[:80]!r} is no name within the folder")
    if len(shape) != 3 or not all(type(size) is int and 0 < size <= LARGEST for size in shape):
        raise ValueError(f"{one_line(stem)}: shape {str(shape)[:80]} is not three positive whole numbers")
    if not all(0 <= values[name] <= LARGEST for name in ("bytes", "seconds")):  # NaN fails every comparison
        numbers = f"{str(values['bytes'])[:30]} and {str(values['seconds'])[:30]}"
        raise ValueError(f"{one_line(stem)}: bytes and seconds cannot be {numbers}")
    return MapRecord(**{**values, "shape": tuple(shape)})


def _is_plain(value: Any, levels: int) -> bool:
    """Whether a value out of JSON can be written back: finite numbers, and not nested deeper than `levels`."""
    if isinstance(value, float):
        return math.isfinite(value)
    if not isinstance(value, dict | list):
        return True
    return levels > 0 and all(
        _is_plain(one, levels - 1) for one in (value.values() if isinstance(value, dict) else value)
    )


def _entry(found: dict[str, Any], name: str, kind: type | tuple[type, ...]) -> Any:
    if name not in found:
        raise ValueError(f"{name} is missing")
    value = found[name]
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(f"{name} is a {type(value).__name__}")
    return value
