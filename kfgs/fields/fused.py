"""Fused features of a trained field: the mean of the rendered features at the pixels that show a Gaussian; and joined fields.

Training constrains only blends of Gaussians, so the latent of a single Gaussian may decode to something that no view shows.
The mean over its pixels, weighted by w = T alpha, does not have this problem. It is computed once, when a field is finished.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from .._rows import EPS, row_norms, unit_rows
from ..cameras import Camera
from ..gaussians import Gaussians
from ..quant.linear import fit_linear_latents
from ..splat import average_views, rasterize
from .decoders import Autoencoded, Codewords, Linear
from .semantic_field import SemanticField

KEEP, MOST = 0.999, 64  # share of the codewords' variation to keep, with at most this many latents
PIXELS = 80_000  # most pixels of a view that are rendered


def fuse_views(field: SemanticField, cameras: Sequence[Camera]) -> SemanticField:
    """Render a trained field from its training cameras, quantise the pixels, and average them onto the Gaussians they show.

    The result is the field with these `cameras` and the averages as `fused`. A field with a `Linear` decoder is fused
    already, and gets the cameras alone. Without a codebook, rendered features are averaged without quantising.
    """
    if not cameras:
        raise ValueError("cameras: expected at least one, got none; pass those that the field was trained with")
    decoder, gaussians = field.decoder, field.gaussians
    if isinstance(decoder, Linear):
        return replace(field, cameras=tuple(cameras))
    with torch.no_grad():
        if isinstance(decoder, Codewords | Autoencoded):
            rows, weights = decoder.codebook.unit, None
        else:
            rows, weights = unit_rows(field.features), gaussians.opacities
        latents = fit_linear_latents(rows, weights, keep=KEEP, maximum=MOST)
        table = torch.nn.functional.pad(latents.encode(rows), (0, 0, 0, 1)).to(gaussians.means)  # nothing known: zeros

        def show(camera: Camera) -> tuple[Camera, Tensor]:  # [H, W, e]
            factor = min(1.0, (PIXELS / (camera.width * camera.height)) ** 0.5)
            small = camera.resized(max(1, round(camera.height * factor)), max(1, round(camera.width * factor)))
            rendering = rasterize(gaussians, small)
            pixels = rendering.map
            if isinstance(decoder, Codewords | Autoencoded):
                return small, table[decoder.codewords(pixels, rendering.alpha > 0)]
            return small, latents.encode(unit_rows(pixels)) * (row_norms(pixels) > EPS)[..., None]

        means = average_views(gaussians, map(show, cameras)).values
    fused = SemanticField(gaussians.replace(features=means), Linear(latents.basis))
    return replace(field, cameras=tuple(cameras), fused=fused)


def join_fields(fields: Sequence[SemanticField]) -> SemanticField:
    """Fused fields with the same linear latents (`sample_latents`) as one; views that several fields have are kept once."""
    first, bases = fields[0], [part.decoder.to_tensors()["linear.basis"] for part in fields]
    assert all(torch.equal(basis, bases[0]) for basis in bases), "fields with the latents of others"
    cameras = {camera.name: camera for part in fields for camera in part.cameras}
    views = list(dict.fromkeys(name for part in fields for name in part.info.get("views", ())))
    return replace(
        first,
        gaussians=Gaussians.cat([part.gaussians.with_origin(first.gaussians.origin) for part in fields]),
        cameras=tuple(cameras.values()),
        info=first.info | {"views": views},
    )
