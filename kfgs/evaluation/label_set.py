"""The classes of a scene and their text embeddings, as they lie beside its images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from .._files import read_json
from ..labels.names import class_index


@dataclass(frozen=True, eq=False)
class LabelSet:
    """C class names with one embedding each, in the teacher's space; a label is an index into both."""

    names: tuple[str, ...]
    embeddings: Tensor  # [C, D]

    def __post_init__(self) -> None:
        if self.embeddings.ndim != 2 or len(self.names) != len(self.embeddings):
            raise ValueError(
                f"embeddings: expected [C, D] with C = {len(self.names)} (one row per name), "
                f"got {tuple(self.embeddings.shape)}"
            )
        if len(set(self.names)) != len(self.names):
            raise ValueError(f"names: expected different names, got {list(self.names)}")

    def __len__(self) -> int:
        return len(self.names)

    def index(self, name: str) -> int:
        """The label of a class; a ValueError offers names that are like an unknown one."""
        return class_index(name, self.names)


def load_label_set(classes: str | Path, embeddings: str | Path) -> LabelSet:
    """Read class names (a JSON list of strings) and embeddings (.npy, [C, D] floats).

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file is not what it should be, or the counts differ.
    """
    names = read_json(classes)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names) or not names:
        raise ValueError(
            f'{classes}: expected a JSON list of class names like ["wall", "floor"], got {type(names).__name__}'
        )
    path = Path(embeddings)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected an .npy file with one embedding row per class")
    try:
        rows = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise ValueError(f"{path}: expected an .npy file of numbers, but it cannot be read ({error})") from error
    if rows.ndim != 2 or rows.dtype.kind != "f" or len(rows) != len(names) or not np.isfinite(rows).all():
        raise ValueError(
            f"{path}: expected finite floats [C, D] with C = {len(names)} (from {classes}), got {rows.dtype} {rows.shape}"
        )
    return LabelSet(tuple(names), torch.from_numpy(rows.astype(np.float32)))
