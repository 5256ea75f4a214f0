"""How a map of features lies on disk: the table of layouts, opened without reading the values, and our own written."""

from __future__ import annotations

import math
from collections.abc import Callable, Container
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from torch import Tensor

from .._check import check_shapes
from .._files import atomic_path
from ..teachers.torch_files import Placeholder, check_plain, load_torch_file
from .langsplat import INDEX, ROWS, MaskFeatures

Axes = Literal["h w D", "D h w"]

WIDTHS = frozenset((128, 256, 384, 512, 768, 1024, 1152, 1280, 1536))
"""Channels of encoders: a first axis of such a size, and a last one that is none, hints at [D, h, w]."""
ROW_BLOCK = 32  # rows of a map converted at a time: 30 MB in single precision at 480 x 512 channels


class StoredMap(Protocol):
    """A map [h, w, D] that lies on disk: a tensor or an array mapped into memory, or one put together when read."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(h, w, D)."""
        ...

    @property
    def dtype(self) -> Any:
        """The kind of floats on disk."""
        ...

    def __getitem__(self, key: tuple[slice, slice], /) -> Any:
        """Some rows and columns."""
        ...


@dataclass(frozen=True)
class Reading:
    """How a map is to be read, where its file does not say it alone."""

    channels: int | None = None
    """D, if it is known: tells [h, w, D] from [D, h, w]."""
    size: tuple[int, int] | None = None
    """(H, W) of the view's picture, if it is known: the map has its aspect."""
    level: int = 0
    """Which of LangSplat's four sets of masks (`langsplat.LEVELS`)."""
    stride: int | None = None
    """One cell per so many pixels of LangSplat's masks, which are as large as the picture; None: as many as needed to
    have no more cells than the paper's maps."""


@dataclass(frozen=True)
class Layout:
    """One way to keep a view's map on disk."""

    suffix: str
    """What follows the picture's stem in the file's name."""
    axes: Axes
    """The order of the axes."""
    certain: bool
    """Whether every writer of such files keeps that order."""
    open: Callable[[Path, Reading], Any]
    """Maps the file into memory."""
    partner: str = ""
    """The suffix of a second file that must lie beside the first."""


def _open_torch(file: Path, _: Reading) -> Any:
    found = load_torch_file(file)
    if isinstance(found, Placeholder):
        raise ValueError("it holds objects beside tensors, which are not run")
    if not isinstance(found, Tensor):
        return found
    check_plain(found)
    return found.detach()  # saved by a training run, it may ask for gradients


def _open_numpy(file: Path, _: Reading) -> Any:
    with np.errstate(over="ignore"):  # a header may ask for any size; one beyond the file's is refused
        return np.load(file, mmap_mode="r", allow_pickle=False)


def _open_safetensors(file: Path, _: Reading) -> Any:
    with safe_open(file, framework="pt") as tensors:
        names = list(tensors.keys())
        if len(names) != 1:
            raise ValueError(f"expected one tensor, got {len(names)}: {', '.join(names[:5])}")
        return tensors.get_tensor(names[0])  # mapped, not read


def _open_langsplat(file: Path, reading: Reading) -> Any:
    return MaskFeatures(file, reading.level, reading.stride)


FEATURE_3DGS = Layout("_fmap_CxHxW.pt", "D h w", True, _open_torch)  # LSeg's in half, SAM's in single precision
LANGSPLAT = Layout(INDEX, "h w D", True, _open_langsplat, partner=ROWS)
OWN = Layout(".npy", "h w D", False, _open_numpy)  # kfgs's, also of other programs
LAYOUTS = (  # the first that a view has is read
    FEATURE_3DGS,
    LANGSPLAT,
    OWN,
    Layout(".safetensors", "h w D", False, _open_safetensors),
)


def layout_of(file: Path, own: Container[Path] = ()) -> Layout | None:
    """The first layout whose suffix the file's name ends in, and whose partner lies beside it; None if there is none.

    Args:
        file: the map.
        own: maps that kfgs wrote, by its manifest: they are `OWN`, and no partners, whatever their pictures are called.
    """
    if file in own:
        return OWN
    for layout in LAYOUTS:
        if file.name.endswith(layout.suffix) and (not layout.partner or _has_partner(file, layout, own)):
            return layout
    return None


def _has_partner(file: Path, layout: Layout, own: Container[Path]) -> bool:
    partner = partner_of(file, layout)
    return partner not in own and partner.is_file()


def partner_of(file: Path, layout: Layout) -> Path:
    """The second file of a map that is kept in two."""
    return file.with_name(file.name.removesuffix(layout.suffix) + layout.partner)


