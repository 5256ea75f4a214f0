"""Write one teacher's maps to a folder, so that a killed process can be resumed."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._files import bytes_in_words, digest_file
from ..teachers.protocol import Teacher
from .finder import MapFinder
from .layouts import LAYOUTS, OWN, layout_of, map_file
from .manifest import (
    MANIFEST,
    Manifest,
    MapRecord,
    differences,
    latest_records,
    part_manifests,
    plain_identity,
    read_manifest,
)
from .pictures import Picture

LOCK = ".features.lock"
ROW_BLOCK = 8  # rows of a map rounded at a time: 4 MB at 480 x 512 channels


class MapWriter:
    """Adds one teacher's maps to a folder and records each in its manifest. Use it while the folder is `locked`.

    Args:
        folder: the folder of maps.
        identity: of the teacher, see `identify`.
        pictures: the pictures whose maps will be written, or exist.
        overwrite: replace maps that kfgs made by another teacher.
        part: record the maps in the manifest of this part.

    Raises:
        TypeError: if JSON cannot hold `identity`.
        ValueError: if the folder holds maps of another teacher (the message says what differs), or of other programs.
    """

    def __init__(
        self,
        folder: Path,
        identity: Mapping[str, Any],
        pictures: Sequence[Picture],
        *,
        overwrite: bool = False,
        part: str | None = None,
    ) -> None:
        wanted = plain_identity(identity)
        found = check_maps(folder, wanted, pictures, overwrite=overwrite, part=part)
        if found is not None and found.teacher != wanted:
            _delete_maps(folder, found, [picture.stem for picture in pictures])
            found = None
        self.folder, self.part, self.manifest = folder, part, found or Manifest(wanted)
        self._missing = {stem for stem, one in self.manifest.maps.items() if not (folder / one.file).is_file()}
        if found is None:
            self.manifest.save(folder, part)  # from now on, a map without a record is one that a killed process left

    def doubt(self, stem: str, image_digest: str) -> str | None:
        """Why a picture's map must be made (again); None if the existing map can be used."""
        record = self.manifest.maps.get(stem)
        if record is None:
            return "new"
        if record.image_digest != image_digest:
            return "the picture has changed"
        if stem in self._missing:
            return "its map was discarded" if self.manifest.discarded else "its map is missing"
        file = self.folder / record.file
        if (doubt := record.doubt(file)) is not None:
            return f"its map {doubt}"
        if (mtime_ns := file.stat().st_mtime_ns) != record.mtime_ns:  # the same bytes: copied, or touched
            self._keep(stem, replace(record, mtime_ns=mtime_ns))
        return None

    def add(
        self, picture: Picture, image_digest: str, file: Path, shape: tuple[int, int, int], seconds: float
    ) -> MapRecord:
        """Record a map [h, w, D] that has been written to `file`, and save the manifest."""
        info, name = file.stat(), file.relative_to(self.folder).as_posix()
        what = {"image": picture.path.name, "image_digest": image_digest, "seconds": round(seconds, 3)}
        record = MapRecord(name, shape, info.st_size, info.st_mtime_ns, digest_file(file), **what)  # type: ignore[arg-type]
        self._keep(picture.stem, record)
        return record

    def _keep(self, stem: str, record: MapRecord) -> None:
        self._missing.discard(stem)
        maps = {**self.manifest.maps, stem: record}
        # while one of the discarded maps is missing, its record still describes it
        self.manifest = replace(self.manifest, maps=maps, discarded=self.manifest.discarded and bool(self._missing))
        self.manifest.save(self.folder, self.part)

    def check_space(self, maps: int, map_bytes: int) -> None:
        """Raise an OSError unless the disk has space for `maps` maps of `map_bytes` bytes."""
        needed, free = maps * map_bytes, shutil.disk_usage(self.folder).free
        if needed > free:
            raise OSError(
                f"{self.folder}: expected {bytes_in_words(needed)} free for {maps} maps, got {bytes_in_words(free)}; "
                "free some, take another disk, or store no maps (RecomputedMaps)"
            )


