"""Carry labels from the semantic field to the colour field by distance (Sec. 3.4)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from .._arrays import Array
from .._check import as_array, as_tensor, check_range, check_shapes
from .._notes import Repair, tell_repairs
from .._origin import recounted
from .._rows import check_finite
from ..gaussians import Gaussians

INSTANCE = "instance"  # the column of `Gaussians.extra` that tells the things of a class apart: 1, 2, ...; 0 = none
SAMPLE = 20_000  # Gaussians measured for lambda or a spacing
COVERAGE = 0.995  # lambda reaches this share of the destinations ...
NEAREST = 2.0  # ... but is at least this many median spacings of the sources ...
FARTHEST, WIDE = 10.0, 0.9  # ... and at most 10 times this quantile of the spacings


@dataclass(frozen=True, eq=False)
class Transfer:
    """Labels carried from S source positions to N destinations."""

    labels: Tensor  # [N] int64, -1 = none
    distances: Tensor  # [N] world units, to the source that gave the label; infinite if there is none
    sources: Tensor  # [N] int64, index of that source; -1 if there is none
    distance: float  # lambda, the distance within which a label is carried over, world units
    how: str  # how lambda was found

    @property
    def labelled(self) -> int:
        """The number of destinations with a label."""
        return int((self.labels >= 0).sum())

    @property
    def orphaned(self) -> int:
        """The number of destinations without a label."""
        return len(self.labels) - self.labelled

    @property
    def scores(self) -> Tensor:  # [N] in [0, 1]
        """How sure each label is: 1 - distance / lambda; 0 without a label."""
        return (1 - self.distances / (self.distance or 1.0)).clamp_min(0.0)

    def __repr__(self) -> str:
        labelled = f"{self.labelled:,} of {len(self.labels):,} labelled (nearest within {self.distance:.4g})"
        return f"Transfer({labelled}, {self.orphaned:,} orphaned; lambda: {self.how})"


def transfer_labels(source: Any, target: Gaussians, distance: float | None = None) -> Gaussians:
    """Label a splat by distance: `transfer_labels(field, read_splats("mine.ply"))`.

    The source is a field, or labelled Gaussians; the rule is that of `nearest_labels`, which also says who gave each label.
    The target gets new `labels`, `scores` (1 - distance / lambda), and the source's class names and column `instance`. Both
    clouds must share one frame; `kfgs.attach` finds the common frame, and can label by views instead of by distance.

    A ValueError if the source has no labels, a position is not finite, or the distance is not positive.

    Example:
        >>> a, b = (torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), torch.tensor([[0.1, 0.0, 0.0], [0.5, 0.0, 0.0]]))
        >>> cloud = Gaussians(a, torch.ones(2, 4), torch.ones(2, 3), torch.ones(2), labels=torch.tensor([0, 1]))
        >>> transfer_labels(cloud, cloud.replace(means=b, labels=None), 0.4).labels.tolist()
        [0, -1]
    """
    source, target = as_cloud(source, "source", labelled=True), without_instances(as_cloud(target, "target"))
    places = recounted(target.means, target.origin, source.origin)
    carried = nearest_labels(source.means, source.labels, places, distance)
    extra, scores = {**target.extra}, carried.scores.to(target.means.dtype)
    if INSTANCE in source.extra:
        extra[INSTANCE] = np.pad(source.extra[INSTANCE], (0, 1))[carried.sources.cpu()]
    return target.replace(labels=carried.labels, scores=scores, names=source.names, extra=extra)


def nearest_labels(
    src_means: Tensor | Array,  # [S, 3]
    src_labels: Tensor | Array,  # [S] int64, -1 = none
    dst_means: Tensor | Array,  # [N, 3]
    distance: float | None = None,
) -> Transfer:
    """Give each destination the label of the nearest labelled source **strictly** closer than `distance`.

    The rule of Sec. 3.4; `distance` is its lambda, in world units. The paper does not say which label wins if several are
    in range: here the nearest does, and of sources at one position the one with the lowest index. Both clouds are counted
    from the same origin.

    The paper gives no value for lambda either. Without one, it is the distance within which 99.5 % of the destinations have
    a source, but at least 2 median spacings of the sources (a spacing is the distance to the nearest other source), so that
    a destination between two sources reaches both. And at most 10 times the 90 % quantile of the spacings, so that floaters
    and background, which only the colour field has, take no labels across the room.

    A destination that is not finite gets no label, and a note is logged. A ValueError if shapes disagree, a source is not
    finite, a label is below -1, or the distance is not positive.
    """
    src_means, dst_means = as_tensor("src_means", src_means), as_tensor("dst_means", dst_means)
    src_labels = as_tensor("src_labels", src_labels)
    check_shapes(("src_means", src_means, "S 3"), ("src_labels", src_labels, "S"), ("dst_means", dst_means, "N 3"))
    if src_labels.is_floating_point() or src_labels.dtype == torch.bool:
        raise TypeError(f"src_labels: expected integer labels, got {src_labels.dtype}; convert them with .long()")
    if distance is not None:
        check_range("distance", distance, 0, closed=(False, False))
    given: Array = src_labels.detach().cpu().numpy().astype(np.int64)
    if given.size and given.min() < -1:
        raise ValueError(f"src_labels: expected class indices or -1, got {given.min()}; map other codes to -1 first")
    points, targets = positions("src_means", src_means), as_array(dst_means).astype(np.float64, copy=False)
    known = np.isfinite(targets).all(1)
    if not known.all():
        lost = Repair(f"{(~known).sum():,} of {len(known):,} places are not finite: they get no label")
        tell_repairs("dst_means", [lost], False, ValueError)
    sources = Sources(points, given >= 0)
    chosen, how = sources.default_distance(targets[known]) if distance is None else (float(distance), "given")
    distances, index = np.full(len(targets), np.inf), np.full(len(targets), -1)
    distances[known], index[known] = sources.nearest(targets[known], chosen)
    labels = np.append(given, -1)[index]  # the last one for index -1
    carried, winners = (torch.from_numpy(values).to(dst_means.device) for values in (labels, index))
    return Transfer(carried, torch.from_numpy(distances).to(dst_means), winners, chosen, how)


class Sources:
    """The positions of labelled Gaussians, as a tree. Of those at one position only the one with the lowest index answers."""

    def __init__(self, points: Array, labelled: Array) -> None:  # [S, 3], [S] bool
        kept = np.flatnonzero(labelled)
        order = kept[np.lexsort(points[kept].T)]  # stable: equal points keep their order; half the time of np.unique
        new = (points[order[1:]] != points[order[:-1]]).any(axis=1)
        self.index = np.sort(order[np.append(True, new)[: len(order)]])
        """The Gaussian of each position of the tree, ascending."""
        self.tree = cKDTree(points[self.index])

    def nearest(self, points: Array, distance: float = np.inf) -> tuple[Array, Array]:  # [N] float64, [N] int64
        """Distance and index of the nearest source **strictly** closer than `distance`; infinite and -1 if there is none."""
        distances, index = np.full(len(points), np.inf), np.full(len(points), -1)
        if not (len(points) and len(self.index)):
            return distances, index
        # neighbours follow each other: a tree answers twice as fast
        cell = max(float(np.ptp(points, axis=0).max()) / 64, np.finfo(np.float64).tiny)
        order: Array = np.lexsort(np.floor((points - points.min(axis=0)) / cell).T)
        near, which = self.tree.query(points[order], distance_upper_bound=distance, workers=-1)
        near = np.where(near < distance, near, np.inf)  # scipy compares squares, which rounds otherwise
        distances[order], index[order] = near, np.where(np.isfinite(near), np.append(self.index, -1)[which], -1)
        return distances, index

    def default_distance(self, targets: Array) -> tuple[float, str]:
        """Lambda for these destinations (see `nearest_labels`), in world units, and one line that explains it."""
        if len(self.index) == 0:
            return 0.0, "no labelled source"
        tiny = 1e-6 * max(1.0, float(np.abs(self.tree.maxes).max()), float(np.abs(self.tree.mins).max()))
        if len(targets) == 0:
            return tiny, "no destinations"
        reach = float(np.quantile(self.tree.query(sampled(targets), workers=-1)[0], COVERAGE))
        usual = wide = 1.01 * reach / NEAREST  # a single source has no spacing: lambda becomes 1.01 times the reach
        if len(self.index) > 1:
            spacings = np.asarray(self.tree.query(sampled(np.asarray(self.tree.data)), k=2, workers=-1)[0])[:, 1]
            usual, wide = (float(spacing) for spacing in np.quantile(spacings, [0.5, WIDE]))
        chosen = min(max(reach, NEAREST * usual), FARTHEST * wide)
        how = f"{100 * COVERAGE:g} % of the destinations have a source within {reach:.3g}; the sources' spacings are"
        return max(chosen, tiny), f"{how} {usual:.3g} (median) and {wide:.3g} ({100 * WIDE:g} % are smaller)"


def as_cloud(value: Any, name: str = "gaussians", *, labelled: bool = False) -> Gaussians:
    """What a person holds as a cloud: Gaussians as they are, or those of a field with the classes that it knows.

    A TypeError for anything else, and a ValueError if it must be `labelled` and is not; both name the call that helps.
    """
    if not isinstance(value, Gaussians):
        if not hasattr(value, "label"):
            path = isinstance(value, str | Path)
            calls = "SemanticField.load or read_splats opens a file" if path else "nearest_labels labels plain points"
            raise TypeError(f"{name}: expected a SemanticField or Gaussians, got {type(value).__name__}; {calls}")
        value = value.label() if labelled or value.classes is not None else value.gaussians
    if labelled and value.labels is None:
        raise ValueError(f"{name}: expected labels, got {value!r}; SemanticField.label or transfer_labels gives some")
    return value


def without_instances(gaussians: Gaussians) -> Gaussians:
    """Without the column `instance`: it numbers things of labels that go."""
    return gaussians.replace(extra={name: column for name, column in gaussians.extra.items() if name != INSTANCE})


def sampled(points: Array) -> Array:
    """At most 20,000 of the points, evenly strided."""
    return points[:: max(1, -(-len(points) // SAMPLE))]


def positions(name: str, means: Tensor) -> Array:  # [N, 3] float64
    """The means in numpy; a ValueError names the first that is not finite."""
    check_finite(name, means)
    return as_array(means).astype(np.float64, copy=False)
