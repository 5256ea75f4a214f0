"""A semantic field on disk: one safetensors file with the field's tensors, and its JSON as the tensor "description".

A lossless file holds the tensors as they are; a packed one holds their streams (`packing.py`). docs/formats.md has the layout.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
import zstandard
from safetensors import safe_open
from torch import Tensor

from .._arrays import read_safetensors, reading, save_tensors
from .._check import ORIGIN, as_origin
from .._files import as_path, atomic_path, parse_json, real_path
from ..cameras import Camera
from ..gaussians import TENSORS as CLOUD
from ..gaussians import Gaussians
from ..labels import LabelSet, load_label_set
from ..scenes.files import PIXELS
from .decoders import Linear, make_decoder
from .packing import Precision, pack, unpack

SUFFIX, NAME = ".kfgs", "field.kfgs"
KIND, VERSION = "semantic field", "1"
DESCRIPTION, WORDS = "description", 8 << 20  # the tensor with the JSON, and its most bytes
WHAT, AGAIN, SPLAT = "a field of kfgs", "copy it again, or fit the field again", "read_splats opens a splat"
SCENE_FILES = ("classes.json", "text.npy"), ("classes.json", "text.safetensors"), ("text.safetensors",)
"""Files of a scene folder that make a label set; the first group of which all exist is used."""


def find_field(path: str | Path) -> Path | None:
    """The file of the field at a path: itself, or `field.kfgs` in a folder; None if there is none."""
    path = _field_file(path)
    try:
        with safe_open(path, framework="pt") as file:
            return path if (file.metadata() or {}).get("kfgs") == KIND else None
    except Exception:  # not a safetensors file, or none at all
        return None


def check_place(path: Path) -> None:
    """An error unless a field may be written to `path`: a file of ours, also a damaged one, or nothing."""
    if path.suffix != SUFFIX:
        raise ValueError(f"path: expected a name that ends in {SUFFIX}, got {path}; give another")
    if path.exists() and not path.is_file():
        raise FileExistsError(f"path: expected a new file or an older field at {path}, got a folder; give another")


def save_field(path: str | Path, parts: Mapping[str, Any], precision: Precision | None = None) -> None:
    """Write the parts of a field, by name; see `SemanticField.save`."""
    path = as_path(path)
    check_place(path)
    tensors, about = _to_tensors(path, parts)
    if precision is not None:
        name = precision if isinstance(precision, str) else "custom"
        tensors, entries, errors = pack(tensors, precision)
        rounded = [*about["info"].get("rounded", []), {"precision": name, "errors": errors}]
        about = {**about, "info": {**about["info"], "rounded": rounded}, "packed": entries}
    about["sha256"] = _digest(tensors, about)
    words = json.dumps(about, allow_nan=False).encode()
    if len(words) > WORDS:
        raise ValueError(
            f"info: expected at most {WORDS} bytes of JSON with names of views, got {len(words)}; shorten it"
        )
    packed = zstandard.ZstdCompressor(level=19).compress(words)
    tensors[DESCRIPTION] = torch.frombuffer(bytearray(packed), dtype=torch.uint8)
    with atomic_path(path) as temporary:
        save_tensors(temporary, tensors, {"kfgs": KIND, "version": VERSION})


def load_field(path: str | Path, make: Callable[..., Any]) -> Any:
    """A field from its file; `make` is `SemanticField`, which imports this file."""
    path = _field_file(path)
    tensors, about = _read(path)
    with reading(path, WHAT, AGAIN):
        if _digest(tensors, about) != about["sha256"]:
            raise ValueError("its content is not what was saved")
        if "packed" in about:
            tensors = unpack(tensors, about["packed"])
        return _from_tensors(path, tensors, about, make)


def read_description(path: str | Path) -> dict[str, Any]:
    """The JSON of a field: `gaussians`, `cameras`, `info`, `sha256`, and `packed` of a packed one. No number is read."""
    return _read(_field_file(path))[1]


def find_classes(scene: Path) -> LabelSet | None:
    """The label set in a scene folder; None if there is none, a ValueError or an OSError if it cannot be read."""
    for files in ([scene / name for name in names] for names in SCENE_FILES):
        if all(file.is_file() for file in files):
            return load_label_set(*files)
    return None


def scene_classes(scene: Path, channels: int | None = None) -> LabelSet | None:
    """The same for a result to hold: None, too, if it cannot be read, or has other channels than the features.

    The error comes when classes are asked for; a long fit does not fail at its end.
    """
    try:
        classes = find_classes(scene)
    except (ValueError, OSError):
        return None
    return classes if classes is None or channels in (None, classes.dim) else None


def recall_scene(info: Mapping[str, Any]) -> Path:
    """The scene folder in a field's notes; a ValueError if there is no note, a FileNotFoundError if no folder."""
    if not isinstance(info.get("scene"), str):
        raise ValueError("scene: expected a field that remembers its scene, got one that does not; pass the scene")
    path = Path(info["scene"])
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such folder, where this field's scene was; pass the scene")
    return path


