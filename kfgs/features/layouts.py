"""The layouts of feature maps on disk: open a map without reading its values, and write one."""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._arrays import FileError, read_array, read_safetensors
from .._check import check_shapes
from .._files import as_path, atomic_path
from .._torch_files import plain_tensor, read_torch
from .._typed import typed
from ..cameras.resample import fits_aspect
from ..scenes.files import some
from .langsplat import INDEX, ROWS, MaskFeatures

StoredMap = Tensor | NDArray[Any] | MaskFeatures
"""A map [h, w, D] on disk: a tensor or an array that is mapped into memory, or one that is looked up when read."""
Axes = Literal["h w D", "D h w"]

WIDTHS = frozenset((128, 256, 384, 512, 768, 1024, 1152, 1280, 1536))
"""Numbers of channels of known encoders. A first axis of one of these sizes, and a last axis of none, hints at [D, h, w]."""
AGAIN = "encode it again, or leave the photo out (split.json)"
ROW_BLOCK = 32  # rows of a map converted at a time: 30 MB in single precision at 480 x 512 channels


@dataclass(frozen=True)
class Reading:
    """How to read a map, as far as its file does not say it."""

    channels: int | None = None
    """D, if it is known: distinguishes [h, w, D] from [D, h, w]."""
    size: tuple[int, int] | None = None
    """(H, W) of the view's picture, if it is known: the map has its aspect."""
    level: int = 0
    """Which of LangSplat's four sets of masks (`langsplat.LEVELS`)."""
    stride: int | None = None
    """Pixels per cell of LangSplat's masks, which are as large as the picture; None: the smallest stride with at most the
    cells of the paper's maps."""


class Layout(NamedTuple):
    """One way to store a view's map."""

    suffix: str  # ending of the file's name after the picture's stem
    axes: Axes
    certain: bool  # whether every program that writes these files uses this order of the axes
    open: Callable[[Path, Reading], Any]  # maps the file into memory


def _open_torch(file: Path, _: Reading) -> Any:
    return plain_tensor(file, "the map", read_torch(file, "a feature map", AGAIN), None, finite=False)


def _open_numpy(file: Path, _: Reading) -> Any:
    return read_array(file, "a feature map", AGAIN, mapped=True)


def _open_safetensors(file: Path, _: Reading) -> Any:
    tensors = read_safetensors(file, "a feature map", AGAIN)[0]
    if len(tensors) != 1:
        raise ValueError(f"expected one tensor, got {len(tensors)}: {some(list(tensors))}")
    return next(iter(tensors.values()))  # mapped, not read


def _open_langsplat(file: Path, reading: Reading) -> Any:
    return MaskFeatures(file, reading.level, reading.stride)


FEATURE_3DGS = Layout("_fmap_CxHxW.pt", "D h w", True, _open_torch)  # LSeg's in half, SAM's in single precision
LANGSPLAT = Layout(INDEX, "h w D", True, _open_langsplat)  # a second file has the features of the masks
OWN = Layout(".npy", "h w D", False, _open_numpy)  # kfgs's layout, which other programs use too
LAYOUTS = (FEATURE_3DGS, LANGSPLAT, OWN, Layout(".safetensors", "h w D", False, _open_safetensors))
"""If a view has several maps, the first of this order is read."""


def map_file(folder: Path, stem: str) -> Path:
    """The file that kfgs writes a view's map to."""
    return folder / f"{stem}{OWN.suffix}"


def layout_of(file: Path, own: Container[Path] = ()) -> Layout | None:
    """The layout of a file by its name; None if it is no map, or only the second file of LangSplat's two.

    Args:
        file: the map.
        own: maps that kfgs wrote, according to the manifest: their layout is `OWN`, whatever their pictures are called.
    """
    if file in own:
        return OWN
    for suffix, other, layout in ((INDEX, ROWS, LANGSPLAT), (ROWS, INDEX, None)):
        partner = file.with_name(file.name.removesuffix(suffix) + other)
        if file.name.endswith(suffix) and partner not in own and partner.is_file():
            return layout
    return next((one for one in LAYOUTS if one is not LANGSPLAT and file.name.endswith(one.suffix)), None)


def open_map(file: Path, reading: Reading = Reading(), own: Container[Path] = ()) -> StoredMap:  # [h, w, D]
    """Map a file into memory without reading its values; checks its type, its number of axes and their order.

    Args:
        file: the map.
        reading: how to read it.
        own: maps that kfgs wrote, see `layout_of`.

    Raises:
        ValueError: if the file cannot be read, is no map of floats, or the order of its axes is not clear.
        TypeError: if it holds anything but one tensor.
    """
    layout = layout_of(file, own)
    assert layout is not None, f"{file} is no map"
    try:
        found = layout.open(file, reading)
    except FileError:
        raise
    except Exception as error:  # a damaged pickle raises almost anything: struct.error, KeyError, EOFError, ...
        raise ValueError(
            f"{file}: expected a feature map, but it cannot be read ({_reason(error)}); {AGAIN}"
        ) from error
    if isinstance(found, MaskFeatures):
        return found
    axes = "[" + layout.axes.replace(" ", ", ") + "]"
    if not isinstance(found, np.ndarray) and not (isinstance(found, Tensor) and found.layout == torch.strided):
        kind = f"{found.layout} tensor" if isinstance(found, Tensor) else type(found).__name__
        raise TypeError(f"{file}: expected one dense tensor {axes}, got a {kind}; save the tensor alone")
    if not (found.is_floating_point() if isinstance(found, Tensor) else found.dtype.kind == "f"):
        raise ValueError(f"{file}: expected floating-point features, got {found.dtype}; {AGAIN}")
    if found.ndim != 3 or 0 in found.shape:
        raise ValueError(f"{file}: expected a map {axes}, got {tuple(found.shape)}; save one view per file")
    order = layout.axes if layout.certain else find_axes(str(file), tuple(map(int, found.shape)), reading)
    if order == "D h w":
        found = found.permute(1, 2, 0) if isinstance(found, Tensor) else found.transpose(1, 2, 0)
    return found  # type: ignore[no-any-return]


