"""A folder of feature maps, one per picture, read one view at a time."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path, PurePosixPath
from statistics import multimode
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._arrays import read_array, read_safetensors, reading
from .._files import Names, as_path, file_stem
from .._rows import EPS, row_norms
from ..cameras.resample import fits_aspect
from ..quant.maps import grid_slices
from .extract import ENDINGS, FEATURE_3DGS, OWN, SAFETENSORS, Split, count_bad, read_manifest
from .files import IMAGE_SUFFIXES, list_images, some
from .scene import Scene, check_is_scene

AGAIN = "encode it again, or leave the photo out (split.json)"
ROW_BLOCK = 32  # rows of a map converted at a time: 30 MB in single precision at 480 x 512 channels


class FeatureFolder(Sequence[Tensor]):
    """The teacher's feature maps of some views: item i is view i's map, [h, w, D] float32, read from disk at each access.

    `FeatureFolder(path).of(scene, "train")` has the maps of a scene's split, for `fit`. An all-zero feature means "unknown".

    Known files, which may be mixed: `<stem>_fmap_CxHxW.pt` (Feature 3DGS and DF-3DGS: a tensor [D, h, w]), `<stem>.npy` and
    `<stem>.safetensors` (an array [h, w, D]; [D, h, w] is recognised by `channels` or the picture's aspect), in half, single
    or double precision. The picture's ending may follow the stem, as in `a.png.npy`. Maps may differ in size.

    Args:
        path: the folder.
        stems: image names without their ending, in order; None: all maps of the folder and its subfolders, sorted.
        channels: the expected D, for instance that of the text embeddings; None: that of the first map.
        sizes: (H, W) of each view's picture, which distinguishes [h, w, D] from [D, h, w].

    Raises:
        NotADirectoryError: if `path` is not a folder.
        FileNotFoundError: if views have no map; the message names them.
        ValueError, TypeError: if `stems` is empty or repeats one. When a map is read: if it cannot be read, is not one dense
            tensor of finite floats, or has other channels than the first; the message names the file.

    Example:
        >>> import tempfile
        >>> from kfgs.scenes import save_feature_map
        >>> folder = tempfile.mkdtemp()
        >>> _ = save_feature_map(folder, "view_0", torch.ones(3, 4, 8))
        >>> FeatureFolder(folder).shape
        (3, 4, 8)
    """

    def __init__(
        self,
        path: str | Path,
        stems: Sequence[str] | None = None,
        *,
        channels: int | None = None,
        sizes: Sequence[tuple[int, int] | None] | None = None,
    ) -> None:
        self.path = as_path(path)
        if not self.path.is_dir():
            got = "a file" if self.path.exists() else "nothing there"
            advice = "check its name, or make maps with `kfgs features`"
            raise NotADirectoryError(f"{self.path}: expected a folder of feature maps, got {got}; {advice}")
        manifest = read_manifest(self.path)
        self.identity: dict[str, Any] | None = manifest.teacher if manifest else None
        """What is known about the teacher if kfgs made the maps, else None."""
        if isinstance(stems, str):
            raise TypeError(f"stems: expected a list of image stems, got the text {stems!r}; put it into a list")
        self.stems = sorted(self._listed) if stems is None else list(stems)
        """The names of the views."""
        if not self.stems or len(set(self.stems)) < len(self.stems):
            got = some(self.stems) or "none"
            raise ValueError(f"stems (in {self.path}): expected at least one view, each once, got {got}; correct them")
        self.channels = channels
        self.sizes = [None] * len(self.stems) if sizes is None else list(sizes)
        if len(self.sizes) != len(self):
            raise ValueError(f"sizes: expected {len(self)} (one per view), got {len(self.sizes)}; give one for each")
        if stems is not None:
            _ = self.files  # views without a map are an error here, not hours later

    def of(self, scene: Scene, split: Split = "train") -> FeatureFolder:
        """The maps of some views of a scene: of a split, of `all`, or of a list of view names or indices."""
        check_is_scene(scene)
        sizes = {file_stem(camera.name): camera.size for camera in scene.select(split)}
        return FeatureFolder(self.path, list(sizes), channels=self.channels, sizes=list(sizes.values()))

    def __len__(self) -> int:
        return len(self.stems)

    def __repr__(self) -> str:
        return f"FeatureFolder({str(self.path)!r}, {len(self)} views)"

    @cached_property
    def _listed(self) -> dict[str, Path]:
        """All maps of the folder by stem; of several files with one stem, the first in the order of `ENDINGS`."""
        maps: list[tuple[int, str, Path]] = []
        for name in list_images(self.path, tuple(ending.lower() for ending in ENDINGS)):
            for ending in filter(name.endswith, ENDINGS):
                stem = name.removesuffix(ending)
                after = PurePosixPath(stem).suffix  # rgb_1.png.npy is the map of rgb_1, too
                stem = stem.removesuffix(after) if after.lower() in IMAGE_SUFFIXES else stem
                maps.append((ENDINGS.index(ending), stem, self.path / name))
        return {stem: file for _, stem, file in sorted(maps, key=lambda entry: -entry[0])}

    def _find(self, stems: Sequence[str]) -> dict[str, Path]:
        """The map of each view that has one."""
        names = Names(self._listed, bare=True).find_each(stems)
        return {stem: self._listed[name] for stem, name in zip(stems, names, strict=True) if name is not None}

    @cached_property
    def files(self) -> list[Path]:
        """The file of each view's map."""
        files = self._find(self.stems)
        missing = [stem for stem in self.stems if stem not in files]
        if not missing:
            return [files[stem] for stem in self.stems]
        others = sorted(set(self._listed) - set(self.stems))
        split = "" if self.identity is None else f" --split all --out {self.path}"
        advice = f"make them with `kfgs features SCENE{split}`, or leave these views out"
        if not files and others and self.identity is None:
            advice = f"rename the maps there ({len(others)}: {some(others, 3)}) to the names of the pictures"
        text = f"expected a feature map for each of {len(self)} views, {len(missing)} missing: {some(missing)}"
        raise FileNotFoundError(f"{self.path}: {text}; {advice}")

    @cached_property
    def shape(self) -> tuple[int, int, int]:
        """(h, w, D) of the first map; opens its file, without reading its values."""
        h, w, D = map(int, self._open(self.files[0], self.sizes[0]).shape)
        if self.channels is not None and self.channels != D:
            got = f"{D} in a map of {h} x {w}; use maps and embeddings of the same encoder"
            raise ValueError(f"{self.files[0]}: expected {self.channels} channels, got {got}")
        return h, w, D

    def __getitem__(self, index: int | slice) -> Any:  # [h, w, D]; of a slice, a FeatureFolder
        if isinstance(index, slice):
            return FeatureFolder(self.path, self.stems[index], channels=self.channels, sizes=self.sizes[index])
        return torch.cat(list(self.blocks(index)))

    def grid(self, i: int, samples: int) -> Tensor:  # [n, D] float32
        """`quant.sample_grid(maps[i], samples=samples)`, reading no more of the file than these pixels."""
        stored = self._open(self.files[i], self.sizes[i])
        rows, columns = grid_slices(int(stored.shape[0]), int(stored.shape[1]), samples)
        return torch.cat(list(self.blocks(i, rows, columns))).flatten(0, 1)

    def blocks(
        self, i: int, rows: slice = slice(None), columns: slice = slice(None)
    ) -> Iterator[Tensor]:  # each [at most 32, w, D] float32
        """A map, or some of its rows and columns, a few rows at a time, which takes less memory than `maps[i]`."""
        stored = self._open(self.files[i], self.sizes[i])
        if stored.shape[2] != self.shape[2]:
            expected = f"{self.shape[2]} channels as in {self.files[0].name}"
            raise ValueError(f"{self.files[i]}: expected {expected}, got {stored.shape[2]}; {AGAIN}")
        for block in read_rows(stored, rows, columns):
            if bad := count_bad(block):
                raise ValueError(f"{self.files[i]}: expected finite features, got {bad} NaN or infinite; {AGAIN}")
            yield block

    def _open(self, file: Path, size: tuple[int, int] | None) -> Tensor | NDArray[Any]:  # [h, w, D]
        """Map a file into memory without reading its values.

        Feature 3DGS writes [D, h, w], kfgs [h, w, D]. In other files a known number of channels decides, then the aspect of
        the picture (`size`); if both fit, [h, w, D]. If nothing is known, a first axis of twice the others' size is D (not in
        .npy).
        """
        if file.name.endswith(OWN):
            values: Any = read_array(file, "a feature map", AGAIN)
        else:
            with reading(file, "a feature map", AGAIN):
                if file.name.endswith(SAFETENSORS):
                    (values,) = read_safetensors(file)[0].values()
                else:
                    values = torch.load(file, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(file))
                if isinstance(values, Tensor) and values.layout == torch.strided:
                    if values.untyped_storage().nbytes() < values.numel() * values.element_size():
                        raise ValueError("its values repeat")  # a few bytes on disk that would fill the memory
                    values = values.detach()  # saved by a training run, it may ask for gradients
        if not isinstance(values, np.ndarray) and not (isinstance(values, Tensor) and values.layout == torch.strided):
            kind = type(values).__name__
            raise TypeError(f"{file}: expected one dense tensor of features, got a {kind}; save the tensor alone")
        if not (values.is_floating_point() if isinstance(values, Tensor) else values.dtype.kind == "f"):
            raise ValueError(f"{file}: expected floating-point features, got {values.dtype}; {AGAIN}")
        if values.ndim != 3 or 0 in values.shape:
            raise ValueError(f"{file}: expected a map [h, w, D], got {tuple(values.shape)}; save one view per file")
        first, middle, last = map(int, values.shape)
        if file.name.endswith(FEATURE_3DGS):
            turned = True
        elif self.identity is not None and file.name.endswith(OWN):
            turned = False
        elif self.channels in (first, last) and first != last:
            turned = first == self.channels
        elif size is None:
            turned = self.channels is None and not file.name.endswith(OWN) and first >= 2 * max(middle, last)
        else:
            turned = not fits_aspect((first, middle), size) and fits_aspect((middle, last), size)
        if not turned:
            return values
        return values.permute(1, 2, 0) if isinstance(values, Tensor) else values.transpose(1, 2, 0)

    def check(self, scene: Scene | None = None, split: Split = "train", *, values: bool = True) -> dict[str, str]:
        """Check the map of every view; says why a map cannot be used, by its file (if there is none, by the view).

        There is none; it cannot be read or is not a map of floats; it has other channels than most; it looks transposed; it has
        NaN or infinite values, or only zeros. `scene` and `split` say whose views (None: those of this folder); `values=False`
        checks only shape and type, in milliseconds.
        """
        sizes = dict(zip(self.stems, self.sizes, strict=True))
        if scene is not None:
            sizes = {file_stem(camera.name): camera.size for camera in scene.select(split)}
        files, shapes, turned = self._find(list(sizes)), dict[str, tuple[int, ...]](), dict[str, str]()
        problems = {stem: "expected its map, got none" for stem in sizes if stem not in files}
        for stem, file in files.items():
            name, size = file.relative_to(self.path).as_posix(), sizes[stem]
            try:
                stored = self._open(file, size)
            except (ValueError, TypeError) as error:
                problems[name] = str(error).removeprefix(f"{file}: ")
                continue
            h, w, _ = shapes[name] = tuple(map(int, stored.shape))
            if size is not None and not fits_aspect((h, w), size) and fits_aspect((w, h), size):
                turned[name] = f"expected the aspect of a picture of {size}, got {h} x {w} cells (transposed?)"
            if values:
                counts = [(count_bad(rows), int((row_norms(rows) > EPS).sum())) for rows in read_rows(stored)]
                bad, known = map(sum, zip(*counts, strict=True))
                if bad or not known:
                    problems[name] = f"{bad} NaN or infinite values" if bad else "every feature is all-zero"
        channels = self.channels or next(iter(multimode(shape[2] for shape in shapes.values())), 0)
        wrong = {name: shape[2] for name, shape in shapes.items() if shape[2] != channels}
        problems |= {name: f"expected {channels} channels, got {D}" for name, D in wrong.items()}
        if len({shape[:2] for shape in shapes.values()}) > 1 or (self.identity is None and len(turned) == len(shapes)):
            problems |= turned  # else the encoder has one grid for all pictures
        return problems

    def check_files(self) -> None:
        """Raise a ValueError if a map does not fit, from shapes and types alone: for use before a long run."""
        problems = self.check(values=False)
        for name, text in problems.items():
            more = f" ({len(problems) - 1} more do not fit; `kfgs features SCENE --out {self.path}` names them)"
            raise ValueError(f"{self.path / name}: {text}; {AGAIN}{more if len(problems) > 1 else ''}")


def read_rows(
    stored: Tensor | NDArray[Any],  # [h, w, D]
    rows: slice = slice(None),
    columns: slice = slice(None),
) -> Iterator[Tensor]:  # each [at most ROW_BLOCK, columns, D] float32
    """Copy some rows and columns of a map in single precision, a few rows at a time; only these are read from disk."""
    chosen = range(int(stored.shape[0]))[rows]
    for start in range(0, len(chosen), ROW_BLOCK):
        part = chosen[start : start + ROW_BLOCK]
        block = stored[part.start : part.stop : part.step, columns]
        if isinstance(block, Tensor):
            yield block.float() if block.dtype != torch.float32 else block.clone()
        else:
            with np.errstate(over="ignore"):  # a value beyond single precision becomes infinite
                yield torch.from_numpy(np.array(block, np.float32, order="C"))
