"""Legends of a 3-D picture: classes by name, scores along a bar."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from .._check import check_range
from .cloud_colors import COLORMAP
from .pictures import LEGEND_INK, LEGEND_PAPER, check_names, legend_column

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]
MARGIN = 10  # pixels from a corner
DARK = 0.5  # of a background on which letters are white
LETTERS = 14  # pixels, in windows up to 770 pixels high; larger ones have larger letters, to be read from as far
SMALLEST = 9  # pixels: the least that can be read
BAR = 0.6  # of the subplot's height


def add_legend(
    plotter: pv.Plotter,
    labels: Tensor | Array,  # any shape, int
    names: Sequence[str],
) -> Any:
    """List the classes present, by name and colour, in the lower left corner of the active subplot.

    A small picture instead of pyvista's legend, which writes each name in its own colour: yellow on white. Where the
    subplot is too low for all classes, letters become smaller, down to 9 pixels, then there are several columns.

    Raises:
        ValueError: if there is no label, or one has no name.
        TypeError: if `names` is no list of names.
    """
    present = np.unique(labels.cpu().numpy() if isinstance(labels, Tensor) else np.asarray(labels))
    if present.size == 0:
        raise ValueError("labels: expected at least one to list, got none; leave the legend out")
    check_names(present.tolist(), names)  # now, not while a frame is drawn

    def draw(height: int, width: int) -> Array:
        room = height - 2 * MARGIN
        for size in range(letter_size(height), SMALLEST, -1):
            picture = legend_column(present, names, size)
            if len(picture) <= room:
                return picture
        return legend_column(present, names, SMALLEST, height=room)

    return pin_picture(plotter, draw)


def add_scalar_bar(plotter: pv.Plotter, cloud: pv.Actor | tuple[float, float], title: str = "score") -> Any:
    """Show which colour stands for which number, in a bar in the lower right corner of the active subplot.

    Args:
        plotter: where the cloud is.
        cloud: what `add_cloud` returned for scores or opacities; or the numbers of the darkest and the brightest colour.
        title: over the bar; broken into lines where it is wider than a fifth of the subplot.

    Raises:
        ValueError: if the cloud's colours stand for no numbers, or two numbers do not ascend.
    """
    clim = cloud if isinstance(cloud, tuple | list) else cloud.mapper.dataset.field_data.get("clim")
    if clim is None:
        raise ValueError(
            "cloud: expected one coloured by scores or opacity, got one without a scale; use add_legend for labels"
        )
    low, high = (float(end) for end in clim)
    check_range("cloud (its darkest)", low, -np.inf, closed=(False, False))
    check_range("cloud (its brightest)", high, low, closed=(False, False))
    return pin_picture(plotter, lambda height, width: bar_picture((low, high), title, height, width), "right")


def bar_picture(
    clim: tuple[float, float],
    title: str,
    height: int,
    width: int,
) -> Array:  # [h, w, 3] uint8
    """A bar of the colours from `clim[0]` (below) to `clim[1]`, with round numbers beside it and a title over it.

    Args:
        clim: the numbers of the darkest and the brightest colour.
        title: broken into lines.
        height: of the subplot, pixels.
        width: of the subplot, pixels.
    """
    from matplotlib import colormaps

    size = min(letter_size(height), max(SMALLEST, height // 16))
    font, gap, line = ImageFont.load_default(size=size), size // 2, round(size * 1.5)
    heading = _broken(title, font, max(width / 5, 8 * size))
    ticks = round_numbers(*clim)
    length = max(int(BAR * height) - line * len(heading), 4 * line)
    texts = [*heading, *(" " * 8 + f"{tick:g}" for tick in ticks)]
    across = 2 * gap + max(round(font.getlength(text)) for text in texts)
    paper = Image.new("RGB", (max(across, 4 * size), length + line * len(heading) + 2 * gap + size), LEGEND_PAPER)
    draw = ImageDraw.Draw(paper)
    for row, text in enumerate(heading):
        draw.text((gap, gap + row * line), text, fill=LEGEND_INK, font=font)
    top, right = gap + len(heading) * line + size // 2, gap + round(1.4 * size)
    colors = colormaps[COLORMAP](np.linspace(1, 0, length), bytes=True)[:, None, :3]
    paper.paste(Image.fromarray(np.repeat(colors, right - gap, axis=1)), (gap, top))
    for tick in ticks:
        y = top + (clim[1] - tick) / (clim[1] - clim[0]) * (length - 1)
        draw.line((right, y, right + size // 4, y), fill=LEGEND_INK)
        draw.text((right + gap, y), f"{tick:g}", fill=LEGEND_INK, font=font, anchor="lm")
    return np.asarray(paper)


def round_numbers(low: float, high: float) -> list[float]:
    """From three to six evenly spaced round numbers from `low` to `high`, ascending."""
    from matplotlib.ticker import MaxNLocator

    slack = 1e-9 * (high - low)
    ticks = MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10], min_n_ticks=3).tick_values(low, high)
    return [float(tick) + 0.0 for tick in ticks if low - slack <= tick <= high + slack]


def letter_size(height: int) -> int:
    """Pixels of letters in a subplot of this height."""
    return max(LETTERS, round(height / 55))


def letters(plotter: pv.Plotter) -> tuple[float, float, float]:
    """A colour for text that can be read on the active subplot's background."""
    dark = np.mean(plotter.renderer.GetBackground()) < DARK
    ink = (255, 255, 255) if dark else LEGEND_INK
    return (ink[0] / 255, ink[1] / 255, ink[2] / 255)


