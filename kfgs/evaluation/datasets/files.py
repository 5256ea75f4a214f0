"""What the readers of ground truth share: mappings that read when asked, binary pictures, and finding a folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..._files import Names
from ...scenes.files import open_picture, some

T = TypeVar("T")


class ReadWhenAsked(Mapping[str, T]):
    """Values by name that are read from disk when they are asked for. Only the last one stays in memory."""

    def __init__(self, readers: Mapping[str, Callable[[], T]]) -> None:
        self._readers = dict(readers)
        self._last: tuple[str, T] | None = None

    def __getitem__(self, key: str) -> T:
        last = self._last  # one read: another thread may change it
        if last is None or last[0] != key:
            last = self._last = (key, self._readers[key]())
        return last[1]

    def __iter__(self) -> Iterator[str]:
        return iter(self._readers)

    def __len__(self) -> int:
        return len(self._readers)


def read_pixels(path: Path, expected: str, mode: str | None = None) -> NDArray[Any]:
    """The values of a picture, converted to a mode of PIL if one is named.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it cannot be decoded.
    """
    with open_picture(path, expected, "copy it again") as picture:
        return np.asarray(picture if mode is None else picture.convert(mode))


def read_mask(path: Path) -> Tensor:  # [H, W] bool
    """A binary picture: True where grey is at least 128 of 255, or anything but 0 where no pixel is brighter than 1."""
    grey = read_pixels(path, "a black and white picture of a mask", "L")
    return torch.from_numpy(grey >= 1 if grey.max(initial=0) == 1 else grey >= 128)


def find_folder(places: Sequence[Path], holds: str, what: str) -> Path:
    """The first place that has a file of this pattern; `what` is for the message.

    Raises:
        FileNotFoundError: if none has; the message names them.
    """
    for place in places:
        if place.is_dir() and next(place.glob(holds), None) is not None:
            return place
    tried = some([str(place) for place in dict.fromkeys(places)])
    raise FileNotFoundError(
        f"{places[0]}: expected {what} ({holds}) there, found none (looked in {tried}); give the right folder"
    )


def files_of_texts(folder: Path, texts: Sequence[str]) -> dict[str, Path]:
    """The PNG files of a folder by the text that each is named after (`Names`), or by its own stem."""
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() == ".png")
    found = Names(texts).find_each(file.stem for file in files)
    return {text or file.stem: file for file, text in zip(files, found, strict=True)}


def check_names(where: str, found: Sequence[str], known: Sequence[str], kind: str, advice: str) -> None:
    """Raise a ValueError unless every name is known."""
    unknown = [name for name in found if name not in set(known)]
    if unknown:
        near = Names(known).advice(unknown[0])
        raise ValueError(f"{where}: expected {kind} {', '.join(known)}; got {some(unknown, 3)} ({near}); {advice}")
