"""The explorer's state: question, gamma, lambda, colours, hidden classes, picked Gaussian. Draws nothing."""

from __future__ import annotations

import numbers
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch

from .._check import as_array, check_choice, check_range, check_whole
from .._files import as_path
from ..cameras import Camera
from ..gaussians import Gaussians
from ..labels import Selection, class_indices
from ..labels.nearest import positions
from ..viz.palette import palette
from .carried import SPAN, Array, Carried
from .meaning import Asked, Meaning
from .picked import SIDE_WORDS, Describe, Picked, Side
from .saved import SelectedSide, save_sides
from .side_colors import SideColors

Show = Literal["labels", "rgb", "score", "latents"]


class Exploration:
    """What the explorer shows: `Explorer`'s methods change it, the other methods say what to draw.

    A colour Gaussian takes the label of the nearest labelled semantic Gaussian if that is strictly closer than lambda
    (Sec. 3.4), and is selected if that one is. The nearest one is computed once, so changing lambda or gamma takes
    milliseconds.

    Args:
        meaning: the semantic cloud and its answers.
        color: the colour cloud, in the same frame; None: the semantic side alone.
        cameras: views without distortion, to find those that see a picked Gaussian; at most 30 are used, evenly chosen.
        distance: lambda, world units; None: from the clouds' spacing (`labels.default_distance`).

    Raises:
        ValueError: if a cloud is empty, a position is not finite, or lambda is not positive.
    """

    def __init__(
        self,
        meaning: Meaning,
        color: Gaussians | None = None,
        *,
        cameras: Sequence[Camera] = (),
        distance: float | None = None,
    ) -> None:
        if not isinstance(getattr(meaning, "gaussians", None), Gaussians):
            raise TypeError(
                f"meaning: expected a FieldMeaning or a SplatMeaning, got {type(meaning).__name__}; `explore` makes one"
            )
        if meaning.gaussians.labels is None:
            raise ValueError(
                "meaning.gaussians.labels: expected labels [N], got None; use FieldMeaning or SplatMeaning"
            )
        clouds: dict[Side, Gaussians] = {"semantic": meaning.gaussians}
        if color is not None:
            clouds["color"] = color.with_origin(meaning.gaussians.origin)
        for name, cloud in clouds.items():
            if len(cloud) == 0:
                raise ValueError(f"{name}: expected at least one Gaussian, got none; choose another file")
        positions("meaning.gaussians.means", meaning.gaussians.means)
        for camera in cameras:
            if camera.distortion is not None:
                raise ValueError(
                    f"cameras: expected views without distortion, got {camera.distortion.model} ({camera.name!r}); pass "
                    "those of scene.undistorted()"
                )
        self.meaning = meaning
        self.cameras = tuple(camera.with_origin(meaning.gaussians.origin) for camera in cameras)
        self.sides: tuple[Side, ...] = tuple(clouds)
        self._clouds = clouds
        self._carried = None if color is None else Carried(meaning.gaussians, clouds["color"])
        self._own_labels = as_array(meaning.gaussians.labels).astype(np.int64)
        self._colors = SideColors(clouds, self._carried, meaning.feature_colors)
        self.show_choices: tuple[Show, ...] = ("labels", *self._colors.show_choices, "score")
        self.show: Show = "labels"
        self.asked: Asked | None = None
        self.gamma: float | None = None
        self.gamma_how = ""
        self.hidden: frozenset[int] = frozenset()
        suggested = 1.0 if self._carried is None else self._carried.suggested
        self.distance, self.distance_how = suggested, "no colour side" if self._carried is None else self._carried.how
        if distance is not None:
            self.set_distance(distance)
        self.distance_range = min(suggested / SPAN, self.distance), max(suggested * SPAN, self.distance)
        self._picked: tuple[Side, int] | None = None
        self._describe = Describe(meaning, clouds, self._carried, self.cameras)

    @property
    def first_show(self) -> Show:
        """The meaning of the colours that the viewer opens with: the clouds' own if they have some, else classes."""
        return "rgb" if "rgb" in self.show_choices else "labels"

    @property
    def gamma_range(self) -> tuple[float, float]:
        """The smallest and the largest useful gamma; 0 and 1 without a question."""
        return (0.0, 1.0) if self.asked is None else (self.asked.low, self.asked.high)

    @property
    def picked(self) -> Picked | None:
        """The picked Gaussian under the current question and lambda; None if it is hidden."""
        if self._picked is None:
            return None
        picked = self._describe(*self._picked, self.asked, self.distance)
        return None if picked.label in self.hidden else picked

    def ask(self, words: str | None) -> Asked | None:
        """See `Explorer.ask`. Sets gamma to the value that the answer suggests."""
        if not isinstance(words, str | None):
            raise TypeError(
                f"words: expected text, got {words!r} ({type(words).__name__}); ask for one class or phrase"
            )
        if words is None or not words.strip():
            self.asked, self.gamma, self.gamma_how = None, None, ""
            return None
        self.asked = self.meaning.ask(words)
        self.gamma, self.gamma_how = self.asked.selection.threshold, self.asked.selection.how
        return self.asked

    def set_gamma(self, gamma: float) -> None:
        """See `Explorer.set_gamma`; the range is `gamma_range`."""
        if self.asked is None:
            raise ValueError(f"gamma: expected a question that it applies to, got none (gamma {gamma!r}); ask first")
        check_number("gamma", gamma)
        low, high = self.gamma_range
        slack = 1e-6 * max(high - low, abs(low), abs(high))  # a slider rounds to float32
        check_range("gamma", gamma, low - slack, high + slack)
        self.gamma, self.gamma_how = min(max(float(gamma), low), high), "given"

    def set_distance(self, distance: float) -> None:
        """See `Explorer.set_distance`."""
        check_number("distance", distance)
        check_range("distance", distance, 0, closed=(False, False))
        self.distance, self.distance_how = float(distance), "given"

    def set_show(self, show: Show) -> None:
        """See `Explorer.set_show`."""
        check_choice("show", show, get_args(Show))
        if show not in self.show_choices:
            lacking = "harmonics (sh)" if show == "rgb" else "features"
            raise ValueError(
                f"show: expected one of {', '.join(self.show_choices)} (no cloud has {lacking}), got {show!r}; "
                "choose one of these"
            )
        self.show = show

    def set_hidden(self, labels: Iterable[int | str]) -> None:
        """See `Explorer.set_hidden`."""
        if isinstance(labels, str) or not isinstance(labels, Iterable):
            raise TypeError(f"labels: expected a list of labels or names, got {labels!r}; pass [{labels!r}]")
        wanted: list[int] = []
        for label in labels:
            if isinstance(label, str):
                wanted += class_indices(label, self.meaning.names)
            else:
                check_whole("labels", label, -1, len(self.meaning.names) - 1)
                wanted.append(int(label))
        self.hidden = frozenset(wanted)

    def cloud(self, side: Side) -> Gaussians:
        """The Gaussians of a side."""
        check_choice("side", side, self.sides)
        return self._clouds[side]

    def labels(self, side: Side) -> Array:  # [N] int64
        """The label of each Gaussian of a side, -1 = none."""
        self.cloud(side)
        return self._own_labels if self._carried is None or side == "semantic" else self._take(self._own_labels, -1)

    @property
    def carried(self) -> Carried | None:
        """The source of each colour Gaussian; None without a colour side."""
        return self._carried

    def base_colors(self, side: Side) -> Array:  # [N, 3] uint8
        """The colours of a side from everywhere; if it has none, those of the other side."""
        return self._colors.rgb(side)

    def latents(self, side: Side) -> Array:  # [N, 3] uint8
        """The latents of a side as colours."""
        return self._colors.latents(side, self.distance)

    def selected(self, side: Side) -> Array:  # [N] bool
        """Which Gaussians of a side are selected, hidden or not; none without a question."""
        cloud = self.cloud(side)
        if self.asked is None or self.gamma is None:
            return np.zeros(len(cloud), dtype=bool)
        own = as_array((self.asked.selection.scores > self.gamma) & self.asked.valid)
        return own if side == "semantic" else self._take(own, False)

    def drawn(self, side: Side) -> Array:  # [N] bool
        """Which Gaussians of a side are not in a hidden class."""
        labels = self.labels(side)
        return ~np.isin(labels, list(self.hidden)) if self.hidden else np.ones(len(labels), dtype=bool)

    @property
    def present(self) -> frozenset[int]:
        """The labels present on either side now, hidden or not; -1 included if a Gaussian has none."""
        return frozenset(int(label) for side in self.sides for label in np.unique(self.labels(side)))

    def scores(self, side: Side) -> Array:  # [N] float64
        """Scores of the question, or of the labels if there is no question; NaN if unknown."""
        self.cloud(side)
        if self.asked is None:
            values, known = self.meaning.scores, self._own_labels >= 0
        else:
            values, known = self.asked.selection.scores, as_array(self.asked.valid)
        own = np.where(known, as_array(values).astype(np.float64), np.nan)
        return own if side == "semantic" else self._take(own, np.nan)

    @property
    def clim(self) -> tuple[float, float]:
        """The scores of the darkest and the brightest colour, equal on both sides."""
        if self.asked is not None:
            return self.gamma_range
        own = self.scores("semantic")
        own = own[np.isfinite(own)]
        return (float(own.min()), float(own.max())) if own.size and own.min() < own.max() else (0.0, 1.0)

    def colors(self, side: Side) -> Array:  # [N, 3] uint8
        """The colours of a side under the current `show`; grey if unknown."""
        self.cloud(side)
        if self.show == "labels":
            return palette(self.labels(side), self.meaning.names)
        if self.show == "score":
            return self._colors.of_scores(side, self.scores(side), self.clim)
        if self.show == "rgb":
            return self._colors.rgb(side)
        return self._colors.latents(side, self.distance)

    def pick(self, side: Side, index: int) -> Picked:
        """Pick a Gaussian."""
        check_whole("index", index, 0, len(self.cloud(side)) - 1)
        self._picked = side, int(index)
        return self._describe(*self._picked, self.asked, self.distance)

    def drop_pick(self) -> None:
        """Pick nothing."""
        self._picked = None

    def details(self) -> dict[str, Any]:
        """The state as JSON: question, gamma, lambda, and the count of each class on each side.

        Classes are [name, count] pairs in label order, because two classes may have the same name.
        """
        details: dict[str, Any] = {
            "words": None if self.asked is None else self.asked.words,
            "gamma": self.gamma,
            "gamma_how": self.gamma_how,
            "by": self.meaning.by,
        }
        if "color" in self.sides:
            details |= {"lambda": self.distance, "lambda_how": self.distance_how}
        for side in self.sides:
            labels = self.labels(side)
            counts = np.bincount(labels + 1, minlength=len(self.meaning.names) + 1)
            details[side] = {
                "total": len(labels),
                "selected": int(self.selected(side).sum()),
                "classes": [[name, int(count)] for name, count in zip(self.meaning.names, counts[1:], strict=True)],
                "none": int(counts[0]),
            }
        if "color" in self.sides:
            details["color"]["orphaned"] = details["color"]["none"]
        return details

    def lines(self) -> list[str]:
        """The state as a few lines of text."""
        lines = []
        if self.asked is not None:
            lines.append(f"{self.asked.words!r}: score > {self.gamma:.3g} ({self.gamma_how})")
        for side in self.sides:
            total, chosen = len(self.cloud(side)), ""
            if self.asked is not None:
                chosen = f"{int(self.selected(side).sum()):,} of "
            lines.append(f"{SIDE_WORDS[side]}: {chosen}{total:,} Gaussians")
        if "color" in self.sides:
            orphaned, total = int((self.labels("color") < 0).sum()), len(self.cloud("color"))
            far = f"farther than lambda = {self.distance:.3g} from any labelled one"
            lines.append(f"{orphaned:,} of {total:,} colour Gaussians are {far}, so they have no class")
        return lines

    def save_selection(self, folder: str | Path) -> list[Path]:
        """Write the selection: numbers as selection.json, the Gaussians of each side as selection_<side>.ply.

        selection.json lists the connected parts (at most the 16 largest), each with the best of at most 30 evenly chosen
        views. Hidden Gaussians are written too. Either all files appear or none; a side without a selection has no file.

        Raises:
            ValueError: if nothing is selected on any side.
        """
        sides = {
            side: SelectedSide(
                self.cloud(side),
                self.selection(side),
                torch.from_numpy(self.labels(side)),
                torch.from_numpy(self.scores(side)),
            )
            for side in self.sides
            if self.selected(side).any()
        }
        if not sides:
            words = "no question is asked"
            if self.asked is not None:
                words = f"score > {self.gamma:.4g} for {self.asked.words!r}"
            raise ValueError(
                f"selection: expected at least one Gaussian, got none ({words}); ask first, or lower gamma"
            )
        return save_sides(sides, self.details(), self.meaning.names, self.cameras, as_path(folder))

    def selection(self, side: Side) -> Selection:
        """The selection on a side, with its scores (0 if unknown) and gamma.

        Raises:
            ValueError: if no question is asked.
        """
        if self.asked is None:
            raise ValueError("selection: expected a question, got none; ask for something first")
        scores = torch.from_numpy(np.nan_to_num(self.scores(side), nan=0.0))
        mask = torch.from_numpy(self.selected(side))
        return Selection(mask, scores, self.gamma, self.gamma_how)

    def _take(self, values: Array, nothing: Any) -> Array:
        """Carry values of the semantic Gaussians to the colour side; `nothing` beyond lambda."""
        assert self._carried is not None
        return np.where(self._carried.within(self.distance), values[self._carried.source], nothing)


def check_number(name: str, value: object) -> None:
    """Raise a TypeError unless `value` is a number and no bool."""
    if not isinstance(value, numbers.Real) or isinstance(value, bool):
        raise TypeError(f"{name}: expected a number, got {value!r} ({type(value).__name__}); pass a float")
