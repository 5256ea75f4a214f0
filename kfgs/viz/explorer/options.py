"""How the explorer draws, and where it saves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from ..._check import check_choice, check_range, check_whole

Style = Literal["auto", "gaussians", "points"]


@dataclass(frozen=True)
class ExploreOptions:
    """How the explorer draws, and where it saves."""

    height: int = 600
    """Of the window, pixels."""
    width: int = 1200
    """Of the window with both panes, pixels; of one pane alone, half of it."""
    style: Style = "auto"
    """`gaussians` (what kfgs's own rasteriser draws), `points`, or `auto`: points where a frame takes over 1 s."""
    rest: float = 0.04
    """Factor on the opacity of what is not selected, in [0, 1)."""
    background: str = "white"
    """A colour that pyvista knows."""
    out: Path = Path("kfgs_view")
    """A folder for pictures and selections."""

    def __post_init__(self) -> None:
        check_whole("height", self.height, 1)
        check_whole("width", self.width, 2)
        check_choice("style", self.style, get_args(Style))
        check_range("rest", self.rest, 0, 1, closed=(True, False))
        object.__setattr__(self, "out", Path(self.out))
