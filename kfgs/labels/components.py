"""Which of the selected Gaussians hang together: the chairs among all that is chair, the thing under a click."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from .._check import check_range, check_shapes, check_whole
from .._rows import check_finite
from .classify import select_like
from .radius_graph import radius_components
from .selection import Selection, select_where

NEIGHBOUR, QUANTILE = 4, 0.9  # a cloud's spacing: 90 % have their fourth neighbour within it
SPACINGS = 1.5  # the default distance, in spacings of the selected: on room_0 2 joins the chairs, 1.2 breaks a sofa ...
MOST_SPACINGS = 4.0  # ... and its bound, in spacings of all: a few specks across the room have a spacing of metres
SAMPLE = 20_000  # Gaussians measured for a spacing

Array = np.ndarray[Any, Any]


def component_distance(
    means: Tensor,  # [N, 3]
    mask: Tensor,  # [N] bool
) -> float:
    """A distance at which the things under a mask hang together but stay apart from each other, in world units.

    1.5 times the distance within which 90 % of the masked Gaussians have their fourth neighbour among themselves, but at
    most four times that of all Gaussians. Sparse things (bare walls, a sofa) get a larger distance than dense ones. On
    room_0's colour field (149,213 Gaussians; 0.03 m for the plant, 0.2 m for the door) this parts 2 chairs, 2 stools,
    2 sofas, 3 tables and 4 heaps of cushions. No constant does: 0.08 m makes one of the two chairs and still breaks a
    sofa. Measured on an evenly strided sample of at most 20,000; copies at one place count once.

    Raises:
        ValueError: if shapes disagree or a position is not finite.
    """
    check_shapes(("means", means, "N 3"), ("mask", mask, "N"))
    check_finite("means", means)
    own, all_of_them = _spacing(_positions(means[mask])), _spacing(_positions(means))
    chosen = min(SPACINGS * own, MOST_SPACINGS * all_of_them)
    return chosen if chosen > 0 else 1.0  # a single place: any distance joins what lies there


def component_numbers(
    means: Tensor,  # [N, 3]
    mask: Tensor,  # [N] bool
    distance: float | None = None,
) -> Tensor:  # [N] int64
    """Number the connected parts of the Gaussians under a mask: 0 is the largest, -1 lies outside the mask.

    Two Gaussians are connected where their means are at most `distance` apart, directly or through others under the
    mask. Of equally large parts the one with the lowest index comes first.

    Args:
        means: positions, in world units.
        mask: which Gaussians take part.
        distance: in world units; None takes `component_distance`.

    Raises:
        ValueError: if shapes disagree, a position is not finite, or the distance is not positive.
        TypeError: if the mask is not boolean.

    Note:
        600,000 Gaussians take about 13 seconds on one core and 1 GB, however dense they lie.
    """
    check_shapes(("means", means, "N 3"), ("mask", mask, "N"))
    if mask.dtype != torch.bool:
        raise TypeError(f"mask: expected a boolean mask, got {mask.dtype}; compare first, as in labels == 3")
    check_finite("means", means)
    numbers = torch.full(mask.shape, -1, dtype=torch.int64, device=mask.device)
    if distance is None:
        distance = component_distance(means, mask)
    check_range("distance", distance, 0, closed=(False, False))
    found = radius_components(_positions(means[mask]), distance)
    numbers[mask] = torch.from_numpy(found).to(mask.device)
    return numbers


def components(
    means: Tensor,  # [N, 3]
    selection: Selection,
    distance: float | None = None,
    *,
    smallest: int = 1,
    most: int = 100,
) -> list[Selection]:
    """The connected parts of a selection, largest first ("the four chairs"); none for an empty selection.

    Args:
        means: positions of all N Gaussians.
        selection: what to take apart; each part keeps its scores and threshold.
        distance: see `component_numbers`.
        smallest: parts of fewer Gaussians are left out; they are mostly floaters and mislabelled specks.
        most: how many parts are returned at most; each holds a mask of N.

    Raises:
        ValueError: if shapes disagree, a position is not finite, or a number is out of range.
    """
    check_shapes(("means", means, "N 3"), ("selection.mask", selection.mask, "N"))
    check_whole("smallest", smallest, 1)
    check_whole("most", most, 1)
    numbers = component_numbers(means, selection.mask, distance)
    sizes = torch.bincount(numbers[selection.mask])[:most]
    kept = int((sizes >= smallest).sum())  # they are sorted
    return [selection.within(numbers == i, f"part {i + 1} of {int(numbers.max()) + 1}") for i in range(kept)]


def select_near(
    means: Tensor,  # [N, 3]
    point: Sequence[float] | Tensor,  # [3]
    *,
    labels: Tensor | None = None,  # [N] int64
    features: Tensor | None = None,  # [N, D]
    threshold: float | None = None,
    distance: float | None = None,
) -> Selection:
    """Select the thing at a point (a click): what is like the nearest Gaussian and connected with it.

    With `labels`, alike is what carries the same label; with `features`, what is more similar to it than `threshold`
    (read off the scores when not given, see `select_by_query`).

    Args:
        means: positions of all N Gaussians.
        point: a place in the world, such as the one under the mouse.
        labels: a class for each Gaussian; give these or features.
        features: decoded features.
        threshold: gamma, a cosine; only with features.
        distance: how far apart connected Gaussians may be; see `component_numbers`.

    Returns:
        The connected part with the nearest Gaussian in it (of equally near ones the lowest index).

    Raises:
        ValueError: if neither or both of labels and features are given, the nearest Gaussian has no label or an all-zero
            feature, there is no Gaussian, shapes disagree, or a number is not finite.
    """
    check_shapes(("means", means, "N 3"), ("labels", labels, "N"), ("features", features, "N D"))
    if (labels is None) == (features is None):
        raise ValueError(
            "labels, features: expected one of them, got none or both; labels say which Gaussians are alike"
        )
    nearest = _nearest(means, point)
    if labels is not None:
        label = int(labels[nearest])
        if label < 0:
            raise ValueError(
                f"labels: expected a label at the nearest Gaussian, got {label} (none) at {nearest}; click elsewhere, or "
                "pass features"
            )
        alike = select_where(labels == label, f"label {label}")
    else:
        assert features is not None
        alike = select_like(features, nearest, threshold)
        if not bool(alike.mask[nearest]):  # a threshold of 1 refuses even itself, as scores are compared strictly
            alike = Selection(alike.mask | (alike.scores >= alike.scores[nearest]), alike.scores, None, alike.words)
    numbers = component_numbers(means, alike.mask, distance)
    return alike.within(numbers == numbers[nearest], f"connected with Gaussian {nearest}, the nearest to the point")


def _nearest(means: Tensor, point: Sequence[float] | Tensor) -> int:
    place = torch.as_tensor(point, dtype=torch.float64, device=means.device)
    check_shapes(("point", place, "3"))
    check_finite("point", place)
    check_finite("means", means)
    if len(means) == 0:
        raise ValueError("means: expected at least one Gaussian, got none; load a cloud that is not empty")
    return int(((means.double() - place) ** 2).sum(dim=1).argmin())


def _spacing(points: Array) -> float:
    """The distance within which 90 % of the places have their fourth neighbour (or the last of fewer); 0 for one place."""
    places = np.unique(points, axis=0)
    if len(places) < 2:
        return 0.0
    k = min(NEIGHBOUR, len(places) - 1)
    sample = places[:: max(1, -(-len(places) // SAMPLE))]
    near: Array = np.asarray(cKDTree(places).query(sample, k=k + 1, workers=-1)[0])
    return float(np.quantile(near[:, k], QUANTILE))


def _positions(means: Tensor) -> Array:
    points: Array = means.detach().cpu().double().numpy()
    return points