def _reason(error: Exception) -> str:
    """An error's first sentence, with its type unless it is a ValueError."""
    text = str(error).split(". ")[0].strip()[:120]
    return text if isinstance(error, ValueError) and text else f"{type(error).__name__}: {text}"


def read_rows(
    stored: StoredMap,  # [h, w, D]
    rows: slice = slice(None),
    columns: slice = slice(None),
    out: Tensor | None = None,  # [rows, columns, D] float32
) -> Iterator[Tensor]:  # each [at most ROW_BLOCK, columns, D] float32
    """Copy some rows and columns of a map in single precision, a few rows at a time; only these are read from disk.

    A value beyond the range of single precision becomes infinite. With `out`, the copies are parts of it.
    """
    chosen = range(int(stored.shape[0]))[rows]
    for start in range(0, len(chosen), ROW_BLOCK):
        part = chosen[start : start + ROW_BLOCK]
        block = stored[part.start : part.stop : part.step, columns]
        copy = torch.empty(tuple(block.shape), dtype=torch.float32) if out is None else out[start : start + ROW_BLOCK]
        if isinstance(block, Tensor):
            copy.copy_(block)
        else:
            with np.errstate(over="ignore"):
                np.copyto(copy.numpy(), block, casting="same_kind")
        yield copy


def count_bad(values: Tensor) -> int:  # any shape, not empty
    """Count NaN and infinite values; if the extremes are finite there are none, and the tensor is not copied."""
    low, high = values.aminmax()  # NaN if any value is
    return 0 if math.isfinite(low) and math.isfinite(high) else int((~torch.isfinite(values)).sum())


def find_axes(name: str, shape: tuple[int, ...], reading: Reading = Reading()) -> Axes:
    """The order of the axes of a map: [h, w, D], as kfgs writes it, or [D, h, w], as encoders return it.

    A known number of channels decides, then the picture's aspect. If both orders fit, or nothing is known, it is [h, w, D].

    Raises:
        ValueError: if nothing is known, and the sizes look like [D, h, w].

    Example:
        >>> find_axes("a.npy", (512, 90, 120), Reading(channels=512)), find_axes("a.npy", (90, 120, 512))
        ('D h w', 'h w D')
    """
    first, middle, last = shape
    if reading.channels is not None and reading.channels in (first, last) and first != last:
        return "h w D" if last == reading.channels else "D h w"
    if reading.size is not None:
        hwd, dhw = fits_aspect((first, middle), reading.size), fits_aspect((middle, last), reading.size)
        if hwd or dhw:
            return "h w D" if hwd else "D h w"
    stretched, plain = max(first / middle, middle / first) > 3, max(middle / last, last / middle) <= 3
    if reading.channels is None and first in WIDTHS and last not in WIDTHS and (last > 64 or (stretched and plain)):
        raise ValueError(
            f"{name}: expected a map [h, w, D], got {shape}, which may also be [D, h, w]; give the number of channels "
            "or the size of the picture, or save it as [h, w, D]"
        )
    return "h w D"


def write_npy_map(
    path: str | Path,
    features: Tensor | NDArray[Any],  # [h, w, D]
) -> Path:
    """Write one view's map as kfgs stores it: a `.npy` file, float16 [h, w, D], atomically.

    The map is converted a few rows at a time, so memory holds no copy of it.

    Raises:
        ValueError: if `features` is not [h, w, D], or not finite in float16 (largest value 65504).
    """
    check_shapes(("features", features, "h w D"))
    target = as_path(path)
    header = {"descr": "<f2", "fortran_order": False, "shape": tuple(map(int, features.shape))}
    with atomic_path(target) as temporary, temporary.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for start in range(0, features.shape[0], ROW_BLOCK):
            rows = features[start : start + ROW_BLOCK]
            if isinstance(rows, Tensor):
                half = rows.detach().to(torch.float16).cpu().contiguous()
            else:
                with np.errstate(over="ignore"):
                    half = torch.from_numpy(np.array(rows, np.float16, order="C"))
            _check_half(half, target.name)
            file.write(half.numpy().astype("<f2", copy=False).data)
    return target


@typed
def save_feature_map(path: str | Path, stem: str, features: Tensor) -> Path:  # features: [h, w, D]
    """Write one view's map in the layout of Feature 3DGS: `<stem>_fmap_CxHxW.pt`, float16 [D, h, w], atomically.

    Raises:
        ValueError: if `features` is not [h, w, D], or not finite in float16 (largest value 65504).
    """
    check_shapes(("features", features, "h w D"))
    h, w, D = features.shape
    half = torch.empty(D, h, w, dtype=torch.float16)
    for i in range(h):  # row by row, which transposes in the cache: 0.3 s instead of 5 s at 360 x 480 x 512
        half[:, i] = features[i].detach().to(torch.float16).T.contiguous()
    _check_half(half, stem)
    target = as_path(path) / f"{stem}{FEATURE_3DGS.suffix}"
    with atomic_path(target) as temporary:
        torch.save(half, temporary)
    return target


def _check_half(half: Tensor, name: str) -> None:
    if count_bad(half):
        raise ValueError(
            f"features: expected finite values below 65504 (they are stored as float16), got others for {name!r}; "
            "normalise the rows"
        )
