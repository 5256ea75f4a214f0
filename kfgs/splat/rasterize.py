"""From Gaussians and a camera to a map: project, bin, composite."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .._card import html_card, short_value
from .._check import as_array
from ..cameras import Camera, Cameras, as_cameras
from ..cameras.camera import check_camera
from ..gaussians import Gaussians, check_gaussians
from .engines import composite, rank_channels
from .engines.contract import Engine, Ranked
from .engines.table import choose_projecting
from .project import Projected, project
from .tiles import bin_tiles
from .views import divide_sums

LAYERS = 32  # of `Rendering.depth`; 64 change it by less than 0.002 m


class Rendering(NamedTuple):
    """What a camera sees. Of B cameras, tensors have B as their first axis, and `projected` is a list."""

    map: Tensor  # [H, W, D] features, or red, green, blue
    alpha: Tensor  # [H, W] opacity in [0, 1): 1 - transmittance
    projected: Projected  # the visible Gaussians on the image plane

    @property
    def depth(self) -> Tensor:  # [H, W]
        """The median depth z of each pixel, world units: half of its opacity is nearer. 0 where nothing is drawn; no gradient.

        The rendering weights are summed in 32 layers of equally many Gaussians; the layer where half is reached gives its mean
        depth. On a colour field of the toy room half of the pixels are within 0.05 m (by the mean of all depths: 0.07 m).
        """
        if self.alpha.ndim == 3:
            return torch.stack([view.depth for view in map(Rendering, *self)])  # type: ignore[arg-type]
        seen, (height, width) = self.projected, self.alpha.shape
        if not len(seen.depths):
            return torch.zeros_like(self.alpha)
        with torch.no_grad():
            ends = seen.depths.sort().values[len(seen.depths) * torch.arange(1, LAYERS) // LAYERS]
            layers = torch.eye(LAYERS).to(ends)[torch.bucketize(seen.depths, ends)]  # [M, 32]: 1 in its own
            both = torch.cat([layers, layers * seen.depths[:, None]], dim=1)
            tiles = bin_tiles(seen, width, height)
            weights, sums = composite(seen.means2d, seen.conics, seen.opacities, both, tiles)[0].split(LAYERS, dim=-1)
            half = (weights.cumsum(-1) < self.alpha[..., None] / 2).sum(-1, keepdim=True).clamp(max=LAYERS - 1)
            return divide_sums(sums.gather(-1, half), weights.gather(-1, half))[..., 0]

    def to_numpy(self) -> np.ndarray[Any, Any]:  # [H, W, D]
        """The map as a NumPy array, from any device and without its gradient."""
        return as_array(self.map)

    def __repr__(self) -> str:
        return f"Rendering(map {short_value(self.map)}, {self._count} Gaussians in sight)"

    @property
    def _count(self) -> int:
        views: Any = [self.projected] if self.alpha.ndim == 2 else self.projected
        return sum(len(seen.index) for seen in views)

    def _repr_html_(self) -> str:
        height, width, channels = self.map.shape[-3:]
        facts = {
            "size": f"{width} x {height} pixels",
            "channels": channels,
            "numbers": short_value(self.map),
            "covered": f"{float((self.alpha.detach() > 0.5).float().mean()):.1%} of the pixels are more than half opaque",
            "Gaussians in sight": self._count,
        }
        return html_card("Rendering", facts)


def rasterize(
    gaussians: Gaussians,
    camera: Cameras,
    *,
    background: Tensor | None = None,  # [D]
    engine: str = "auto",
    near: float | None = None,
) -> Rendering:
    """Render the Gaussians' features, or their colour where they have no features.

    Colour comes from `gaussians.sh` along the direction from the camera to each mean. `projected.means2d` is part of the
    graph: a caller may call `projected.means2d.retain_grad()` before the backward pass (densification does).

    Args:
        gaussians: with `features` or `sh`.
        camera: a pinhole; undistort a picture from a distorting lens first. Several of one size (a list, kornia's
            `PinholeCamera` of batch B) are drawn one after the other; `kfgs.nn.GaussianRenderer` gives them as [B, D, H, W].
        background: what shows through, zeros if None; one value per channel.
        engine: see `composite`.
        near: smallest depth that is drawn, world units; None takes the camera's.

    Returns:
        The map, its opacity, and the projected Gaussians; differentiable in all tensors of `gaussians` and in
        `background`. Without a visible Gaussian the map is the background.

    Raises:
        TypeError: if `gaussians` or `camera` is something else.
        ValueError: if there is nothing to render with, tensors differ in dtype or device, the camera has distortion, or
            `background` has another number of channels.
        ImportError: if a named engine is missing.

    Example:
        >>> import torch
        >>> camera = Camera(torch.eye(4), torch.tensor([[10.0, 0, 2], [0, 10, 2], [0, 0, 1]]), 4, 4)
        >>> shape = {"quats": torch.tensor([[1.0, 0, 0, 0]]), "scales": torch.full((1, 3), 0.1), "opacities": torch.tensor([0.5])}
        >>> ball = Gaussians(means=torch.tensor([[0.0, 0.0, 2.0]]), features=torch.tensor([[1.0, 2.0]]), **shape)
        >>> rendering = rasterize(ball, camera, engine="reference")
        >>> rendering.map.shape, rendering.alpha[1, 1] > rendering.alpha[0, 0]
        (torch.Size([4, 4, 2]), tensor(True))
    """
    if not isinstance(camera, Camera):
        views = as_cameras(camera, "draw at least one", one_size=True)
        options: Any = {"background": background, "engine": engine, "near": near}
        maps, alphas, seen = zip(*(rasterize(gaussians, view, **options) for view in views), strict=True)
        return Rendering(torch.stack(maps), torch.stack(alphas), list(seen))  # type: ignore[arg-type]
    _check_arguments(gaussians, camera)
    if gaussians.features is None and gaussians.sh is None:
        raise ValueError("gaussians: expected features or sh to render, got neither; add them with gaussians.replace()")
    projected = project(gaussians, camera, near=near, engine=engine)
    tiles = bin_tiles(projected, camera.width, camera.height, engine=engine)
    footprints = projected.means2d, projected.conics, projected.opacities
    features, index = _shown(gaussians, camera, projected, engine)
    pixels = composite(*footprints, features, tiles, background=background, index=index, engine=engine)
    return Rendering(*pixels, projected)


def rasterize_labels(
    gaussians: Gaussians,
    camera: Camera,
    *,
    top: int = 1,
    early: bool = False,
    engine: str = "auto",
    near: float | None = None,
) -> Ranked:
    """Render scores of classes and keep each pixel's best classes, at about the price of a picture.

    `gaussians.features` [N, C] are scores of C classes, for instance votes or cosines. The labels are those of the largest
    of `rasterize(...).map`, but the map of all scores is never in memory. No gradient.

    Args:
        gaussians: with finite scores as `features`.
        camera: a single one, a pinhole.
        top: how many classes are kept, from 1 to C.
        early: for labels alone, in about two thirds of the time: with `top` 1 an engine may stop at a pixel as soon as its
            label is certain. Its score and opacity are then those reached so far. The CPU engine does so for up to 26 classes.
        engine: as in `composite`.
        near: as in `rasterize`.

    Returns:
        Labels and scores [H, W, top], the best first, of equal scores the lowest class first; and the opacity [H, W].
        Labels are -1 and scores 0 where nothing is drawn.

    Raises:
        TypeError: as `rasterize`.
        ValueError: as `rasterize`, and if there are no features, or `top` is out of range.
        ImportError: if a named engine is missing.

    Example:
        >>> import torch
        >>> camera = Camera(torch.eye(4), torch.tensor([[10.0, 0, 2], [0, 10, 2], [0, 0, 1]]), 4, 4)
        >>> shape = {"quats": torch.tensor([[1.0, 0, 0, 0]]), "scales": torch.full((1, 3), 0.02)}
        >>> scores = {"opacities": torch.tensor([0.5]), "features": torch.tensor([[0.1, 0.7, 0.2]])}
        >>> ball = Gaussians(means=torch.tensor([[0.0, 0.0, 2.0]]), **shape, **scores)
        >>> rasterize_labels(ball, camera, engine="reference").labels[..., 0].tolist()
        [[-1, 1, 1, -1], [1, 1, 1, 1], [1, 1, 1, 1], [-1, 1, 1, -1]]
    """
    _check_arguments(gaussians, camera)
    if gaussians.features is None:
        raise ValueError("gaussians: expected scores of classes as features, got None; add them by gaussians.replace()")
    with torch.no_grad():
        projected = project(gaussians, camera, near=near, engine=engine)
        tiles = bin_tiles(projected, camera.width, camera.height, engine=engine)
        footprints = projected.means2d, projected.conics, projected.opacities
        return rank_channels(
            *footprints, gaussians.features, tiles, top=top, early=early, index=projected.index, engine=engine
        )


class Votes(NamedTuple):
    """What each Gaussian adds to the score of a class at a pixel that shows it, for the W classes that get anything."""

    classes: Tensor  # [W] int64, which of all classes, ascending
    shares: Tensor  # [N, W] positive: shares of one vote, or any scores; 0 for a Gaussian about which nothing is known


def rank_votes(gaussians: Gaussians, camera: Camera, votes: Votes, top: int = 1, *, early: bool = False) -> Ranked:
    """The `top` classes with most votes at each pixel; votes are blended like colours. With fewer classes, the rest is -1 and 0.

    `early` is that of `rasterize_labels`.
    """
    if not len(votes.classes):  # nothing is known about any Gaussian: an empty vote, so that the opacity is drawn
        votes = Votes(votes.classes.new_zeros(1), votes.shares.new_zeros(len(votes.shares), 1))
    count = min(top, len(votes.classes))
    with torch.no_grad():
        shown = gaussians.replace(features=votes.shares, sh=None)
        labels, scores, alphas = rasterize_labels(shown, camera, top=count, early=early)
        if int(votes.classes[-1]) != len(votes.classes) - 1:  # else each column has the number of its class
            labels = votes.classes[labels]
        labels.masked_fill_(scores <= 0, -1)
    if count < top:
        labels = torch.nn.functional.pad(labels, (0, top - count), value=-1)
        scores = torch.nn.functional.pad(scores, (0, top - count))
    return Ranked(labels, scores, alphas)


def _check_arguments(gaussians: Gaussians, camera: Camera) -> None:
    check_gaussians(gaussians)
    check_camera(camera)
    means = gaussians.means
    shown = "sh" if gaussians.features is None else "features"
    for name in ("quats", "scales", "opacities", shown):
        value = getattr(gaussians, name)
        if value is not None and (value.dtype, value.device) != (means.dtype, means.device):
            raise ValueError(
                f"gaussians.{name}: expected {means.dtype} on {means.device} (from gaussians.means), got {value.dtype} on "
                f"{value.device}; convert all of them with gaussians.to({means.device.type!r}, torch.float32)"
            )


def _shown(gaussians: Gaussians, camera: Camera, projected: Projected, engine: str) -> tuple[Tensor, Tensor | None]:
    """What the visible Gaussians show: rows of features, and the row of each; or a colour for each, and None."""
    if gaussians.features is not None:
        return gaussians.features, projected.index
    assert gaussians.sh is not None
    center = camera.with_origin(gaussians.origin).center.to(gaussians.means)
    compiled = None if center.requires_grad else choose_projecting(engine, gaussians.sh, gaussians.means)
    tensors = gaussians.sh.contiguous(), gaussians.means.contiguous(), center.contiguous(), projected.index
    return (compiled or Engine()).shade(*tensors), None


def render_color(gaussians: Gaussians, camera: Camera) -> Tensor:  # [H, W, 3] in [0, 1]
    """Draw a colour field on black, without gradients."""
    with torch.no_grad():
        return rasterize(gaussians.replace(features=None), camera).map.clamp(0, 1)
