"""What the viewer shows: two clouds, a question, gamma and lambda. Draws nothing; page, notebook and window all use it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
from scipy.spatial import cKDTree

from .._check import as_array, check_choice, check_range
from .._origin import to_world
from ..cameras import Camera
from ..gaussians import Gaussians
from ..labels.transfer import Sources, positions
from ..splat.sh import SH_C0
from ..viz.colors import Array, FeatureColors, cloud_colors
from ..viz.linked import upwards
from ..viz.palette import UNLABELLED, palette
from ..viz.pictures import as_bytes
from .meaning import Asked, Meaning

Side = Literal["semantic", "color"]
Show = Literal["labels", "rgb", "score", "latents"]
SIDE_WORDS: dict[Side, str] = {"semantic": "semantic", "color": "colour"}
GREY = np.array(UNLABELLED, dtype=np.uint8)
DOWN_Y = (0.0, -1.0, 0.0)  # up in nearly all files of splats without cameras: y points down
SPAN = 30.0  # the lambda slider reaches from a 30th of the suggestion to 30 times it


@dataclass(frozen=True)
class Picked:
    """A picked Gaussian."""

    side: Side
    index: int
    name: str  # its class
    score: float  # for the question, or of its label without one; NaN if unknown
    position: tuple[float, float, float]  # in the world


class Exploration:
    """The state of a viewer. The methods `ask` and `set_...` change it, the others say what to draw.

    A colour Gaussian takes the label of the nearest labelled semantic Gaussian if that is strictly closer than lambda
    (Sec. 3.4), and is selected if that one is. The nearest one is computed once, so changing lambda or gamma takes
    milliseconds and selects what `transfer_labels` selects.

    Args:
        meaning: the semantic cloud and its answers.
        color: the colour cloud, in the same frame; None: the semantic side alone.
        cameras: views without distortion, to find those that see a Gaussian.
        distance: lambda, world units; None: from the clouds' spacing (see `labels.nearest_labels`).
    """

    def __init__(
        self,
        meaning: Meaning,
        color: Gaussians | None = None,
        *,
        cameras: Sequence[Camera] = (),
        distance: float | None = None,
    ) -> None:
        semantic = meaning.gaussians
        assert semantic.labels is not None
        self._clouds: dict[Side, Gaussians] = {"semantic": semantic}
        if color is not None:
            self._clouds["color"] = color.with_origin(semantic.origin)
        for side, cloud in self._clouds.items():
            if len(cloud) == 0:
                raise ValueError(f"{side}: expected at least one Gaussian, got none; choose another file")
            positions(f"{side}.means", cloud.means)
        for camera in cameras:
            if camera.distortion is not None:
                got = f"{camera.distortion.model} ({camera.name!r})"
                raise ValueError(f"cameras: expected views without distortion, got {got}; pass scene.undistorted()'s")
        self.meaning = meaning
        self.cameras = tuple(camera.with_origin(semantic.origin) for camera in cameras)
        self.sides: tuple[Side, ...] = tuple(self._clouds)
        self.up: Sequence[float] = upwards(cameras) if cameras else DOWN_Y
        self._own_labels = as_array(semantic.labels).astype(np.int64)
        self.source, self.far, suggested, self.distance_how = self._find_sources()
        self._base: dict[Side, Array] = {}
        colorless = all(cloud.sh is None for cloud in self._clouds.values())
        absent: dict[Show, bool] = {"rgb": colorless, "latents": semantic.features is None}
        self.show_choices: tuple[Show, ...] = tuple(show for show in get_args(Show) if not absent.get(show))
        self.show: Show = "labels"
        self.things: dict[str, dict[str, Any]] = {}  # what a page shows as well, by name (`pack_thing`)
        self.asked: Asked | None = None
        self.gamma: float | None = None
        self.gamma_how = ""
        self.distance = suggested
        if distance is not None:
            self.set_distance(distance)
        self.distance_range = min(suggested / SPAN, self.distance), max(suggested * SPAN, self.distance)

    def ask(self, words: str | None) -> Asked | None:
        """Ask for a class or a phrase, with the gamma that the answer suggests. None or "" clears the question.

        A ValueError if there is no answer to these words; the earlier question stays.
        """
        if words is None or not words.strip():
            self.asked, self.gamma, self.gamma_how = None, None, ""
            return None
        self.asked = self.meaning.ask(words)
        self.gamma, self.gamma_how = self.asked.selection.threshold, self.asked.selection.how
        return self.asked

    def set_gamma(self, gamma: float) -> None:
        """Select the Gaussians that score above gamma; a ValueError without a question, or out of `gamma_range`."""
        if self.asked is None:
            raise ValueError(f"gamma: expected a question that it applies to, got none (gamma {gamma!r}); ask first")
        low, high = self.gamma_range
        slack = 1e-6 * max(high - low, abs(low), abs(high))  # a slider rounds to float32
        check_range("gamma", gamma, low - slack, high + slack)
        self.gamma, self.gamma_how = min(max(float(gamma), low), high), "given"

    def set_distance(self, distance: float) -> None:
        """Set lambda: colour Gaussians closer than this to a semantic one take its label. In world units, positive."""
        check_range("distance", distance, 0, closed=(False, False))
        self.distance, self.distance_how = float(distance), "given"

    def set_show(self, show: Show) -> None:
        """Choose what the colours mean, one of `show_choices`: classes, own colours, latents or scores."""
        check_choice("show", show, self.show_choices)
        self.show = show

    @property
    def first_show(self) -> Show:
        """The meaning of the colours that the page opens with: the clouds' own if they have some, else classes."""
        return "rgb" if "rgb" in self.show_choices else "labels"

    @property
    def gamma_range(self) -> tuple[float, float]:
        """The smallest and the largest useful gamma; 0 and 1 without a question."""
        return (0.0, 1.0) if self.asked is None else (self.asked.low, self.asked.high)

    def cloud(self, side: Side) -> Gaussians:
        """The Gaussians of a side."""
        check_choice("side", side, self.sides)
        return self._clouds[side]

    def labels(self, side: Side) -> Array:  # [N] int64
        """The label of each Gaussian of a side, -1 = none."""
        return self._on(side, self._own_labels, -1)

    def selected(self, side: Side) -> Array:  # [N] bool
        """Which Gaussians of a side are selected; none without a question."""
        if self.asked is None or self.gamma is None:
            return np.zeros(len(self.cloud(side)), dtype=bool)
        return self._on(side, as_array((self.asked.selection.scores > self.gamma) & self.asked.valid), False)

    def scores(self, side: Side) -> Array:  # [N] float64
        """Scores of the question, or of the labels if there is no question; NaN if unknown."""
        if self.asked is None:
            values, known = self.meaning.scores, self._own_labels >= 0
        else:
            values, known = self.asked.selection.scores, as_array(self.asked.valid)
        return self._on(side, np.where(known, as_array(values).astype(np.float64), np.nan), np.nan)

    def describe(self, side: Side, index: int) -> Picked:
        """What is known about a Gaussian."""
        cloud = self.cloud(side)
        x, y, z = to_world(cloud.means[index], cloud.origin).tolist()
        score = float(self.scores(side)[index])
        return Picked(side, index, self.class_name(int(self.labels(side)[index])), score, (x, y, z))

    def class_name(self, label: int) -> str:
        """The name of a class; "no class" for -1."""
        return self.meaning.names[label] if label >= 0 else "no class"

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
        if self.show == "labels":
            return palette(self.labels(side), self.meaning.names)
        if self.show == "score":
            return cloud_colors(self.cloud(side), self.scores(side), clim=self.clim).rgb
        return as_bytes(self.base_colors(side)) if self.show == "rgb" else self._on(side, self.latents, GREY)

    def base_colors(self, side: Side) -> Array:  # [N, 3]
        """The colours of a side from everywhere, mostly in [0, 1]; without any, the nearest ones of the other side, or grey."""
        if side not in self._base:
            own = self.cloud(side)
            if own.sh is not None:
                self._base[side] = as_array(own.sh[:, 0]).astype(np.float64) * SH_C0 + 0.5
            elif "rgb" in self.show_choices:
                other: Side = "color" if side == "semantic" else "semantic"
                tree = cKDTree(as_array(self.cloud(other).means), balanced_tree=False, compact_nodes=False)
                self._base[side] = self.base_colors(other)[tree.query(as_array(own.means), workers=-1)[1]]
            else:
                self._base[side] = np.tile(GREY / 255, (len(own), 1))
        return self._base[side]

    @cached_property
    def latents(self) -> Array:  # [S, 3] uint8
        """The latents of the semantic side as colours; grey if a latent was never learnt."""
        features = self._clouds["semantic"].features
        assert features is not None
        return np.where(as_array(features.any(dim=1))[:, None], FeatureColors.fit(features)(features), GREY)

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
        return details

    def lines(self) -> list[str]:
        """The state as a few lines of text."""
        lines = []
        if self.asked is not None:
            lines.append(f"{self.asked.words!r}: score > {self.gamma:.3g} ({self.gamma_how})")
        for side in self.sides:
            chosen = "" if self.asked is None else f"{int(self.selected(side).sum()):,} of "
            lines.append(f"{SIDE_WORDS[side]}: {chosen}{len(self.cloud(side)):,} Gaussians")
        if "color" in self.sides:
            orphaned, total = int((self.labels("color") < 0).sum()), len(self.cloud("color"))
            far = f"farther than lambda = {self.distance:.3g} from any labelled one"
            lines.append(f"{orphaned:,} of {total:,} colour Gaussians are {far}, so they have no class")
        return lines

    def _find_sources(self) -> tuple[Array, Array, float, str]:
        """For each colour Gaussian the nearest labelled semantic one (-1: none is labelled), its distance; and lambda.

        The same as `nearest_labels`, for all lambdas at once.
        """
        if "color" not in self._clouds:
            return np.zeros(0, np.int64), np.zeros(0), 1.0, "no colour side"
        points, targets = (positions(side, cloud.means) for side, cloud in self._clouds.items())
        sources = Sources(points, self._own_labels >= 0)
        far, source = sources.nearest(targets)
        distance, how = sources.default_distance(targets)
        return source, far, distance or 1.0, how

    def _on(self, side: Side, own: Array, nothing: Any) -> Array:
        """Values of the semantic Gaussians, or carried from them to the colour side; `nothing` beyond lambda."""
        check_choice("side", side, self.sides)
        if side == "semantic":
            return own
        reached = np.less(self.far, self.distance)
        return np.where(reached.reshape(-1, *[1] * (own.ndim - 1)), own[self.source], nothing).astype(own.dtype)
