"""The connected parts of a selection ("the four chairs"): count, place, size and best view of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .._card import say_coordinate, short_repr
from .._check import as_tensor, check_range, check_shapes, check_whole
from .._origin import to_world
from .._rows import check_finite
from ..cameras import Camera, as_cameras
from ..gaussians import Gaussians
from ..splat.rasterize import rasterize
from .components import SPECK, number_parts
from .selection import as_selection
from .transfer import as_cloud

LONGEST = 160  # longer side in pixels of the views compared; on room_0 shares change by at most 0.3 % of the picture


@dataclass(frozen=True, eq=False)
class OrientedBox:
    """A box with any orientation, in world units: the points `center + sum_i t_i axes[i]` with |t_i| <= half[i].

    **Convention**: the axes are the *rows* of a rotation (right-handed); `half` are half the edges. In Open3D the box is
    `OrientedBoundingBox(box.center.numpy(), box.axes.numpy().T, 2 * box.half.numpy())`.
    """

    center: Tensor  # [3]
    axes: Tensor  # [3, 3] orthonormal rows
    half: Tensor  # [3] >= 0

    __repr__ = short_repr

    @classmethod
    def around(cls, points: Tensor) -> OrientedBox:  # points: [N, 3]
        """The smaller of two boxes around the points: along their principal axes, or the world's; longest edge first."""
        points = as_tensor("points", points).detach().cpu().double()
        check_shapes(("points", points, "N 3"))
        if len(points) == 0:
            raise ValueError("points: expected at least one, got none; select something first")
        check_finite("points", points)
        middle = points.mean(dim=0)
        principal = torch.linalg.svd((points - middle).T @ (points - middle))[2]
        boxes = []
        for axes in (principal, torch.eye(3, dtype=torch.float64)):
            low, high = ((points - middle) @ axes.T).aminmax(dim=0)
            longest = (high - low).argsort(descending=True, stable=True)
            first, second = axes[longest[0]], axes[longest[1]]
            axes = torch.stack([first, second, torch.linalg.cross(first, second)])  # right-handed
            low, high = ((points - middle) @ axes.T).aminmax(dim=0)
            boxes.append(OrientedBox(middle + (low + high) / 2 @ axes, axes, (high - low) / 2))
        return min(boxes, key=lambda box: box.volume)

    @property
    def volume(self) -> float:
        """The volume in cubed world units; 0 for a flat box."""
        return float((2 * self.half).prod())

    @property
    def corners(self) -> Tensor:  # [8, 3]
        """The eight corners, sorted by their coordinates along the first, second and third axis."""
        signs = torch.cartesian_prod(*([torch.tensor([-1.0, 1.0])] * 3)).to(self.half)
        return self.center + (signs * self.half) @ self.axes


@dataclass(frozen=True)
class BestView:
    """The camera that shows a part largest."""

    camera: str  # its name
    index: int  # its index in the list of cameras
    share: float  # the visible part's share of the picture, in [0, 1)


@dataclass(frozen=True, eq=False)
class Part:
    """A part of a selection in numbers. Positions are the Gaussians' centres, in world units."""

    gaussians: Gaussians  # itself, as a cloud of n
    indices: Tensor  # [n] int64, ascending, in the whole cloud
    score: float  # mean score of its Gaussians
    centroid: Tensor  # [3] mean position
    box: OrientedBox  # a small box around the centres
    extent: tuple[Tensor, Tensor]  # lowest and highest corner [3] along the world's axes
    best_view: BestView | None  # None without cameras, or if no camera shows any of it
    how: str  # how it was selected
    number: int = 1  # what `OfClass` and the command line call it: chair/2
    total: int = 1  # how many connected parts the selection has, including those that are left out

    @property
    def count(self) -> int:
        """How many Gaussians."""
        return len(self.indices)

    def __repr__(self) -> str:
        place = ", ".join(say_coordinate(x, 3) for x in self.centroid.tolist())
        size = " x ".join(f"{2 * x:.3g}" for x in self.box.half.tolist())
        view = "" if self.best_view is None else f", {self.best_view.share:.1%} of {self.best_view.camera!r}"
        what = f"{self.count} Gaussian{'s' * (self.count != 1)} at ({place})"
        return f"Part({what}, {size}, score {self.score:.3f}{view})"

    def to_json(self) -> dict[str, Any]:
        """Plain numbers, lists and strings."""
        return {
            "number": self.number,
            "count": self.count,
            "score": self.score,
            "centroid": self.centroid.tolist(),
            "box": {name: value.tolist() for name, value in vars(self.box).items()},
            "extent": [corner.tolist() for corner in self.extent],
            "volume": self.box.volume,
            "best_view": None if self.best_view is None else vars(self.best_view).copy(),
            "how": self.how,
            "indices": self.indices.tolist(),
        }


def connected_parts(
    gaussians: Any,
    selection: Any,
    cameras: Sequence[Camera] | None = None,
    *,
    distance: float | None = None,
    smallest: int | None = None,
    most: int = 100,
) -> list[Part]:
    """Split a selection of these Gaussians into its parts ("the four chairs"), largest first.

    A cloud with the column `instance` (`number_instances`) has the things that it says, others have connected parts.

    Args:
        gaussians: a cloud or a field.
        selection: a class name, a `Selection`, a rule, several of these, or a mask [N]; an empty one has no parts.
        cameras: views without distortion, to find the best one of each part.
        distance: Gaussians at most this far apart are connected, in world units, whatever the column says; None takes it from
            their spacing.
        smallest: parts with fewer Gaussians are left out; None: those below 5 % of the largest.
        most: the most parts to return.
    """
    gaussians, cameras = as_cloud(gaussians), as_cameras(cameras or ())
    selection = as_selection(selection, gaussians)
    check_shapes(("gaussians.means", gaussians.means, "N 3"), ("selection.mask", selection.mask, "N"))
    check_whole("most", most, 1)
    if distance is not None:
        check_range("distance", distance, 0, closed=(False, False))
    numbers = number_parts(gaussians, selection.mask, distance)
    names, sizes = numbers[numbers >= 0].unique(return_counts=True)
    if len(sizes) == 0:
        return []
    order = torch.argsort(sizes, descending=True, stable=True)[:most]
    least = SPECK * int(sizes.max()) if smallest is None else smallest
    kept = names[order[sizes[order] >= least]].tolist()
    members, parts = [(numbers == name).nonzero()[:, 0] for name in kept], []
    marks = (numbers[:, None] == numbers.new_tensor(kept)).to(gaussians.means)
    shown, views = gaussians.replace(features=marks), [camera.fitted(LONGEST) for camera in cameras]
    shares = torch.stack([rasterize(shown, view).map.mean(dim=(0, 1)) for view in views] or [torch.zeros(len(kept))])
    for i, indices in enumerate(members):
        points = to_world(gaussians.means[indices].detach().double(), gaussians.origin)
        share, best = float(shares[:, i].max()), int(shares[:, i].argmax())
        view = BestView(cameras[best].name, best, share) if cameras and share > 0 else None
        score, extent = float(selection.scores[indices].double().mean()), (points.amin(dim=0), points.amax(dim=0))
        place, box = points.mean(dim=0), OrientedBox.around(points)
        how = f"{selection.how}; part {i + 1} of {len(sizes)}"
        parts.append(Part(gaussians[indices], indices, score, place, box, extent, view, how, kept[i] + 1, len(sizes)))
    return parts
