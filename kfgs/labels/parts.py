"""The connected parts of a selection ("the four chairs"): count, place, size and best view of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .._card import say_coordinate
from .._check import check_shapes, check_whole
from .._origin import to_world
from ..cameras import Camera
from ..gaussians import Gaussians, check_gaussians
from ..splat import sum_pixels
from .boxes import OrientedBox
from .components import component_numbers
from .selection import Selection

LONGEST = 160  # longer side in pixels of the views compared; on room_0 shares change by at most 0.3 % of the picture
SPECK = 0.05  # parts smaller than this share of the largest are left out


@dataclass(frozen=True)
class BestView:
    """The camera that shows a part largest."""

    camera: str  # its name
    index: int  # its index in the list of cameras
    share: float  # the visible part's share of the picture, in [0, 1)


@dataclass(frozen=True, eq=False)
class Part:
    """A part of a selection in numbers. Positions are the Gaussians' centres, in world units."""

    indices: Tensor  # [n] int64, ascending
    score: float  # mean score of its Gaussians
    centroid: Tensor  # [3] mean position
    box: OrientedBox  # a small box around the centres
    extent: tuple[Tensor, Tensor]  # lowest and highest corner [3] along the world's axes
    best_view: BestView | None  # None without cameras, or if no camera shows any of it
    how: str  # how it was selected
    total: int = 1  # how many connected parts the selection has, with those that are left out

    @property
    def count(self) -> int:
        """How many Gaussians."""
        return len(self.indices)

    @property
    def volume(self) -> float:
        """Of the oriented box, in cubed world units."""
        return self.box.volume

    def selection(self, count: int) -> Selection:
        """This part as a selection in the selection's cloud, which has `count` Gaussians; scores are 1 inside, 0 outside.

        Raises:
            ValueError: if the cloud has fewer Gaussians than the highest index needs.
        """
        check_whole("count", count, int(self.indices[-1]) + 1)
        mask = torch.zeros(count, dtype=torch.bool, device=self.indices.device)
        mask[self.indices] = True
        return Selection.of(mask, self.how)

    def __repr__(self) -> str:
        place = ", ".join(say_coordinate(x, 3) for x in self.centroid.tolist())
        size = " x ".join(f"{2 * x:.3g}" for x in self.box.half.tolist())
        view = "" if self.best_view is None else f", {self.best_view.share:.1%} of {self.best_view.camera!r}"
        what = "Gaussian" if self.count == 1 else "Gaussians"
        return f"Part({self.count} {what} at ({place}), {size}, score {self.score:.3f}{view})"

    def to_json(self) -> dict[str, Any]:
        """Plain numbers, lists and strings."""
        return {
            "count": self.count,
            "score": self.score,
            "centroid": self.centroid.tolist(),
            "box": self.box.to_json(),
            "extent": [corner.tolist() for corner in self.extent],
            "volume": self.volume,
            "best_view": None if self.best_view is None else vars(self.best_view).copy(),
            "how": self.how,
            "indices": self.indices.tolist(),
        }


def connected_parts(
    gaussians: Gaussians,
    selection: Selection,
    cameras: Sequence[Camera] | None = None,
    *,
    distance: float | None = None,
    smallest: int | None = None,
    most: int = 100,
    engine: str = "auto",
) -> list[Part]:
    """Split a selection of these Gaussians into its connected parts ("the four chairs"), largest first.

    Args:
        gaussians: the cloud.
        selection: an empty one has no parts.
        cameras: views without distortion, to find the best one of each part.
        distance: Gaussians at most this far apart are connected, in world units; see `component_numbers`.
        smallest: parts with fewer Gaussians are left out; None: those below 5 % of the largest.
        most: the most parts to return.
        engine: compositing engine.

    Raises:
        ValueError: if shapes disagree, a position is not finite, or a number is out of range.
    """
    check_gaussians(gaussians)
    check_shapes(("gaussians.means", gaussians.means, "N 3"), ("selection.mask", selection.mask, "N"))
    check_whole("most", most, 1)
    numbers = component_numbers(gaussians.means, selection.mask, distance)
    sizes = torch.bincount(numbers[selection.mask])
    if len(sizes) == 0:
        return []
    least = SPECK * int(sizes[0]) if smallest is None else smallest
    kept = int((sizes[:most] >= least).sum())
    order = torch.argsort(numbers, stable=True)[int((numbers < 0).sum()) :]  # part by part, ascending in each
    members = list(order.split(sizes.tolist())[:kept])
    shares = _view_shares(gaussians, members, cameras or [], engine)
    parts = []
    for i, indices in enumerate(members):
        points = to_world(gaussians.means[indices].detach().double(), gaussians.origin)
        view = None
        if cameras and bool((shares[:, i] > 0).any()):
            best = int(shares[:, i].argmax())
            view = BestView(cameras[best].name, best, float(shares[best, i]))
        part = Part(
            indices=indices,
            score=float(selection.scores[indices].double().mean()),
            centroid=points.mean(dim=0),
            box=OrientedBox.around(points),
            extent=(points.amin(dim=0), points.amax(dim=0)),
            best_view=view,
            how=f"{selection.how}; part {i + 1} of {len(sizes)}",
            total=len(sizes),
        )
        parts.append(part)
    return parts


def _view_shares(gaussians: Gaussians, parts: list[Tensor], cameras: Sequence[Camera], engine: str) -> Tensor:  # [C, P]
    """The share of each camera's picture that each part fills: the mean over pixels of its rendering weights w = T alpha.

    Hidden parts do not count, and a transparent part counts by its opacity. Pictures have at most 160 pixels a side.
    """
    shares = torch.zeros(len(cameras), len(parts)).to(gaussians.means)
    for c, camera in enumerate(cameras if parts else ()):
        small = camera.fitted(LONGEST)
        with torch.no_grad():
            index, _, weights = sum_pixels(gaussians, small, torch.ones(*small.size, 1).to(shares), engine=engine)
        whole = torch.zeros(len(gaussians)).to(shares).index_add_(0, index, weights.to(shares))
        shares[c] = torch.stack([whole[part].sum() for part in parts]) / (small.width * small.height)
    return shares
