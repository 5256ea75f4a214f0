"""Find the format of a splat file: by content when reading, by name when writing.

A format is one module of this package, and a line in `MODULES`. It has

- `NAME`, `SUFFIXES`: its name, and the endings of its files;
- `MAGIC`, if all files begin with the same bytes: then the ending of a name alone never chooses this format;
- `matches(head)`, unless the name alone decides: whether a file that begins with these bytes (up to 64 KiB) has this format;
- `read(path) -> Gaussians`: whatever it raises becomes an error that names the file; other programs' broken Gaussians stay;
- `write(path, gaussians) -> list[str]`: write the file, whole or not at all, and describe what it rounds or cuts off. The cloud
  has been checked, is in float64 on the CPU, and has colours (but for PLY). Formats that are only read have no `write`;
- `HOLDS`: what a written file can have of "labels" (with scores; others go to a file next to it, see `sidecar`), "origin"
  (coordinates in double; others are counted from it), "harmonics", "antialiased", "features" and "columns";
- `SORTS = True`, if the format packs neighbours together: `write` keeps the given order, `write_splats` passes Morton order.
"""

from __future__ import annotations

import re
from codecs import BOM_UTF8
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .._arrays import reading
from .._card import short_repr
from .._check import ORIGIN
from .._files import as_path
from .._notes import is_strict
from .._origin import choose_origin, describe_origin, recounted
from ..gaussians import Gaussians, check_gaussians
from .encodings import morton_order
from .ply_3dgs import plain_cloud
from .sidecar import NAMES, beside, read_sidecar, write_sidecar
from .sog_files import META
from .values import check_splats, describe_loss, leave_out_broken

MODULES = ("compressed_ply", "ply_3dgs", "spz", "checkpoint", "sog", "gltf", "ksplat", "splat")
"""Tried in this order: compressed PLY before PLY, because both end in .ply, and checkpoints before SOG, which takes every zip."""
_HEAD_BYTES = 1 << 16
_PLAIN = frozenset({"harmonics", "antialiased"})  # what a plain PLY holds
PATTERNS = (  # of the output folders of training programs: Inria's 3DGS, gsplat, nerfstudio; * is the step
    "point_cloud/iteration_*/point_cloud.ply",
    "ckpts/ckpt_*_rank0.pt",
    "nerfstudio_models/step-*.ckpt",
)


class Written(NamedTuple):
    """The result of `write_splats`."""

    paths: list[Path]  # the splat file, and extra files next to it
    lost: tuple[str, ...]  # descriptions of what the format could not store
    order: Tensor | None  # [N] int64: row i of the file is Gaussian order[i] of the cloud; None: the same order

    def __repr__(self) -> str:
        return short_repr(self)


def formats() -> dict[str, ModuleType]:
    """All formats by name, in the order in which `read_splats` tries them."""
    modules = [import_module(f".{name}", __package__) for name in MODULES]
    return {module.NAME: module for module in modules}


def find_format(path: str | Path) -> ModuleType:
    """The format of a file: by its content, or by its name if the content has no mark (``.splat``).

    Of the output folder of a training program it is the format of its newest splat. A ValueError if it is none of them.
    """
    path, known = splat_file_of(path), formats()
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file; expected a splat file there")
    if path.is_file():
        with reading(path, "a splat file"), path.open("rb") as file:
            head = file.read(_HEAD_BYTES).removeprefix(BOM_UTF8)
        marked = [module for module in known.values() if hasattr(module, "matches") and module.matches(head)]
        named = [module for module in known.values() if path.name.lower().endswith(module.SUFFIXES)]
        candidates = marked or [module for module in named if not hasattr(module, "MAGIC")]
        if candidates:
            return candidates[0]
    elif (path / META).is_file():
        return known["sog"]
    names = ", ".join(f"{name} ({', '.join(module.SUFFIXES)})" for name, module in known.items())
    names += f", and folders with {' or '.join(PATTERNS)}"
    raise ValueError(f"{path}: expected a splat file of a known format, got something else; known are {names}")


def find_writer(path: Path, name: str = "path") -> ModuleType:
    """The format that a new file's ending chooses; a ValueError about the argument `name` if none has that ending."""
    writers = [module for module in formats().values() if hasattr(module, "write")]
    for module in writers:
        if path.name.lower().endswith(module.SUFFIXES):
            return module
    endings = ", ".join(ending for module in writers for ending in module.SUFFIXES)
    raise ValueError(f"{name}: expected a name that ends in one of {endings}, got {path}; it chooses the format")