def _broken(text: str, font: Any, width: float) -> list[str]:
    """Words in lines no wider than `width` pixels, but for single words that are."""
    lines: list[str] = []
    for word in text.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and font.getlength(longer) <= width:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def pin_picture(
    plotter: pv.Plotter,
    draw: Callable[[int, int], Array],  # (height, width) of the subplot, pixels -> [h, w, 3] uint8
    corner: Literal["left", "right"] = "left",
) -> Any:
    """Put a picture into the lower left or the lower right corner of the active subplot.

    It is drawn pixel by pixel, and again when the subplot's size changes. It appears in the next frame: drawing one here could
    take long.

    Args:
        plotter: where to draw.
        draw: makes the picture, best no larger than the subplot without a margin of 10 pixels on each side.
        corner: which.

    Returns:
        The actor; `plotter.remove_actor` takes it away.
    """
    from vtkmodules.vtkRenderingCore import vtkActor2D, vtkImageMapper

    mapper = vtkImageMapper()
    mapper.SetColorWindow(255)  # bytes as they are
    mapper.SetColorLevel(127.5)
    actor = vtkActor2D()
    actor.SetMapper(mapper)
    pinned = _Pinned(plotter.renderer, actor, draw, corner)
    pinned.draw(*_size_of(plotter))
    plotter.add_actor(actor, reset_camera=False, pickable=False, render=False)
    pinned.tag = plotter.renderer.AddObserver("StartEvent", pinned.before_frame)
    return actor


class _Pinned:
    """Follows the size of its subplot as long as its actor is there."""

    def __init__(self, renderer: Any, actor: Any, make: Callable[[int, int], Array], corner: str) -> None:
        self.renderer, self.actor, self.make, self.corner = renderer, actor, make, corner
        self.size: tuple[int, int] | None = None
        self.tag = 0

    def before_frame(self, *_: Any) -> None:
        """The renderer is about to draw."""
        if not self.renderer.HasViewProp(self.actor):
            self.renderer.RemoveObserver(self.tag)
            return
        width, height = self.renderer.GetSize()
        self.draw(height, width)

    def draw(self, height: int, width: int) -> None:
        """Make the picture for a subplot of this size, unless it is there already."""
        if self.size == (height, width):
            return
        self.size = (height, width)
        picture = self.make(height, width)
        import pyvista as pv

        rows, columns, _ = picture.shape
        image = pv.ImageData(dimensions=(columns, rows, 1))
        image.point_data["rgb"] = picture[::-1].reshape(-1, 3)  # VTK counts rows from below
        image.set_active_scalars("rgb")
        self.actor.GetMapper().SetInputData(image)
        left = MARGIN if self.corner == "left" else max(width - columns - MARGIN, 0)
        self.actor.SetPosition(left, MARGIN)


def _size_of(plotter: pv.Plotter) -> tuple[int, int]:
    """(height, width) that the active subplot will have, also before the first frame."""
    width, height = plotter.window_size
    x0, y0, x1, y1 = plotter.renderer.GetViewport()
    return max(round((y1 - y0) * height), 1), max(round((x1 - x0) * width), 1)