def _known(folder: Path, part: str, whole: Manifest | None, identity: Any, stems: list[str]) -> Manifest | None:
    """What is recorded of a part's pictures, in the manifest of the folder, and in those of the parts.

    An earlier call may have divided the pictures in another way: if there are maps that this part did not record, all parts
    are read. If one of these manifests is of another teacher, that one is returned.
    """
    manifests = [one for one in (whole, read_manifest(folder, part)) if one is not None]
    records = latest_records(manifests)
    if any(stem not in records and map_file(folder, stem).is_file() for stem in stems):
        manifests = [*manifests, *part_manifests(folder).values()]
        records = latest_records(manifests)
    other = next((one for one in manifests if one.teacher != identity), None)
    if other is not None or not manifests:
        return other
    return replace(manifests[0], maps={stem: records[stem] for stem in stems if stem in records})


def check_maps(
    folder: Path, identity: Mapping[str, Any], pictures: Sequence[Picture], *, overwrite: bool, part: str | None = None
) -> Manifest | None:
    """The manifest of a folder that a teacher may write maps to; arguments and errors are those of `MapWriter`.

    Maps of another teacher are an error; with `overwrite` they may be replaced. Maps of other programs never are. Nothing is
    written here.
    """
    finder, stems, identity = MapFinder(folder), [picture.stem for picture in pictures], plain_identity(identity)
    found, hint = finder.manifest, "use another folder, or pass overwrite=True (--overwrite)"
    if part is not None:
        found = _known(folder, part, finder.manifest, identity, stems)
        hint = "use another folder, or delete this one"
    files = [map_file(folder, stem) for stem in stems]
    finder.own |= set(files)
    for file in (file for stem in stems for file in finder.named(stem)):
        expected = f"{folder}: expected a folder without maps of other programs, got {file.relative_to(folder)}"
        if layout_of(file, finder.own) in LAYOUTS[: LAYOUTS.index(OWN)]:
            raise ValueError(f"{expected}, which would be read instead of ours; use another folder")
        if found is None and file in files:
            raise ValueError(
                f"{expected} and no {MANIFEST}; use another folder, or move the maps away, which kfgs did not make"
            )
    if found is not None and found.teacher != identity and not overwrite:
        raise ValueError(
            f"{folder}: expected maps of the same teacher as now, got others ({differences(found.teacher, identity)}); "
            f"{hint} to give up its {len(found.maps)} maps"
        )
    return found


def _delete_maps(folder: Path, manifest: Manifest, stems: Sequence[str]) -> None:
    """Delete the maps that another teacher made."""
    own = MapFinder(folder).own | {map_file(folder, stem) for stem in stems}
    for stem in manifest.maps:
        if (file := map_file(folder, stem)) in own:  # never a file outside of the folder
            file.unlink(missing_ok=True)


def encode_half(teacher: Teacher, picture: Tensor, path: Path) -> Tensor:  # [H, W, 3] -> [h, w, D] float16
    """A teacher's map of one picture as it is stored: channels last, rounded to half precision, on the CPU.

    Raises:
        TypeError: if the teacher returns no tensor.
        ValueError: if the map is not finite before or after rounding, or if a feature becomes all-zero by rounding, which
            would mean "unknown"; the message names the picture.
    """
    with torch.inference_mode():
        features = teacher.encode_image(picture.permute(2, 0, 1).contiguous())
        D, h, w = features.shape
        half = torch.empty(h, w, D, dtype=torch.float16, device=features.device)
        finite, lost = torch.ones((), dtype=torch.bool, device=features.device), 0
        for start in range(0, h, ROW_BLOCK):  # one block stays in the processor's cache
            block = features[:, start : start + ROW_BLOCK]
            rows = half[start : start + ROW_BLOCK].copy_(block.permute(1, 2, 0))
            sums = rows.float().sum(-1)  # finite only if all values are; isfinite takes six times as long
            finite &= torch.isfinite(sums).all()
            i, j = (sums == 0).nonzero(as_tuple=True)
            lost += int((~rows[i, j].any(-1) & block[:, i, j].any(0)).sum()) if len(i) else 0
        if not bool(finite):
            bad = int((~torch.isfinite(features)).sum())
            expected, got = (
                "finite features",
                f"{bad} NaN or infinite values; check its weights, or use single precision",
            )
            if not bad:
                expected = "features below 65504 (they are stored as float16)"
                got = f"values up to {float(features.abs().max()):g}; scale them, or bring the rows to unit length"
            raise ValueError(f"teacher {teacher.name!r}: expected {expected} for {path}, got {got}")
        if lost:
            raise ValueError(
                f"teacher {teacher.name!r}: expected features above 6e-8 (they are stored as float16) for {path}, got "
                f"{lost} that become all-zero; scale them, or bring the rows to unit length"
            )
    return half.cpu()
