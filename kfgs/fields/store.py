"""A semantic field on disk: a folder with `field.safetensors` and `field.json`, or one packed file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._arrays import read_safetensors
from .._check import ORIGIN, as_origin, check_choice
from .._files import as_path, atomic_folder, atomic_path, digest_file, read_json, write_json
from .._origin import Origin
from .._tensors import save_tensors
from ..cameras import Camera
from ..gaussians import TENSORS as CLOUD
from ..gaussians import Gaussians
from ..labels import LabelSet
from ..quant import Autoencoder, Codebook, LinearLatents
from ..scenes.files import PIXELS
from .answers import Seen
from .container import HEADER, pack_tensors, peek, unpack_tensors
from .parts import check_parts
from .precision import PRECISIONS, Rounding
from .remembered import check_notes, rebased, recall_classes

DESCRIPTION, TENSORS = "field.json", "field.safetensors"
"""The files in the folder of a field; the first one holds the digest of the second."""
SUFFIX = ".kfgs.safetensors"
"""Of a field in one file."""
FORMAT, VERSIONS = "kfgs.semantic_field", (1, 2, 3)
"""Version 2 may hold linear latents, fused answers and cameras; version 3 the classes."""


def describes_field(folder: Path) -> bool:
    """Whether a folder is that of a field."""
    return (folder / DESCRIPTION).is_file()


def find_field(path: str | Path) -> Path | None:
    """The field at a path: a field folder, also by one of its two files; a packed field; that of a run folder; or None."""
    path = as_path(path)
    if path.name in (DESCRIPTION, TENSORS) and path.is_file() and describes_field(path.parent):
        return path.parent
    found = (one for one in (path, path / "field") if describes_field(one))
    return next(found, path if _peek(path) is not None else None)


def field_data(path: Path) -> Path:
    """The file with the numbers of a field: in its folder, or the packed file."""
    return path / TENSORS if path.is_dir() else path


def save_field(path: str | Path, parts: Mapping[str, Any], precision: str | Rounding | None = None) -> None:
    """Write the parts of a field, as returned by `load_field`; see `SemanticField.save`."""
    path = as_path(path)
    single = path.name.endswith(SUFFIX)
    if precision is not None and not single:
        raise ValueError(
            f"path: expected a name that ends in {SUFFIX} for a field in one file, got {path}; give another, or leave "
            "precision out to write a folder"
        )
    check_place(path)
    if single:
        parts = _moved(parts, path)
        data = pack_parts({**parts, "words": _words(parts, path)}, precision or "lossless")
        with atomic_path(path) as temporary:
            temporary.write_bytes(data)
        return
    tensors, description = _to_tensors(_moved(parts, path))
    with atomic_folder(path) as folder:
        save_tensors(folder / TENSORS, tensors)
        version = VERSIONS[-1] if "words" in description else VERSIONS[-2]
        about = {"format": FORMAT, "version": version, "sha256": digest_file(folder / TENSORS)}
        write_json(folder / DESCRIPTION, about | description)


def holds_field(path: Path, parts: Mapping[str, Any]) -> bool:
    """Whether a folder holds already what `save_field` would write to it."""
    tensors, description = _to_tensors(_moved(parts, path))
    try:
        there, about = _read_folder(path)
    except (OSError, ValueError):
        return False
    same = tensors.keys() == there.keys() and all(torch.equal(tensors[name], there[name]) for name in tensors)
    rest = {name: value for name, value in about.items() if name not in ("format", "version", "sha256")}
    return same and rest == json.loads(json.dumps(description))


def _moved(parts: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """The parts of a field for another place: paths in its notes are relative to it."""
    return {**parts, "info": rebased(check_notes(parts["info"]), parts["folder"], path)}


def check_place(path: Path) -> None:
    """Raise a FileExistsError unless there is nothing at `path`, or a field that may be replaced."""
    single = path.name.endswith(SUFFIX)
    older = _peek(path) is not None if single else path.is_dir() and (describes_field(path) or not any(path.iterdir()))
    if path.exists() and not older:
        raise FileExistsError(
            f"path: expected a new {'file' if single else 'folder'} or an older field at {path}, got something else; "
            "give another"
        )


def pack_parts(parts: Mapping[str, Any], precision: str | Rounding) -> bytes:
    """The bytes of a packed field; see `pack_field`."""
    if not isinstance(precision, Rounding):
        check_choice("precision", precision, PRECISIONS)
    tensors, description = _to_tensors(parts)
    return pack_tensors(tensors, description, precision)


def unpack_parts(data: bytes, name: str = "data") -> dict[str, Any]:
    """The parts of a field from the bytes of `pack_parts`; a ValueError that begins with `name` for others."""
    tensors, description = unpack_tensors(data, name)
    return _from_tensors(name, tensors, description)


def load_field(path: str | Path) -> dict[str, Any]:
    """The parts of a field, by name; see `SemanticField.load`."""
    path = as_path(path)
    if path.is_file():
        return unpack_parts(b"" if _peek(path) is None else path.read_bytes(), str(path))
    tensors, description = _read_folder(path)
    return _from_tensors(str(path), tensors, description)


def read_description(path: Path) -> dict[str, Any]:
    """What `field.json` says about the field of a folder.

    Raises:
        FileNotFoundError: if there is no field.
        ValueError: if the file is damaged, or of another format or version.
    """
    return _read_description(path, path / DESCRIPTION)


def _read_description(path: Path, file: Path) -> dict[str, Any]:
    if not file.is_file():
        raise FileNotFoundError(
            f"{path}: expected a saved field, a file or a folder with {DESCRIPTION}, found none; pass what "
            "SemanticField.save got"
        )
    description = read_json(file)
    found = description.get("format") if isinstance(description, dict) else None
    if found != FORMAT:
        raise ValueError(f"{path}: expected a field ({FORMAT}), got {found!r}; pass what SemanticField.save wrote")
    if description.get("version") not in VERSIONS:
        known = " or ".join(map(str, VERSIONS))
        raise ValueError(
            f"{path}: expected format version {known}, got {description.get('version')!r}; use the kfgs that wrote it"
        )
    return dict(description)


def _read_folder(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and description of a field folder."""
    description, file = read_description(path), path / TENSORS
    if not file.is_file() or digest_file(file) != description.get("sha256"):
        raise ValueError(
            f"{path}: expected {TENSORS} as it was saved, got {'another' if file.is_file() else 'none'}; copy the whole "
            "folder again, or fit the field again"
        )
    return read_safetensors(file, "the numbers of a field", "fit it again")[0], description


