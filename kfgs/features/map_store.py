"""A folder that fills up with one teacher's maps: who may write to it, which maps still hold, what is left to do."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from torch import Tensor

from .._check import one_line
from .._files import bytes_in_words, digest_file
from ..teachers.protocol import Teacher, check_features
from .manifest import MANIFEST, Manifest, MapRecord, read_manifest

try:
    import fcntl
except ImportError:  # Windows: two processes on one folder are not told apart there
    fcntl = None  # type: ignore[assignment]

LOCK = ".features.lock"
ROW_BLOCK = 8  # rows of a map rounded at a time: 4 MB at 480 x 512 channels


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other processes from writing to a folder of maps; the folder is made if there is none.

    Raises:
        ValueError: if another process is writing to it.
        OSError: if it cannot be made or written to; the message says so.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / LOCK).open("a")
    except OSError as error:
        raise type(error)(
            f"folder: expected a folder that can be written to, got {folder} ({error.strerror}); choose another"
        ) from error
    with file:
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise ValueError(
                    f"folder: expected one that no other process writes to, got {folder}, which is in use; wait until "
                    "that process has ended"
                ) from error
        yield  # the empty file stays: removing it would let two processes hold locks of one name


def encode_half(teacher: Teacher, picture: Tensor, path: Path) -> Tensor:  # [H, W, 3] -> [h, w, D] float16
    """A teacher's map of one picture as it is kept: channels last, rounded to half precision, on the CPU.

    Raises:
        TypeError, ValueError: if the teacher returns no map, or one that is not finite, before or after the rounding; the
            message names the picture.
    """
    with torch.inference_mode():
        features = check_features(teacher.name, teacher.encode_image(picture.permute(2, 0, 1).contiguous()))
        D, h, w = features.shape
        half = torch.empty(h, w, D, dtype=torch.float16, device=features.device)
        finite = torch.ones((), dtype=torch.bool, device=features.device)
        for start in range(0, h, ROW_BLOCK):  # what is in a processor's cache is cheap to look at twice
            rows = half[start : start + ROW_BLOCK]
            rows.copy_(features[:, start : start + ROW_BLOCK].permute(1, 2, 0))
            # NaN and infinity outlast a sum, which overflows from none that is finite; isfinite takes six times as long
            finite &= torch.isfinite(rows.sum(dtype=torch.float32))
        if not bool(finite):
            _refuse(teacher.name, features, path)
        _check_underflow(teacher.name, features, half, path)
    return half.cpu()


def _refuse(name: str, features: Tensor, path: Path) -> None:
    bad = int((~torch.isfinite(features)).sum())
    if bad:
        raise ValueError(
            f"teacher {name!r}: expected finite features for {path}, got {bad} NaN or infinite values; check its weights, "
            "or run it in single precision"
        )
    largest = float(features.abs().max())
    raise ValueError(
        f"teacher {name!r}: expected features below 65504 (they are stored as float16) for {path}, got values up to "
        f"{largest:g}; scale them, or bring the rows to unit length"
    )


def _check_underflow(
    name: str,
    features: Tensor,  # [D, h, w]
    half: Tensor,  # [h, w, D] float16
    path: Path,
) -> None:
    """Refuse features that are something, but nothing (all-zero: unknown) once they are rounded."""
    probe = slice(None, None, max(half.shape[2] // 8, 1))  # a few channels rule out nearly all cells
    lost = 0
    for start in range(0, half.shape[0], ROW_BLOCK):
        rows = half[start : start + ROW_BLOCK]
        i, j = (rows[..., probe] == 0).all(-1).nonzero(as_tuple=True)
        zero = ~rows[i, j].any(-1)
        lost += int(features[:, start + i[zero], j[zero]].any(0).sum())
    if lost:
        raise ValueError(
            f"teacher {name!r}: expected features above 6e-8 (they are stored as float16) for {path}, got {lost} that "
            "become all-zero; scale them, or bring the rows to unit length"
        )


@dataclass
class MapStore:
    """The maps of one teacher in one folder, as its manifest records them. To be used while the folder is `locked`."""

    folder: Path
    manifest: Manifest
    missing: set[str] = field(default_factory=set)  # stems that are recorded, but whose maps are gone

    @staticmethod
    def open(folder: Path, identity: Mapping[str, Any]) -> MapStore:
        """The store of a teacher's maps, which may be new.

        Raises:
            TypeError: if `identity` is no JSON.
            ValueError: if the folder holds maps of another teacher; the message says what differs.
        """
        wanted = plain_identity(identity)
        found = read_manifest(folder)
        if found is not None and found.teacher != wanted:
            raise ValueError(
                f"folder: expected maps of the same teacher as now, got others in {folder} "
                f"({differences(found.teacher, wanted)}); use another folder, or pass overwrite=True "
                f"(--overwrite) to give up its {len(found.maps)} maps"
            )
        store = MapStore(folder, found or Manifest(wanted))
        store.missing = {stem for stem, one in store.manifest.maps.items() if not (folder / one.file).is_file()}
        if found is None:
            store.manifest.save(folder)  # from now on, a map without a record is ours, of a process that was killed
        return store

    def doubt(self, stem: str, image_digest: str) -> str | None:
        """Why a picture's map has to be made (again), in words; None if it holds."""
        record = self.manifest.maps.get(stem)
        if record is None:
            return "new"
        if record.image_digest != image_digest:
            return "the picture has changed"
        if stem in self.missing:
            return "its map was discarded" if self.manifest.discarded else "its map is gone"
        path = self.folder / record.file
        if (doubt := doubt_file(path, record)) is not None:
            return f"its map {doubt}"
        if (mtime_ns := path.stat().st_mtime_ns) != record.mtime_ns:
            self._keep(stem, replace(record, mtime_ns=mtime_ns))  # the same bytes: copied, or touched
        return None

    def add(self, stem: str, file: Path, **about: Any) -> MapRecord:
        """Record a map that has been written; `about` holds what MapRecord wants beside the file's own properties."""
        info = file.stat()
        name = file.relative_to(self.folder).as_posix()
        record = MapRecord(name, bytes=info.st_size, mtime_ns=info.st_mtime_ns, digest=digest_file(file), **about)
        self._keep(stem, record)
        return record

    def _keep(self, stem: str, record: MapRecord) -> None:
        self.missing.discard(stem)
        maps = {**self.manifest.maps, stem: record}
        # as long as one of the discarded maps is gone, the others' records speak for it
        self.manifest = replace(self.manifest, maps=maps, discarded=self.manifest.discarded and bool(self.missing))
        self.manifest.save(self.folder)


