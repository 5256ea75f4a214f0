"""How a cloud was trained to be drawn, as its file says: antialiased, as flat surfels, or in a way that kfgs does not know.

`Gaussians.antialiased`: with the filter of Mip-Splatting, so what a renderer widens on the screen must become fainter. Surfels
(2DGS) are read as flat 3-D Gaussians, and a note says so. PLY files of Brush and Postshot say it in comments, SOG in
`meta.json`, SPZ in a flag, checkpoints in the settings next to them; other formats do not store it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch

from .._notes import tell
from ..gaussians import Gaussians

FLAT = 1e-3  # a surfel's thickness, times its shorter side: far below a pixel where the side is one
# Against rays that intersect them (17 pixels wide, 1/30 of the depth): alpha is off by 0.02 at 30 degrees, 0.04 at 75, 0.5 at 89.
AS_FLAT = (
    "2-D Gaussians (2DGS): drawn as flat 3-D ones, which differ if seen nearly from their edge, or from nearer than ten times "
    "their size"
)


class Mode(NamedTuple):
    """What a file says."""

    antialiased: bool = False
    surfels: bool = False
    unknown: tuple[str, ...] = ()  # what kfgs does not know, as the file writes it


_PLAIN, _MIP, _SURFELS = Mode(), Mode(antialiased=True), Mode(surfels=True)
_MODES = {  # what a file may say, by the word that announces it
    "splatrendermode:": {"default": _PLAIN, "mip": _MIP, "2dgs": _SURFELS},
    "antialiased": {"0": _PLAIN, "1": _MIP},
    "postshot.anti_aliasing": {"0": _PLAIN, "1": _MIP},
    "model": {"default": _PLAIN, "antialiased": _MIP, "2dgs": _SURFELS},
}


def mode_from_comments(comments: Iterable[str]) -> Mode:
    """Read the mode from the comments of a PLY header. The last one that kfgs knows counts, as in Brush."""
    mode, unknown = Mode(), []
    for comment in comments:
        key, *values = comment.lower().replace("=", " ").split() or [""]
        if key in _MODES and len(values) == 1:
            mode = _MODES[key].get(values[0], mode)
            unknown += [comment.strip()] * (values[0] not in _MODES[key])
    return mode._replace(unknown=tuple(unknown))


def mode_from_meta(meta: Mapping[str, Any]) -> Mode:
    """Read the mode from the `meta.json` of a SOG scene; `model` has priority over `antialias`."""
    model, antialias = meta.get("model"), meta.get("antialias")
    if isinstance(model, str) and model in _MODES["model"]:
        return _MODES["model"][model]
    said = {"model": model, "antialias": None if isinstance(antialias, bool) else antialias}
    unknown = tuple(f"{key}: {value!r:.40}" for key, value in said.items() if value is not None)
    return Mode(antialias is True, unknown=unknown)


def with_mode(path: Path, gaussians: Gaussians, mode: Mode) -> Gaussians:
    """A cloud that is drawn as its file says, with notes where that is not quite possible.

    Surfels have no extent along their third axis, whatever the file has there.
    """
    for words in mode.unknown:
        tell(f"{path.name}: the file says {words!r}, which kfgs does not know: drawn as 3-D Gaussians")
    if mode.surfels:
        tell(f"{path.name}: {AS_FLAT}")
        sides, depth = gaussians.scales[:, :2], gaussians.scales[:, 2]
        depth = torch.minimum(depth, FLAT * sides.amin(dim=1))
        gaussians = gaussians.replace(scales=torch.cat([sides, depth[:, None]], dim=1))
    return gaussians.replace(antialiased=mode.antialiased)


def comments_of_mode(gaussians: Gaussians) -> tuple[str, ...]:
    """Comments for a PLY header, in the words of Brush and of Postshot; none for an ordinary cloud."""
    return ("SplatRenderMode: mip", "antialiased 1") if gaussians.antialiased else ()
