"""The common 3DGS layout of a PLY file: written first by Inria's script, read by most programs.

Columns x y z nx ny nz f_dc_* f_rest_* opacity scale_* rot_*, with opacity as a logit, scale as a natural logarithm,
rotation as (w, x, y, z) and f_rest channel by channel. Some have red, green, blue in place of f_dc_*.
kfgs adds `class_id` and `score`; every other column is kept.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from .._check import ORIGIN
from .._origin import to_world
from ..gaussians import Gaussians
from .ply import Column, Columns, points_from_columns, read_header, read_ply, stack_columns, write_ply
from .render_mode import comments_of_mode, mode_from_comments, with_mode
from .values import EXACT, SCORE, SH_C0, positive_scales, up_to_degree_3, whole_labels

NAME = "ply"
SUFFIXES = (".ply",)
MAGIC = b"ply"
HOLDS = frozenset({"labels", "origin", "harmonics", "antialiased", "features", "columns"})
FILTER = "filter_3D"  # Mip-Splatting's own files: the 3-D filter's deviation, not yet part of scales and opacities
NORMALS = ("nx", "ny", "nz")  # always zero in 3DGS files; written, not kept
RGB = ("red", "green", "blue")  # colours, if there is no f_dc_*
OURS = ("f_dc_", "f_rest_", "scale_", "rot_", "semantic_")  # beginnings of columns that are not kept in `extra`
COEFFICIENTS = 16  # of harmonics of degree 3, which Inria's script always writes


def matches(head: bytes) -> bool:
    """Any PLY file; compressed ones are checked before."""
    return head.startswith(MAGIC)


def read(path: Path) -> Gaussians:
    """Read a 3DGS PLY; unknown columns go to `extra`. The comments, or columns, say how it is drawn (`render_mode`)."""
    columns = read_ply(path)
    gaussians = gaussians_from_columns(path, columns)
    known = {"x", "y", "z", "opacity", "class_id", SCORE, FILTER, *NORMALS}
    known |= set(RGB) if gaussians.sh is not None and "f_dc_0" not in columns else set()
    extra = {name: values for name, values in columns.items() if name not in known and not name.startswith(OURS)}
    mode = mode_from_comments(read_header(path).comments)
    surfels, antialiased = mode.surfels or "scale_2" not in columns, mode.antialiased or FILTER in columns
    return with_mode(path, gaussians.replace(extra=extra), mode._replace(surfels=surfels, antialiased=antialiased))


def write(path: Path, g: Gaussians) -> list[str]:
    """Write the 3DGS layout, labels and extra columns included; x, y, z are double if it has an origin.

    Nothing is lost but columns whose name PLY cannot have.
    """
    columns = columns_from_gaussians(g)
    own = {name: values for name, values in g.extra.items() if name.split() == [name] and name not in columns}
    write_ply(path, columns | own, comments=("written by kfgs", *comments_of_mode(g)))
    left = [name for name in g.extra if name not in own]
    return [f"the columns {', '.join(left)}: .ply has no place for them"] if left else []


def plain_cloud(g: Gaussians) -> Gaussians:
    """What a file of Inria's script has room for, whose 62 properties some importers count: harmonics of degree 3 at most,
    zero if unknown, and nothing else.
    """
    assert g.sh is not None
    whole = torch.nn.functional.pad(g.sh, (0, 0, 0, COEFFICIENTS - g.sh.shape[1]))
    return g.replace(sh=whole, features=None, labels=None, scores=None, extra={}, origin=ORIGIN)


def _numbered(columns: Columns, group: str, counts: tuple[int, ...]) -> list[str]:
    """Names of the columns of a group, which are numbered from 0 without a gap."""
    have = {name for name in columns if name.startswith(group)}
    names = [f"{group}{i}" for i in range(len(have))]
    missing = [name for name in names if name not in have]
    if missing or (counts and len(names) not in counts):
        allowed = f"{' or '.join(map(str, counts))} columns " if counts else ""
        gap = f", {missing[0]} missing" if missing else ""
        raise ValueError(f"expected {allowed}{group}0, {group}1, ..., got {len(names)}{gap}")
    return names


def gaussians_from_columns(path: Path, columns: Columns) -> Gaussians:
    """Read a 3DGS vertex table (values activated on the way); `path` is for notes. A ValueError if its columns are odd."""
    if {"scale_0", "scale_1"} <= columns.keys():  # 2DGS has no third; `with_mode` makes it thin
        columns = {"scale_2": np.minimum(columns["scale_0"], columns["scale_1"]), **columns}
    needed = ["x", "y", "z", "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    missing = [name for name in needed if name not in columns]
    if missing:
        raise ValueError(f"the 3DGS layout has {', '.join(missing)}, it has not; is this a plain point cloud?")
    colours = all(name in columns for name in RGB)
    dc_names, features = _numbered(columns, "f_dc_", (0, 3)), _numbered(columns, "semantic_", ())
    rest = _numbered(columns, "f_rest_", (0, 9, 24, 45, 72))
    if rest and not (dc_names or colours):
        raise ValueError("expected f_dc_0 to f_dc_2 next to f_rest_*, got none")
    sh = None
    if dc_names or colours:
        dc = (stack_columns(columns, dc_names) if dc_names else _dc_from_rgb(columns))[:, None]
        higher = stack_columns(columns, rest) if rest else dc.new_zeros(len(dc), 0)  # stored channel-major
        sh = torch.cat([dc, higher.view(len(dc), 3, len(rest) // 3).transpose(1, 2)], 1)
    scales = stack_columns(columns, [f"scale_{i}" for i in range(3)]).exp()
    opacities = stack_columns(columns, ["opacity"])[:, 0].sigmoid()
    if FILTER in columns:  # Yu et al. 2024, eq. 7: a Gaussian that is widened becomes fainter
        narrow = scales.double()
        wide = (narrow**2 + stack_columns(columns, [FILTER]).double() ** 2).sqrt()
        scales, opacities = wide.float(), (opacities * (narrow / wide.clamp_min(1e-300)).prod(dim=1)).float()
    return Gaussians(
        means=points_from_columns(path, columns),
        quats=stack_columns(columns, [f"rot_{i}" for i in range(4)]),
        scales=positive_scales(scales.numpy()),
        opacities=opacities,
        features=stack_columns(columns, features) if features else None,
        sh=None if sh is None else up_to_degree_3(path, sh),
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
    columns |= {name: np.zeros(len(g), np.float32) for name in NORMALS}
    for group, values in groups:
        for i in range(values.shape[1]):
            columns[group if group == "opacity" else f"{group}_{i}"] = values[:, i].contiguous().numpy()
    if g.labels is not None:
        columns["class_id"] = label_column(g.labels)
    if g.scores is not None:
        columns[SCORE] = g.scores.numpy()
    return columns


def label_column(labels: Tensor) -> Column:  # [N] -> [N]
    """The column `class_id`, as `float` like all others: some importers know no `int`, and misread the whole file.

    It is `int` if a label is too large for `float` to hold exactly.
    """
    exact = not bool((labels > EXACT).any())
    return labels.detach().cpu().to(torch.float32 if exact else torch.int32).numpy()
