"""Two splat clouds side by side: is each value as close as a format says it is? Written in numpy float64."""

import numpy as np

from kfgs.formats import Precision
from kfgs.gaussians import Gaussians


def rotation_angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:  # [N, 4] twice -> [N] radians
    """Angle between two rotations; q and -q are one. Half the angle is asin(|a -+ b| / 2) * 2 for unit quaternions."""
    a = a / np.linalg.norm(a, axis=1, keepdims=True)
    b = b / np.linalg.norm(b, axis=1, keepdims=True)
    chord = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    return 4 * np.arcsin(chord / 2)


def assert_within(back: Gaussians, cloud: Gaussians, precision: Precision) -> None:
    """Fail unless `back` is `cloud` in the same order, as exactly as `precision` says."""
    a, b = (
        {name: t.detach().double().numpy() for name, t in g._tensors().items() if name != "labels"}
        for g in (back, cloud)
    )
    assert len(back) == len(cloud)
    means = np.broadcast_to(np.asarray(precision.means, np.float64), a["means"].shape)
    assert (np.abs(a["means"] - b["means"]) <= means).all()
    assert np.abs(a["scales"] / b["scales"] - 1).max(initial=0) <= precision.scales
    assert rotation_angles(a["quats"], b["quats"]).max(initial=0) <= precision.rotation
    assert np.abs(a["opacities"] - b["opacities"]).max(initial=0) <= precision.opacities
    assert np.abs(a["sh"][:, 0] - b["sh"][:, 0]).max(initial=0) <= precision.sh0
    kept = min((precision.degree + 1) ** 2, b["sh"].shape[1])
    assert a["sh"].shape[1] == kept
    assert np.abs(a["sh"][:, 1:] - b["sh"][:, 1:kept]).max(initial=0) <= precision.sh_rest
