"""The connected parts of a selection ("the four chairs"): count, place, size and best view of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from .._card import say_coordinate
from .._check import check_shapes, check_whole
from .._origin import to_world
from .._rows import check_finite
from .._typed import typed
from ..cameras import Camera
from ..gaussians import Gaussians
from .boxes import OrientedBox
from .components import component_numbers
from .selection import Selection
from .views import sum_pixels

LONGEST = 160  # longer side in pixels of the views compared; on room_0 shares change by at most 0.3 % of the picture
SPECK = 0.05  # parts smaller than this share of the largest are left out


@dataclass(frozen=True)
class BestView:
    """The camera that shows a selection largest."""

    camera: str  # its name
    index: int  # its index in the list of cameras
    share: float  # the visible selection's share of the picture, in [0, 1)


@dataclass(frozen=True, eq=False)
class Part:
    """A selection or a part of it, in numbers. Positions are the Gaussians' centres, in world units."""

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
        """This part as a selection in the selection's cloud, which has `count` Gaussians.

        Scores are 1 inside and 0 outside. `selection & part.selection(count)` has the scores of the selection.

        Raises:
            ValueError: if the cloud has fewer Gaussians than the highest index needs.
        """
        check_whole("count", count, 1)
        if int(self.indices[-1]) >= count:
            raise ValueError(
                f"count: expected more than {int(self.indices[-1])} (the part's highest index), got {count}; pass len of "
                "the cloud that was selected in, not of a part of it"
            )
        mask = torch.zeros(count, dtype=torch.bool, device=self.indices.device)
        mask[self.indices] = True
        return Selection.of(mask, self.how)

    def __repr__(self) -> str:
        place = ", ".join(say_coordinate(x, 3) for x in self.centroid.tolist())
        size = " x ".join(f"{2 * x:.3g}" for x in self.box.half.tolist())
        view = "" if self.best_view is None else f", {self.best_view.share:.1%} of {self.best_view.camera!r}"
        what = "Gaussian" if self.count == 1 else "Gaussians"
        return f"Part({self.count} {what} at ({place}), {size}, score {self.score:.3f}{view})"

    def to_json(self, indices: bool = True) -> dict[str, Any]:
        """Plain numbers, lists and strings; `indices=False` leaves out the list of Gaussians, which may be long."""
        view = self.best_view
        return {
            "count": self.count,
            "score": self.score,
            "centroid": self.centroid.tolist(),
            "box": self.box.to_json(),
            "extent": [corner.tolist() for corner in self.extent],
            "volume": self.volume,
            "best_view": None if view is None else {"camera": view.camera, "index": view.index, "share": view.share},
            "how": self.how,
        } | ({"indices": self.indices.tolist()} if indices else {})


@typed
def describe_selection(
    gaussians: Gaussians,
    selection: Selection,
    cameras: Sequence[Camera] | None = None,
    *,
    engine: str = "auto",
) -> Part:
    """Describe a selection as a whole; `connected_parts` describes each of its connected parts.

    Args:
        gaussians: the selection's cloud.
        selection: at least one Gaussian.
        cameras: views without distortion, to find the best one.
        engine: compositing engine.

    Raises:
        ValueError: if nothing is selected, shapes disagree, or a selected position is not finite.
    """
    check_shapes(("gaussians.means", gaussians.means, "N 3"), ("selection.mask", selection.mask, "N"))
    if not bool(selection.mask.any()):
        raise ValueError(
            f"selection: expected at least one Gaussian, got none ({selection.summary}); lower the threshold, or ask for "
            "something else"
        )
    return _described(gaussians, selection, [selection.indices], [selection.how], cameras, engine)[0]


