"""Pictures of classes over a photograph or a rendering."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from kfgs import Camera, Gaussians
from kfgs.splat import rasterize_labels
from kfgs.viz import overlay_labels, palette

Show = Callable[[Camera], Any]


def show_classes(gaussians: Gaussians, names: Sequence[str], under: Show | None = None) -> Show:
    """Make a function camera -> picture: each pixel has the colour of its class, over another picture if given.

    A pixel has the class that most of its Gaussians have, weighted as in a rendering; none if nothing covers it.
    """
    labels = gaussians.labels
    votes = torch.nn.functional.one_hot(labels.clamp_min(0), len(names)).to(gaussians.means) * (labels >= 0)[:, None]
    voting = gaussians.detach().replace(features=votes, sh=None, labels=None)

    def show(camera: Camera) -> np.ndarray[Any, Any]:
        ranked = rasterize_labels(voting, camera.to(voting.means))
        known = (ranked.alphas >= 0.5) & (ranked.scores[..., 0] > 0)
        classes = torch.where(known, ranked.labels[..., 0], -1).cpu().numpy()
        if under is None:
            return np.where((classes >= 0)[..., None], palette(classes, names), 255).astype(np.uint8)
        photo = under(camera)
        drawn = overlay_labels(photo / 255, classes, names, alpha=0.65, legend=False)
        return np.where((classes >= 0)[..., None], drawn, photo)

    return show
