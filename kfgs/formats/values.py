"""Helpers of all formats: checks of values, flipped axes, and descriptions of what a format cannot store."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._check import ORIGIN, as_origin
from .._origin import choose_origin, to_local
from ..gaussians import Gaussians
from .splat_file import SCORE, SplatFile

SH_C0 = 0.28209479177387814  # the constant harmonic: rgb = 0.5 + SH_C0 * coefficient
UP_AND_BACK = (1, -1, -1)  # x right, y up, z back (RUB) against x right, y down, z forward (RDF) of the 3DGS PLY
# Signs of the coefficients under a flip of axes: which of x, y, z each harmonic is odd in, degrees 1 to 3.
_ODD = ("y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")
_TINY_SCALE = 1e-10  # world units, instead of a scale of 0
_SHORTEST = 1e-12  # of a quaternion; kornia divides by no less
EXACT = 1 << 24  # float32 holds all whole numbers up to this one
_LABELS = 2**31 - 1  # the largest int32
_EXPECTED = {
    "means": "finite numbers",
    "quats": "finite numbers, not all 0",
    "scales": "finite numbers above 0",
    "opacities": "numbers from 0 to 1",
    "sh": "finite numbers",
    "features": "finite numbers",
}

_RAW = {
    "scales": "if they are logarithms, as 3DGS trains them, take scales.exp()",
    "opacities": "if they are logits, as 3DGS trains them, take opacities.sigmoid()",
}
"""What to do if most values are out of range."""


def check_finite(path: Path, **values: NDArray[np.float32]) -> None:
    """Raise a ValueError that names the file, the kind of value and the first Gaussian with NaN or infinity."""
    for name, array in values.items():
        bad = ~np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
        if bad.any():
            raise ValueError(
                f"{path}: expected finite {name}, got {array[bad][0].tolist()} at Gaussian {int(bad.argmax())} and at "
                f"{int(bad.sum()) - 1} more; the file is damaged, write it again"
            )


def positive_scales(path: Path, scales: NDArray[np.float32]) -> Tensor:  # [N, 3] float32 > 0
    """Linear scales as read, zeros raised to 1e-10; negative ones are damage (ValueError)."""
    if (scales < 0).any():
        row = int((scales < 0).any(1).argmax())
        raise ValueError(
            f"{path}: expected scales of 0 or more, got {scales[row].tolist()} at Gaussian {row}; the file is damaged, or "
            "of another format"
        )
    return torch.from_numpy(np.where(scales == 0, np.float32(_TINY_SCALE), scales))


def near_zero(g: Gaussians) -> Gaussians:
    """A cloud as read, with its means in float32, counted from an origin if they are far from zero."""
    if g.origin != ORIGIN:  # the file has its own
        return g.replace(means=g.means.float())
    origin = choose_origin(g.means)
    return g.replace(means=to_local(g.means, origin), origin=origin)


def flip_axes(g: Gaussians, axes: tuple[int, int, int]) -> Gaussians:
    """Flip the axes with sign -1: means change sign, rotations become S R S, harmonics change sign by their parity."""
    signs = dict(zip("xyz", axes, strict=True))
    x, y, z = axes
    means, quats = g.means.new_tensor([x, y, z]), g.quats.new_tensor([1, y * z, x * z, x * y])
    sh = None
    if g.sh is not None:
        parity = [float(np.prod([signs[axis] for axis in odd])) for odd in ("", *_ODD)]
        sh = g.sh * g.sh.new_tensor(parity[: g.sh.shape[1]])[:, None]
    place = [value * axis + 0.0 for value, axis in zip(g.origin, axes, strict=True)]  # + 0: no negative zeros
    return g.replace(means=g.means * means + 0.0, quats=g.quats * quats + 0.0, sh=sh, origin=as_origin(place))


def known_quats(quats: Tensor) -> Tensor:  # [N, 4] wxyz twice
    """The quaternions; those of length 0, which are no rotation at all, become the identity, as in the rasteriser."""
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quats.dtype)
    known = quats.norm(dim=1, keepdim=True) > _SHORTEST
    return quats if bool(known.all()) else torch.where(known, quats, identity)


def unit_quats(quats: Tensor) -> Tensor:  # [N, 4] wxyz -> [N, 4] of length 1
    """Quaternions of length 1; those of length 0 become the identity."""
    known = known_quats(quats)
    return known / known.norm(dim=1, keepdim=True)


def check_splats(splats: SplatFile) -> None:
    """Check a cloud before it is written, for the values that readers refuse. They are checked as float32, as stored.

    A quaternion of length 0 is refused, too: other programs divide by its length. In a file, it is read as no rotation.
    Opacities of exactly 0 and 1 are allowed: the PLY, which stores logits, keeps them within 1e-7.

    Raises:
        ValueError: if a value is NaN or infinite, a quaternion is 0, a scale is not positive, an opacity lies outside [0, 1],
            a label is below -1 or none of the named classes, or a labelled Gaussian's score is not finite.
    """
    g = splats.gaussians.detach()
    for name, expected in _EXPECTED.items():
        values = getattr(g, name)
        if values is None:
            continue
        values = values.float()
        good = values.isfinite()
        if name == "quats":
            good &= values.norm(dim=1, keepdim=True) > _SHORTEST
        elif name == "scales":
            good &= values > 0
        elif name == "opacities":
            good &= (values >= 0) & (values <= 1)
        _check_rows(name, expected, values, good)
    for name, column in splats.extra.items():
        if np.asarray(column).dtype.kind not in "biuf":
            raise ValueError(
                f"extra[{name!r:.80}]: expected numbers, got {np.asarray(column).dtype}; number them, or leave the column out"
            )
    if g.labels is None:
        return
    most = len(splats.classes) - 1 if splats.classes else _LABELS
    expected = f"-1 (none) to {most}" + (" (the named classes)" if splats.classes else "")
    if "class_id" in splats.extra:
        raise ValueError(
            "extra['class_id']: expected no such column beside labels, which are stored under that name, got both; leave it out"
        )
    _check_rows("labels", expected, g.labels, (g.labels >= -1) & (g.labels <= most))
    if SCORE in splats.extra:
        score = torch.from_numpy(np.asarray(splats.extra[SCORE], np.float32))
        _check_rows(SCORE, "finite numbers", score, score.isfinite())


def _check_rows(name: str, expected: str, values: Tensor, good: Tensor) -> None:  # [N, ...] twice
    if good.all():
        return
    bad = ~good.reshape(len(good), -1).all(1)
    row = int(bad.nonzero()[0])
    raw = values.isfinite().all() and 2 * int(bad.sum()) > len(bad) and name in _RAW
    advice = _RAW[name] if raw else "correct them, or leave these Gaussians out (in Python: with select)"
    raise ValueError(
        f"{name}: expected {expected} in every Gaussian, got {values[row].flatten()[:4].tolist()} at {row} and others at "
        f"{int(bad.sum()) - 1} more of {len(bad)}; {advice}"
    )


def colours_to_write(gaussians: Gaussians, name: str) -> Gaussians:
    """The cloud in float64 on the CPU, detached; a ValueError if it has no spherical harmonics."""
    if gaussians.sh is None:
        raise ValueError(
            f"splats: expected a cloud with colours (sh [N, K, 3]) for {name}, got {gaussians!r}; write a field without "
            "colours as .ply"
        )
    return gaussians.detach().to("cpu", torch.float64)


def describe_loss(splats: SplatFile, name: str, degree: int) -> tuple[str, ...]:
    """Describe the losses of a format without features, extra columns, and harmonics above a degree."""
    g, lost = splats.gaussians, []
    if g.sh is not None and (have := int(g.sh.shape[1] ** 0.5) - 1) > degree:
        kept = "the base colour only" if degree == 0 else f"degree {degree}"
        lost.append(f"spherical harmonics of degree {have}: {name} holds {kept}")
    if g.features is not None:
        lost.append(f"{g.features.shape[1]} features per Gaussian: {name} has no place for them")
    columns = [key for key in splats.extra if not (key == SCORE and g.labels is not None)]
    if columns:
        lost.append(f"the columns {', '.join(columns)}: {name} has no place for them")
    return tuple(lost)


def describe_cut(values: Tensor, low: float, high: float, what: str, name: str) -> tuple[str, ...]:  # values: [N, ...]
    """Describe the loss of a format that holds values in 256 steps from `low` to `high`: those beyond become the ends."""
    step = (high - low) / 255
    beyond = ((values < low - step) | (values > high + step)).flatten(1).any(1)
    count = int(beyond.sum())
    return (f"{what} of {count} of {len(values)} Gaussians beyond what {name} holds: cut off",) if count else ()


def byte_error(values: Tensor, low: float, high: float) -> float:
    """Largest error of values in 256 even steps from `low` to `high`: half a step, or the largest cut-off."""
    step = (high - low) / 255
    beyond = (values - values.clamp(low, high)).abs().max().item() if values.numel() else 0.0
    return max(step / 2, beyond) * (1 + 1e-4)  # float32 rounding on the way back
