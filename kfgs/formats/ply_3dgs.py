"""The common 3DGS layout of a PLY file: written first by Inria's script, read by most programs.

Columns x y z nx ny nz f_dc_* f_rest_* opacity scale_* rot_*, with opacity as a logit, scale as a natural logarithm,
rotation as (w, x, y, z) and f_rest channel by channel. Some have red, green, blue in place of f_dc_*.
kfgs adds `class_id` and `score`; every other column is kept.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._check import ORIGIN
from .._notes import tell
from .._origin import to_world
from ..gaussians import Gaussians
from .ply import Columns, points_from_columns, read_comments, read_ply, stack_columns, write_ply
from .render_mode import comments_of_mode, mode_from_comments, with_mode
from .values import (
    EXACT,
    NO_DEGREE_4,
    SCORE,
    SH_C0,
    colours_to_write,
    describe_loss,
    positive_scales,
    whole_labels,
)

NAME = "ply"
SUFFIXES = (".ply",)
MAGIC = b"ply"
HOLDS_LABELS = True
HOLDS_ORIGIN = True
FILTER = "filter_3D"  # Mip-Splatting's own files: the 3-D filter's deviation, not yet part of scales and opacities
NORMALS = ("nx", "ny", "nz")  # always zero in 3DGS files; written, not kept
RGB = ("red", "green", "blue")  # colours, if there is no f_dc_*
COEFFICIENTS = 16  # of harmonics of degree 3, which Inria's script always writes


def matches(head: bytes) -> bool:
    """Any PLY file; compressed ones are checked before."""
    return head.startswith(MAGIC)


def read(path: Path) -> Gaussians:
    """Read a 3DGS PLY with spherical harmonics of degree 0 to 4 (4 is dropped); unknown columns go to `extra`.

    The comments, or columns, say whether it is antialiased or has surfels (`render_mode`).

    Raises:
        ValueError: if it is damaged, or no 3DGS file; opacities of 0 and 1, whose logits are infinite, stay 0 and 1.
    """
    columns = read_ply(path)
    try:
        gaussians = gaussians_from_columns(columns)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    used = () if gaussians.sh is None or "f_dc_0" in columns else RGB
    extra = {name: values for name, values in columns.items() if not _is_ours(name) and name not in used}
    gaussians = gaussians.replace(scales=positive_scales(path, gaussians.scales.numpy()), extra=extra)
    if "f_rest_45" in columns:
        tell(f"{path.name}: {NO_DEGREE_4}")
    mode = mode_from_comments(read_comments(path))
    mode = mode._replace(
        surfels=mode.surfels or "scale_2" not in columns, antialiased=mode.antialiased or FILTER in columns
    )
    return with_mode(path, gaussians, mode)


def write(path: Path, gaussians: Gaussians) -> tuple[str, ...]:
    """Write the 3DGS layout, labels and extra columns included; x, y, z are double if it has an origin.

    Nothing is lost but columns whose name PLY cannot have.
    """
    comments = ("written by kfgs", *comments_of_mode(gaussians))
    columns, extra = columns_from_gaussians(gaussians), gaussians.extra
    own = {name: values for name, values in extra.items() if name.split() == [name] and name not in columns}
    write_ply(path, columns | own, comments=comments)
    left = {name: values for name, values in extra.items() if name not in own}
    return describe_loss(gaussians.replace(features=None, scores=None, extra=left), ".ply", 3)


def write_plain(path: Path, gaussians: Gaussians) -> tuple[str, ...]:
    """Write the 62 properties of the files of Inria's script, no more and no fewer: harmonics up to degree 3, zero if unknown.

    Some importers count properties, or cannot skip those that they do not know.
    """
    what = "a plain PLY"
    g = colours_to_write(gaussians, what)
    assert g.sh is not None
    whole = torch.nn.functional.pad(g.sh, (0, 0, 0, COEFFICIENTS - g.sh.shape[1]))
    write(path, g.replace(sh=whole, features=None, labels=None, scores=None, extra={}, origin=ORIGIN))
    return describe_loss(gaussians, what, 3)


def _is_ours(name: str) -> bool:
    known = {"x", "y", "z", "opacity", "class_id", SCORE, FILTER, *NORMALS}
    return name in known or name.startswith(("f_dc_", "f_rest_", "scale_", "rot_", "semantic_"))


def _numbered(columns: Columns, group: str) -> list[str]:
    """Names of the columns of a group, which are numbered from 0 without a gap."""
    have = [name for name in columns if name.startswith(group)]
    names = [f"{group}{i}" for i in range(len(have))]
    missing = [name for name in names if name not in columns]
    if missing:
        odd = sorted(set(have) - set(names))
        raise ValueError(
            f"columns: expected {missing[0]} as well as {odd[0]}, got none; number {group}* from 0 to the last"
        )
    return names


def gaussians_from_columns(columns: Columns) -> Gaussians:
    """Read a 3DGS vertex table (values activated on the way).

    Raises:
        ValueError: if a column of the 3DGS layout is missing, or numbered columns have gaps or an odd count.
    """
    if {"scale_0", "scale_1"} <= columns.keys():  # 2DGS has no third; `with_mode` makes it thin
        columns = {"scale_2": np.minimum(columns["scale_0"], columns["scale_1"]), **columns}
    needed = ["x", "y", "z", "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    missing = [name for name in needed if name not in columns]
    if missing:
        raise ValueError(
            f"columns: expected the 3DGS layout, {', '.join(missing)} missing; is this a plain point cloud?"
        )
    dc_names, rest, features = (_numbered(columns, group) for group in ("f_dc_", "f_rest_", "semantic_"))
    colours = bool(dc_names) or all(name in columns for name in RGB)
    for group, names, counts in (("f_dc_", dc_names, (0, 3)), ("f_rest_", rest, (0, 9, 24, 45, 72))):
        if len(names) not in counts or (rest and not colours):
            raise ValueError(
                f"columns: expected {group}0, {group}1, ... of {' or '.join(map(str, counts))} columns (f_rest_* only "
                f"with f_dc_0 to f_dc_2), got {len(names)} {group}*; export the splat with whole degrees of harmonics"
            )
    sh = None
    if colours:
        dc = (stack_columns(columns, dc_names) if dc_names else _dc_from_rgb(columns))[:, None]
        higher = dc[:, :0]
        if rest:  # stored channel-major
            higher = stack_columns(columns, rest).view(len(dc), 3, len(rest) // 3).transpose(1, 2)
        sh = torch.cat([dc, higher], 1)[:, :COEFFICIENTS]
    scales = stack_columns(columns, [f"scale_{i}" for i in range(3)]).exp()
    opacities = stack_columns(columns, ["opacity"])[:, 0].sigmoid()
    if FILTER in columns:  # Yu et al. 2024, eq. 7: a Gaussian that is widened becomes fainter
        narrow = scales.double()
        wide = (narrow**2 + stack_columns(columns, [FILTER]).double() ** 2).sqrt()
        scales, opacities = wide.float(), (opacities * (narrow / wide.clamp_min(1e-300)).prod(dim=1)).float()
    return Gaussians(
        means=points_from_columns(columns),
        quats=stack_columns(columns, [f"rot_{i}" for i in range(4)]),
        scales=scales,
        opacities=opacities,
        features=stack_columns(columns, features) if features else None,
        sh=sh,
        labels=whole_labels(columns["class_id"]) if "class_id" in columns else None,
        scores=stack_columns(columns, [SCORE])[:, 0] if SCORE in columns else None,
    )


def _dc_from_rgb(columns: Columns) -> Tensor:  # [N, 3]
    """Coefficients of degree 0 from colours: whole numbers up to 255 (65535 if wider), or fractions from 0 to 1."""
    rgb = stack_columns(columns, [*RGB])
    code = columns[RGB[0]].dtype
    largest = 1.0 if code.kind == "f" and not bool((rgb > 2).any()) else 255.0
    return (rgb / (65535.0 if code == np.uint16 else largest) - 0.5) / SH_C0


def columns_from_gaussians(gaussians: Gaussians) -> Columns:
    """The 3DGS vertex table of a cloud: places in the world, logits, logarithms, features, labels and scores."""
    g = gaussians.detach().to("cpu", torch.float32)
    opacity = g.opacities.clamp(1e-7, 1 - 1e-7)
    groups: list[tuple[str, Tensor]] = []
    if g.sh is not None:
        groups += [("f_dc", g.sh[:, 0]), ("f_rest", g.sh[:, 1:].transpose(1, 2).flatten(1))]
    groups += [("opacity", opacity.logit()[:, None]), ("scale", g.scales.log()), ("rot", g.quats)]
    if g.features is not None:
        groups.append(("semantic", g.features))
    places = to_world(g.means, g.origin)
    columns: Columns = {name: places[:, i].numpy() for i, name in enumerate("xyz")}
    columns |= {name: np.zeros(len(g), np.float32) for name in ("nx", "ny", "nz")}
    for group, values in groups:
        for i in range(values.shape[1]):
            columns[group if group == "opacity" else f"{group}_{i}"] = values[:, i].contiguous().numpy()
    if g.labels is not None:
        columns["class_id"] = label_column(g.labels)
    if g.scores is not None:
        columns[SCORE] = g.scores.numpy()
    return columns


def label_column(labels: Tensor) -> NDArray[Any]:  # [N] -> [N]
    """The column `class_id`, as `float` like all others: some importers know no `int`, and misread the whole file.

    It is `int` if a label is too large for `float` to hold exactly.
    """
    exact = not bool((labels > EXACT).any())
    return labels.detach().cpu().to(torch.float32 if exact else torch.int32).numpy()
