"""What a scene of a batch has: poses or photos, true labels, names of classes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from .._files import read_json
from ..fields.notes import CLASSES
from ..labels import LabelSet, load_label_set
from ..scenes import Scene, SceneError, is_scene, list_images, load_scene
from .options import Job
from .places import Place

TRUTH = ("labels_scored", "labels")


def photos_of(source: Place) -> str | None:
    """The folder of photos of a place without poses, as a relative name; None if it has poses."""
    if not source.path.is_dir():
        raise FileNotFoundError(f"{source.path}: no such folder; expected a scene or photos there")
    if is_scene(source.path):
        return None
    found = next(
        (name for name in ("images", ".") if (source.path / name).is_dir() and list_images(source.path / name)), None
    )
    if found is None:
        raise SceneError(
            f"{source.path}: expected a COLMAP model, a transforms.json, or photos to find their cameras, got none of them; name "
            "the folder of a scene"
        )
    return found


def load(source: Place, out: Place) -> Scene:
    """The scene, with the cameras that sfm found if it has none of its own."""
    photos = photos_of(source)
    return load_scene(source.path) if photos is None else load_scene(out.path / "scene", images=source.path / photos)


def relative(path: Path, source: Place) -> str:
    """The name of a picture in its scene; its whole path if it is elsewhere."""
    try:
        return path.relative_to(source.path).as_posix()
    except ValueError:  # a transforms.json may name pictures elsewhere on this machine
        return str(path.absolute())


def truth_of(source: Place) -> Path | None:
    """The folder of true labels; None if there is none."""
    return next((source.path / name for name in TRUTH if (source.path / name).is_dir()), None)


def counts_alike(job: Job, source: Place, report: Callable[[str], None]) -> bool:
    """Whether the numbers in true labels mean the classes of the table for all scenes, if there is one."""
    listed = source.path / "classes.json"
    if job.text_file is None or (listed.is_file() and tuple(read_json(listed)) == load_label_set(job.text_file).names):
        return True
    report(
        f"note: not scored: the scene's labels count the classes of its classes.json, and {job.text_file} has others"
    )
    return False


def class_files(job: Job, source: Place) -> list[Path] | None:
    """The files of the label set: the table for all scenes, or the scene's own; None if there is none."""
    if job.text_file is not None:
        return [job.text_file]
    choices = ([source.path / name for name in names] for names in CLASSES)
    return next((files for files in choices if all(file.is_file() for file in files)), None)


def classes_of(job: Job, source: Place) -> LabelSet:
    """The label set of a scene that has one."""
    files = class_files(job, source)
    assert files is not None
    return load_label_set(*files)
