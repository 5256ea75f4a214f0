"""A folder of feature maps on disk, read one view at a time."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import overload

import torch
from torch import Tensor

from .._check import check_shapes, check_whole
from .._files import atomic_path, digest_file
from ..quant import grid_slices
from .langsplat import parse_level
from .layouts import (
    FEATURE_3DGS,
    LANGSPLAT,
    ROW_BLOCK,
    Reading,
    StoredMap,
    count_bad,
    layout_of,
    open_map,
    partner_of,
    read_block,
)
from .manifest import MANIFEST, MapRecord, read_manifest
from .stems import explain_missing, find_maps, list_maps


class FeatureFolder(Sequence[Tensor]):
    """The teacher's feature maps of some views: item i is view i's map, [h, w, D] float32, read when asked for.

    These layouts are known, and may be mixed: `<stem>_fmap_CxHxW.pt` (Feature 3DGS: a tensor [D, h, w]),
    `<stem>_s.npy` beside `<stem>_f.npy` (LangSplat: mask numbers [4, H, W], and a feature per mask), and `<stem>.npy` or
    `<stem>.safetensors` (an array [h, w, D]; one of [D, h, w] is recognised by `channels` or the picture's aspect). Half,
    single or double precision. The stem may be followed by the picture's ending, and a picture in a subfolder has its
    map in the same subfolder; if no view has a map there, the last part of its name is looked for in all subfolders.
    A folder that kfgs filled (it holds `features.json`) is read as kfgs filled it: maps of other programs among them,
    or what a killed process left, are refused.

    No map is kept in memory, so the maps of a scene need not fit. Every map must have the same size; all-zero features
    are allowed, and mean "nothing known here". Maps that kfgs wrote, and deleted once index maps had been made of them
    (`features.json` says `discarded`), need not be there until one is read.

    Args:
        path: the folder.
        stems: image names without their ending, in the order wanted; if None all maps of the folder, sorted, and all that
            `features.json` tells of, which may lie in subfolders or have been discarded.
        channels: D that is expected, for instance that of the text embeddings; taken from the first map if None.
        sizes: (H, W) of each view's picture, which tells [h, w, D] from [D, h, w] where nothing else does.
        level: of LangSplat's masks: 0 to 3, or `default`, `s`, `m`, `l`.
        stride: of LangSplat's masks, which are as large as the pictures: one cell per so many pixels; None: the least
            stride that leaves no more cells than 360 x 480.

    Raises:
        NotADirectoryError: if `path` is no folder.
        FileNotFoundError: if views have no map; the message names them. When a map is read: if it was discarded.
        ValueError: if `stems` is empty or repeats one, several files may be meant, or `features.json` is damaged or does
            not tell of a view's file. When a map is read: if it is not a finite map of floats of the size of
            the first, or cannot be read at all; the message names the file.
        TypeError: when a map is read: if the file holds something else than one tensor.

    Example:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> _ = save_feature_map(folder, "view_0", torch.ones(3, 4, 8))
        >>> maps = FeatureFolder(folder, ["view_0"])
        >>> len(maps), maps.shape, maps[0].dtype
        (1, (3, 4, 8), torch.float32)
    """

    def __init__(
        self,
        path: str | Path,
        stems: Sequence[str] | None = None,
        *,
        channels: int | None = None,
        sizes: Sequence[tuple[int, int]] | None = None,
        level: int | str = 0,
        stride: int | None = None,
    ) -> None:
        self.path = Path(path)
        if not self.path.is_dir():
            raise NotADirectoryError(f"path: expected a folder of feature maps, got {self.path}; check its name")
        if stride is not None:
            check_whole("stride", stride, 1)
        self.channels = channels
        self.reading = Reading(channels=channels, level=parse_level(level), stride=stride)
        manifest = read_manifest(self.path)
        self.identity = manifest.teacher if manifest else None
        """What decides the maps (`identify`), if kfgs made them; else None."""
        records = manifest.maps if manifest else {}
        gone = manifest.gone(self.path) if manifest else {}
        self._own = manifest.files(self.path) if manifest else frozenset()
        listed = [*list_maps(self.path, own=self._own), *records] if stems is None else stems
        self.stems = _check_stems(self.path, listed, stems is None)
        if sizes is not None and len(sizes) != len(self.stems):
            raise ValueError(f"sizes: expected {len(self.stems)} (one per view), got {len(sizes)}; give one for each")
        self.sizes = None if sizes is None else list(sizes)
        self._records = [records.get(stem) for stem in self.stems]
        self.files = _find_files(self.path, self.stems, gone, self._own)
        if manifest is not None:
            _check_recorded(self.path, self.files, self._own)
        self._shape: tuple[int, int, int] | None = None

    def __len__(self) -> int:
        return len(self.files)

    def __repr__(self) -> str:
        return f"FeatureFolder({str(self.path)!r}, {len(self)} views)"

    @property
    def shape(self) -> tuple[int, int, int]:
        """(h, w, D) of every map; opens the first file, without reading its values."""
        if self._shape is None:
            record = self._record(0)
            h, w, D = record.shape if record else self._open(0).shape
            if self.channels is not None and self.channels != D:
                raise ValueError(
                    f"{self.files[0]}: expected {self.channels} channels, got {D} in a map of {h} x {w}; "
                    "use maps and embeddings of the same encoder"
                )
            self._shape = int(h), int(w), int(D)
        return self._shape

    @overload
    def __getitem__(self, index: int) -> Tensor: ...

    @overload
    def __getitem__(self, index: slice) -> FeatureFolder: ...

    def __getitem__(self, index: int | slice) -> Tensor | FeatureFolder:
        if isinstance(index, slice):
            return FeatureFolder(
                self.path,
                self.stems[index],
                channels=self.channels,
                sizes=None if self.sizes is None else self.sizes[index],
                level=self.reading.level,
                stride=self.reading.stride,
            )
        stored = self._checked(index)
        values, bad = torch.empty(self.shape, dtype=torch.float32), 0
        for start in range(0, self.shape[0], ROW_BLOCK):  # by rows, so that the values are all that is in memory
            rows = slice(start, start + ROW_BLOCK)
            bad += count_bad(read_block(stored, rows, out=values[rows]))
        self._check_finite(index, bad)
        return values

    def grid(self, i: int, step: tuple[int, int] | None, samples: int) -> Tensor:  # [n, D] float32
        """`quant.sample_grid(maps[i], step, samples=samples)`, reading no more of the file than that.

        Raises:
            ValueError: as when the whole map is read; only the values that are taken are looked at.
        """
        stored = self._checked(i)
        values = read_block(stored, *grid_slices(*self.shape[:2], step, samples=samples))
        self._check_finite(i, count_bad(values))
        return values.reshape(-1, self.shape[2])

    def digests(self) -> list[list[str]] | None:
        """[file name, SHA-256] of each view's map as far as it is known without reading the maps, else None.

        It is known where `features.json` tells of this very file, or of one that was discarded. LangSplat's maps are
        digested here, both files together; the level and the stride are part of the name. Where a map is LangSplat's or
        gone, nobody else can tell all of them, so the others that are not known are digested here as well.
        """
        gone = any(not file.is_file() for file in self.files)
        langsplat = [file.is_file() and layout_of(file, self._own) is LANGSPLAT for file in self.files]
        result = []
        for i, file in enumerate(self.files):
            record = self._record(i)
            if langsplat[i]:
                both = digest_file(file) + digest_file(partner_of(file, LANGSPLAT))
                result.append([f"{file.name} level {self.reading.level} stride {self.reading.stride or 'auto'}", both])
            elif record is not None:
                result.append([file.name, record.digest])
            elif gone or any(langsplat):
                result.append([file.name, digest_file(file)])
            else:
                return None
        return result

    def _record(self, i: int) -> MapRecord | None:
        """What the manifest says about this very file, or about one that was discarded."""
        record, file = self._records[i], self.files[i]
        if record is None or file != self.path / record.file:
            return None
        if not file.is_file():
            return record
        info = file.stat()
        return record if (info.st_size, info.st_mtime_ns) == (record.bytes, record.mtime_ns) else None

    def _open(self, i: int) -> StoredMap:
        file, record = self.files[i], self._record(i)
        if not file.is_file():
            raise FileNotFoundError(
                f"{file}: expected a feature map, but it was discarded once its index map had been made, or deleted "
                "since; make it again with `kfgs features`"
            )
        reading = replace(self.reading, size=self.sizes[i] if self.sizes else None)
        known = reading if record is None else replace(reading, channels=record.shape[2])
        return open_map(file, known, self._own)

    def _checked(self, i: int) -> StoredMap:
        """View i's map, if it has the size of the first."""
        stored = self._open(i)
        if tuple(stored.shape) != self.shape:
            raise ValueError(
                f"{self.files[i]}: expected a map of (h, w, D) = {self.shape} as in {self.files[0].name}, got "
                f"{tuple(stored.shape)}; encode all views with the same settings"
            )
        return stored

    def _check_finite(self, i: int, bad: int) -> None:
        if bad:
            raise ValueError(
                f"{self.files[i]}: expected finite features, got {bad} NaN or infinite values; encode it again"
            )


def save_feature_map(path: str | Path, stem: str, features: Tensor) -> Path:  # features: [h, w, D]
    """Write one view's map in the layout of Feature 3DGS, `<stem>_fmap_CxHxW.pt`, float16 [D, h, w], atomically.

    Raises:
        ValueError: if `features` is not [h, w, D], or not finite once it is float16 (largest value 65504).
    """
    check_shapes(("features", features, "h w D"))
    h, w, D = features.shape
    half = torch.empty(D, h, w, dtype=torch.float16)
    for i in range(h):  # row by row, which transposes in the cache: 0.3 s instead of 5 s at 360 x 480 x 512
        half[:, i] = features[i].detach().to(torch.float16).T.contiguous()
    if count_bad(half):
        raise ValueError(
            f"features: expected finite values below 65504 (they are stored as float16), got others in {stem!r}; "
            "normalise the rows"
        )
    target = Path(path) / f"{stem}{FEATURE_3DGS.suffix}"
    with atomic_path(target) as temporary:
        torch.save(half, temporary)
    return target


def _check_stems(folder: Path, stems: Sequence[str], listed: bool) -> list[str]:
    if isinstance(stems, str):
        raise TypeError(f"stems: expected a list of image stems, got the text {stems!r}; put it into a list")
    found = sorted(set(stems)) if listed else list(stems)
    if not found:
        raise ValueError(f"stems: expected at least one view, got none ({folder}); name the views to read")
    if len(set(found)) != len(found):
        twice = sorted({stem for stem in found if found.count(stem) > 1})
        raise ValueError(f"stems: expected each view once, got {', '.join(twice)} more than once; remove repeats")
    return found


def _find_files(folder: Path, stems: list[str], gone: dict[str, Path], own: Collection[Path]) -> list[Path]:
    """Each view's file; the one it was, where the map has been discarded."""
    rest = [stem for stem in stems if stem not in gone]
    present = dict(zip(rest, find_maps(folder, rest, own), strict=True))
    found = [[gone[stem]] if stem in gone else present[stem] for stem in stems]
    for stem, files in zip(stems, found, strict=True):
        if len(files) > 1:
            names = ", ".join(str(file.relative_to(folder)) for file in files[:3])
            raise ValueError(
                f"{folder}: expected one map for view {stem!r}, got {len(files)}: {names}; name the subfolder itself"
            )
    missing = [stem for stem, files in zip(stems, found, strict=True) if not files]
    if missing:
        raise FileNotFoundError(f"{folder}: {explain_missing(folder, stems, missing)}")
    return [files[0] for files in found]


def _check_recorded(folder: Path, files: list[Path], own: Collection[Path]) -> None:
    """Refuse maps that the folder's manifest does not tell of: its teacher need not have made them."""
    others = [file for file in files if file not in own]
    if others:
        raise ValueError(
            f"{others[0]}: expected a map that {MANIFEST} tells of, as kfgs filled this folder, got one without a record "
            f"({len(others)} of {len(files)} views); move it away if another program made it, then run `kfgs features` "
            "again, which makes these maps (it would write over one that is there)"
        )
