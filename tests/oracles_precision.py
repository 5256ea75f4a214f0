"""How exactly a cloud comes back from each format, and whether it does. Comparisons are written in numpy float64."""

import math
from typing import NamedTuple

import numpy as np
import torch

from kfgs.formats.compressed_ply import half_steps
from kfgs.formats.encodings import fit_codebook, morton_order, nearest_codes
from kfgs.formats.sog import encode_rest, position_errors
from kfgs.formats.spz import choose_fractional_bits
from kfgs.gaussians import Gaussians

SH_C0 = 0.28209479177387814
BYTE = 0.5 / 255 + 1e-6


class Precision(NamedTuple):
    """The largest error of a value that was written and read again."""

    means: float | torch.Tensor  # world units, per axis: one number, or [N, 3]
    scales: float  # relative, of each standard deviation
    rotation: float  # radians between the rotations
    opacities: float  # absolute
    sh0: float  # absolute, of the degree-0 coefficients
    sh_rest: float  # absolute, of the higher coefficients
    degree: int = 3  # highest degree of spherical harmonics


def precision(name: str, cloud: Gaussians) -> Precision:
    return _PRECISIONS[name](cloud.detach().to("cpu", torch.float64))


def _smallest_three(steps: int) -> float:
    """The largest angle between a rotation and its three components in steps.

    Each is off by d = sqrt(2) / steps / 2 at most. The largest, m >= 1/2, is off by (a . e) / m, which is at most 3 d (all
    four components 1/2); the quaternion then by sqrt(12) d, the rotation by twice that.
    """
    return 2 * math.sqrt(12) * math.sqrt(2) / steps / 2 * 1.02 + 1e-5  # second order, and float32


def _bytes(values: torch.Tensor, low: float, high: float) -> float:
    """Values in 256 even steps from `low` to `high`: half a step, or the largest cut-off."""
    beyond = (values - values.clamp(low, high)).abs().max().item() if values.numel() else 0.0
    return max((high - low) / 255 / 2, beyond) * (1 + 1e-4)  # float32 rounding on the way back


def _codes(values: np.ndarray) -> float:
    book = fit_codebook(values)
    return float(np.abs(book[nearest_codes(book, values)] - values).max(initial=0.0))


def _splat(g: Gaussians) -> Precision:
    return Precision(0.0, 1e-6, 0.016, BYTE, _bytes(g.sh[:, 0], -0.5 / SH_C0, 0.5 / SH_C0), 0.0, degree=0)


def _spz(g: Gaussians) -> Precision:
    reach = g.means.abs().max().item() if len(g) else 0.0
    logs = g.scales.log()
    cut = (logs - logs.clamp(-10, 255 / 16 - 10)).abs().max().item() if len(g) else 0.0
    return Precision(
        means=0.5 * 2.0 ** -choose_fractional_bits(g.means) * (1 + 1e-4) + 1e-6 * reach,
        scales=math.expm1(max(1 / 32, cut)) * (1 + 1e-5) + 1e-4,
        rotation=0.005,  # 2 x sqrt(3 + 3^2) half steps of sqrt(0.5) / 511
        opacities=BYTE,
        sh0=_bytes(g.sh[:, :1], -0.5 / 0.15, 0.5 / 0.15),
        sh_rest=_bytes(g.sh[:, 1:], -1.0, 127 / 128) + 1e-5,
    )


def _sog(g: Gaussians) -> Precision:
    means, g = position_errors(g.means.numpy()), g.select(morton_order(g.means))
    rest = 0.0
    if g.sh.shape[1] > 1 and len(g):
        book, codes, labels = encode_rest(g.sh)
        rest = float((torch.from_numpy(book[codes])[labels] - g.sh[:, 1:].flatten(1)).abs().max())
    scales, sh0 = math.expm1(_codes(g.scales.log().numpy())) + 1e-5, _codes(g.sh[:, 0].numpy()) + 1e-6
    return Precision(means, scales, _smallest_three(255), BYTE, sh0, rest + 1e-6)


