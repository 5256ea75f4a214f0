"""What a film can show besides a cloud: classes over a picture, and a selection that stands out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from .._check import check_shapes
from ..cameras import Camera
from ..gaussians import Gaussians
from ..scenes import Scene
from ..splat import rasterize, rasterize_labels
from .film_frames import Show
from .palette import palette
from .pictures import Array, as_bytes, overlay_labels, resize_photo

COVERED = 0.5  # opacity from which a pixel has a class
OUTLINE = (213, 94, 0)  # vermilion of Okabe and Ito
ALPHA = 0.65  # of classes over a picture
FADED = 0.7  # share of white in what is not selected


def show_classes(gaussians: Gaussians, names: Sequence[str], under: Show | None = None) -> Show:
    """Make a function camera -> picture that gives each pixel the colour of its class, over another picture if given.

    A pixel has the class that most of its Gaussians have, weighted as in a rendering; none if nothing covers it.

    Args:
        gaussians: with labels.
        names: class names by index, which decide the colours.
        under: draws the picture below, for instance `show_cloud(colors)`; None: white paper.
    """
    if gaussians.labels is None:
        raise ValueError("gaussians: expected labels, got None; classify them first")
    labels = gaussians.labels.long()
    count = max(int(labels.max()) + 1, 1) if len(labels) else 1
    votes = torch.nn.functional.one_hot(labels.clamp_min(0), count).to(gaussians.means) * (labels >= 0)[:, None]
    voting = gaussians.detach().replace(features=votes, sh=None, labels=None)

    def show(camera: Camera) -> Array:
        ranked = rasterize_labels(voting, camera.to(voting.means))
        known = (ranked.alphas >= COVERED) & (ranked.scores[..., 0] > 0)
        found = torch.where(known, ranked.labels[..., 0], -1).cpu().numpy()
        if under is None:
            return np.where((found >= 0)[..., None], palette(found, names), 255).astype(np.uint8)
        photo = as_bytes(under(camera))
        drawn = overlay_labels(photo / 255, found, names, alpha=ALPHA, legend=False)
        return np.where((found >= 0)[..., None], drawn, photo)

    return show


def show_selection(gaussians: Gaussians, mask: Tensor, under: Show | None = None) -> Show:
    """Make a function camera -> picture in which a selection keeps its colours, with an outline, and the rest fades.

    Args:
        gaussians: what was selected from.
        mask: which are selected, [N] bool.
        under: draws the picture, for instance `show_cloud(colors)`; None: the selection is dark on white paper.
    """
    check_shapes(("gaussians.opacities", gaussians.opacities, "N"), ("mask", mask, "N"))
    marked = gaussians.detach().replace(features=mask[:, None].to(gaussians.means), sh=None, labels=None)

    def show(camera: Camera) -> Array:
        from skimage.segmentation import find_boundaries

        with torch.no_grad():
            inside = rasterize(marked, camera.to(marked.means)).map[..., 0].cpu().numpy() > 0.5
        photo = np.where(inside, 60, 255)[..., None].repeat(3, -1) if under is None else as_bytes(under(camera))
        gray = photo.mean(-1, keepdims=True)
        picture = np.where(inside[..., None], photo, FADED * 255 + (1 - FADED) * gray)
        picture[find_boundaries(inside, mode="thick")] = OUTLINE
        return np.rint(picture).astype(np.uint8)

    return show


class Photos:
    """The photographs of a scene by the names of its views: a function camera -> picture; grey where there is none.

    The scene must be undistorted like the cameras.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._places = {camera.name: i for i, camera in enumerate(scene.cameras) if scene.image_paths[i].is_file()}

    def __contains__(self, camera: Camera) -> bool:
        """Whether there is a photograph of this view."""
        return camera.name in self._places

    def __call__(self, camera: Camera) -> Array:  # [H, W, 3] uint8
        """The photograph at the camera's size."""
        if camera not in self:
            return np.full((camera.height, camera.width, 3), 200, np.uint8)
        return as_bytes(resize_photo(self._scene.image(self._places[camera.name]), camera.size))
