"""A field's notes about its scene: relative paths and digests of classes and text table, so that it finds them again."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from .._files import digest_file, real_path
from .._typed import typed
from ..labels import LabelSet, load_label_set

CLASSES = ("classes.json", "text.npy"), ("classes.json", "text.safetensors"), ("text.safetensors",)
"""Files of a scene folder that make a label set; the first pair that exists is used."""


def remember(scene: Path, field: Path, channels: int | None = None) -> dict[str, Any]:
    """Make a field's notes about a scene folder, as JSON: paths relative to the field, and digests.

    Classes are left out if their embeddings cannot be read, or do not have the `channels` of the teacher's features.
    """
    found: dict[str, Any] = {"scene": _relative(scene, field)}
    for names in CLASSES:
        files = [scene / name for name in names]
        if all(file.is_file() for file in files):
            if channels is not None and not _is_of(files, channels):
                break
            found["classes"] = [{"path": _relative(file, field), "sha256": digest_file(file)} for file in files]
            break
    return found


def check_notes(info: object) -> dict[str, Any]:
    """A field's `info` as it is; a ValueError if it is no object, or if views or classes are not as `remember` writes them."""
    if not isinstance(info, dict):
        raise ValueError(f"info: expected an object, got {type(info).__name__}")
    views, classes = info.get("views", []), info.get("classes", [])
    if not isinstance(views, list | tuple) or not all(isinstance(name, str) for name in views):
        raise ValueError(f"info.views: expected a list of names, got {views!r:.80}")
    files = classes if isinstance(classes, list | tuple) else [None]
    if not all(isinstance(one, dict) and {"path", "sha256"} <= set(one) for one in files):
        raise ValueError(f"info.classes: expected a list of files with path and sha256, got {classes!r:.80}")
    return info


def rebased(info: dict[str, Any], old: Path | None, new: Path) -> dict[str, Any]:
    """The notes of a field that moves to another folder."""
    if old is None or real_path(old) == real_path(new):
        return info
    moved = dict(info)
    if isinstance(info.get("scene"), str):
        moved["scene"] = _relative(real_path(old) / info["scene"], new)
    if info.get("classes"):
        moved["classes"] = [one | {"path": _relative(real_path(old) / one["path"], new)} for one in info["classes"]]
    return moved


@typed
def recall_scene(info: dict[str, Any], folder: Path | None) -> Path:
    """The scene folder in a field's notes; a ValueError if there is no note, a FileNotFoundError if no folder."""
    noted = info.get("scene")
    if not isinstance(noted, str) or folder is None:
        raise ValueError("scene: expected a field that remembers its scene, got one that does not; pass the scene")
    path = noted_path(folder, noted)
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such folder, where this field's scene was; pass the scene")
    return path


def scene_in_words(info: dict[str, Any], folder: Path | None) -> dict[str, str]:
    """The scene of a field's notes as a user can name it: below the current folder if it lies there, else absolute."""
    noted = info.get("scene")
    if not isinstance(noted, str) or folder is None:
        return {}
    path = noted_path(folder, noted)
    here = real_path(Path.cwd())
    shown = path.relative_to(here) if path.is_relative_to(here) else path
    return {"scene": f"{shown}" if path.is_dir() else f"{shown} (not there any more)"}


def recall_classes(info: dict[str, Any], folder: Path | None) -> LabelSet:
    """The label set that a field remembers.

    Raises:
        ValueError: if it remembers none, or a file has changed.
        FileNotFoundError: if a file is missing.
    """
    noted = info.get("classes")
    if not noted or folder is None:
        raise ValueError(
            "classes: expected a label set, or a field that remembers the classes of its scene, got neither; pass "
            "the classes (in Python: load_label_set(names, embeddings))"
        )
    files = [noted_path(folder, str(one["path"])) for one in noted]
    for file, one in zip(files, noted, strict=True):
        if not file.is_file():
            raise FileNotFoundError(f"{file}: no such file, where this field's classes were; pass the classes")
        if digest_file(file) != one["sha256"]:
            raise ValueError(
                f"classes: expected {file} as it was when the field was fitted, got another; pass the classes that you mean"
            )
    return load_label_set(*files)


def _is_of(files: list[Path], channels: int) -> bool:
    try:
        return load_label_set(*files).embeddings.shape[1] == channels
    except (ValueError, OSError):  # said when classes are asked for; a long fit does not fail at its end
        return False


def _relative(path: Path, field: Path) -> str:
    return Path(os.path.relpath(real_path(path), real_path(field))).as_posix()


def noted_path(place: Path, noted: str) -> Path:
    """The absolute form of a path that is relative to a folder. Links are resolved first: it is noted of the real folder."""
    return Path(os.path.normpath(real_path(place) / noted))
