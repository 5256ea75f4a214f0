"""Find the ground truth of a scene by its files, and the views that it is of."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from kfgs._files import as_path
from kfgs.evaluation import View, find_points
from kfgs.evaluation.find import read_first
from kfgs.evaluation.truth import PointTruth, ReadWhenAsked
from kfgs.evaluation.views import match_views, sized_view
from kfgs.scenes import Scene

from ..mask_truth import MaskTruth
from .coco_masks import load_coco_masks
from .legaussians import load_legaussians
from .lerf_ovs import load_lerf_ovs
from .ovs3d import load_3dovs
from .scenesplat import load_scenesplat_points


def find_masks(path: str | Path) -> MaskTruth:
    """The masks of a scene: of 3D-OVS, of LEGaussians, of LERF-OVS, or in a COCO JSON.

    Raises:
        FileNotFoundError: if there are none.
        ValueError: if a file is damaged.
    """
    path = as_path(path)
    places: list[tuple[str, Callable[[Path], MaskTruth]]] = [
        ("segmentations/classes.txt", load_3dovs),
        ("classes.txt", load_3dovs),
        ("segmentations/*/*.png", load_legaussians),
        ("label/**/*.json", load_lerf_ovs),
        ("annotations.json", lambda at: load_coco_masks(at / "annotations.json")),
    ]
    if next((path.parent / "label" / path.name).glob("*.json"), None) is not None:
        return load_lerf_ovs(path)
    if not any((path / name).exists() for name in ("images", "sparse", "transforms.json", "results", "color", "rgb")):
        places += [
            ("*.json", load_lerf_ovs),
            ("*/*.png", load_legaussians),
        ]  # a scene's own JSONs and PNGs are no truth
    masks: MaskTruth = read_first(path, places, "masks", load_coco_masks)
    return masks


def open_masks(
    scene: Scene, folder: Path, truth: Path | None = None, split: str | None = None
) -> tuple[MaskTruth, list[View]]:
    """The masks of a scene (`find_masks`), and a view for each picture that has some, of the masks' size.

    Args:
        scene: without distortion.
        folder: the scene's.
        truth: where the masks are, if not there.
        split: which views; None: all that have masks.

    Raises:
        FileNotFoundError: if there are no masks.
        ValueError: if the pictures have lens distortion, a picture is not of the scene or has no mask, or has another shape.
    """
    masks = find_masks(truth or folder)
    chosen = match_views(scene, masks.frames, split)
    if any((scene.lenses or scene.cameras)[i].distortion is not None for i in chosen.values()):
        raise ValueError(
            "truth: expected masks of pictures without lens distortion, got distorted ones; undistort pictures and masks"
        )
    if empty := [stem for stem in chosen if not masks.frames[stem]]:
        raise ValueError(f"truth: expected a mask in {empty[0]!r}, got none; leave the picture out")
    sizes = {stem: next(iter(masks.frames[stem].values())).mask.shape for stem in chosen}
    views = [sized_view(scene, i, (int(sizes[stem][0]), int(sizes[stem][1]))) for stem, i in chosen.items()]
    frames = ReadWhenAsked({scene.stem(i): partial(masks.frames.__getitem__, stem) for stem, i in chosen.items()})
    return MaskTruth(frames, masks.scene, masks.listed), views


def open_points(
    scene: Scene, folder: Path, truth: Path | None = None, split: str | None = None, benchmark: str | None = None
) -> tuple[PointTruth, list[View]]:
    """The labelled points of a scene: what `find_points` finds, or those of SceneSplat-Bench; no views."""
    place = truth or folder
    if place.suffix == ".npy" or (place / "coord.npy").is_file():
        return load_scenesplat_points(place, benchmark), []
    return find_points(place), []
