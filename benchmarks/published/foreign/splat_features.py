"""A splat with features: in its own columns, or in a file beside it.

From protocols.md f1: SceneSplat's language features are (N, D) in `.npy` or `.pth`. Our readings, confirmed by no sample: the
`.pth` holds one tensor, and rows are in the order of the splat file.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from kfgs._arrays import read_array, read_torch
from kfgs._files import as_path
from kfgs.formats.table import read_rows

from .files import finite_tensor
from .splatted import Level, SplattedMethod


def load_splat_features(
    splats: str | Path, features: str | Path | None = None, *, column: str = "semantic_", name: str | None = None
) -> SplattedMethod:
    """Read a splat file whose Gaussians have the teacher's own features.

    Args:
        splats: any splat file that kfgs reads.
        features: `.npy`, or `.pt` and `.pth` with one tensor [N, D] (SceneSplat's language features), a row per Gaussian in
            the order of the splat file; None: the columns of the PLY.
        column: what their names begin with; a number from 0 follows.
        name: for tables; None: the name of the file.

    Returns:
        One level; a Gaussian with an all-zero feature has none.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if there are no features, or not one row per Gaussian.
    """
    path = as_path(splats)
    gaussians, kept = read_rows(path)
    if features is not None:
        values = _read_rows(as_path(features))
        if len(values) == len(kept):
            values = values[kept]
        if len(values) != len(gaussians):
            raise ValueError(
                f"{features}: expected [{len(gaussians)}, D], a row for each Gaussian of {path}, got {list(values.shape)}; some "
                "formats change the order and number of Gaussians: give the file the features were made for"
            )
    elif column == "semantic_" and gaussians.features is not None:
        values = gaussians.features
    else:
        names = [f"{column}{i}" for i in range(sum(key.startswith(column) for key in gaussians.extra))]
        if not names or any(key not in gaussians.extra for key in names):
            others = ", ".join(list(gaussians.extra)[:6]) or "none but its own"
            raise ValueError(
                f"{path}: expected columns {column}0, {column}1, ..., got other columns ({others}); pass column=, or "
                "features=FILE"
            )
        values = torch.from_numpy(np.stack([gaussians.extra[key] for key in names], 1)).float()
    return SplattedMethod(path.stem if name is None else name, [Level(gaussians.replace(features=values.contiguous()))])


def _read_rows(path: Path) -> Tensor:  # [N, D]
    expected = "one array of features [N, D]"
    if path.suffix == ".npy":
        value: object = torch.from_numpy(read_array(path, expected, "write it again").astype(np.float32))
    else:
        value = read_torch(path, expected)
        if isinstance(value, Mapping) and len(value) == 1:
            value = next(iter(value.values()))
    values = finite_tensor(path, "features", value)
    if values.ndim != 2 or 0 in values.shape:
        raise ValueError(f"{path}: expected {expected}, got {list(values.shape)}; give one row per Gaussian")
    return values
