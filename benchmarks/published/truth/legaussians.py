"""LEGaussians' masks of Mip-NeRF 360, and those of other scenes in its layout.

Which texts and views of the six scenes are scored is data: `load_classes("legaussians")` and `"legaussians_views"`. The
authors' pictures are at 1/4 of the size (garden and kitchen trained at 1/8).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from kfgs._files import as_path
from kfgs.evaluation.truth import ReadWhenAsked
from kfgs.scenes.files import natural_key, some

from ..class_lists import load_classes
from ..mask_truth import MaskAndBoxes, MaskTruth
from .files import check_names, files_of_texts, find_folder, read_mask


def load_legaussians(path: str | Path, scene: str | None = None) -> MaskTruth:
    """Read masks in LEGaussians' layout: `<scene>/segmentations/<picture>/<text>.png`, black and white.

    Of the six scenes of Mip-NeRF 360 the texts and views must be those of the authors (`load_classes("legaussians")`); other
    scenes (their five of LERF, or your own) have what is in the folder.

    Args:
        path: the scene, its `segmentations`, or the folder of all scenes together with `scene`.
        scene: the scene's name; None: that of the folder.

    Returns:
        Masks by the stem of the picture, read when asked.

    Raises:
        FileNotFoundError: if there are no masks, or a view of the authors has none.
        ValueError: if a mask has an unknown text, or a file is damaged.
    """
    path = as_path(path)
    base = path.parent if path.name == "segmentations" else path
    base = base / scene if scene and base.name != scene else base
    folder = find_folder([base / "segmentations", base], "*/*.png", "masks of LEGaussians")
    views = {f.name: f for f in sorted(folder.iterdir(), key=lambda f: natural_key(f.name)) if f.is_dir()}
    known: list[str] = load_classes("legaussians_views")["views"].get(base.name, [])
    if known:
        missing = [view for view in known if view not in views]
        if missing:
            raise FileNotFoundError(
                f"{folder}: expected masks of {len(known)} views of {base.name}, {some(missing)} missing; download the "
                "masks again"
            )
        views = {view: views[view] for view in known}
    texts: list[str] | None = load_classes("legaussians")[base.name] if known else None
    readers = {view: partial(_read_view, place, texts) for view, place in views.items()}
    return MaskTruth(ReadWhenAsked(readers))


def _read_view(view: Path, texts: list[str] | None) -> dict[str, MaskAndBoxes]:
    files = files_of_texts(view, texts or ())
    if texts is not None:
        check_names(
            str(view), list(files), texts, "masks of the texts", "rename the mask, or the folder of another scene"
        )
    order = list(files) if texts is None else [text for text in texts if text in files]
    return {text: MaskAndBoxes(read_mask(files[text])) for text in order}
