"""Which views of a scene have ground truth: found by name, as the views are, with cameras of the truth's size."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path

from torch import Tensor

from .._files import Names
from ..cameras import undistort
from ..scenes import Scene
from ..scenes.files import some
from ..scenes.scene import as_taken
from .find import find_labels
from .label_pictures import load_label_map
from .method import View
from .truth import LabelTruth, ReadWhenAsked


def label_views(
    scene: Scene, folder: Path, truth: Path | None = None, split: str | None = None
) -> tuple[LabelTruth, list[View]]:
    """The label pictures of a scene as its views are (without lens, -1 where a pixel does not count), and their views.

    Args:
        scene: without distortion.
        folder: the scene's, where label pictures are looked for (`find_labels`).
        truth: another folder, or a COCO JSON.
        split: which views; None: the test views, or all views with labels if no test view has some.

    Raises:
        FileNotFoundError: if there are no label pictures.
        ValueError: if a picture is not of the scene, has another shape than its view, or no view of the split has labels.
    """
    labels = find_labels(truth or folder)
    chosen = match_views(scene, labels.maps, split, "test")

    def read(stem: str) -> Tensor:
        stored = labels.maps[stem]
        return labels_of_view(scene, chosen[stem], stored if isinstance(stored, Tensor) else load_label_map(stored))

    maps = ReadWhenAsked({scene.stem(i): partial(read, stem) for stem, i in chosen.items()})
    sizes = ((i, maps[scene.stem(i)].shape) for i in chosen.values())
    return LabelTruth(labels.names, maps), [sized_view(scene, i, (int(h), int(w))) for i, (h, w) in sizes]


def match_views(scene: Scene, stems: Iterable[str], split: str | None, preferred: str = "") -> dict[str, int]:
    """The view of each picture of a truth in a split, by the picture's name, which may be spelled otherwise (`Names`).

    Args:
        scene: any.
        stems: names of pictures that have a truth.
        split: which views; None: those of `preferred` that have a truth, or all.
        preferred: name of a split that may be empty or missing.

    Raises:
        ValueError: if a chosen picture is not in the scene, or no view of the split has a truth.
    """
    stems = list(stems)
    place = {camera.name: i for i, camera in enumerate(scene.cameras)}
    names = Names(place, bare=True).find_each(stems)
    index = {stem: place[name] for stem, name in zip(stems, names, strict=True) if name is not None}
    wanted = set(scene.splits.get(preferred, ()) if split is None else scene.views(split))
    chosen = [stem for stem in stems if index.get(stem) in wanted]
    if split is None:
        chosen = chosen or stems
    elif not chosen:
        got = f"{split!r}: none of its {len(wanted)} views is among the {len(stems)} pictures with truth"
        raise ValueError(f"split: expected one whose views have ground truth, got {got}; choose another")
    missing = [stem for stem in chosen if stem not in index]
    if missing:
        got = f"{some(missing, 3)} too ({len(missing)} of {len(chosen)} are not in it)"
        advice = f"{Names(place).advice(missing[0])} Else give the scene and the labels of one data set"
        raise ValueError(f"truth: expected pictures of the scene ({len(scene)} views), got {got}; {advice}")
    return {stem: index[stem] for stem in chosen}


def sized_view(scene: Scene, i: int, size: tuple[int, int]) -> View:
    """A view with a camera of the truth's (height, width); a ValueError if its shape differs by more than a pixel."""
    camera, (height, width) = scene.cameras[i], size
    if abs(camera.width * height - camera.height * width) > max(camera.width + height, camera.height + width):
        shape = f"{scene.stem(i)!r} in the shape of its picture ({camera.width}x{camera.height})"
        advice = "were the labels made for cropped or turned pictures?"
        raise ValueError(f"truth: expected {shape}, got {width}x{height}; {advice}")
    return View(scene.stem(i), camera.resized(height, width))


def labels_of_view(scene: Scene, i: int, labels: Tensor) -> Tensor:  # [h, w] int64
    """True labels of a view's picture as the view is: without lens, and void (-1) where a pixel does not count."""
    taken = as_taken(scene)
    size = int(labels.shape[0]), int(labels.shape[1])
    counted = taken.counted(i, size)
    labels = labels if counted is None else labels.where(counted, -1)
    if scene.lenses is None:
        return labels
    lens = taken.cameras[i].resized(*size)
    straight, _, recorded = undistort(labels[..., None].double(), lens, mode="nearest")  # exact up to 2^53
    return straight[..., 0].to(labels).where(recorded, -1)
