"""Splatting written from the equations, one Gaussian and one pixel at a time, in numpy float64."""

from math import exp, factorial, log, pi, sqrt

import numpy as np
from scipy.special import lpmv


def rotation(quat):
    """Rotation matrix of a quaternion (w, x, y, z): the columns are the images of the axes under v -> q v q*."""
    w, x, y, z = np.asarray(quat, float) / np.linalg.norm(quat)

    def product(p, q):
        return np.array(
            [
                p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
                p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
                p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
                p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
            ]
        )

    axes = [product(product([w, x, y, z], [0, *axis]), [w, -x, -y, -z])[1:] for axis in np.eye(3)]
    return np.array(axes).T


def covariance(quat, scale):
    """Sigma = R S S^T R^T."""
    R, S = rotation(quat), np.diag(np.asarray(scale, float))
    return R @ S @ S.T @ R.T


def project(mean, quat, scale, viewmat, K, width, height, low_pass=0.3, margin=1.3):
    """Mean [2], covariance [2, 2] and depth of one Gaussian on the image plane (EWA, linearised within the margin)."""
    fx, fy, cx, cy = K[0][0], K[1][1], K[0][2], K[1][2]
    W = np.asarray(viewmat, float)[:3, :3]
    x, y, z = W @ np.asarray(mean, float) + np.asarray(viewmat, float)[:3, 3]
    left, right = (0 - cx) / fx, (width - cx) / fx  # tangents of the picture's borders
    top, bottom = (0 - cy) / fy, (height - cy) / fy
    tx = np.clip(x / z, left - (margin - 1) * (right - left) / 2, right + (margin - 1) * (right - left) / 2)
    ty = np.clip(y / z, top - (margin - 1) * (bottom - top) / 2, bottom + (margin - 1) * (bottom - top) / 2)
    J = np.array([[fx / z, 0, -fx * tx / z], [0, fy / z, -fy * ty / z]])
    cov = J @ W @ covariance(quat, scale) @ W.T @ J.T + low_pass * np.eye(2)
    return np.array([fx * x / z + cx, fy * y / z + cy]), cov, z


def compensation(*gaussian_and_camera):
    """Mip-Splatting's factor of the opacity, sqrt(det S / det(S + 0.3 I)); the arguments of `project`."""
    plain, widened = (project(*gaussian_and_camera, low_pass=width)[1] for width in (0.0, 0.3))
    return sqrt(np.linalg.det(plain) / np.linalg.det(widened))


def alpha_at(x, y, mean, conic, opacity):
    """min(0.99, opacity * density) at a point, 0 where that is below 1/255."""
    dx, dy = x - mean[0], y - mean[1]
    a, b, c = conic
    alpha = min(0.99, opacity * exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy)))
    return alpha if alpha >= 1 / 255 else 0.0


def surfel_alpha(x, y, mean, quat, sides, opacity, viewmat, K):
    """Alpha of a 2-D Gaussian at a point of the picture: where the ray meets its plane, but at least a blob (2DGS, eq. 11)."""
    R, W = rotation(quat), np.asarray(viewmat, float)[:3, :3]
    center = W @ np.asarray(mean, float) + np.asarray(viewmat, float)[:3, 3]
    (u, v, normal), ray = (W @ R).T, np.linalg.inv(K) @ [x, y, 1.0]
    at = ray * (center @ normal) / (ray @ normal) - center
    middle = K @ center / center[2]
    form = min((at @ u / sides[0]) ** 2 + (at @ v / sides[1]) ** 2, 2 * (x - middle[0]) ** 2 + 2 * (y - middle[1]) ** 2)
    return opacity * exp(-0.5 * form)


def composite(means2d, conics, depths, opacities, features, width, height, background=None):
    """maps [H, W, D] and alphas [H, W], pixel by pixel over all Gaussians in order of depth, then index."""
    M, D = features.shape
    order = sorted(range(M), key=lambda g: (depths[g], g))
    maps, alphas = np.zeros((height, width, D)), np.zeros((height, width))
    for i in range(height):
        for j in range(width):
            T = 1.0
            for g in order:
                alpha = alpha_at(j + 0.5, i + 0.5, means2d[g], conics[g], opacities[g])
                if alpha == 0.0:
                    continue
                if T * (1 - alpha) < 1e-4:
                    break
                maps[i, j] += T * alpha * features[g]
                T *= 1 - alpha
            alphas[i, j] = 1 - T
            if background is not None:
                maps[i, j] += T * background
    return maps, alphas


def render(means, quats, scales, opacities, features, viewmat, K, width, height, near=0.2, background=None):
    """From 3-D to a map: every Gaussian beyond `near` is projected and tried at every pixel."""
    flat = [project(m, q, s, viewmat, K, width, height) for m, q, s in zip(means, quats, scales, strict=True)]
    seen = [g for g in range(len(flat)) if flat[g][2] > near]
    means2d = np.array([flat[g][0] for g in seen]).reshape(-1, 2)
    depths = [flat[g][2] for g in seen]
    inverses = [np.linalg.inv(flat[g][1]) for g in seen]
    conics = np.array([(C[0, 0], C[0, 1], C[1, 1]) for C in inverses]).reshape(-1, 3)
    return composite(means2d, conics, depths, opacities[seen], features[seen], width, height, background)


def smallest_in_rectangle(conic, left, right, top, bottom):
    """Minimum of a x^2 + 2 b x y + c y^2 over a rectangle: 0 inside, else on one of the four sides."""
    a, b, c = conic
    if left <= 0 <= right and top <= 0 <= bottom:
        return 0.0
    values = []
    for x in (left, right):
        y = min(max(-b * x / c, top), bottom)
        values.append(a * x * x + 2 * b * x * y + c * y * y)
    for y in (top, bottom):
        x = min(max(-b * y / a, left), right)
        values.append(a * x * x + 2 * b * x * y + c * y * y)
    return min(values)


def reach(opacity):
    """Largest d^T C d at which alpha >= 1/255."""
    return 2 * log(255 * opacity)


def real_harmonic(degree, order, direction):
    """Real spherical harmonic with Condon-Shortley phase, from scipy's associated Legendre functions."""
    x, y, z = np.asarray(direction, float) / np.linalg.norm(direction)
    m, azimuth = abs(order), np.arctan2(y, x)
    size = sqrt((2 * degree + 1) / (4 * pi) * factorial(degree - m) / factorial(degree + m))
    value = size * lpmv(m, degree, z)
    if order == 0:
        return value
    return sqrt(2) * value * (np.cos(m * azimuth) if order > 0 else np.sin(m * azimuth))
