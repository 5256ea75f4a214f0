"""Label pictures for other programs: masks of any cameras, and COCO's JSON with the pictures that it speaks of."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from unicodedata import category

from torch import Tensor
from tqdm import tqdm

from .._files import as_path, check_output, file_stem
from .._typed import typed
from ..cameras import Camera
from ..evaluation.coco import save_coco
from ..fields import SemanticField
from ..labels import LabelSet
from ..viz import save_picture
from ..viz.pictures import Array
from .apply import check_classes, save_colored_labels, save_label_map

COCO = "coco"  # the folder with annotations.json and images/
CONTROL = ("Cc", "Cs")  # Unicode's categories of control characters and of halves of a character
LONGEST = 255  # bytes of a file's name on most disks


@typed
def segment_cameras(
    field: SemanticField,
    cameras: Sequence[Camera],
    classes: LabelSet,
    out: str | Path,
    *,
    progress: bool = False,
) -> dict[str, Tensor]:
    """Segment what any cameras see, and write label pictures. For views of a scene, `segment_scene` adds photographs.

    Args:
        field: a finished field.
        cameras: viewpoints without distortion in its frame, each with a name of its own: `path_cameras`, `orbit_cameras`,
            `spiral_cameras`, or your own.
        classes: names and embeddings in the teacher's space.
        out: receives `predicted/<name>.png` (class numbers, 255 = none) and `colored/<name>.png` (in the classes' colours).
        progress: show a progress bar.

    Returns:
        The label map [H, W] of each camera by its name, without a suffix such as .png.

    Raises:
        ValueError: if names are missing, repeated, or cannot be those of pictures; or if there are more classes
            than a byte can hold.
    """
    out, names = as_path(out), picture_names(cameras)
    check_output("out", out, "a folder")
    check_classes(field, classes)
    found: dict[str, Tensor] = {}
    for name, camera in zip(names, tqdm(cameras, desc="segment", unit="view", disable=not progress), strict=True):
        found[name] = field.segment(camera, classes)
        save_label_map(out / "predicted" / f"{name}.png", found[name])
        save_colored_labels(out / "colored" / f"{name}.png", found[name], classes.names)
    return found


def picture_names(cameras: Sequence[Camera], argument: str = "cameras") -> list[str]:
    """The names of the cameras without suffixes, as those of pictures in an output folder.

    Raises:
        ValueError: if one is missing, repeated, or cannot be a picture's name: absolute, with "..",
            with control characters, too long, or that of a folder that another one needs. It names `argument`.
    """
    names = [file_stem(camera.name or "") for camera in cameras]
    if "" in names or len(set(names)) != len(names):
        raise ValueError(
            f"{argument}: expected a name of its own for each, got {names!r:.120}; name them with replace()"
        )
    folders = {str(folder) for name in names for folder in PurePosixPath(name).parents}
    for name in names:
        parts = PurePosixPath(f"{name}.png").parts
        odd = name.startswith("/") or ".." in parts or any(category(one) in CONTROL for one in name)
        if odd or f"{name}.png" in folders or max(len(os.fsencode(part)) for part in parts) > LONGEST:
            raise ValueError(
                f"{argument}: expected cameras whose names can be those of pictures, got {name!r:.120}; rename it (no folder of "
                f"this name with .png, no '..', no control characters, at most {LONGEST} bytes)"
            )
    return names


@typed
def write_coco(
    out: str | Path,
    labels: Mapping[str, Tensor],  # each [H, W] int64, -1 = none
    names: Sequence[str],
    picture: Callable[[str], Tensor | Array] | None = None,
) -> Path:
    """Write `coco/annotations.json`, and the pictures that it speaks of to `coco/images/`.

    The pictures are of the same camera as the labels. A photograph by a lens with distortion is not: it must be undistorted,
    as `Scene.image` of an undistorted scene is.

    Args:
        out: receives the folder `coco`.
        labels: the label map of each view by its name, for instance from `segment_scene` or `segment_cameras`.
        names: the name of each class.
        picture: gives the picture [H, W, 3] of a view by its name; None: write no pictures.

    Returns:
        The folder `coco`.
    """
    folder = as_path(out) / COCO
    check_output("out", folder, "a folder")
    for name in labels:
        if picture is not None:
            save_picture(folder / "images" / f"{name}.png", picture(name))
    save_coco(folder / "annotations.json", {f"{name}.png": found for name, found in labels.items()}, names)
    return folder