def _compressed_ply(g: Gaussians) -> Precision:
    """Half a step between the bounds of the chunks in Morton order, plus what the fixed ranges cut off."""
    order = morton_order(g.means)
    g, means = g.select(order), torch.empty(len(g), 3, dtype=torch.float64)
    steps, logs = np.array([2047, 1023, 2047], np.float32), g.scales.log().numpy()
    means[order] = torch.from_numpy(half_steps(g.means.numpy(), steps))
    scales = half_steps(logs.clip(-20, 20), steps) + np.abs(logs.clip(-20, 20) - logs)
    colors = half_steps((g.sh[:, 0] * SH_C0 + 0.5).numpy(), np.full(3, 255, np.float32))
    strongest = float(g.sh[:, 1:].abs().max()) if g.sh.shape[1] > 1 and len(g) else 0.0
    return Precision(
        means=means,
        scales=math.expm1(min(float(scales.max(initial=0.0)), 700.0)) * (1 + 1e-5) + 1e-6,
        rotation=_smallest_three(1023),
        opacities=BYTE,
        sh0=float(colors.max(initial=0.0)) / SH_C0 + 1e-6,
        sh_rest=max(1 / 64 if strongest < 4 - 1 / 32 else 1 / 32, strongest - 4)
        + 1e-6,  # the outermost steps are the ends
    )


_PRECISIONS = {
    "ply": lambda g: Precision(0.0, 1e-5, 1e-3, 1e-5, 0.0, 0.0),
    "gltf": lambda g: Precision(0.0, 1e-6, 1e-3, 1e-7, 0.0, 0.0),
    "splat": _splat,
    "spz": _spz,
    "sog": _sog,
    "compressed_ply": _compressed_ply,
}


def rotation_angles(a, b) -> np.ndarray:  # [N, 4] twice, of any length -> [N] radians
    """Angle between two rotations; q and -q are one. Half the angle is asin(|a -+ b| / 2) * 2 for unit quaternions."""
    a, b = (np.asarray(q, np.float64) for q in (a, b))
    a = a / np.linalg.norm(a, axis=1, keepdims=True)
    b = b / np.linalg.norm(b, axis=1, keepdims=True)
    chord = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    return 4 * np.arcsin(np.minimum(chord / 2, 1))  # exact for small angles, unlike arccos


def breaches(back: Gaussians, cloud: Gaussians, stated: Precision) -> list[str]:
    """The values of `back` that are further off than stated from those of `cloud`, which is in the same order."""
    if len(back) != len(cloud):
        return [f"{len(back)} Gaussians, not {len(cloud)}"]
    kept = min((stated.degree + 1) ** 2, cloud.sh.shape[1])
    if back.sh.shape[1] != kept:
        return [f"{back.sh.shape[1]} coefficients, not {kept}"]
    names = ("means", "quats", "scales", "opacities", "sh")
    new, old = ({name: getattr(g, name).detach().double().numpy() for name in names} for g in (back, cloud))
    off = {
        "means": np.abs(new["means"] - old["means"]) - np.asarray(stated.means, np.float64),
        "scales": np.abs(new["scales"] / old["scales"] - 1) - stated.scales,
        "rotation": rotation_angles(new["quats"], old["quats"]) - stated.rotation,
        "opacities": np.abs(new["opacities"] - old["opacities"]) - stated.opacities,
        "sh0": np.abs(new["sh"][:, 0] - old["sh"][:, 0]) - stated.sh0,
        "sh_rest": np.abs(new["sh"][:, 1:] - old["sh"][:, 1:kept]) - stated.sh_rest,
    }
    return [f"{name}: {v.max():.3g} beyond what is stated" for name, v in off.items() if v.size and not v.max() <= 0]


def assert_within(back: Gaussians, cloud: Gaussians, stated: Precision) -> None:
    """Fail unless `back` is `cloud` in the same order, as exactly as stated."""
    assert breaches(back, cloud, stated) == []
