"""The frames of a film: pictures of clouds from any camera, drawn by kfgs's rasteriser.

Unlike pyvista it needs no display and no OpenGL, and scores are computed from the same pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
import torch

from .._check import check_choice
from ..cameras import Camera
from ..gaussians import Gaussians, check_gaussians
from ..labels.color import parse_color
from ..splat import rasterize
from .cloud_colors import cloud_colors, color_by_default
from .field_colors import FeatureColors
from .palette import palette
from .pictures import as_bytes, legend_strip, picture_grid

Array = np.ndarray[Any, Any]
Show = Callable[[Camera], Any]
"""A function from a camera to a picture [H, W, 3] of the camera's size (uint8, or floats in [0, 1])."""

ColorBy = Literal["label", "rgb", "feature", "opacity"]


def show_cloud(
    gaussians: Gaussians,
    *,
    color_by: ColorBy | None = None,
    feature_colors: FeatureColors | None = None,
    background: str | Sequence[float] = "white",
    names: Sequence[str] | None = None,
) -> Show:
    """Make a function camera -> picture [H, W, 3] uint8 that draws a cloud with `rasterize`.

    Labels and features become one colour per Gaussian, and the colours are composited (Eq. 3 with three channels), so they
    blend at borders. `rgb` is the colour of the harmonics, which depends on the direction.

    Args:
        gaussians: what to draw; on any device.
        color_by: `label` (the palette), `rgb`, `feature` (through `feature_colors`) or `opacity`; None: as `add_cloud`.
        feature_colors: the scene's projection of features to colours.
        background: a colour by name or three numbers in [0, 1].
        names: class names: they decide the colours of labels, as in `palette`.

    Raises:
        ValueError: if the cloud is empty or lacks what to colour by.
    """
    check_gaussians(gaussians)
    if color_by is None:
        color_by, feature_colors = color_by_default(gaussians, feature_colors)
    check_choice("color_by", color_by, get_args(ColorBy))
    if len(gaussians) == 0:
        raise ValueError("gaussians: expected at least one Gaussian to draw, got none; widen the selection")
    painted = _paint(gaussians.detach(), color_by, feature_colors, names)
    paper = torch.tensor(parse_color(background, "background")).to(gaussians.means)

    def show(camera: Camera) -> Array:
        with torch.no_grad():
            drawn = rasterize(painted, camera.to(painted.means), background=paper)
        return as_bytes(drawn.map)

    return show


def _paint(
    gaussians: Gaussians, color_by: ColorBy, feature_colors: FeatureColors | None, names: Sequence[str] | None
) -> Gaussians:
    """The cloud with the colours as features; for `rgb`, with its harmonics only."""
    colors = cloud_colors(gaussians, color_by, feature_colors).rgb
    if color_by == "label" and gaussians.labels is not None:
        colors = palette(gaussians.labels, names)
    if color_by == "rgb":
        return gaussians.replace(features=None)
    return gaussians.replace(features=torch.from_numpy(colors).to(gaussians.means) / 255, sh=None)


def draw_frame(
    shows: Mapping[str, Show],
    camera: Camera,
    strip: Array | None = None,  # [h, w, 3] uint8
) -> Array:  # [h, w, 3] uint8
    """One frame: the pictures side by side under their titles; a single picture without a title stays as it is."""
    pictures = []
    for title, show in shows.items():
        picture = as_bytes(show(camera))
        if picture.shape != (camera.height, camera.width, 3):
            raise ValueError(
                f"shows[{title!r}]: expected pictures [{camera.height}, {camera.width}, 3] (from the camera), got "
                f"{picture.shape}; draw at the camera's size, without a legend"
            )
        pictures.append(picture)
    frame = pictures[0] if list(shows) == [""] else picture_grid([pictures], list(shows))
    return frame if strip is None else np.concatenate([frame, strip[:, : frame.shape[1]]])


def as_shows(
    shows: Gaussians | Show | Mapping[str, Gaussians | Show], names: Sequence[str] | None = None
) -> dict[str, Show]:
    """Bring the `shows` argument into one form: a drawing function for each title. A single one has the title ""."""
    named = shows if isinstance(shows, Mapping) else {"": shows}
    if not named:
        raise ValueError("shows: expected at least one thing to show, got none; pass Gaussians or a function")
    made: dict[str, Show] = {}
    for title, thing in named.items():
        if isinstance(thing, Gaussians):
            made[title] = show_cloud(thing, names=names)
        elif callable(thing):
            made[title] = thing
        else:
            raise TypeError(
                f"shows[{title!r}]: expected Gaussians or a function of a camera, got {type(thing).__name__}; "
                "make one with show_cloud"
            )
    return made


def legend_under(
    shows: Gaussians | Show | Mapping[str, Gaussians | Show],
    names: Sequence[str],
    width: int,
) -> Array:  # [h, width, 3] uint8
    """The legend below every frame: the classes of all labelled clouds, visible or not."""
    things = list(shows.values()) if isinstance(shows, Mapping) else [shows]
    labels = [thing.labels.cpu() for thing in things if isinstance(thing, Gaussians) and thing.labels is not None]
    if not labels:
        raise ValueError(
            "names: expected labelled Gaussians among what is shown, got none; leave names out, and draw the legend in "
            "your own pictures"
        )
    return legend_strip(torch.cat(labels).unique(), names, width)