def _peek(path: Path) -> dict[str, Any] | None:
    """See `peek`; None for a folder."""
    if not path.is_file():
        return None
    with path.open("rb") as file:
        return peek(file.read(HEADER + 8))


def _words(parts: Mapping[str, Any], path: Path) -> LabelSet | None:
    """The classes that a field holds or remembers; None if their files are gone or have changed."""
    try:
        return parts["words"] or recall_classes(parts["info"], path)
    except (OSError, ValueError):
        return None


def _to_tensors(parts: Mapping[str, Any]) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """All tensors of a field by name, and the rest of it as JSON."""
    gaussians, cameras, words = parts["gaussians"], parts["cameras"], parts["words"]
    try:
        json.dumps(parts["info"], allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"info: expected what JSON can hold, got {error}; use strings and finite numbers") from error
    values = ((name, getattr(gaussians, name)) for name in CLOUD)
    tensors = {f"gaussians.{name}": value for name, value in values if value is not None}
    for part in ("codebook", "autoencoder", "linear"):
        if parts[part] is not None:
            tensors |= {f"{part}.{name}": value for name, value in parts[part].to_tensors().items()}
    if parts["answers"] is not None:
        tensors["answers.latents"] = parts["answers"]
    if parts["seen"] is not None:
        tensors |= {f"seen.{name}": value for name, value in parts["seen"]._asdict().items()}
    if cameras:
        cameras = [camera.with_origin(gaussians.origin) for camera in cameras]
        tensors["cameras.viewmats"] = torch.stack([camera.viewmat for camera in cameras])
        tensors["cameras.Ks"] = torch.stack([camera.K for camera in cameras])
    description = {
        "gaussians": len(gaussians),
        "cameras": [[camera.name, camera.width, camera.height, camera.near] for camera in cameras],
        "info": parts["info"],
        **({"origin": gaussians.origin} if any(gaussians.origin) else {}),
        **({"antialiased": True} if gaussians.antialiased else {}),
    }
    if words is not None:
        tensors["words.embeddings"] = words.embeddings
        if words.negatives is not None:
            tensors["words.negatives"] = words.negatives
        names = {"names": words.names, "negative_names": words.negative_names, "info": words.info}
        description["words"] = json.loads(json.dumps(names))
    whole = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    return whole, description


def _from_tensors(name: str, tensors: dict[str, Tensor], description: dict[str, Any]) -> dict[str, Any]:
    """The parts of a field, which fit together; a ValueError that begins with `name` if they do not."""
    try:
        linear, seen, answers = (_part(tensors, part) for part in ("linear", "seen", "answers"))
        origin, antialiased = as_origin(description.get("origin", ORIGIN)), bool(description.get("antialiased", False))
        codebook, autoencoder, words = (_part(tensors, part) for part in ("codebook", "autoencoder", "words"))
        found: dict[str, Any] = {
            "gaussians": Gaussians(**_part(tensors, "gaussians"), origin=origin, antialiased=antialiased),
            "codebook": Codebook.from_tensors(codebook) if codebook else None,
            "autoencoder": Autoencoder.from_tensors(autoencoder) if autoencoder else None,
            "info": check_notes(description["info"]),
            "linear": LinearLatents.from_tensors(linear) if linear else None,
            "answers": answers.get("latents"),
            "seen": Seen(**seen) if seen else None,
            "cameras": _cameras(description.get("cameras", []), _part(tensors, "cameras"), origin),
            "words": _label_set(words, description["words"]) if words else None,
        }
        check_parts(*(found[one] for one in ("gaussians", "codebook", "autoencoder", "linear", "answers", "seen")))
    except (TypeError, LookupError, ValueError, AttributeError, RuntimeError) as error:
        raise ValueError(
            f"{name}: expected a field, but its parts do not fit together ({error}); fit it again"
        ) from error
    return found


def _label_set(tensors: dict[str, Tensor], names: dict[str, Any]) -> LabelSet:
    return LabelSet(
        tuple(names["names"]),
        tensors["embeddings"],
        tensors.get("negatives"),
        tuple(names["negative_names"]),
        dict(names["info"]),
    )


def _cameras(rows: list[Any], tensors: dict[str, Tensor], origin: Origin) -> tuple[Camera, ...]:
    if not rows:
        return ()
    for _, width, height, _ in rows:
        if width * height > PIXELS:
            raise ValueError(
                f"cameras: expected at most {PIXELS:,} pixels, as a picture has, got {width:,} x {height:,}"
            )
    both = zip(rows, tensors["viewmats"], tensors["Ks"], strict=True)
    return tuple(
        Camera(E, K, width, height, name, near=near, origin=origin) for (name, width, height, near), E, K in both
    )


def _part(tensors: dict[str, Tensor], kind: str) -> dict[str, Tensor]:
    prefix = f"{kind}."
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
