"""Two splat clouds side by side: is each value as close as a format says it is? Written in numpy float64."""

import numpy as np

from kfgs.formats.values import Precision
from kfgs.gaussians import Gaussians


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
