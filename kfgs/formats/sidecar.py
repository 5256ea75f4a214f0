"""Extra files next to a splat file: class names, and the labels and the origin if the format cannot store them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .._arrays import FileError, read_arrays, reading
from .._check import ORIGIN, as_origin
from .._files import as_path, atomic_path, digest_file, read_json, real_path, write_json
from ..gaussians import Gaussians
from .values import SCORE

NAMES, LABELS, ORIGINS = ".classes.json", ".labels.npz", ".origin.json"
"""What follows the name of a splat file: its classes; `class_id` and `score` of a format that cannot hold them; and where the
(0, 0, 0) of a file that holds float32 only lies in the world."""
_NPZ_HEADERS = 1 << 16  # bytes of headers in an .npz file of three arrays


def beside(path: str | Path, ending: str) -> Path:
    """`scene.ply` -> `scene.ply.classes.json`."""
    return as_path(path).with_name(as_path(path).name + ending)


def write_names(path: str | Path, classes: tuple[str, ...], **facts: Any) -> Path:
    """Write the class names of a splat file next to it, with details about how its labels were made."""
    write_json(beside(path, NAMES), {"class_id": dict(enumerate(classes)), "none": -1, **facts})
    return beside(path, NAMES)


def write_sidecar(path: Path, gaussians: Gaussians, facts: Mapping[str, Any], holds: frozenset[str]) -> list[Path]:
    """Write the labels and the origin if a format does not hold them, and the names; delete those of an older `path`.

    Names are written for every labelled file, even if the format stores them, so that people can read them.
    """
    labels, written = gaussians.labels, []
    if labels is not None and "labels" not in holds:
        arrays = {"class_id": labels.to(torch.int32).cpu().numpy(), "of": np.array(digest_file(path))}
        if gaussians.scores is not None:
            arrays[SCORE] = gaussians.scores.detach().to("cpu", torch.float32).numpy()
        with atomic_path(beside(path, LABELS)) as temporary, temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        written.append(beside(path, LABELS))
    if gaussians.origin != ORIGIN and "origin" not in holds:
        write_json(beside(path, ORIGINS), {"origin": gaussians.origin, "of": digest_file(path)})
        written.append(beside(path, ORIGINS))
    if labels is not None and gaussians.names:
        written.append(write_names(path, gaussians.names, **facts))
    for older in {beside(path, ending) for ending in (NAMES, LABELS, ORIGINS)} - set(written):
        older.unlink(missing_ok=True)
    return written


def read_sidecar(path: Path, gaussians: Gaussians) -> Gaussians:
    """Add labels, names and the origin from the files next to a splat file; those in the splat file have priority.

    If `path` is a link, files next to the link come first, then those next to the file that it leads to. A FileError if one
    is damaged, or belongs to another version of the splat file.
    """
    labels, origin, names = (
        next((file for place in (path, real_path(path)) if (file := beside(place, ending)).is_file()), None)
        for ending in (LABELS, ORIGINS, NAMES)
    )
    if labels is not None or origin is not None:
        digest, n = digest_file(path / "meta.json" if path.is_dir() else path), len(gaussians)
    if gaussians.labels is None and labels is not None:
        what = f"labels of the {n} Gaussians of {path.name}"
        with reading(labels, what, "delete it"):
            arrays = read_arrays(labels, what, "delete it", most=16 * n + _NPZ_HEADERS)  # before it is unpacked
            classes = arrays["class_id"]
            _check_version(labels, path, str(arrays["of"]), digest)
            if classes.dtype.kind not in "iu" or (classes < -1).any():
                raise ValueError(f"class_id: {classes.dtype}, not whole numbers of -1 or more")
            gaussians = gaussians.replace(labels=classes.astype(np.int64), scores=arrays.get(SCORE))
    if origin is not None:
        with reading(origin, "an origin of three numbers", "delete it"):
            content = read_json(origin)
            _check_version(origin, path, content["of"], digest)
            gaussians = gaussians.replace(origin=as_origin(content["origin"]))
    if gaussians.labels is not None and not gaussians.names and names is not None:
        gaussians = gaussians.replace(names=read_names(names))
    return gaussians


def _check_version(file: Path, path: Path, of: object, digest: str) -> None:
    if of != digest:
        got = "one of another version; delete it, or write both again"
        raise FileError(f"{file}: expected a file of this version of {path.name}, got {got}")


def read_names(path: Path) -> tuple[str, ...]:
    """The names of classes 0, 1, ... from a file that `write_names` wrote; a FileError if it holds something else."""
    with reading(path, "'class_id' with the names of classes 0, 1, ...", "write each class as a string"):
        table = read_json(path)["class_id"]
        names = tuple(table[str(i)] for i in range(len(table)))
        if not all(isinstance(name, str) for name in names):
            raise ValueError(f"got {names!r:.80}")
        return names
