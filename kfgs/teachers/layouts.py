"""How a map of features lies on disk: the table of layouts, opened without reading the values, and our own written."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from torch import Tensor

from .._check import check_shapes
from .._files import atomic_path

Axes = Literal["h w D", "D h w"]
Array = Tensor | NDArray[Any]

WIDTHS = frozenset((128, 256, 384, 512, 768, 1024, 1152, 1280, 1536))
"""Channels of encoders: a first axis of such a size, and a last one that is none, hints at [D, h, w]."""
ROW_BLOCK = 32  # rows of a map converted at a time: 30 MB in single precision at 480 x 512 channels


@dataclass(frozen=True)
class Layout:
    """One way to keep a view's map in one file."""

    suffix: str
    """What follows the picture's stem in the file's name."""
    axes: Axes
    """The order of the axes."""
    certain: bool
    """Whether every writer of such files keeps that order."""
    open: Callable[[Path], Any]
    """Maps the file's array into memory."""


@dataclass(frozen=True)
class Known:
    """What is known about a map before its file is opened, to tell [h, w, D] from [D, h, w]."""

    channels: int | None = None
    """D."""
    size: tuple[int, int] | None = None
    """(H, W) of the view's picture: the map has its aspect."""


def _open_torch(file: Path) -> Any:
    mapped = zipfile.is_zipfile(file)  # files of torch < 1.6 are not zip archives and cannot be mapped
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about the pickle's protocol; what matters is raised
        return torch.load(file, map_location="cpu", mmap=mapped, weights_only=True)


def _open_numpy(file: Path) -> Any:
    return np.load(file, mmap_mode="r", allow_pickle=False)


def _open_safetensors(file: Path) -> Any:
    with safe_open(file, framework="pt") as tensors:
        names = list(tensors.keys())
        if len(names) != 1:
            raise ValueError(f"expected one tensor, got {len(names)}: {', '.join(names[:5])}")
        return tensors.get_tensor(names[0])  # mapped, not read


LAYOUTS = (  # the first whose file exists is read
    Layout("_fmap_CxHxW.pt", "D h w", True, _open_torch),  # Feature 3DGS: LSeg's half, SAM's single precision
    Layout(".npy", "h w D", False, _open_numpy),  # kfgs
    Layout(".safetensors", "h w D", False, _open_safetensors),
)


def layout_of(file: Path) -> Layout:
    """The layout whose suffix the file's name ends in.

    Raises:
        ValueError: if there is none.
    """
    for layout in LAYOUTS:
        if file.name.endswith(layout.suffix):
            return layout
    endings = ", ".join(layout.suffix for layout in LAYOUTS)
    raise ValueError(f"{file}: expected a name that ends in one of {endings}, got {file.name!r}; rename the map")


def open_map(file: Path, known: Known = Known()) -> Array:  # [h, w, D]
    """A file's map, mapped into memory rather than read; its kind, its number of axes and their order are checked.

    Raises:
        ValueError: if the file cannot be read, or is no map of floats, or the order of its axes is in doubt.
        TypeError: if it holds something else than one tensor.
    """
    layout = layout_of(file)
    try:
        found = layout.open(file)
    except Exception as error:  # a damaged pickle raises almost anything: struct.error, KeyError, EOFError, ...
        raise ValueError(
            f"{file}: expected a feature map, but it cannot be read ({type(error).__name__}: {str(error)[:120]}); "
            "encode it again"
        ) from error
    axes = "[" + layout.axes.replace(" ", ", ") + "]"
    if not isinstance(found, np.ndarray) and not (isinstance(found, Tensor) and found.layout == torch.strided):
        raise TypeError(
            f"{file}: expected one dense tensor {axes}, got a {type(found).__name__}; save the tensor alone"
        )
    if not (found.is_floating_point() if isinstance(found, Tensor) else found.dtype.kind == "f"):
        raise ValueError(f"{file}: expected floating-point features, got {found.dtype}; encode it again")
    if found.ndim != 3 or 0 in found.shape:
        raise ValueError(f"{file}: expected a map {axes}, got {tuple(found.shape)}; save one view per file")
    order = layout.axes if layout.certain else find_axes(str(file), (*map(int, found.shape),), known)
    if order == "h w D":
        return found  # type: ignore[no-any-return]
    return found.permute(1, 2, 0) if isinstance(found, Tensor) else found.transpose(1, 2, 0)


def find_axes(name: str, shape: tuple[int, ...], known: Known = Known()) -> Axes:
    """The order of the axes of a map that may be [h, w, D], as kfgs writes it, or [D, h, w], as encoders give it.

    Known channels decide, then the picture's aspect; where both orders fit, or nothing is known, it is [h, w, D].

    Raises:
        ValueError: if nothing is known, and the sizes look like [D, h, w].

    Example:
        >>> find_axes("a.npy", (512, 90, 120), Known(channels=512)), find_axes("a.npy", (90, 120, 512))
        ('D h w', 'h w D')
    """
    first, middle, last = shape
    if known.channels is not None and known.channels in (first, last) and first != last:
        return "h w D" if last == known.channels else "D h w"
    if known.size is not None:
        hwd, dhw = fits_aspect((first, middle), known.size), fits_aspect((middle, last), known.size)
        if hwd or dhw:
            return "h w D" if hwd else "D h w"
    stretched, plain = max(first / middle, middle / first) > 3, max(middle / last, last / middle) <= 3
    if known.channels is None and first in WIDTHS and last not in WIDTHS and (last > 64 or (stretched and plain)):
        raise ValueError(
            f"{name}: expected a map [h, w, D], got {shape}, which may also be [D, h, w], and nothing tells which; "
            "say the number of channels, or save it as [h, w, D]"
        )
    return "h w D"


def fits_aspect(cells: tuple[int, int], size: tuple[int, int]) -> bool:
    """Whether a grid of (h, w) cells has the aspect of a picture of (H, W) pixels, up to one cell of rounding.

    Example:
        >>> fits_aspect((90, 120), (360, 480)), fits_aspect((48, 64), (479, 640)), fits_aspect((120, 90), (360, 480))
        (True, True, False)
    """
    (h, w), (H, W) = cells, size
    return abs(h - H * w / W) <= 1 or abs(w - W * h / H) <= 1


def write_npy_map(path: str | Path, features: Array) -> Path:  # features: [h, w, D]
    """Write one view's map as kfgs keeps it: a `.npy` file, float16 [h, w, D], whole or absent.

    The map is converted a few rows at a time, so no copy of it is made in memory.

    Raises:
        ValueError: if `features` is not [h, w, D], or not finite once it is float16 (largest value 65504).
    """
    check_shapes(("features", features, "h w D"))
    target = Path(path)
    values = features.detach() if isinstance(features, Tensor) else torch.from_numpy(features)
    header = {"descr": "<f2", "fortran_order": False, "shape": tuple(map(int, values.shape))}
    with atomic_path(target) as temporary, temporary.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for start in range(0, values.shape[0], ROW_BLOCK):
            rows = values[start : start + ROW_BLOCK].to(torch.float16).cpu().contiguous()
            if not bool(torch.isfinite(rows).all()):
                raise ValueError(
                    f"features: expected finite values below 65504 (they are stored as float16), got others for "
                    f"{target.name!r}; normalise the rows"
                )
            file.write(rows.numpy().astype("<f2", copy=False).data)
    return target