def _field_file(path: str | Path) -> Path:
    path = as_path(path)
    return path / NAME if path.is_dir() else path


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors of a field's file, and its description."""
    tensors, _ = read_safetensors(path, WHAT, AGAIN if path.suffix == SUFFIX else SPLAT, kfgs=(KIND, VERSION))
    with reading(path, WHAT, AGAIN):
        packed = tensors.pop(DESCRIPTION).numpy().tobytes()
        if zstandard.get_frame_parameters(packed).content_size > WORDS:
            raise ValueError("its description is too long")
        return tensors, dict(parse_json(zstandard.ZstdDecompressor().decompress(packed, max_output_size=WORDS)))


def _digest(tensors: Mapping[str, Tensor], about: Mapping[str, Any]) -> str:
    """SHA-256 over a field's JSON, and over names, shapes and values of its tensors."""
    rest = {name: value for name, value in about.items() if name != "sha256"}
    digest = hashlib.sha256(json.dumps(rest, sort_keys=True, allow_nan=False).encode())
    for name in sorted(tensors):
        value = tensors[name].contiguous()
        digest.update(f"{name} {tuple(value.shape)} {value.dtype}".encode())
        digest.update(value.reshape(-1).view(torch.uint8).numpy().data if value.numel() else b"")
    return digest.hexdigest()


def _to_tensors(path: Path, parts: Mapping[str, Any]) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """All tensors of a field by name, and the rest of it as JSON; its scene's folder is noted relative to the file."""
    gaussians, cameras, classes, info = (parts[name] for name in ("gaussians", "cameras", "classes", "info"))
    if isinstance(scene := info.get("scene"), str):
        info = {**info, "scene": Path(os.path.relpath(real_path(scene), real_path(path.parent))).as_posix()}
    try:
        info = json.loads(json.dumps(info, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ValueError(f"info: expected what JSON can hold, got {error}; use strings and finite numbers") from error
    tensors = {f"gaussians.{name}": value for name, value in gaussians.tensors().items()}
    tensors |= parts["decoder"].to_tensors()
    if parts["fused"] is not None:
        tensors |= {"fused.latents": parts["fused"].latents, "fused.basis": parts["fused"].decoder.basis}
    if cameras:
        cameras = [camera.with_origin(gaussians.origin) for camera in cameras]
        tensors["cameras.viewmats"] = torch.stack([camera.viewmat for camera in cameras])
        tensors["cameras.Ks"] = torch.stack([camera.K for camera in cameras])
    about: dict[str, Any] = {
        "gaussians": len(gaussians),
        "cameras": [[camera.name, camera.width, camera.height, camera.near] for camera in cameras],
        "info": info,
        "origin": gaussians.origin,
        "antialiased": gaussians.antialiased,
    }
    if classes is not None:
        tensors["classes.embeddings"] = classes.embeddings
        if classes.negatives is not None:
            tensors["classes.negatives"] = classes.negatives
        names = {"names": classes.names, "negative_names": classes.negative_names, "info": classes.info}
        about["classes"] = json.loads(json.dumps(names))
    return {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}, about


def _from_tensors(path: Path, tensors: dict[str, Tensor], about: dict[str, Any], make: Callable[..., Any]) -> Any:
    """The field, which checks its parts."""
    origin, classes, fused = as_origin(about.get("origin", ORIGIN)), None, None
    cloud: dict[str, Any] = {name: tensors[f"gaussians.{name}"] for name in CLOUD if f"gaussians.{name}" in tensors}
    for name, value in cloud.items():
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            raise ValueError(f"gaussians.{name} has NaN or infinity")
    gaussians = Gaussians(**cloud, origin=origin, antialiased=bool(about.get("antialiased", False)))
    if "classes" in about:
        names = about["classes"]
        rows = tensors["classes.embeddings"], tensors.get("classes.negatives")
        classes = LabelSet(tuple(names["names"]), *rows, tuple(names["negative_names"]), dict(names["info"]))
    info = dict(about["info"])
    if isinstance(info.get("scene"), str):
        info["scene"] = os.path.normpath(real_path(path).parent / info["scene"])
    cameras = []
    for i, (name, width, height, near) in enumerate(about.get("cameras", [])):
        if width * height > PIXELS:
            raise ValueError(f"a camera has {width:,} x {height:,} pixels; a picture has at most {PIXELS:,}")
        pose = tensors["cameras.viewmats"][i], tensors["cameras.Ks"][i]
        cameras.append(Camera(*pose, width, height, name, near=near, origin=origin))
    if "fused.latents" in tensors:
        fused = make(gaussians.replace(features=tensors["fused.latents"]), Linear(tensors["fused.basis"]))
    decoder = make_decoder(tensors, tensors["gaussians.features"].shape[1])
    return make(gaussians, decoder, tuple(cameras), classes, info, fused)
