"""Carry labels from the semantic field to the colour field by distance (Sec. 3.4)."""

from __future__ import annotations

from .._origin import recounted
from ..gaussians import Gaussians, check_gaussians
from .nearest import nearest_labels


def transfer_labels(source: Gaussians, target: Gaussians, distance: float | None = None) -> Gaussians:
    """Label a splat by distance: `transfer_labels(field.label(classes), read_splats("mine.ply"))`.

    Each target takes the label of the nearest labelled source **strictly** closer than lambda (see `nearest_labels`, which
    also says which source that is). Both clouds must share one frame; `kfgs.attach` finds the common frame, and can label
    by views instead of by distance.

    Args:
        source: Gaussians with labels, for instance from `SemanticField.label`, or a labelled splat.
        target: the splat to label; old labels, scores and names are replaced.
        distance: lambda, the distance within which a label is carried over, in world units; None: `default_distance`.

    Returns:
        The target with `labels`, with `scores` (1 - distance / lambda), and with the class names of the source.

    Raises:
        TypeError: if one of them is not Gaussians, for instance a path.
        ValueError: if the source has no labels, a position is not finite, or the distance is not positive.

    Example:
        >>> import torch
        >>> a, b = (torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), torch.tensor([[0.1, 0.0, 0.0], [0.5, 0.0, 0.0]]))
        >>> cloud = Gaussians(a, torch.ones(2, 4), torch.ones(2, 3), torch.ones(2), labels=torch.tensor([0, 1]))
        >>> transfer_labels(cloud, cloud.replace(means=b, labels=None), 0.4).labels.tolist()
        [0, -1]
    """
    check_gaussians(source, "source")
    check_gaussians(target, "target")
    if source.labels is None:
        raise ValueError("source: expected Gaussians with labels, got none; `SemanticField.label` gives them some")
    means = recounted(target.means, target.origin, source.origin)
    carried = nearest_labels(source.means, source.labels, means, distance)
    return target.replace(labels=carried.labels, scores=carried.scores.to(target.means.dtype), names=source.names)
