"""A folder of feature maps on disk, read one view at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import torch
from torch import Tensor

from .._check import check_whole
from .._files import digest_file
from .._typed import typed
from ..quant.sampling import grid_slices
from ..scenes import Scene
from .check import FeatureReport, check_maps
from .finder import MapFinder
from .langsplat import parse_level, rows_file
from .layouts import AGAIN, LANGSPLAT, Reading, StoredMap, count_bad, layout_of, read_rows
from .pictures import Picture, Split, as_pictures, check_stems, pictures_of


class FeatureFolder(Sequence[Tensor]):
    """The teacher's feature maps of some views: item i is view i's map, [h, w, D] float32, read from disk at each access.

    `FeatureFolder(path).of(scene, "train")` has the maps of a scene's split, for `fit_scene`.

    These layouts are known, and may be mixed: `<stem>_fmap_CxHxW.pt` (Feature 3DGS: a tensor [D, h, w]), `<stem>_s.npy`
    with `<stem>_f.npy` (LangSplat: mask numbers [4, H, W], and a feature per mask), and `<stem>.npy` or
    `<stem>.safetensors` (an array [h, w, D]; [D, h, w] is recognised by `channels` or the picture's aspect). Values have
    half, single or double precision. The picture's ending may follow the stem. The map of a picture in a subfolder is in a
    subfolder of the same name; if no view has a map there, all subfolders are searched for the last part of its name. If
    kfgs filled the folder (it holds `features.json`), maps of other programs or of a killed process are refused.

    No map is kept in memory. Maps may differ in size (pictures of several sizes), not in channels; an all-zero feature means
    "unknown". Maps that kfgs wrote and later discarded (`features.json` says so) may be missing until one is read.

    Args:
        path: the folder.
        stems: image names without their ending, in order. If None, all maps of the folder, sorted, and all in
            `features.json`, including those in subfolders and discarded ones.
        channels: the expected D, for instance that of the text embeddings; taken from the first map if None.
        sizes: (H, W) of each view's picture, which distinguishes [h, w, D] from [D, h, w].
        level: of LangSplat's masks: 0 to 3, or `default`, `s`, `m`, `l`.
        stride: pixels per cell of LangSplat's masks, which are as large as the pictures; None: the smallest stride with at
            most 360 x 480 cells.

    Raises:
        NotADirectoryError: if `path` is no folder.
        FileNotFoundError: if views have no map; the message names them. When a map is read: if it was discarded.
        ValueError: if `stems` is empty or repeats one, several files may be meant, or `features.json` is damaged or has no
            record of a view's file. Without `stems` this is checked at first use. When a map is read: if it cannot be read,
            is not finite, or has other channels than the first; the message names the file.
        TypeError: when a map is read: if the file holds anything but one tensor.

    Example:
        >>> import tempfile
        >>> from kfgs.features import save_feature_map
        >>> folder = tempfile.mkdtemp()
        >>> _ = save_feature_map(folder, "view_0", torch.ones(3, 4, 8))
        >>> maps = FeatureFolder(folder)
        >>> len(maps), maps.shape, maps[0].dtype
        (1, (3, 4, 8), torch.float32)
    """

    def __init__(
        self,
        path: str | Path,
        stems: Sequence[str] | None = None,
        *,
        channels: int | None = None,
        sizes: Sequence[tuple[int, int] | None] | None = None,
        level: int | str = 0,
        stride: int | None = None,
    ) -> None:
        if stride is not None:
            check_whole("stride", stride, 1)
        self._finder = MapFinder(path)
        self.path, manifest = self._finder.path, self._finder.manifest
        self.identity: dict[str, Any] | None = manifest.teacher if manifest else None
        """Identity of the teacher (`identify`) if kfgs made the maps, else None."""
        self.channels, self.sizes = channels, None if sizes is None else list(sizes)
        self.reading = Reading(channels=channels, level=parse_level(level), stride=stride)
        self._chosen = stems if stems is None or isinstance(stems, str) else list(stems)
        if self.sizes is not None and len(self.sizes) != len(self.stems):
            raise ValueError(
                f"sizes: expected {len(self.stems)} (one per view), got {len(self.sizes)}; give one for each"
            )
        if stems is not None:
            _ = self.files  # views without a map are an error here, not hours later

    @typed
    def of(self, scene: Scene, split: Split = "train") -> FeatureFolder:
        """The maps of some views of a scene.

        Args:
            scene: the views.
            split: the name of a split, `all`, or a list of view names or indices.

        Raises:
            FileNotFoundError, ValueError: if the scene has no such views, or as for a `FeatureFolder` of these `stems`.
        """
        pictures = pictures_of(scene, split)
        return self._with([picture.stem for picture in pictures], [picture.size for picture in pictures])

    def check(
        self, pictures: Scene | Sequence[Picture] | None = None, split: Split = "train", *, values: bool = True
    ) -> FeatureReport:
        """Check the map of every view, and report everything that does not fit.

        Problems: no map, or several; a file that cannot be read or holds no map of floats; unexpected channels; a map that
        looks transposed, or has another aspect than its picture by more than one cell; NaN or infinite values; a map of
        zeros only; a map without a record in a folder that kfgs filled. Notes: maps of several sizes; maps of one size with
        another aspect than the pictures (from encoders with a fixed grid); double precision; many all-zero features; maps of
        no view; discarded maps; maps that changed since kfgs wrote them.

        Memory holds a few rows of one map at a time.

        Args:
            pictures: a scene, or a list of pictures, see `pictures_of`; the views of this FeatureFolder if None.
            split: of the scene, see `of`.
            values: False checks only shape and type, in milliseconds. Then a copied map looks like a changed one.

        Raises:
            ValueError: if there are no pictures.
        """
        if pictures is not None:
            chosen = as_pictures(pictures, split)
            stems, sizes = [picture.stem for picture in chosen], [picture.size for picture in chosen]
        else:
            stems, sizes = self.stems, self.sizes or [None] * len(self)
        return check_maps(self._finder, dict(zip(stems, sizes, strict=True)), self.reading, values=values)

    def __len__(self) -> int:
        return len(self.stems)

    def __repr__(self) -> str:
        views = "" if self._chosen is None else f", {len(self)} views"
        return f"FeatureFolder({str(self.path)!r}{views})"

    @cached_property
    def stems(self) -> list[str]:
        """The names of the views."""
        all_maps = sorted({*self._finder.listed(), *self._finder.records}) if self._chosen is None else []
        check_stems(f"stems (in {self.path})", self._chosen or all_maps)
        return list(self._chosen or all_maps)

    @cached_property
    def files(self) -> list[Path]:
        """The file of each view's map; for a discarded map, its former file."""
        found = self._finder.find(self.stems)
        missing = [stem for stem, files in found.items() if not files]
        if missing:
            raise FileNotFoundError(f"{self.path}: {self._finder.explain_missing(self.stems, missing)}")
        faults = self._finder.faults(found)
        for name, text in faults.items():
            raise ValueError(f"{self.path / name}: {text} ({len(faults)} of {len(found)} views)")
        return [files[0] for files in found.values()]

    @cached_property
    def shape(self) -> tuple[int, int, int]:
        """(h, w, D) of the first map; opens its file, without reading its values."""
        record = self._finder.record(self.stems[0], self.files[0])
        h, w, D = map(int, record.shape if record else self._open(0).shape)
        if self.channels is not None and self.channels != D:
            raise ValueError(
                f"{self.files[0]}: expected {self.channels} channels, got {D} in a map of {h} x {w}; "
                "use maps and embeddings of the same encoder"
            )
        return h, w, D

    @property
    def has_masks(self) -> bool:
        """Whether a map has LangSplat's layout, where `level` and `stride` matter."""
        return any(map(self._is_masks, self.files))

    @overload
    def __getitem__(self, index: int) -> Tensor: ...

    @overload
    def __getitem__(self, index: slice) -> FeatureFolder: ...

    def __getitem__(self, index: int | slice) -> Tensor | FeatureFolder:
        if isinstance(index, slice):
            sizes = None if self.sizes is None else self.sizes[index]
            return self._with(self.stems[index], sizes)
        return self._read(index, self._checked(index))

    def grid(self, i: int, step: tuple[int, int] | None, samples: int) -> Tensor:  # [n, D] float32
        """`quant.sample_grid(maps[i], step, samples=samples)`, reading no more of the file than these pixels.

        Raises:
            ValueError: as when the whole map is read, but only the values that are read are checked.
        """
        stored = self._checked(i)
        rows, columns = grid_slices(int(stored.shape[0]), int(stored.shape[1]), step, samples=samples)
        return self._read(i, stored, rows, columns).flatten(0, 1)

    def blocks(self, i: int) -> Iterator[Tensor]:  # each [at most 32, w, D] float32
        """Read a map a few rows at a time, which takes less memory than `maps[i]`.

        Raises:
            ValueError: as when the whole map is read; values that are not finite are counted in the first block that has any.
        """
        stored = self._checked(i)
        for block in read_rows(stored):
            self._refuse_bad(i, count_bad(block))
            yield block

    def check_files(self) -> None:
        """`check` every map without reading its values, before a long run. Discarded maps are left out.

        Raises:
            ValueError: if one does not fit; the first is named, and the others counted.
        """
        bad = self.check(values=False).problems
        for name, texts in bad.items():
            advice = "" if "; " in texts[0] else f"; {AGAIN}"
            more = f" ({len(bad) - 1} more do not fit; `kfgs features SCENE --check {self.path}` names them)"
            raise ValueError(f"{self.path / name}: {texts[0]}{advice}{more if len(bad) > 1 else ''}")

    def digests(self) -> list[list[str]] | None:
        """[file name, SHA-256] of each view's map, or None if the caller should compute them from the files.

        A digest is known if `features.json` has a record of the same file, or of a discarded one. If a map is LangSplat's
        or discarded, the caller could not compute all digests, so missing ones are computed here. For LangSplat's maps both
        files are digested, and level and stride are part of the name.
        """
        records = [self._finder.record(stem, file) for stem, file in zip(self.stems, self.files, strict=True)]
        if None in records and not self.has_masks and all(file.is_file() for file in self.files):
            return None
        result = []
        for file, record in zip(self.files, records, strict=True):
            if self._is_masks(file):
                both = digest_file(file) + digest_file(rows_file(file))
                result.append([f"{file.name} level {self.reading.level} stride {self.reading.stride or 'auto'}", both])
            else:
                result.append([file.name, digest_file(file) if record is None else record.digest])
        return result

    def _with(self, stems: Sequence[str], sizes: Sequence[tuple[int, int] | None] | None) -> FeatureFolder:
        """Other views, read in the same way."""
        level, stride = self.reading.level, self.reading.stride
        return FeatureFolder(self.path, stems, channels=self.channels, sizes=sizes, level=level, stride=stride)

    def _is_masks(self, file: Path) -> bool:
        return file.is_file() and layout_of(file, self._finder.own) is LANGSPLAT

    def _open(self, i: int) -> StoredMap:
        stem, file, size = self.stems[i], self.files[i], self.sizes[i] if self.sizes else None
        if not file.is_file():
            raise FileNotFoundError(
                f"{file}: expected a feature map, but it was discarded once its index map had been made, or deleted "
                "since; make it again with `kfgs features`"
            )
        return self._finder.open(stem, file, replace(self.reading, size=size))

    def _checked(self, i: int) -> StoredMap:  # [h, w, D]
        """View i's map on disk, if it has the channels of the first."""
        stored = self._open(i)
        if stored.shape[2] != self.shape[2]:
            raise ValueError(
                f"{self.files[i]}: expected {self.shape[2]} channels as in {self.files[0].name}, got {stored.shape[2]}; {AGAIN}"
            )
        return stored

    def _refuse_bad(self, i: int, bad: int) -> None:
        if bad:
            raise ValueError(f"{self.files[i]}: expected finite features, got {bad} NaN or infinite values; {AGAIN}")

    def _read(
        self, i: int, stored: StoredMap, rows: slice = slice(None), columns: slice = slice(None)
    ) -> Tensor:  # [rows, columns, D]
        """Some rows and columns of view i's map, if they are finite."""
        h, w, D = map(int, stored.shape)
        values = torch.empty(len(range(h)[rows]), len(range(w)[columns]), D, dtype=torch.float32)
        self._refuse_bad(i, sum(count_bad(block) for block in read_rows(stored, rows, columns, out=values)))
        return values