def read_splats(path: str | Path, *, strict: bool = False) -> Gaussians:
    """Read a splat file of any known format, with labels and class names from it or from the files next to it.

    Gaussians with NaN or infinity, and rows of zeros, are left out, with their labels and columns. A quaternion of length 0
    is read as no rotation, (1, 0, 0, 0): rasterisers do the same. A logged note says how many, and where; also what is not
    drawn as the file says. Harmonics of degree 4 are read up to degree 3.

    **Convention**: axes are those of the 3DGS PLY (COLMAP's frame: x right, y down, z forward), whatever the file has.

    Args:
        path: the file; or the output folder of 3DGS, gsplat or nerfstudio, whose newest step is then read.
        strict: refuse a file with Gaussians that are otherwise left out.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is of no known format, or damaged: truncated, with counts that disagree, no Gaussian with finite
            numbers, or labels without a name in its classes.
    """
    return read_rows(path, strict=strict)[0]


def read_rows(path: str | Path, *, strict: bool = False) -> tuple[Gaussians, Tensor]:  # and [rows of the file] bool
    """`read_splats`, and which rows of the file its Gaussians are: for values of each row in another file."""
    path = splat_file_of(path)
    module = find_format(path)
    with reading(path / META if path.is_dir() else path, f"a {module.NAME} file of Gaussians", "export it again"):
        gaussians = module.read(path)
    gaussians, kept = leave_out_broken(path, read_sidecar(path, gaussians), strict=strict or is_strict())
    labels, names = gaussians.labels, gaussians.names
    if labels is not None and len(labels):
        low, high = int(labels.min()), int(labels.max())
        if low < -1 or (names and high >= len(names)):
            raise ValueError(
                f"{path}: expected labels from -1 to {len(names) - 1} (the named classes), got {low} to {high}; correct the "
                f"labels, or the names in {beside(path, NAMES).name}"
            )
    if gaussians.origin != ORIGIN:  # the file has its own
        return gaussians.replace(means=gaussians.means.float()), kept
    origin = choose_origin(gaussians.means)
    return gaussians.replace(means=recounted(gaussians.means, ORIGIN, origin).float(), origin=origin), kept


def write_splats(
    gaussians: Gaussians, path: str | Path, *, plain: bool = False, facts: Mapping[str, Any] | None = None
) -> Written:
    """Write a cloud in the format of the file's ending. The file is whole or absent.

    **Convention**: formats that pack neighbours together (compressed PLY, SOG) store the Gaussians in Morton order, with
    their labels and scores. `Written.order` is that order: apply it to indices that you keep (an edit of `OfIndex`), or
    work on the cloud as read back. All other formats keep the order.

    Args:
        gaussians: a cloud with colours; its labels, scores, class names and other columns are written too.
        path: the file.
        plain: write a PLY with exactly the 62 properties of Inria's 3DGS, for importers that fail on others. Classes and
            scores go to a file next to it, which `read_splats` finds; other columns and features are lost.
        facts: how the labels were made, for the file with the class names.

    Raises:
        ValueError: if no format has this ending, or cannot store this cloud; or a value is NaN or infinite, a quaternion 0,
            a scale not positive, an opacity outside [0, 1] (both ends are allowed), or a label has no name in `names`.
            Nothing is written then.
    """
    check_gaussians(gaussians)
    path = as_path(path)
    module = find_writer(path)
    if plain and module.NAME != "ply":
        raise ValueError(f"plain: expected it for a file that ends in .ply, got {path}; leave it out")
    what, holds = ("a plain PLY", _PLAIN) if plain else (module.SUFFIXES[0], module.HOLDS)
    if gaussians.sh is None and (plain or module.NAME != "ply"):
        raise ValueError(
            f"gaussians: expected a cloud with colours (sh [N, K, 3]) for {what}, got {gaussians!r}; write a field without "
            "colours as .ply"
        )
    check_splats(gaussians)
    order = morton_order(gaussians.means) if getattr(module, "SORTS", False) else None
    gaussians = gaussians if order is None else gaussians.select(order)
    cloud = gaussians.detach().to("cpu", torch.float64)
    lost = describe_loss(cloud, what, holds) + module.write(path, plain_cloud(cloud) if plain else cloud)
    others = write_sidecar(path, gaussians, facts or {}, holds)
    if "origin" not in holds:
        lost += describe_origin(gaussians.origin, path.name)
    return Written([path, *others], tuple(lost), order)


def numbered_files(folder: Path, pattern: str) -> dict[int, Path]:
    """The files of a pattern with one `*`, by the whole number in its place."""
    shape, files = re.escape(pattern).replace(r"\*", r"(\d{1,18})"), dict[int, Path]()
    for file in folder.glob(pattern) if folder.is_dir() else ():
        match = re.fullmatch(shape, file.relative_to(folder).as_posix())
        if match and file.is_file():
            files[int(match[1])] = file
    return files


def splat_file_of(path: str | Path) -> Path:
    """The path itself; of the output folder of a training program, its newest splat; of SOG's `meta.json`, its folder."""
    path = as_path(path)
    if path.name == META and path.is_file():
        return path.parent
    steps = (numbered_files(path, pattern) for pattern in PATTERNS)
    return next((files[max(files)] for files in steps if files), path)
