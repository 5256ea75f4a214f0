"""Which views of a scene have ground truth, with cameras of the right size."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from ..._check import check_choice
from ..._files import Names
from ..._typed import typed
from ...scenes.files import some
from ...scenes.scene import Scene
from ..method import View
from ..segmentation import load_label_map
from ..truth import LabelTruth, MaskTruth
from .files import ReadWhenAsked


@typed
def truth_views(scene: Scene, truth: LabelTruth | MaskTruth, size: Literal["truth", "scene"] = "truth") -> list[View]:
    """The views of a scene that have ground truth, in the order of the truth, as protocols take them.

    Args:
        scene: undistorted; a picture's stem is the key of its truth.
        truth: masks or labels by stem.
        size: the camera is that of the truth's picture (it is resized if the shape is the same), or the scene's own.

    Raises:
        ValueError: if a picture with ground truth is not in the scene, its shape differs from the camera's, or the scene has
            distortion.
    """
    check_choice("size", size, ("truth", "scene"))
    if scene.distorted:
        raise ValueError("scene: expected cameras without distortion, got a distorted scene; pass scene.undistorted()")
    stems = truth.maps if isinstance(truth, LabelTruth) else truth.frames
    index = views_of(scene, stems)
    missing = [stem for stem in stems if stem not in index]
    if missing:
        advice = Names(camera.name for camera in scene.cameras).advice(missing[0])
        raise ValueError(
            f"truth: expected pictures of the scene ({len(scene)} views), got {some(missing, 3)} too ({len(missing)} of "
            f"{len(stems)} are not in it); {advice} Else give the scene and the labels of one data set"
        )
    views = []
    for stem in stems:
        camera, (height, width) = scene.cameras[index[stem]], _size(truth, stem)
        if abs(camera.width * height - camera.height * width) > max(camera.width + height, camera.height + width):
            raise ValueError(
                f"truth: expected {stem!r} in the shape of its picture ({camera.width}x{camera.height}), got {width}x{height}; "
                "were the labels made for cropped or turned pictures?"
            )
        views.append(View(stem, camera if size == "scene" else camera.resized(height, width)))
    return views


def views_of(scene: Scene, stems: Iterable[str]) -> dict[str, int]:
    """The view of each picture of a truth that is in the scene, by its name, which may be spelled otherwise (`Names`)."""
    place = {camera.name: i for i, camera in enumerate(scene.cameras)}
    stems = list(stems)
    names = Names(place, bare=True).find_each(stems)
    return {stem: place[name] for stem, name in zip(stems, names, strict=True) if name is not None}


def named_as_in(scene: Scene, truth: LabelTruth | MaskTruth) -> LabelTruth | MaskTruth:
    """The truth with the scene's stems as the names of its pictures."""
    known: Mapping[str, Any] = truth.maps if isinstance(truth, LabelTruth) else truth.frames
    stems = {stem: scene.stem(i) for stem, i in views_of(scene, known).items()}
    if all(stem == own for stem, own in stems.items()) or len(set(stems.values())) < len(stems):
        return truth
    renamed = ReadWhenAsked({stems.get(stem, stem): partial(known.__getitem__, stem) for stem in known})
    return replace(truth, maps=renamed) if isinstance(truth, LabelTruth) else replace(truth, frames=renamed)


def _size(truth: LabelTruth | MaskTruth, stem: str) -> tuple[int, int]:
    """(height, width) of the truth of a picture."""
    if isinstance(truth, LabelTruth):
        found = truth.maps[stem]
        height, width = (found if isinstance(found, Tensor) else load_label_map(Path(found))).shape
    else:
        masks = list(truth.frames[stem].values())
        if not masks:
            raise ValueError(f"truth: expected a mask in {stem!r}, got none; leave the picture out")
        height, width = masks[0].mask.shape
    return int(height), int(width)
