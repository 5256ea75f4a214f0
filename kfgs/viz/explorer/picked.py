"""What is known of one Gaussian that a person points at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from .pick import Sight

Side = Literal["semantic", "color"]
SHOWN = 4  # views and neighbours named in a line


@dataclass(frozen=True)
class Picked:
    """One Gaussian of one side."""

    side: Side
    index: int
    name: str | None  # of its class; None where it has none
    label: int  # -1 = none
    score: float | None  # of the question, else of its label; None where nothing is known
    position: tuple[float, float, float]  # world units
    opacity: float
    source: int | None  # colour side: the nearest labelled semantic Gaussian, in range or not
    distance: float | None  # to it, world units
    neighbours: list[tuple[int, float, str | None]]  # the nearest of its own side: index, distance, class
    views: list[Sight]  # that see it, the best first

    def lines(self) -> list[str]:
        """For a person."""
        place = ", ".join(f"{x:.3f}" for x in self.position)
        score = "" if self.score is None else f", score {self.score:.3f}"
        lines = [
            f"{self.side} Gaussian {self.index}: {self.name or 'no class'}{score}",
            f"at ({place}), opacity {self.opacity:.2f}",
        ]
        if self.source is not None:
            said = "label from" if self.label >= 0 else "nearest labelled"
            reach = "" if self.label >= 0 else ": out of reach"
            lines.append(f"{said} semantic Gaussian {self.source}, {self.distance:.3g} away{reach}")
        if self.neighbours:
            near = [f"{name or 'none'} {distance:.2g}" for _, distance, name in self.neighbours[:SHOWN]]
            lines.append(f"near it: {', '.join(near)}")
        if self.views:
            seen = [f"{sight.name or sight.index} ({sight.weight:.0%})" for sight in self.views[:SHOWN]]
            more = f" and {len(self.views) - SHOWN} more" if len(self.views) > SHOWN else ""
            lines.append(f"seen by {', '.join(seen)}{more}")
        return lines
