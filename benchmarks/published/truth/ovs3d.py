"""3D-OVS: masks of a scene's closed list of texts in some of its pictures."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from kfgs._files import as_path, file_stem, read_text
from kfgs.evaluation.truth import ReadWhenAsked
from kfgs.scenes.files import list_images, natural_key, some

from ..mask_truth import MaskAndBoxes, MaskTruth
from .files import check_names, files_of_texts, read_mask

OVS3D_SCENES = ("bed", "bench", "blue_sofa", "covered_desk", "lawn", "office_desk", "room", "snacks", "sofa", "table")
OVS3D_REPORTED = ("bed", "bench", "room", "sofa", "lawn")
"""The five scenes that most papers report."""


def load_3dovs(path: str | Path) -> MaskTruth:
    """Read a scene of 3D-OVS: `segmentations/classes.txt` and `segmentations/<view>/<text>.png`.

    A view is the picture of that name in `images/`, or of that number (view 4 is `04.jpg`). A text without a picture in a
    view is not asked there.

    Args:
        path: the scene, or its `segmentations`.

    Returns:
        Masks by the stem of the picture, read when asked, as they are as large as the photographs; and the list of texts.

    Raises:
        FileNotFoundError: if there is no `classes.txt`.
        ValueError: if a mask's name is not in the list, a view has no picture, or a file is damaged.
    """
    path = as_path(path)
    folder = path if path.name == "segmentations" else path / "segmentations"
    texts = read_texts(folder)
    views = sorted((f for f in folder.iterdir() if f.is_dir()), key=lambda f: natural_key(f.name))
    if not views:
        raise ValueError(
            f"{folder}: expected a folder of masks for each annotated view, got none; copy the whole folder"
        )
    stems = _stems(folder.parent, [view.name for view in views])
    readers = {stem: partial(_read_view, view, texts) for stem, view in zip(stems, views, strict=True)}
    return MaskTruth(ReadWhenAsked(readers), listed=tuple(texts))


def read_texts(folder: Path) -> list[str]:
    """The texts of `classes.txt`, one per line.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is empty or has a text twice.
    """
    file = folder / "classes.txt"
    lines = read_text(file, "the texts of a 3D-OVS scene, one per line").splitlines()
    texts = [line.strip() for line in lines if line.strip()]
    if not texts or len(set(texts)) != len(texts):
        raise ValueError(
            f"{file}: expected different texts, one per line, got {some(texts) or 'none'}; correct the file"
        )
    return texts


def _stems(scene: Path, views: list[str]) -> list[str]:
    """The stem of the picture of each view; the view's own name where there are no pictures."""
    found = next(
        (scene / name for name in ("images", "images_2", "images_4", "images_8") if (scene / name).is_dir()), None
    )
    if found is None:
        return views
    pictures = [file_stem(name) for name in list_images(found)]
    by_number: dict[int, list[str]] = {}
    for stem in pictures:
        if stem.isdecimal():
            by_number.setdefault(int(stem), []).append(stem)
    stems = []
    for view in views:
        same = [view] if view in pictures else by_number.get(int(view), []) if view.isdecimal() else []
        if len(same) != 1:
            raise ValueError(
                f"{scene / 'segmentations' / view}: expected a view that has a picture in {found} ({some(pictures, 3)}), got "
                f"{view!r}; rename the folder after its picture"
            )
        stems.append(same[0])
    return stems


def _read_view(view: Path, texts: list[str]) -> dict[str, MaskAndBoxes]:
    files = files_of_texts(view, texts)
    check_names(str(view), list(files), texts, "masks of the texts", "correct classes.txt or the name of the mask")
    if not files:
        raise ValueError(f"{view}: expected masks <text>.png of {some(texts)}, got none; copy the folder again")
    masks = {text: read_mask(files[text]) for text in texts if text in files}
    sizes = {text: tuple(mask.shape) for text, mask in masks.items()}
    if len(set(sizes.values())) > 1:
        raise ValueError(f"{view}: expected masks of one size, got {sizes!r:.200}; copy the folder again")
    return {text: MaskAndBoxes(mask) for text, mask in masks.items()}
