"""What the readers of masks share: binary pictures, folders, and files that are named after texts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from kfgs._files import Names
from kfgs.scenes.files import open_picture, some


def read_mask(path: Path) -> Tensor:  # [H, W] bool
    """A binary picture: True where grey is at least 128 of 255, or anything but 0 where no pixel is brighter than 1."""
    with open_picture(path, "a black and white picture of a mask", "copy it again") as picture:
        grey = np.asarray(picture.convert("L"))
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
    matched = Names(texts).find_each(file.stem for file in files)
    return {text or file.stem: file for file, text in zip(files, matched, strict=True)}


def check_names(where: str, names: Sequence[str], known: Sequence[str], kind: str, advice: str) -> None:
    """Raise a ValueError unless every name is known."""
    unknown = [name for name in names if name not in set(known)]
    if unknown:
        near = Names(known).advice(unknown[0])
        raise ValueError(f"{where}: expected {kind} {', '.join(known)}; got {some(unknown, 3)} ({near}); {advice}")
