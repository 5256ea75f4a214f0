"""Options of the explorer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from .._check import check_choice, check_range, check_whole

Style = Literal["auto", "gaussians", "points"]


@dataclass(frozen=True)
class ExploreOptions:
    """How the explorer draws, and where it saves."""

    height: int = 600
    """Height of the window, pixels."""
    width: int = 1200
    """Width of a window with two panes, pixels; one pane alone has half of it."""
    style: Style = "auto"
    """`gaussians` (as kfgs's rasteriser draws them), `points`, or `auto`: points if there are more than 150,000."""
    rest: float = 0.04
    """Factor on the opacity of Gaussians that are not selected, in [0, 1)."""
    background: str = "white"
    """A colour that pyvista knows."""
    out: Path = Path("kfgs_view")
    """Folder for saved pictures and selections."""

    def __post_init__(self) -> None:
        check_whole("height", self.height, 1)
        check_whole("width", self.width, 2)
        check_choice("style", self.style, get_args(Style))
        check_range("rest", self.rest, 0, 1, closed=(True, False))
        object.__setattr__(self, "out", Path(self.out))
