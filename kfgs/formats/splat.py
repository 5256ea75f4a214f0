"""The `.splat` file of antimatter15's viewer: 32 bytes a Gaussian, nothing else.

A record is 3 float32 of position, 3 float32 of linear scale, red, green, blue and opacity as bytes, and the quaternion
(w, x, y, z) as bytes q * 128 + 128. Axes are those of the 3DGS PLY. There is no header: a file is recognised by its name,
and accepted if its size is a whole number of records and its floats are plausible. The order is kept. Viewers that draw
while loading look better if large and opaque Gaussians come first.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from .._files import atomic_path
from ..gaussians import Gaussians
from .values import SH_C0, describe_cut, positive_scales, unit_quats

NAME = "splat"
SUFFIXES = (".splat",)
HOLDS: frozenset[str] = frozenset()
RECORD = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def read(path: Path) -> Gaussians:
    """Read a .splat file: colours of degree 0, opacities as stored (0 and 1 included)."""
    size = path.stat().st_size
    if size % RECORD.itemsize:
        raise ValueError(f"its {size} bytes are no whole records of {RECORD.itemsize}: truncated, or another format")
    rows = np.fromfile(path, dtype=RECORD)
    rgba = torch.from_numpy(rows["rgba"].astype(np.float32)) / 255
    quats = (torch.from_numpy(rows["quats"].astype(np.float32)) - 128) / 128
    quats[torch.from_numpy(rows.view(np.uint8).reshape(-1, RECORD.itemsize) == 0).all(1)] = 0  # a row of zeros
    return Gaussians(
        means=torch.from_numpy(rows["means"].copy()),
        quats=quats / quats.norm(dim=1, keepdim=True).clamp(min=1e-12),  # 0 stays 0
        scales=positive_scales(rows["scales"]),
        opacities=rgba[:, 3].contiguous(),
        sh=((rgba[:, :3] - 0.5) / SH_C0)[:, None],
    )


def write(path: Path, g: Gaussians) -> list[str]:
    """Write the base colours; a quaternion is stored with its largest component negative, since -1 fits and +1 does not."""
    assert g.sh is not None
    quats = unit_quats(g.quats)
    largest = quats.gather(1, quats.abs().argmax(1, keepdim=True))
    quats = torch.where(largest > 0, -quats, quats)
    rgba = torch.cat([0.5 + SH_C0 * g.sh[:, 0], g.opacities[:, None]], 1)
    rows = np.zeros(len(g), RECORD)
    rows["means"], rows["scales"] = g.means.numpy(), g.scales.numpy()
    rows["rgba"] = (rgba.clamp(0, 1) * 255).round().numpy()
    rows["quats"] = (quats * 128 + 128).round().clamp(0, 255).numpy()
    with atomic_path(path) as temporary:
        rows.tofile(temporary)
    return describe_cut(rgba[:, :3], 0.0, 1.0, "colours", ".splat")
