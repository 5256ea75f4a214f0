"""Clouds in axes that point the other way: y up and z back, as in SPZ and glTF, against y down and z forward here."""

from __future__ import annotations

import numpy as np

from ..gaussians import Gaussians

UP_AND_BACK = (1, -1, -1)  # x right, y up, z back (RUB) against x right, y down, z forward (RDF) of the 3DGS PLY
# Signs of the coefficients under a flip of axes: which of x, y, z each harmonic is odd in, degrees 1 to 3.
_ODD = ("y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")


def flip_axes(g: Gaussians, axes: tuple[int, int, int]) -> Gaussians:
    """The same cloud with some axes turned around: means by their signs, quaternions as S R S, harmonics by parity."""
    sign = dict(zip("xyz", axes, strict=True))
    x, y, z = axes
    means, quats = g.means.new_tensor([x, y, z]), g.quats.new_tensor([1, y * z, x * z, x * y])
    sh = None
    if g.sh is not None:
        parity = [float(np.prod([sign[axis] for axis in odd])) for odd in ("", *_ODD)]
        sh = g.sh * g.sh.new_tensor(parity[: g.sh.shape[1]])[:, None]
    return g.replace(means=g.means * means + 0.0, quats=g.quats * quats + 0.0, sh=sh)  # + 0: no negative zeros
