"""One view's feature map on disk: open it without reading its values, read some of its rows, write it."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._arrays import read_array, read_safetensors, reading
from .._check import as_tensor, check_shapes
from .._files import as_path, atomic_path
from ..cameras.resample import fits_aspect

StoredMap = Tensor | NDArray[Any]
"""A map [h, w, D], mapped into memory: values are read when they are used."""
Size = tuple[int, int]
"""(H, W) of a picture."""

OWN, FEATURE_3DGS, SAFETENSORS = ".npy", "_fmap_CxHxW.pt", ".safetensors"
ENDINGS = (OWN, FEATURE_3DGS, SAFETENSORS)
"""Endings of a map's file after the picture's stem. If a view has several maps, the first of this order is read."""
AGAIN = "encode it again, or leave the photo out (split.json)"
ROW_BLOCK = 32  # rows of a map converted at a time: 30 MB in single precision at 480 x 512 channels


def open_map(
    file: Path, channels: int | None = None, size: Size | None = None, *, own: bool = False
) -> StoredMap:  # [h, w, D]
    """Map a file into memory without reading its values.

    Feature 3DGS writes [D, h, w], kfgs [h, w, D]. In other files a known number of channels decides, then the aspect of the
    picture; if both fit, [h, w, D]. If nothing is known, a first axis of twice the others' size is D,
    except in .npy. `size` is that
    of the view's picture; `own` says that kfgs wrote the map.
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
    elif own and file.name.endswith(OWN):
        turned = False
    elif channels in (first, last) and first != last:
        turned = first == channels
    elif size is None:
        turned = channels is None and not file.name.endswith(OWN) and first >= 2 * max(middle, last)
    else:
        turned = not fits_aspect((first, middle), size) and fits_aspect((middle, last), size)
    if not turned:
        return values
    return values.permute(1, 2, 0) if isinstance(values, Tensor) else values.transpose(1, 2, 0)


def read_rows(
    stored: StoredMap,  # [h, w, D]
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


def count_bad(values: Tensor) -> int:  # any shape, not empty
    """Count NaN and infinite values; if the extremes are finite there are none, and the tensor is not copied."""
    low, high = values.aminmax()  # NaN if any value is
    return 0 if math.isfinite(low) and math.isfinite(high) else int((~torch.isfinite(values)).sum())


def save_feature_map(path: str | Path, stem: str, features: Tensor) -> Path:  # features: [h, w, D]
    """Write one view's map as kfgs stores it: `<stem>.npy`, float16 [h, w, D]; the file appears whole or not at all.

    Raises:
        ValueError: if `features` is not [h, w, D], not finite in float16 (largest value 65504), or becomes all-zero there in
            some cells but not before (below 6e-8).
    """
    features = as_tensor("features", features, floating=True)
    check_shapes(("features", features, "h w D"))
    half = features.detach().to(torch.float16).cpu().contiguous()
    empty = ~half.any(-1)
    if 0 in half.shape or count_bad(half) or bool(features[empty.to(features.device)].any()):
        low, high = (float(end) for end in features.aminmax()) if features.numel() else (0.0, 0.0)
        raise ValueError(
            f"features: expected finite values below 65504 and, where they are not all zero, above 6e-8 (they are stored as "
            f"float16), got {tuple(half.shape)} from {low:g} to {high:g} for {stem!r}; "
            + ("bring the rows to unit length" if math.isfinite(low + high) else "check the weights of its network")
        )
    target = as_path(path) / f"{stem}{OWN}"
    with atomic_path(target) as temporary, temporary.open("wb") as file:
        np.save(file, half.numpy())
    return target
