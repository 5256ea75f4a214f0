"""The fused feature of each Gaussian: the mean of the rendered features at the pixels that show it, over the training views.

Training constrains only blends of Gaussians, so the latent of a single Gaussian may decode to something that no view shows.
The mean over its pixels, weighted by w = T alpha, does not have this problem. It is computed once, when a field is finished;
later no camera is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .._card import short_repr
from .._rows import EPS, row_norms, unit_rows
from .._typed import typed
from ..cameras import Camera
from ..gaussians import Gaussians
from ..labels import nearest_codeword
from ..labels.views import average_shown
from ..quant import Autoencoder, Codebook, LinearLatents, fit_linear_latents
from ..splat import rasterize

KEEP, MOST = 0.999, 64  # share of the codewords' variation to keep, with at most so many latents
CHUNK = 8192  # pixels quantised at once
PIXELS = 80_000  # most pixels of a view that are rendered


class Seen(NamedTuple):
    """How well the training views show each Gaussian."""

    pixels: Tensor  # [N] number of pixels that it fills, in all training views
    agreement: Tensor  # [N] in [0, 1]: length of the mean of the unit features at its pixels

    def __repr__(self) -> str:
        return short_repr(self)

    def to(self, *args: Any, **kwargs: Any) -> Seen:
        """Both on another device or in another dtype, as `torch.Tensor.to`."""
        return Seen(*(value.to(*args, **kwargs) for value in self))


class Answers(NamedTuple):
    """Each Gaussian's fused feature."""

    latents: Tensor  # [N, e], all-zero where no view shows the Gaussian
    linear: LinearLatents
    seen: Seen

    def __repr__(self) -> str:
        return short_repr(self)


@typed
def fused_answers(
    gaussians: Gaussians, codebook: Codebook | None, autoencoder: Autoencoder | None, cameras: Sequence[Camera]
) -> Answers:
    """Render a trained field from each camera, quantise the pixels, and average them onto the Gaussians that they show.

    Args:
        gaussians: with the field's latents.
        codebook: S; None: the rendered features are averaged without quantising.
        autoencoder: E and Psi, or None.
        cameras: at least one; the training cameras.
    """
    assert gaussians.features is not None
    with torch.no_grad():
        if codebook is None:
            linear = fit_linear_latents(unit_rows(gaussians.features), gaussians.opacities, keep=KEEP, maximum=MOST)
            table, centres = None, None
        else:
            linear = fit_linear_latents(codebook.unit, keep=KEEP, maximum=MOST)
            table = linear.encode(codebook.unit).to(gaussians.means)
            centres = None if autoencoder is None else autoencoder.encode(codebook.codewords).to(gaussians.means)

        def shown(camera: Camera) -> Tensor:  # [H, W, e]
            rendering = rasterize(gaussians, camera)
            pixels = rendering.map.flatten(0, 1)
            parts = pixels.split(CHUNK)
            if codebook is None or table is None:
                rows = torch.cat([linear.encode(unit_rows(part)) for part in parts])
            elif centres is None:
                rows = table[torch.cat([codebook.quantize(part) for part in parts])]
            else:
                rows = table[torch.cat([nearest_codeword(part, centres) for part in parts])]
            something = rendering.alpha > 0 if centres is not None else row_norms(pixels).view(camera.size) > EPS
            return rows.view(*camera.size, -1) * something[..., None]

        small = [_shrunk(camera) for camera in cameras]
        mean = average_shown(gaussians, small, lambda camera: (camera, shown(camera)))
        length = torch.linalg.vector_norm(mean.values, dim=1)
        scale = sum(a.width * a.height for a in cameras) / max(1, sum(b.width * b.height for b in small))
    return Answers(mean.values, linear, Seen(mean.weights * scale, length.clamp_max(1)))


def _shrunk(camera: Camera) -> Camera:
    factor = min(1.0, (PIXELS / (camera.width * camera.height)) ** 0.5)
    return camera.resized(max(1, round(camera.height * factor)), max(1, round(camera.width * factor)))