@typed
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
    """Split a selection into its connected parts ("the four chairs"), largest first.

    Args:
        gaussians: the selection's cloud.
        selection: an empty one has no parts.
        cameras: as in `describe_selection`.
        distance: Gaussians at most this far apart are connected, in world units; see `component_numbers`.
        smallest: parts with fewer Gaussians are left out; None: those below 5 % of the largest.
        most: the most parts to return.
        engine: compositing engine.

    Raises:
        ValueError: if shapes disagree, a position is not finite, or a number is out of range.
    """
    check_shapes(("gaussians.means", gaussians.means, "N 3"), ("selection.mask", selection.mask, "N"))
    check_whole("most", most, 1)
    if smallest is not None:
        check_whole("smallest", smallest, 1)
    numbers = component_numbers(gaussians.means, selection.mask, distance)
    sizes = torch.bincount(numbers[selection.mask])
    if len(sizes) == 0:
        return []
    least = SPECK * int(sizes[0]) if smallest is None else smallest
    kept = int((sizes[:most] >= least).sum())
    order = torch.argsort(numbers, stable=True)[int((numbers < 0).sum()) :]  # part by part, ascending in each
    parts = list(order.split(sizes.tolist())[:kept])
    how = [f"{selection.how}; part {i + 1} of {len(sizes)}" for i in range(kept)]
    return [replace(part, total=len(sizes)) for part in _described(gaussians, selection, parts, how, cameras, engine)]


def view_shares(
    gaussians: Gaussians,
    parts: Sequence[Tensor],  # P index tensors [n] int64
    cameras: Sequence[Camera],
    *,
    engine: str = "auto",
) -> Tensor:  # [C, P]
    """The share of each camera's picture that each part fills: the mean over pixels of its rendering weights w = T alpha.

    Hidden parts do not count, and a transparent part counts by its opacity. Pictures are rendered with at most 160 pixels
    a side. The share of two parts together is the sum of their shares.

    Args:
        gaussians: the whole cloud.
        parts: indices of the Gaussians of each part; parts may overlap.
        cameras: views without distortion.
        engine: compositing engine.
    """
    shares = torch.zeros(len(cameras), len(parts), dtype=gaussians.means.dtype, device=gaussians.means.device)
    if not parts:
        return shares
    members = torch.cat(list(parts)).to(shares.device)
    owner = torch.repeat_interleave(torch.tensor([len(part) for part in parts])).to(shares.device)
    for c, camera in enumerate(cameras):
        shares[c].index_add_(0, owner, gaussian_shares(gaussians, camera, engine=engine)[members])
    return shares


def gaussian_shares(gaussians: Gaussians, camera: Camera, *, engine: str = "auto") -> Tensor:  # [N]
    """The share of a camera's picture that each Gaussian fills; see `view_shares`."""
    scale = min(1.0, LONGEST / max(camera.size))
    small = camera.resized(*(max(1, round(side * scale)) for side in camera.size))
    with torch.no_grad():
        ones = torch.ones(*small.size, 1).to(gaussians.means)
        index, _, weights = sum_pixels(gaussians, small, ones, engine=engine)
        found = torch.zeros(len(gaussians)).to(gaussians.means)
        return found.index_add_(0, index, weights.to(found) / (small.width * small.height))


def _described(
    gaussians: Gaussians,
    selection: Selection,
    parts: list[Tensor],
    how: list[str],
    cameras: Sequence[Camera] | None,
    engine: str,
) -> list[Part]:
    shares = view_shares(gaussians, parts, cameras or [], engine=engine)  # [C, P]
    found = []
    for i, (indices, why) in enumerate(zip(parts, how, strict=True)):
        check_finite("gaussians.means", gaussians.means[indices])
        points = to_world(gaussians.means[indices].detach().double(), gaussians.origin)
        best = int(shares[:, i].argmax()) if cameras else 0
        view = BestView(cameras[best].name, best, float(shares[best, i])) if cameras and shares[best, i] > 0 else None
        found.append(
            Part(
                indices=indices,
                score=float(selection.scores[indices].double().mean()),
                centroid=points.mean(dim=0),
                box=OrientedBox.around(points),
                extent=(points.amin(dim=0), points.amax(dim=0)),
                best_view=view,
                how=why,
            )
        )
    return found