def open_map(
    file: Path,
    reading: Reading = Reading(),
    own: Container[Path] = (),
) -> StoredMap:  # [h, w, D]
    """A file's map, mapped into memory rather than read; its kind, its number of axes and their order are checked.

    Args:
        file: the map.
        reading: how it is to be read.
        own: maps that kfgs wrote, see `layout_of`.

    Raises:
        ValueError: if the file cannot be read, or is no map of floats, or the order of its axes is in doubt.
        TypeError: if it holds something else than one tensor.
    """
    layout = layout_of(file, own)
    if layout is None:
        endings = ", ".join(layout.suffix for layout in LAYOUTS)
        raise ValueError(f"{file}: expected a name that ends in one of {endings}, got {file.name!r}; rename the map")
    try:
        found = layout.open(file, reading)
    except Exception as error:  # a damaged pickle raises almost anything: struct.error, KeyError, EOFError, ...
        raise ValueError(
            f"{file}: expected a feature map, but it cannot be read ({_reason(error)}); encode it again"
        ) from error
    if isinstance(found, MaskFeatures):
        return found
    axes = "[" + layout.axes.replace(" ", ", ") + "]"
    if not isinstance(found, np.ndarray) and not (isinstance(found, Tensor) and found.layout == torch.strided):
        kind = f"{found.layout} tensor" if isinstance(found, Tensor) else type(found).__name__
        raise TypeError(f"{file}: expected one dense tensor {axes}, got a {kind}; save the tensor alone")
    if not (found.is_floating_point() if isinstance(found, Tensor) else found.dtype.kind == "f"):
        raise ValueError(f"{file}: expected floating-point features, got {found.dtype}; encode it again")
    if found.ndim != 3 or 0 in found.shape:
        raise ValueError(f"{file}: expected a map {axes}, got {tuple(found.shape)}; save one view per file")
    order = layout.axes if layout.certain else find_axes(str(file), tuple(map(int, found.shape)), reading)
    if order == "D h w":
        found = found.permute(1, 2, 0) if isinstance(found, Tensor) else found.transpose(1, 2, 0)
    return found  # type: ignore[no-any-return]


def _reason(error: Exception) -> str:
    """An error's first sentence, with its kind where it is not one of a value."""
    text = str(error).split(". ")[0].strip()[:120]
    return text if isinstance(error, ValueError) and text else f"{type(error).__name__}: {text}"


def read_block(
    stored: StoredMap,  # [h, w, D]
    rows: slice = slice(None),
    columns: slice = slice(None),
    out: Tensor | None = None,  # [rows, columns, D] float32
) -> Tensor:  # [rows, columns, D] float32
    """Some rows and columns of a map in single precision, in memory of their own; only they are read from disk.

    A value beyond the range of single precision becomes infinite.
    """
    block = stored[rows, columns]
    out = torch.empty(tuple(block.shape), dtype=torch.float32) if out is None else out
    if isinstance(block, Tensor):
        return out.copy_(block)
    with np.errstate(over="ignore"):
        np.copyto(out.numpy(), block, casting="same_kind")
    return out


def count_bad(values: Tensor) -> int:  # any shape, not empty
    """NaN and infinite values, without a copy of the tensor if there are none (its extremes then are finite)."""
    low, high = values.aminmax()  # NaN if any value is
    return 0 if math.isfinite(low) and math.isfinite(high) else int((~torch.isfinite(values)).sum())


def find_axes(name: str, shape: tuple[int, ...], reading: Reading = Reading()) -> Axes:
    """The order of the axes of a map that may be [h, w, D], as kfgs writes it, or [D, h, w], as encoders give it.

    Known channels decide, then the picture's aspect; where both orders fit, or nothing is known, it is [h, w, D].

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


def write_npy_map(
    path: str | Path,
    features: Tensor | NDArray[Any],  # [h, w, D]
) -> Path:
    """Write one view's map as kfgs keeps it: a `.npy` file, float16 [h, w, D], whole or absent.

    The map is converted a few rows at a time, so no copy of it is made in memory.

    Raises:
        ValueError: if `features` is not [h, w, D], or not finite once it is float16 (largest value 65504).
    """
    check_shapes(("features", features, "h w D"))
    target = Path(path)
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
            if count_bad(half):
                raise ValueError(
                    f"features: expected finite values below 65504 (they are stored as float16), got others for "
                    f"{target.name!r}; normalise the rows"
                )
            file.write(half.numpy().astype("<f2", copy=False).data)
    return target
