"""A folder of feature maps on disk, read one view at a time."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._check import check_shapes
from .._files import atomic_path

_SUFFIXES = ("_fmap_CxHxW.pt", ".npy")  # tried in this order


class FeatureFolder(Sequence[Tensor]):
    """The teacher's feature maps of some views: item i is view i's map, [h, w, D] float32, read when asked for.

    Two layouts are known, and may be mixed: `<stem>_fmap_CxHxW.pt` (Feature-3DGS: a tensor [D, h, w], half or single
    precision) and `<stem>.npy` (an array [h, w, D]). No map is kept in memory, so the maps of a scene need not fit.
    Every map must have the same size; all-zero features are allowed, and mean "nothing known here".

    Args:
        path: the folder.
        stems: image names without their ending, in the order wanted; all maps of the folder, sorted, if None.
        channels: D that is expected, for instance that of the text embeddings; taken from the first map if None.

    Raises:
        NotADirectoryError: if `path` is no folder.
        FileNotFoundError: if views have no map; the message names them.
        ValueError: if `stems` is empty or repeats one. When a map is read: if it is not a finite map of floats of the
            size of the first, or cannot be read at all; the message names the file.
        TypeError: when a map is read: if the file holds something else than one tensor.

    Example:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> _ = save_feature_map(folder, "view_0", torch.ones(3, 4, 8))
        >>> maps = FeatureFolder(folder, ["view_0"])
        >>> len(maps), maps.shape, maps[0].dtype
        (1, (3, 4, 8), torch.float32)
    """

    def __init__(self, path: str | Path, stems: Sequence[str] | None = None, *, channels: int | None = None) -> None:
        self.path = Path(path)
        if not self.path.is_dir():
            raise NotADirectoryError(f"path: expected a folder of feature maps, got {self.path}; check its name")
        if isinstance(stems, str):
            raise TypeError(f"stems: expected a list of image stems, got the text {stems!r}; put it into a list")
        self.stems = _all_stems(self.path) if stems is None else list(stems)
        if not self.stems:
            raise ValueError(f"stems: expected at least one view, got none ({self.path}); name the views to read")
        if len(set(self.stems)) != len(self.stems):
            twice = sorted({stem for stem in self.stems if self.stems.count(stem) > 1})
            raise ValueError(f"stems: expected each view once, got {', '.join(twice)} more than once; remove repeats")
        self.files = [_find(self.path, stem) for stem in self.stems]
        missing = [stem + _SUFFIXES[0] for stem, file in zip(self.stems, self.files, strict=True) if not file.is_file()]
        if missing:
            named = ", ".join(missing[:5]) + (", ..." if len(missing) > 5 else "")
            raise FileNotFoundError(
                f"{self.path}: expected a feature map for each of {len(self.stems)} views, {len(missing)} missing: "
                f"{named} (or .npy); encode these views or leave them out of `stems`"
            )
        self.channels = channels
        self._shape: tuple[int, int, int] | None = None

    def __len__(self) -> int:
        return len(self.files)

    def __repr__(self) -> str:
        return f"FeatureFolder({str(self.path)!r}, {len(self)} views)"

    @property
    def shape(self) -> tuple[int, int, int]:
        """(h, w, D) of every map; opens the first file, without reading its values."""
        if self._shape is None:
            h, w, D = _open(self.files[0]).shape
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
            return FeatureFolder(self.path, self.stems[index], channels=self.channels)
        file = self.files[index]
        found = _open(file)
        if tuple(found.shape) != self.shape:
            raise ValueError(
                f"{file}: expected a map of (h, w, D) = {self.shape} as in {self.files[0].name}, got "
                f"{tuple(found.shape)}; encode all views with the same settings"
            )
        values = torch.empty(self.shape)
        values.copy_(found if isinstance(found, Tensor) else torch.from_numpy(np.array(found, np.float32)))
        bad = int((~torch.isfinite(values)).sum())
        if bad:
            raise ValueError(f"{file}: expected finite features, got {bad} NaN or infinite values; encode it again")
        return values


def save_feature_map(path: str | Path, stem: str, features: Tensor) -> Path:  # features: [h, w, D]
    """Write one view's map in the layout of Feature-3DGS, `<stem>_fmap_CxHxW.pt`, float16 [D, h, w], atomically.

    Raises:
        ValueError: if `features` is not [h, w, D], or not finite once it is float16 (largest value 65504).
    """
    check_shapes(("features", features, "h w D"))
    half = features.detach().cpu().permute(2, 0, 1).to(torch.float16).contiguous()
    if not torch.isfinite(half).all():
        raise ValueError(
            f"features: expected finite values below 65504 (they are stored as float16), got others in {stem!r}; "
            "normalise the rows"
        )
    target = Path(path) / f"{stem}{_SUFFIXES[0]}"
    with atomic_path(target) as temporary:
        torch.save(half, temporary)
    return target


def _all_stems(folder: Path) -> list[str]:
    names = sorted(file.name for file in folder.iterdir() if not file.name.startswith("."))
    return sorted({name.removesuffix(suffix) for name in names for suffix in _SUFFIXES if name.endswith(suffix)})


def _find(folder: Path, stem: str) -> Path:
    """The file of a view; if there is none, the name it should have."""
    candidates = [folder / f"{stem}{suffix}" for suffix in _SUFFIXES]
    return next((file for file in candidates if file.is_file()), candidates[0])


def _open(file: Path) -> Tensor | NDArray[np.floating]:  # [h, w, D]
    """A file's map, mapped into memory rather than read; its kind and number of axes are checked."""
    found: Any
    try:
        if file.suffix == ".npy":
            found = np.load(file, mmap_mode="r", allow_pickle=False)
        else:
            mapped = zipfile.is_zipfile(file)  # files of torch < 1.6 are not zip archives and cannot be mapped
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # about the pickle's protocol; what matters is raised
                found = torch.load(file, map_location="cpu", mmap=mapped, weights_only=True)
    except Exception as error:  # a damaged pickle raises almost anything: struct.error, KeyError, EOFError, ...
        raise ValueError(
            f"{file}: expected a feature map, but it cannot be read ({type(error).__name__}: {str(error)[:120]}); "
            "encode it again"
        ) from error
    axes = "[h, w, D]" if file.suffix == ".npy" else "[D, h, w]"
    if not isinstance(found, np.ndarray) and not (isinstance(found, Tensor) and found.layout == torch.strided):
        raise TypeError(
            f"{file}: expected one dense tensor {axes}, got a {type(found).__name__}; save the tensor alone"
        )
    floating = found.is_floating_point() if isinstance(found, Tensor) else found.dtype.kind == "f"
    if not floating:
        raise ValueError(f"{file}: expected floating-point features, got {found.dtype}; encode it again")
    if found.ndim != 3 or 0 in found.shape:
        raise ValueError(f"{file}: expected a map {axes}, got {tuple(found.shape)}; save one view per file")
    return found.permute(1, 2, 0) if isinstance(found, Tensor) else found
