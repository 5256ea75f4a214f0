"""Draw the desktop window's panel as a picture, with the boxes that can be clicked. Knows no window and no events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, log
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..._card import short_repr
from ..palette import palette
from ..pictures import LEGEND_INK

Array = np.ndarray[Any, Any]
Box = tuple[int, int, int, int]  # left, top, right, bottom, in pixels from the panel's upper left corner

WIDTH = 300  # pixels
LETTERS, MARGIN, LINE = 13, 10, 20  # pixels
PAPER, FIELD, PALE, MUTED = (244, 244, 246), (255, 255, 255), (214, 214, 220), (104, 104, 112)
CHOSEN, ALARM = (0, 100, 165), (176, 0, 32)
LEAST_ROWS = 4  # rows of classes, however long the text below


class Spot(NamedTuple):
    """Something in the panel that can be clicked."""

    kind: str  # question, slider, show, style, do, box, name, all
    value: Any  # a slider's name, an action, a label
    box: Box


@dataclass(frozen=True)
class Slider:
    """A number between two ends."""

    name: str
    value: float | None
    """None: the slider is pale and cannot be dragged."""
    low: float
    high: float
    logarithmic: bool = False

    def share(self, value: float) -> float:
        """The position of a value between the ends, in [0, 1]."""
        low, high, x = (log(v) if self.logarithmic else v for v in (self.low, self.high, self._inside(value)))
        return (x - low) / (high - low) if high > low else 0.0

    def at(self, share: float) -> float:
        """The value at a position, which is clipped to [0, 1]."""
        part = min(max(share, 0.0), 1.0)
        if not self.logarithmic:
            return self._inside(self.low + part * (self.high - self.low))
        return self._inside(exp(log(self.low) + part * (log(self.high) - log(self.low))))

    def _inside(self, value: float) -> float:  # rounding could leave the range
        return min(max(value, self.low), self.high)


@dataclass(frozen=True)
class PanelView:
    """The content of the panel."""

    question: str = ""
    """The question, or the text typed so far."""
    hint: str = ""
    """The text that Tab would add."""
    typing: bool = False
    sliders: Sequence[Slider] = ()
    choices: Sequence[tuple[str, Sequence[str], str]] = ()
    """Rows of buttons: (kind, names, the chosen one)."""
    actions: Sequence[str] = ()
    classes: Sequence[tuple[int, str]] = ()
    """(label, name)."""
    names: Sequence[str] | None = None
    """Of all classes, in label order: they decide the colours."""
    hidden: frozenset[int] = frozenset()
    scroll: int = 0
    """Number of class rows scrolled past."""
    lines: Sequence[str] = ()
    note: str = ""
    """The result of the last action."""
    error: str = ""
    """The error of the last action."""
    keys: Sequence[str] = ()


class Panel(NamedTuple):
    """The picture, the boxes that can be clicked, and the largest useful `scroll`."""

    picture: Array  # [H, W, 3] uint8
    spots: list[Spot]
    last_scroll: int

    def __repr__(self) -> str:
        return short_repr(self)

    def find(self, x: float, y: float) -> Spot | None:
        """The spot at a point: pixels from the upper left corner."""
        for spot in self.spots:
            left, top, right, bottom = spot.box
            if left <= x < right and top <= y < bottom:
                return spot
        return None


def draw_panel(view: PanelView, height: int, width: int = WIDTH) -> Panel:
    """Draw the panel: question, sliders and buttons above, classes in the middle, status and keys below.

    If one column of classes is not enough there are two, and if two are not enough they scroll.
    """
    pen = _Pen(height, width)
    _draw_question(pen, view)
    for slider in view.sliders:
        _draw_slider(pen, slider)
    for kind, buttons, chosen in view.choices:
        pen.buttons(kind, buttons, chosen)
    pen.buttons("do", view.actions, None)
    below = [(line, MUTED) for text in view.keys for line in pen.wrap(text)]
    status = [(line, LEGEND_INK) for text in view.lines for line in pen.wrap(text)]
    status += [(line, CHOSEN) for line in pen.wrap(view.note)] + [(line, ALARM) for line in pen.wrap(view.error)]
    room = (height - MARGIN - pen.y) // LINE - LEAST_ROWS - 2 - len(below)
    if len(status) > max(room, 0):  # keep the end: the error or the picked Gaussian is the newest
        status = status[len(status) - max(room, 0) :]
    bottom = height - MARGIN - LINE * (len(status) + len(below))
    last = _draw_classes(pen, view, bottom - LINE // 2)
    for row, (line, ink) in enumerate(status + below):
        pen.text(MARGIN, bottom + LINE * row + LINE // 2, line, ink)
    return Panel(np.asarray(pen.image), pen.spots, last)


class _Pen:
    """Draws from the top downwards, and records the spots that can be clicked."""

    def __init__(self, height: int, width: int) -> None:
        self.image = Image.new("RGB", (width, height), PAPER)
        self.draw = ImageDraw.Draw(self.image)
        self.font: Any = ImageFont.load_default(size=LETTERS)
        self.width, self.y = width, MARGIN
        self.spots: list[Spot] = []

    def text(self, x: float, middle: float, words: str, ink: tuple[int, int, int] = LEGEND_INK) -> None:
        self.draw.text((x, middle), words, fill=ink, font=self.font, anchor="lm")

    def length(self, words: str) -> float:
        return float(self.font.getlength(words))

    def fit(self, words: str, room: float) -> str:
        """The text, cut with "..." if it is too long."""
        if self.length(words) <= room:
            return words
        kept = words
        while kept and self.length(kept + "...") > room:
            kept = kept[:-1]
        return kept + "..."

    def wrap(self, words: str) -> list[str]:
        """Break text into lines that fit the panel; a word that is too long is cut."""
        lines: list[str] = []
        for word in words.split():
            longer = f"{lines[-1]} {word}" if lines else word
            if lines and self.length(longer) <= self.width - 2 * MARGIN:
                lines[-1] = longer
            else:
                lines.append(self.fit(word, self.width - 2 * MARGIN))
        return lines

    def button(self, box: Box, words: str, on: bool) -> None:
        left, top, right, bottom = box
        self.draw.rounded_rectangle((left, top, right - 1, bottom - 1), 4, CHOSEN if on else FIELD, PALE)
        self.draw.text(
            ((left + right) / 2, (top + bottom) / 2), self.fit(words, right - left - 4), anchor="mm", font=self.font,
            fill=FIELD if on else LEGEND_INK,
        )  # fmt: skip

    def buttons(self, kind: str, names: Sequence[str], chosen: str | None) -> None:
        """A row of buttons, each as wide as its text needs."""
        wanted = [self.length(name) for name in names]
        spare = (self.width - 2 * MARGIN - 4 * (len(names) - 1) - sum(wanted)) / max(len(names), 1)
        left = float(MARGIN)
        for name, length in zip(names, wanted, strict=True):
            box = (round(left), self.y, round(left + length + spare), self.y + LINE + 4)
            self.button(box, name, name == chosen)
            self.spots.append(Spot(kind, name, box))
            left += length + spare + 4
        self.y += LINE + 9 if names else 0


def _draw_question(pen: _Pen, view: PanelView) -> None:
    box = (MARGIN, pen.y, pen.width - MARGIN, pen.y + 28)
    middle, room = pen.y + 14, pen.width - 2 * MARGIN - 16
    pen.draw.rounded_rectangle((box[0], box[1], box[2] - 1, box[3] - 1), 4, FIELD, CHOSEN if view.typing else PALE)
    if view.typing:
        typed = view.question
        while pen.length(typed) > room:  # show the end, where the cursor is
            typed = typed[1:]
        end = MARGIN + 8 + pen.length(typed)
        pen.text(MARGIN + 8, middle, typed)
        pen.draw.line((end + 1, pen.y + 6, end + 1, pen.y + 21), LEGEND_INK)
        pen.text(end + 2, middle, pen.fit(view.hint, MARGIN + 8 + room - end) if view.hint else "", MUTED)
    else:
        empty = "press / and type what to look for"
        pen.text(MARGIN + 8, middle, pen.fit(view.question or empty, room), LEGEND_INK if view.question else MUTED)
    pen.spots.append(Spot("question", None, box))
    pen.y += 36


def _draw_slider(pen: _Pen, slider: Slider) -> None:
    ready = slider.value is not None
    pen.text(MARGIN, pen.y + 9, slider.name, LEGEND_INK if ready else MUTED)
    number = f"{slider.value:.4g}" if slider.value is not None else "-"
    pen.text(pen.width - MARGIN - pen.length(number), pen.y + 9, number, LEGEND_INK if ready else MUTED)
    left, right, middle = MARGIN + 7, pen.width - MARGIN - 7, pen.y + 27
    pen.draw.rounded_rectangle((left, middle - 2, right, middle + 2), 2, PALE)
    if slider.value is not None:
        x = left + slider.share(slider.value) * (right - left)
        pen.draw.rounded_rectangle((left, middle - 2, x, middle + 2), 2, CHOSEN)
        pen.draw.ellipse((x - 7, middle - 7, x + 7, middle + 7), CHOSEN)
        pen.spots.append(Spot("slider", slider.name, (left, middle - 10, right + 1, middle + 11)))
    pen.y += 42


def _draw_classes(pen: _Pen, view: PanelView, bottom: int) -> int:
    """Draw boxes and names down to `bottom`; returns the number of rows that do not fit."""
    if not view.classes:
        return 0
    pen.text(MARGIN, pen.y + LINE // 2, pen.fit("classes: box shows, name asks", pen.width - 90), MUTED)
    box = (pen.width - MARGIN - 62, pen.y, pen.width - MARGIN, pen.y + LINE)
    pen.button(box, "show all" if view.hidden else "hide all", on=False)
    pen.spots.append(Spot("all", bool(view.hidden), box))
    pen.y += LINE + 4
    rows = max((bottom - pen.y) // LINE, 1)
    columns = 1 if len(view.classes) <= rows else 2
    last = max(-(-len(view.classes) // columns) - rows, 0)
    first = min(view.scroll, last) * columns
    step = (pen.width - 2 * MARGIN) // columns
    colors = palette(np.array([label for label, _ in view.classes]), view.names).tolist()
    for place, (label, name) in enumerate(view.classes[first : first + rows * columns]):
        column, row = (place // rows, place % rows) if last == 0 else (place % columns, place // columns)
        corner, color = (MARGIN + column * step, pen.y + row * LINE), tuple(colors[first + place])
        _draw_class(pen, label, name, color, corner, step, label not in view.hidden)
    if last:  # a scroll bar
        x, top, tall = pen.width - 6, pen.y, rows * LINE
        all_rows = last + rows
        begin = top + tall * min(view.scroll, last) / all_rows
        pen.draw.rectangle((x, top, x + 2, top + tall), PALE)
        pen.draw.rectangle((x, begin, x + 2, begin + tall * rows / all_rows), MUTED)
    return last


def _draw_class(
    pen: _Pen,
    label: int,
    name: str,
    color: tuple[int, int, int],
    corner: tuple[int, int],
    step: int,
    shown: bool,
) -> None:
    (x, y), (red, green, blue) = corner, color
    box = (x, y + 3, x + 14, y + 17)
    pen.draw.rectangle((box[0], box[1], box[2] - 1, box[3] - 1), (red, green, blue) if shown else FIELD, LEGEND_INK)
    if shown:
        ink = FIELD if 0.3 * red + 0.59 * green + 0.11 * blue < 140 else LEGEND_INK
        pen.draw.line((x + 3, y + 10, x + 6, y + 13, x + 11, y + 6), ink, 2)
    else:
        pen.draw.rectangle((x + 3, y + 6, x + 10, y + 13), (red, green, blue))
    pen.text(x + 20, y + LINE // 2, pen.fit(name, step - 26), LEGEND_INK if shown else MUTED)
    pen.spots.append(Spot("box", label, (x, y, x + 18, y + LINE)))
    if label >= 0:
        pen.spots.append(Spot("name", label, (x + 18, y, x + step - 2, y + LINE)))
