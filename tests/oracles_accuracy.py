"""Compositing and its gradients over all (pixel, Gaussian) pairs in numpy float64, with what rounding may do to them.

Written from the text of `kfgs.splat.engines.contract`, one Gaussian after another, front to back, for all pixels at once.
Beside the values it follows, to first order, how far an engine of a given rounding unit can be off for reasons that lie
in the data: terms of the power of the density that cancel, and decisions that lie on one of the three thresholds.
"""

from typing import NamedTuple

import numpy as np

ALPHA_MAX, ALPHA_MIN, T_MIN = 0.99, 1 / 255, 1e-4
ROUNDINGS = 4  # of a term of the power: the difference, its two factors, the conic's scale
DECISION = 16  # roundings within which a comparison may fall either way


class Scene(NamedTuple):
    """What is composited; float64 arrays that hold numbers of the engine's precision."""

    means2d: np.ndarray  # [M, 2]
    conics: np.ndarray  # [M, 3]
    depths: np.ndarray  # [M]
    opacities: np.ndarray  # [M]
    features: np.ndarray  # [M, D]
    background: np.ndarray  # [D]
    width: int
    height: int


class Look(NamedTuple):
    """One Gaussian at all pixels; [H * W] each."""

    dx: np.ndarray
    dy: np.ndarray
    full: np.ndarray  # opacity * density
    log_full: np.ndarray
    error: np.ndarray  # of `full`, relative, from terms of its power that cancel
    doubt: np.ndarray  # relative distance from a threshold within which a decision may fall either way


class Layer(NamedTuple):
    """One Gaussian as it is composited; [H * W] each."""

    row: int
    look: Look
    alpha: np.ndarray  # 0 where it is not drawn
    before: np.ndarray  # transmittance
    sloped: np.ndarray  # bool: whether alpha has a gradient


class Composited(NamedTuple):
    """Values and how far off rounding may bring them. Pixels are flat: [H * W]."""

    maps: np.ndarray  # [H * W, D]
    alphas: np.ndarray
    allowance: np.ndarray  # what the weights may be off by, all together
    on_threshold: np.ndarray  # bool: alpha on 1/255 or T' on 1e-4
    on_clamp: np.ndarray  # bool: opacity * density on 0.99, where the gradient jumps
    layers: list[Layer]  # front to back
    left: np.ndarray  # transmittance in the end
    left_error: np.ndarray  # of it, relative


def _look(scene: Scene, row: int, centers: np.ndarray, unit: float) -> Look:
    """Point 1 of the contract, for pixel centres [2, H * W]."""
    dx, dy = centers - scene.means2d[row][:, None]
    a, b, c = scene.conics[row]
    cross = b * dx * dy
    power = 0.5 * (a * dx * dx + c * dy * dy) + cross
    cancels = np.where(cross < 0, -2 * cross, 0)  # by how much the sum of |terms| exceeds the power
    log_full = np.log(scene.opacities[row]) - power
    doubt = DECISION * unit * (1 + np.abs(power) + cancels)
    return Look(dx, dy, np.exp(log_full), log_full, np.expm1(np.minimum(ROUNDINGS * unit * cancels, 9)), doubt)


def composite(scene: Scene, unit: float) -> Composited:
    """Points 2 to 4 of the contract, for arithmetic with the rounding unit `unit` (2^-24 for float32)."""
    i, j = np.mgrid[: scene.height, : scene.width]
    centers, pixels = np.stack([j.ravel() + 0.5, i.ravel() + 0.5]), i.size
    maps, left, left_error, allowance = (
        np.zeros((pixels, scene.features.shape[1])),
        np.ones(pixels),
        *np.zeros((2, pixels)),
    )
    stopped, on_threshold, on_stop, on_clamp = np.zeros((4, pixels), bool)
    layers = []
    for row in sorted(range(len(scene.depths)), key=lambda m: (scene.depths[m], m)):
        look = _look(scene, row, centers, unit)
        taken = ~stopped & (look.full >= ALPHA_MIN)
        on_min = ~stopped & (np.abs(look.log_full - np.log(ALPHA_MIN)) <= look.doubt)
        if not (taken | on_min).any():
            continue
        alpha = np.minimum(look.full, ALPHA_MAX)
        after = left * (1 - alpha)
        stopping = taken & (after < T_MIN)
        drawn = taken & ~stopping

        # by how much alpha may be off, and T behind it
        sloped = look.full <= ALPHA_MAX
        change = np.where(on_min, np.maximum(alpha, ALPHA_MIN) * (1 + look.error), alpha * look.error)
        change = np.where((look.full <= ALPHA_MAX * (1 + look.error)) & (drawn | on_min), change, 0)
        next_error = left_error + change / (1 - alpha)
        allowance += left * change
        # a pixel may stop here, or not: all the light that is left may go one way or the other
        doubt = next_error + DECISION * unit * (1 + len(layers) + 1 / (1 - alpha))
        may_stop = (taken | on_min) & (np.abs(np.log(after / T_MIN)) <= doubt) & ~on_stop
        allowance += left * may_stop
        on_stop |= may_stop
        on_threshold |= on_min | may_stop
        on_clamp |= taken & (np.abs(look.log_full - np.log(ALPHA_MAX)) <= look.doubt)

        shown = np.where(drawn, alpha, 0)
        layers.append(Layer(row, look, shown, left, drawn & sloped))
        maps += (shown * left)[:, None] * scene.features[row]
        left, left_error = np.where(drawn, after, left), next_error
        stopped |= stopping
    maps += left[:, None] * scene.background
    return Composited(maps, 1 - left, allowance, on_threshold, on_clamp, layers, left, left_error)


