"""The readers of kfgs, each as a function of a path that uses everything it reads."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path


def _splats(path: Path) -> None:
    from kfgs.formats import read_splats

    read_splats(path)


def _cloud(path: Path) -> None:
    from kfgs.formats.ply import points_from_columns, read_ply

    points_from_columns(path, read_ply(path))


def _scene(path: Path) -> None:
    from kfgs.scenes import load_scene

    load_scene(path).image(0)


def _points(path: Path) -> None:
    from kfgs.evaluation import find_points

    find_points(path)


def _labels(path: Path) -> None:
    from kfgs.evaluation import find_labels
    from kfgs.evaluation.label_pictures import load_label_map

    maps = find_labels(path).maps
    for stem in maps:
        found = maps[stem]
        if isinstance(found, Path):
            load_label_map(found)


def _masks(path: Path) -> None:
    from published.truth.find import find_masks

    frames = find_masks(path).frames
    for stem in frames:
        dict(frames[stem])


def _picture(path: Path) -> None:
    from kfgs.scenes import read_image

    read_image(path)


def _label_map(path: Path) -> None:
    from kfgs.evaluation.label_pictures import load_label_map

    load_label_map(path)


def _field(path: Path) -> None:
    from kfgs.fields import SemanticField

    field = SemanticField.load(path)
    field.summary()
    repr(field)
    if field.classes is not None:
        field.classify()


def _table(path: Path) -> None:
    from kfgs.labels import load_label_set

    load_label_set(path)


def _names_and_rows(path: Path) -> None:
    from kfgs.labels import load_label_set

    load_label_set(path / "classes.json", path / "text.npy")


def _words(path: Path) -> None:
    from kfgs.cli.features import read_words

    read_words(str(path))


def _examples(path: Path) -> None:
    from kfgs.fields.examples import read_examples

    read_examples(path)


def _codebook(path: Path) -> None:
    from kfgs.quant import Codebook

    Codebook.load(path)


def _autoencoder(path: Path) -> None:
    from kfgs.quant import Autoencoder

    Autoencoder.load(path)


def _index_maps(path: Path) -> None:
    from kfgs.quant.maps import IndexMaps

    IndexMaps.load(path)


def _training(path: Path) -> None:
    from kfgs.fields.train import read_checkpoint

    read_checkpoint(path, "x")


def _description(path: Path) -> None:
    from kfgs.pipeline.describe import describe

    describe(path)


def _edits(path: Path) -> None:
    from kfgs.labels import EditList

    repr(EditList.load(path))


def _maps(path: Path) -> None:
    from kfgs.scenes import FeatureFolder

    folder = FeatureFolder(path)
    folder.check()
    for i in range(len(folder)):
        folder[i]


def _manifest(path: Path) -> None:
    from kfgs.scenes.extract import read_manifest

    repr(read_manifest(path))


def _checkpoint(path: Path) -> None:
    from kfgs.teachers.checkpoint import read_checkpoint

    for value in read_checkpoint(path).values():
        value.sum()


def _foreign(path: Path) -> None:
    from published.foreign import load_foreign

    load_foreign(path)


READERS: dict[str, Callable[[Path], None]] = {
    "splats": _splats,
    "cloud": _cloud,
    "scene": _scene,
    "points": _points,
    "labels": _labels,
    "masks": _masks,
    "picture": _picture,
    "label map": _label_map,
    "field": _field,
    "table": _table,
    "names and rows": _names_and_rows,
    "words": _words,
    "examples": _examples,
    "codebook": _codebook,
    "autoencoder": _autoencoder,
    "index maps": _index_maps,
    "training": _training,
    "description": _description,
    "edits": _edits,
    "maps": _maps,
    "manifest": _manifest,
    "checkpoint": _checkpoint,
    "foreign": _foreign,
}
MAY_RAISE_TYPE_ERROR = ("maps",)  # documented by FeatureFolder: a file that holds anything but one tensor