def doubt_file(path: Path, record: MapRecord) -> str | None:
    """Why a file that is there is not the map that was recorded, in words; None if it is, maybe copied or touched."""
    info = path.stat()
    if info.st_size != record.bytes:
        return f"has {info.st_size} bytes instead of {record.bytes}"
    return "has changed" if info.st_mtime_ns != record.mtime_ns and digest_file(path) != record.digest else None


def plain_identity(identity: Mapping[str, Any]) -> dict[str, Any]:
    """An identity as it comes back from a JSON file: tuples are lists.

    Raises:
        TypeError: if it is no JSON.
    """
    try:
        return dict(json.loads(json.dumps(dict(identity), allow_nan=False)))
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"teacher.identity: expected plain values that JSON can hold, got {identity!r} ({error}); leave out the rest"
        ) from error


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """What two identities do not agree in: `weights: 'a81f...' there, '77c0...' now`."""

    def short(value: Any) -> str:
        # one is out of a file, so nothing in it is shown raw; JSON is escaped already
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


def map_file(folder: Path, stem: str) -> Path:
    """Where a view's map lies.

    Raises:
        ValueError: if that is outside of the folder.
    """
    parts = PurePosixPath(stem)
    if not stem or parts.is_absolute() or ".." in parts.parts:
        raise ValueError(f"stem: expected a name within the folder of maps, got {stem!r}; rename the picture")
    return folder / f"{stem}.npy"


def sweep(folder: Path, files: list[Path]) -> None:
    """Remove the half-written files that a killed process left beside these and the manifest."""
    for file in [folder / MANIFEST, *files]:
        if file.parent.is_dir():
            for left_over in file.parent.glob(f".{_literal(file.name)}.*"):
                left_over.unlink(missing_ok=True)


def _literal(name: str) -> str:
    return "".join(f"[{c}]" if c in "*?[" else c for c in name)


def check_space(folder: Path, needed: int, maps: int) -> None:
    """Raise an OSError unless `needed` bytes for so many maps are free where `folder` lies."""
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise OSError(
            f"folder: expected {bytes_in_words(needed)} free for {maps} maps, got {bytes_in_words(free)} where {folder} lies; "
            "free some, take another disk, or make the maps anew when they are needed (RecomputedMaps)"
        )
