"""Options of LSeg: the size that pictures are resized to, scales, mirroring, arithmetic."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from ..._check import check_choice, check_range, check_whole
from .windows import BASE_OVER_CROP, count_forwards

PAPER_SCALES = (0.75, 1.0, 1.25, 1.75)


@dataclass(frozen=True)
class LSegOptions:
    """Options of LSeg. The defaults are the paper's, except that pictures that are not 4:3 keep their aspect.

    Raises:
        ValueError: if a value is out of its range.
        TypeError: if `scales` are no numbers.
    """

    scales: tuple[float, ...] = PAPER_SCALES
    """Scales whose features are summed; 1 is a long side of 520 pixels."""
    flip: bool = True
    """Average with the features of the mirrored picture."""
    size: Literal["auto"] | tuple[int, int] | None = "auto"
    """Size of the map, and of the resized picture. "auto": long side 480 pixels, or the picture's if that is smaller, aspect
    kept, rounded half up. (height, width): this size if the picture is wider than `width`, else the picture's, as in the
    paper's script, with any aspect. None: the picture's size."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Arithmetic of the network; the features are float32 in any case."""

    def __post_init__(self) -> None:
        numbers = isinstance(self.scales, Sequence) and not isinstance(self.scales, str)
        if not numbers or not all(isinstance(scale, int | float) for scale in self.scales):
            raise TypeError(f"scales: expected numbers, got {self.scales!r}; pass (1.0,) for one scale")
        object.__setattr__(self, "scales", tuple(float(scale) for scale in self.scales))
        if not self.scales:
            raise ValueError("scales: expected at least one scale, got none; pass (1.0,)")
        for scale in self.scales:
            check_range("scales", scale, 0.0, 16.0, closed=(False, True))  # 8320 pixels; more is a slip
        check_choice("precision", self.precision, ("float32", "bfloat16"))
        check_choice("flip", self.flip, (False, True))
        if self.size is None or self.size == "auto":
            return
        if not isinstance(self.size, tuple | list) or len(self.size) != 2:
            raise ValueError(f"size: expected 'auto', (height, width) or None, got {self.size!r}; pass (360, 480)")
        height, width = self.size
        for side in (height, width):
            check_whole("size", side, 1)
        object.__setattr__(self, "size", (int(height), int(width)))

    @staticmethod
    def paper() -> LSegOptions:
        """The paper's script: 26 runs of the network per picture, resized to 360 x 480 if it is wider than 480.

        The script does so for any aspect and orientation, and does not resize pictures of 480 columns or fewer. For 4:3
        pictures, for instance 640 x 480, the defaults do the same.
        """
        return LSegOptions(size=(360, 480))

    @staticmethod
    def fast() -> LSegOptions:
        """One scale, one window, no mirroring: the network runs once for a picture, whatever its shape, not 26 times."""
        return LSegOptions(scales=(1 / BASE_OVER_CROP,), flip=False)

    def map_size(self, height: int, width: int, *, window: int = 480) -> tuple[int, int]:
        """Size (h, w) of the map of a picture of that size.

        Example:
            >>> LSegOptions().map_size(480, 640), LSegOptions().map_size(479, 639), LSegOptions().map_size(640, 360)
            ((360, 480), (360, 480), (480, 270))
        """
        if self.size is None or (self.size == "auto" and max(height, width) <= window):
            return height, width
        if self.size == "auto":
            ratio = window / max(height, width)
            h, w = (max(1, math.floor(side * ratio + 0.5)) for side in (height, width))
            return h, w
        assert not isinstance(self.size, str)
        return self.size if width > self.size[1] else (height, width)

    def forwards(self, height: int, width: int, *, window: int = 480) -> int:
        """How often the network runs for a picture of that size.

        Example:
            >>> LSegOptions().forwards(480, 640), LSegOptions.fast().forwards(480, 640)
            (26, 1)
        """
        h, w = self.map_size(height, width, window=window)
        return count_forwards(h, w, window=window, scales=self.scales, flip=self.flip)
