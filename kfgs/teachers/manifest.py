"""What a folder of feature maps says about itself: which teacher made them, of which pictures, and what was written."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from dataclasses import field as default
from pathlib import Path
from typing import Any

from .._files import read_json, write_json

MANIFEST = "features.json"
FORMAT = "kfgs-features/1"


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


@dataclass(frozen=True)
class Manifest:
    """The maps of one teacher, by the stem of their picture. Maps may have been deleted since (`discarded`)."""

    teacher: dict[str, Any]  # teachers.identify
    maps: dict[str, MapRecord] = default(default_factory=dict)
    discarded: bool = False  # the maps were deleted on purpose, once index maps had been made of them

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
    found = read_json(path)
    hint = "delete it to use the maps without it, or make them again with `kfgs features`"
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise ValueError(f"{path}: expected format {FORMAT!r}, got something else; {hint}")
    try:
        records = {
            stem: MapRecord(**{**record, "shape": tuple(record["shape"])}) for stem, record in found["maps"].items()
        }
        return Manifest(dict(found["teacher"]), records, bool(found["discarded"]))
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: expected a manifest of kfgs, but it is damaged ({error}); {hint}") from error
