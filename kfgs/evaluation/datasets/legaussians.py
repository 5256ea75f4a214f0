"""LEGaussians' masks of Mip-NeRF 360: which texts and views of each scene are scored."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import NamedTuple

from ...scenes.files import natural_key, some
from ..truth import MaskAndBoxes, MaskTruth
from .files import ReadWhenAsked, check_names, find_folder, read_mask


class LEGaussiansScene(NamedTuple):
    """What the authors' configuration of a scene says."""

    codes: int  # K, the size of their codebook
    texts: tuple[str, ...]
    views: tuple[str, ...]  # stems of the test pictures; all others train


def _named(prefix: str, *numbers: int) -> tuple[str, ...]:
    return tuple(f"{prefix}{number:0{8 - len(prefix)}d}" for number in numbers)


LEGAUSSIANS_SCENES = {
    "bicycle": LEGaussiansScene(
        128,
        ("green grass", "white bicycle", "tire", "bench", "Asphalt ground", "Silver Oak Tree"),
        _named(
            "_DSC", 8683, 8695, 8705, 8709, 8713, 8715, 8721, 8733, 8738, 8746, 8751, 8756, 8776, 8812, 8824, 8830, 8836, 8848,
            8872,
        ),
    ),
    "bonsai": LEGaussiansScene(
        64,
        ("piano keyboard", "bicycle", "purple table cloth", "black stool", "plastic bonsai tree", "dark grey patterned carpet"),
        _named(
            "DSCF", 5565, 5575, 5585, 5595, 5605, 5615, 5625, 5635, 5645, 5655, 5660, 5675, 5685, 5695, 5710, 5720, 5730, 5740,
            5745, 5755, 5765, 5775, 5785, 5790, 5800, 5810, 5824, 5838, 5850,
        ),
    ),
    "counter": LEGaussiansScene(
        128,
        (
            "Jar of coconut oil", "fruit oranges", "onions", "plants", "blue Oven Gloves", "Wood Rolling Pin",
            "free range eggs box", "gold Ripple Baking Pan", "Napolina Tomatoes", "Garofalo pasta", "stale bread",
        ),
        _named("DSCF", 5857, *range(5865, 6086, 10)),
    ),
    "garden": LEGaussiansScene(
        128,
        (
            "football", "wood round table", "green grass", "wood pot", "elderflower", "green plant", "bricks wall", "windows",
            "Hexagonal Stone ground",
        ),
        _named("DSC", 7956, *range(7960, 8091, 10), 8095, 8120, 8135),
    ),
    "kitchen": LEGaussiansScene(
        32,
        ("LEGO Technic 856 Bulldozer", "Basket Weave Cloth", "Wood plat", "old pink striped cloth", "Red Oven Gloves"),
        _named(
            "DSCF", *range(660, 761, 10), 775, 785, 795, 805, 815, 822, 825, 835, 845, 855, 865, 880, 890, 900, 910, 920, 930,
        ),
    ),
    "room": LEGaussiansScene(
        128,
        (
            "blue grey chair", "silver gray curtain", "brown shoes", "yellow books", "deep dark green carpets",
            "green Yucca plant", "wine glasses and bottles", "yellow wood floors", "piano keyboard", "white wood door",
            "windows",
        ),
        _named(
            "DSCF", 4670, 4680, 4690, 4700, 4721, 4730, 4759, 4770, 4780, 4795, 4800, 4816, 4854, 4867, 4880, 4908, 4920, 4925,
            4958,
        ),
    ),
}  # fmt: skip
"""The six scenes of Mip-NeRF 360. The authors' pictures are at 1/4 of the size (garden and kitchen trained at 1/8)."""


def load_legaussians(path: str | Path, scene: str | None = None) -> MaskTruth:
    """Read masks in LEGaussians' layout: `<scene>/segmentations/<picture>/<text>.png`, black and white.

    Of the six scenes of Mip-NeRF 360 the texts and views must be those of the authors (`LEGAUSSIANS_SCENES`); other scenes
    (their five of LERF, or your own) have what is in the folder.

    Args:
        path: the scene, its `segmentations`, or the folder of all scenes together with `scene`.
        scene: the scene's name; None: that of the folder.

    Returns:
        Masks by the stem of the picture, read when asked.

    Raises:
        FileNotFoundError: if there are no masks, or a view of the authors has none.
        ValueError: if a mask has an unknown text, or a file is damaged.
    """
    path = Path(path)
    base = path.parent if path.name == "segmentations" else path
    base = base / scene if scene and base.name != scene else base
    folder = find_folder([base / "segmentations", base], "*/*.png")
    views = {f.name: f for f in sorted(folder.iterdir(), key=lambda f: natural_key(f.name)) if f.is_dir()}
    known = LEGAUSSIANS_SCENES.get(base.name)
    if known is not None:
        missing = [view for view in known.views if view not in views]
        if missing:
            raise FileNotFoundError(
                f"{folder}: expected masks of {len(known.views)} views of {base.name}, {some(missing)} missing; download the "
                "masks again"
            )
        views = {view: views[view] for view in known.views}
    texts = None if known is None else known.texts
    readers = {view: partial(_read_view, place, texts) for view, place in views.items()}
    return MaskTruth(ReadWhenAsked(readers))


def _read_view(view: Path, texts: tuple[str, ...] | None) -> dict[str, MaskAndBoxes]:
    files = {file.stem: file for file in sorted(view.glob("*.png"))}
    if texts is not None:
        check_names(
            str(view), list(files), texts, "masks of the texts", "rename the mask, or the folder of another scene"
        )
    order = list(files) if texts is None else [text for text in texts if text in files]
    return {text: MaskAndBoxes(read_mask(files[text])) for text in order}
