"""Extra files next to a splat file: class names, and the labels if the format cannot store them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .._arrays import read_arrays
from .._check import ORIGIN, as_origin
from .._files import as_path, atomic_path, digest_file, read_json, real_path, write_json
from .._origin import Origin
from ..gaussians import Gaussians
from .values import SCORE

_NPZ_HEADERS = 1 << 16  # bytes of headers in an .npz file of three arrays


def names_path(path: str | Path) -> Path:
    """`scene.ply` -> `scene.ply.classes.json`: the names of the classes of this one splat file."""
    path = as_path(path)
    return path.with_name(path.name + ".classes.json")


def labels_path(path: str | Path) -> Path:
    """`scene.splat` -> `scene.splat.labels.npz`: `class_id` and `score` of a format that cannot hold them."""
    path = as_path(path)
    return path.with_name(path.name + ".labels.npz")


def origin_path(path: str | Path) -> Path:
    """`scene.splat` -> `scene.splat.origin.json`: where in the world the (0, 0, 0) of a file lies that holds float32 only."""
    path = as_path(path)
    return path.with_name(path.name + ".origin.json")


def write_names(path: str | Path, classes: tuple[str, ...], **facts: Any) -> Path:
    """Write the class names of a splat file next to it, with details about how its labels were made."""
    target = names_path(path)
    write_json(target, {"class_id": dict(enumerate(classes)), "none": -1, **facts})
    return target


def write_sidecar(
    path: Path, gaussians: Gaussians, facts: Mapping[str, Any], *, holds_labels: bool, holds_origin: bool
) -> list[Path]:
    """Write the labels, names and origin that the format cannot store, and delete those of an older `path`.

    Names are written for every labelled file, even if the format stores them, so that people can read them.
    """
    labels, written = gaussians.labels, []
    beside = labels_path(path)
    if labels is not None and not holds_labels:
        arrays = {"class_id": labels.to(torch.int32).cpu().numpy(), "of": np.array(_digest(path))}
        if gaussians.scores is not None:
            arrays[SCORE] = gaussians.scores.detach().to("cpu", torch.float32).numpy()
        with atomic_path(beside) as temporary, temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        written.append(beside)
    else:
        beside.unlink(missing_ok=True)
    if gaussians.origin != ORIGIN and not holds_origin:
        write_json(origin_path(path), {"origin": gaussians.origin, "of": _digest(path)})
        written.append(origin_path(path))
    else:
        origin_path(path).unlink(missing_ok=True)
    if labels is not None and gaussians.names:
        written.append(write_names(path, gaussians.names, **facts))
    else:
        names_path(path).unlink(missing_ok=True)
    return written


def read_sidecar(path: Path, gaussians: Gaussians) -> Gaussians:
    """Add labels, names and the origin from the files next to a splat file; those in the splat file have priority.

    If `path` is a link, files next to the link come first, then those next to the file that it leads to.

    Raises:
        ValueError: if such a file is damaged, or its labels belong to another version of the splat file.
    """
    beside = _first(labels_path(place) for place in _places(path))
    if gaussians.labels is None and beside is not None:
        gaussians = _with_labels(beside, path, gaussians)
    far = _first(origin_path(place) for place in _places(path))
    if far is not None:
        gaussians = gaussians.replace(origin=_read_origin(far, path))
    names = find_names(path)
    if gaussians.labels is not None and not gaussians.names and names is not None:
        gaussians = gaussians.replace(names=read_names(names))
    return gaussians


def find_names(path: str | Path) -> Path | None:
    """The file with the class names of a splat file (`names_path`): next to the path or, if that is a link, to its target."""
    return _first(names_path(place) for place in _places(path))


def _places(path: str | Path) -> tuple[Path, ...]:
    """A path, and the file that it leads to if it is a link."""
    return (as_path(path), real_path(path))


def _first(paths: Iterable[Path]) -> Path | None:
    return next((path for path in paths if path.is_file()), None)


def read_names(path: Path) -> tuple[str, ...]:
    """The names of classes 0, 1, ... from a file that `write_names` wrote.

    Raises:
        ValueError: if it holds something else.
    """
    content = read_json(path)
    table = content.get("class_id") if isinstance(content, dict) else None
    if not isinstance(table, dict) or set(table) != {str(i) for i in range(len(table))}:
        raise ValueError(f"{path}: expected 'class_id' with the names of classes 0, 1, ..., got {type(table).__name__}")
    names = tuple(table[str(i)] for i in range(len(table)))
    if not all(isinstance(name, str) for name in names):
        raise ValueError(f"{path}: expected names, got {names!r:.80}; write each class as a string")
    return names


def _with_labels(beside: Path, path: Path, gaussians: Gaussians) -> Gaussians:
    labels, score, of = _load_labels(beside, path, len(gaussians))
    if of != _digest(path) or labels.shape != (len(gaussians),):
        raise ValueError(
            f"{beside}: expected the labels of this version of {path.name}, got those of another version; delete it, or write "
            "both again"
        )
    if (labels < -1).any() or (score is not None and score.shape != labels.shape):
        raise ValueError(f"{beside}: expected class_id of -1 or more and as many scores, got others; delete it")
    scores = None if score is None else torch.from_numpy(score)
    return gaussians.replace(labels=torch.from_numpy(labels.astype(np.int64)), scores=scores)


def _read_origin(far: Path, path: Path) -> Origin:
    content = read_json(far)
    try:
        origin, of = as_origin(content["origin"]), content["of"]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{far}: expected an origin of three numbers, got {content!r:.80}; delete it") from error
    if of != _digest(path):
        raise ValueError(
            f"{far}: expected the origin of this version of {path.name}, got that of another version; delete it if the file "
            "has coordinates of the world, or write both again"
        )
    return origin


def _load_labels(beside: Path, path: Path, count: int) -> tuple[NDArray[Any], NDArray[Any] | None, str]:
    """Read `class_id`, `score` and the digest of their splat file; sizes are checked before unpacking."""
    found = read_arrays(
        beside, f"labels of the {count} Gaussians of {path.name}", "delete it", most=16 * count + _NPZ_HEADERS
    )
    if not {"class_id", "of"} <= set(found):
        raise ValueError(f"{beside}: expected the arrays class_id and of, got {', '.join(found) or 'none'}; delete it")
    labels, of, score = found["class_id"], str(found["of"]), found.get(SCORE)
    if labels.dtype.kind not in "iu" or (score is not None and score.dtype.kind != "f"):
        raise ValueError(f"{beside}: expected whole numbers as class_id, got {labels.dtype}; delete it")
    return labels, score, of


def _digest(path: Path) -> str:
    return digest_file(path / "meta.json" if path.is_dir() else path)
