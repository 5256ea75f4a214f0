"""What a field knows about its scene: the folder, and the classes in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..labels import LabelSet, load_label_set

CLASSES = ("classes.json", "text.npy"), ("classes.json", "text.safetensors"), ("text.safetensors",)
"""Files of a scene folder that make a label set; the first pair that exists is used."""


def scene_classes(scene: Path, channels: int | None = None) -> LabelSet | None:
    """The label set in a scene folder; None if there is none, it cannot be read, or it has other channels than the features."""
    files = next((names for names in CLASSES if all((scene / name).is_file() for name in names)), None)
    if files is None:
        return None
    try:
        classes = load_label_set(*(scene / name for name in files))
    except (ValueError, OSError):  # said when classes are asked for; a long fit does not fail at its end
        return None
    return classes if channels in (None, classes.embeddings.shape[1]) else None


def recall_scene(info: dict[str, Any]) -> Path:
    """The scene folder in a field's notes; a ValueError if there is no note, a FileNotFoundError if no folder."""
    if not isinstance(info.get("scene"), str):
        raise ValueError("scene: expected a field that remembers its scene, got one that does not; pass the scene")
    path = Path(info["scene"])
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such folder, where this field's scene was; pass the scene")
    return path
