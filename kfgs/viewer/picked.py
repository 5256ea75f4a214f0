"""What the explorer tells about a picked Gaussian."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from .._origin import to_world
from ..cameras import Camera
from ..gaussians import Gaussians
from ..viz.frusta import evenly
from .carried import Carried
from .hit_test import Sight, neighbours_of, views_seeing
from .meaning import Asked, Meaning

Side = Literal["semantic", "color"]
SIDE_WORDS: dict[Side, str] = {"semantic": "semantic", "color": "colour"}
SHOWN = 4  # views and neighbours named in a line
NEIGHBOURS = 8
MOST_VIEWS = 30  # views checked for a picked Gaussian: 0.2 s with 600,000 Gaussians


@dataclass(frozen=True)
class Picked:
    """One picked Gaussian."""

    side: Side
    index: int
    name: str | None  # its class; None if it has none
    label: int  # -1 = none
    score: float | None  # for the question, or of its label without one; None if unknown
    position: tuple[float, float, float]  # world units
    opacity: float
    source: int | None  # colour side: the nearest labelled semantic Gaussian, within lambda or not
    distance: float | None  # to `source`, world units
    neighbours: list[tuple[int, float, str | None]]  # the nearest ones of the same side: index, distance, class
    views: list[Sight]  # the views that see it, best first

    def lines(self) -> list[str]:
        """A few lines of text."""
        place = ", ".join(f"{x:.3f}" for x in self.position)
        score = "" if self.score is None else f", score {self.score:.3f}"
        lines = [
            f"{SIDE_WORDS[self.side]} Gaussian {self.index}: {self.name or 'no class'}{score}",
            f"at ({place}), opacity {self.opacity:.2f}",
        ]
        if self.source is not None:
            relation = "label from" if self.label >= 0 else "nearest labelled"
            reach = "" if self.label >= 0 else ": out of reach"
            lines.append(f"{relation} semantic Gaussian {self.source}, {self.distance:.3g} away{reach}")
        if self.neighbours:
            near = [f"{name or 'no class'} {distance:.2g}" for _, distance, name in self.neighbours[:SHOWN]]
            lines.append(f"near it: {', '.join(near)}")
        if self.views:
            seen = [f"{sight.name or sight.index} ({sight.weight:.0%})" for sight in self.views[:SHOWN]]
            more = f" and {len(self.views) - SHOWN} more" if len(self.views) > SHOWN else ""
            lines.append(f"seen by {', '.join(seen)}{more}")
        return lines


class Describe:
    """Describes a Gaussian under a question and a lambda; neighbours and views, which depend on neither, are cached."""

    def __init__(
        self,
        meaning: Meaning,
        clouds: Mapping[Side, Gaussians],
        carried: Carried | None,
        cameras: Sequence[Camera],
    ) -> None:
        assert meaning.gaussians.labels is not None
        self._meaning, self._clouds, self._carried = meaning, clouds, carried
        self._labels = meaning.gaussians.labels.tolist()
        self._places = evenly(len(cameras), MOST_VIEWS).tolist() if cameras else []
        self._views = [cameras[place] for place in self._places]
        self._around: dict[tuple[Side, int], tuple[list[tuple[int, float]], list[Sight]]] = {}

    def __call__(self, side: Side, index: int, asked: Asked | None, distance: float) -> Picked:
        """Describe one Gaussian."""
        cloud, label = self._clouds[side], self._label(side, index, distance)
        near, views = self._surroundings(side, index)
        nearest = -1 if side == "semantic" or self._carried is None else int(self._carried.source[index])
        x, y, z = to_world(cloud.means[index], cloud.origin).tolist()
        return Picked(
            side=side,
            index=index,
            name=self._name(label),
            label=label,
            score=self._score(self._source(side, index, distance), asked),
            position=(x, y, z),
            opacity=float(cloud.opacities[index]),
            source=nearest if nearest >= 0 else None,
            distance=float(self._carried.far[index]) if self._carried is not None and nearest >= 0 else None,
            neighbours=[(i, d, self._name(self._label(side, i, distance))) for i, d in near],
            views=views,
        )

    def _surroundings(self, side: Side, index: int) -> tuple[list[tuple[int, float]], list[Sight]]:
        key = side, index
        if key not in self._around:
            cloud = self._clouds[side]
            near = [(int(i), float(d)) for i, d in zip(*neighbours_of(cloud.means, index, NEIGHBOURS), strict=True)]
            sights = views_seeing(cloud, index, self._views)
            self._around[key] = near, [replace(sight, index=self._places[sight.index]) for sight in sights]
        return self._around[key]

    def _source(self, side: Side, index: int, distance: float) -> int | None:
        """The semantic Gaussian that gives this one its label and score, if there is one."""
        if side == "semantic" or self._carried is None:
            return index
        return int(self._carried.source[index]) if self._carried.far[index] < distance else None

    def _label(self, side: Side, index: int, distance: float) -> int:
        source = self._source(side, index, distance)
        return -1 if source is None else int(self._labels[source])

    def _score(self, source: int | None, asked: Asked | None) -> float | None:
        """The score of one Gaussian, as in `Exploration.scores`."""
        if source is None:
            return None
        if asked is None:
            return float(self._meaning.scores[source]) if self._labels[source] >= 0 else None
        return float(asked.selection.scores[source]) if bool(asked.valid[source]) else None

    def _name(self, label: int) -> str | None:
        return self._meaning.names[label] if label >= 0 else None