class Gradients(NamedTuple):
    """A gradient for every input, or an allowance for every one."""

    means2d: np.ndarray
    conics: np.ndarray
    opacities: np.ndarray
    features: np.ndarray
    background: np.ndarray


def differentiate(
    scene: Scene, seen: Composited, cotangents: tuple[np.ndarray, np.ndarray], unit: float, *, from_outputs: bool
) -> tuple[Gradients, Gradients]:
    """Gradients of sum(maps * cotangents[0]) + sum(alphas * cotangents[1]), and what rounding may do to them.

    The allowance is the sum, over the pixels, of the *absolute* contributions times their relative error: that of the
    transmittance and the alphas (terms that cancel), and a few roundings of the contribution itself. `from_outputs` is
    for an engine whose backward pass starts from the maps and alphas that the forward pass returned: it finds the
    transmittance at the end as 1 - alpha, and what lies behind a Gaussian as the rest of the whole. Both are known to a
    rounding of the *whole*, and the rest is then multiplied by alpha / (1 - alpha), up to 99.
    """
    grad_maps, grad_alphas = cotangents
    grads, allowances = (Gradients(*(np.zeros(value.shape) for value in _inputs(scene))) for _ in range(2))
    own, size_own = scene.features @ grad_maps.T, np.abs(scene.features) @ np.abs(grad_maps.T)  # [M, H * W]
    behind = seen.left * (grad_maps @ scene.background - grad_alphas)  # what the loss gets from behind the Gaussian
    size_last = np.abs(grad_maps) @ np.abs(scene.background) + np.abs(grad_alphas)
    size_behind = seen.left * size_last
    whole = sum((k.alpha * k.before * size_own[k.row] for k in seen.layers), size_last)
    whole = ROUNDINGS * unit * whole * from_outputs
    relative = seen.left_error + DECISION * unit
    grads.background[:] = seen.left @ grad_maps
    allowances.background[:] = (relative * seen.left + unit * from_outputs) @ np.abs(grad_maps)
    for layer in reversed(seen.layers):
        row, alpha, dx, dy = layer.row, layer.alpha, layer.look.dx, layer.look.dy
        (a, b, c), opacity, error = scene.conics[row], scene.opacities[row], layer.look.error
        weight, ratio = alpha * layer.before, alpha / (1 - alpha)
        # maps = ... + T alpha f + T (1 - alpha) * (what is behind, per unit of light)
        v = np.where(layer.sloped, weight * own[row] - ratio * behind, 0)  # slope in log(alpha)
        size = (weight * size_own[row] + ratio * size_behind) * (relative + error / (1 - alpha))
        size = np.where(layer.sloped, size + ratio * whole, 0)
        grads.opacities[row] = v.sum() / opacity
        grads.means2d[row] = (v * (a * dx + b * dy)).sum(), (v * (b * dx + c * dy)).sum()
        grads.conics[row] = -(v * dx * dx).sum() / 2, -(v * dx * dy).sum(), -(v * dy * dy).sum() / 2
        grads.features[row] = weight @ grad_maps
        allowances.opacities[row] = size.sum() / opacity
        allowances.conics[row] = (size * dx * dx).sum() / 2, (size * np.abs(dx * dy)).sum(), (size * dy * dy).sum() / 2
        x, y = np.abs(dx), np.abs(dy)
        allowances.means2d[row] = (size * (a * x + abs(b) * y)).sum(), (size * (abs(b) * x + c * y)).sum()
        allowances.features[row] = (weight * (relative + error)) @ np.abs(grad_maps)
        behind = behind + weight * own[row]
        size_behind = size_behind + weight * size_own[row]
    return grads, allowances


def accumulate(scene: Scene, seen: Composited, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """weights^T . pixels [M, D] and the sum of the weights [M]."""
    sums, weights = np.zeros((len(scene.depths), pixels.shape[1])), np.zeros(len(scene.depths))
    for layer in seen.layers:
        sums[layer.row] = (layer.alpha * layer.before) @ pixels
        weights[layer.row] = (layer.alpha * layer.before).sum()
    return sums, weights


def _inputs(scene: Scene) -> tuple[np.ndarray, ...]:
    return scene.means2d, scene.conics, scene.opacities, scene.features, scene.background
