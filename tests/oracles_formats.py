"""How far one cloud is from another, value by value, against what a format states; in float64, from the definitions."""

import numpy as np


def rotation_angles(a, b) -> np.ndarray:  # [N, 4] wxyz, any length -> [N] radians
    """The angle between two rotations: twice the angle between their quaternions, whose sign does not matter."""
    a, b = (q.double().numpy() / np.linalg.norm(q.double().numpy(), axis=1, keepdims=True) for q in (a, b))
    near = np.linalg.norm(a - b, axis=1)
    far = np.linalg.norm(a + b, axis=1)
    return 4 * np.arcsin(np.clip(np.minimum(near, far) / 2, 0, 1))  # exact for small angles, unlike arccos


def breaches(before, after, stated) -> list[str]:
    """The values that came back further off than stated; `before` and `after` are in the same order."""
    if len(before) != len(after):
        return [f"{len(after)} Gaussians, not {len(before)}"]
    K = min(before.sh.shape[1], (stated.degree + 1) ** 2)
    if after.sh.shape[1] != K:
        return [f"{after.sh.shape[1]} coefficients, not {K}"]
    old, new = (
        {key: getattr(g, key).double().numpy() for key in ("means", "scales", "opacities", "sh")}
        for g in (before, after)
    )
    means = stated.means if isinstance(stated.means, float) else stated.means.double().numpy()
    off = {
        "means": np.abs(new["means"] - old["means"]) - means,
        "scales": np.abs(new["scales"] / old["scales"] - 1) - stated.scales * (1 + 1e-6),  # float32 in the ratio
        "opacities": np.abs(new["opacities"] - old["opacities"]) - stated.opacities,
        "sh0": np.abs(new["sh"][:, :1] - old["sh"][:, :1]) - stated.sh0,
        "sh_rest": np.abs(new["sh"][:, 1:K] - old["sh"][:, 1:K]) - stated.sh_rest,
        "rotation": rotation_angles(before.quats, after.quats) - stated.rotation,
    }
    return [f"{key}: {v.max():.3g} beyond what is stated" for key, v in off.items() if v.size and not v.max() <= 0]
