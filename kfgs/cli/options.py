"""Options that several commands share, each described once: scene, words, teacher."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

import tyro
from tyro.conf import Positional as Positional
from tyro.constructors import PrimitiveConstructorSpec

from .._notes import Repair
from .files import open_field
from .output import say

# Heavy imports happen inside the functions, so that `kfgs --help` answers at once.

T = TypeVar("T")
_quiet = tyro.conf.arg(help_behavior_hint="")  # no "(default: None)" in the help
Given = Annotated[T | None, _quiet]  # None when the option is not given
Flag = Annotated[bool, _quiet]
Name = Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")]
Split = Annotated[str, tyro.conf.arg(metavar="NAME")]
Several = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="TEXT")]


def _choice(kind: Any) -> PrimitiveConstructorSpec[Any]:
    """How tyro reads one word of a Literal, or None when the option is not given. On its own it counts None as a word."""
    words = get_args(kind)
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="{" + ",".join(words) + "}",
        instance_from_str=lambda given: given[0],
        is_instance=lambda value: value is None or value in words,
        str_from_instance=lambda value: [str(value)],
        choices=words,
    )


By = Literal["views", "distance"]
LabelRule = Literal["own", "nearest"]  # of `kfgs evaluate`: who says the class of a pixel
Matching = Literal["exhaustive", "sequential"]  # of `kfgs sfm`: which pairs of pictures are compared
Precision = Literal["lossless", "fine", "small", "tiny"]  # `fields.precision`, without its imports
Walk = Literal["orbit", "cameras"] | Path  # paths of cameras
GivenBy = Annotated[By | None, _choice(By), _quiet]
GivenRule = Annotated[LabelRule | None, _choice(LabelRule), _quiet]
GivenMatching = Annotated[Matching | None, _choice(Matching), _quiet]
GivenWalk = Annotated[Walk | None, _quiet]

SceneFolder = Annotated[
    Path, Positional, tyro.conf.arg(help="Folder with images and a COLMAP model or transforms.json.")
]


@dataclass(frozen=True)
class Teacher:
    """The network whose features, or whose text encoder, is used."""

    teacher: Name = None
    """lseg, clip, siglip, ... (a wrong name lists all), or package.module:name of your own."""
    weights: Name = None
    """Its checkpoint file (lseg, sam), or a folder or hub id (the others)."""

    def load(self, **options: Any) -> Any:
        """Load the teacher, on the GPU if there is one; None if none is named."""
        from ..pipeline.train import training_device
        from ..teachers.load import load_teacher

        if self.teacher is None:
            if self.weights is not None:
                raise ValueError(
                    f"weights: expected --teacher with it, whose weights they are, got {self.weights} alone"
                )
            return None
        teacher = load_teacher(self.teacher, self.weights, **options)
        return teacher.to(training_device("auto")) if hasattr(teacher, "to") else teacher


@dataclass(frozen=True)
class Classes:
    """A field remembers its scene and classes. These options name others."""

    scene: Given[Path] = None
    """Scene folder in the same frame: cameras, pictures and classes."""
    text: Given[Path] = None
    """Words: a table of `kfgs features --words`, or a .npy with a row for each class of the classes.json next to it; by
    default those of SCENE (text.safetensors, or text.npy and classes.json)."""

    def load_scene(self) -> Any:
        """The scene without distortion of its lens; None if none is given."""
        from ..scenes import load_scene

        return None if self.scene is None else load_scene(self.scene).undistorted()

    def load_classes(self, field: Any | None = None) -> Any:
        """The label set that is named; if none is, that of the field.

        If the scene has a `classes.json`, whose indices its label pictures hold, only these classes are taken from the
        scene's table, in their order. A table that is named by --text is used whole.
        """
        from .._files import read_json
        from ..labels import load_label_set

        listed = None if self.scene is None else self.scene / "classes.json"
        if self.text is not None:
            beside = self.text.parent / "classes.json"
            made = load_label_set(*((self.text,) if self.text.suffix != ".npy" else (beside, self.text)))
            if listed is not None and listed.is_file() and tuple(read_json(listed)) != made.names:
                say(f"note: label numbers follow the class list of {self.text}, which differs from {listed}")
            return made
        if listed is not None and self.scene is not None:
            rows, table = self.scene / "text.npy", self.scene / "text.safetensors"
            words = table if table.is_file() and not rows.is_file() else rows
            if words.is_file() or field is None or field.classes is None:
                return load_label_set(*((words,) if words is table and not listed.is_file() else (listed, words)))
        if field is None or field.classes is None:
            raise ValueError(
                "text: expected a table of words, got none; make one with `kfgs features --words chair,table --teacher NAME`, or "
                "by examples with `kfgs features FIELD --examples clicks.json`, and pass it as --text"
            )
        return field.classes

    def photos_of(self, field: Any | None) -> Any:
        """The scene of --scene or of the field, for its photographs; None if there is none, or it is gone."""
        from ..fields import recall_scene
        from ..scenes import load_scene

        if self.scene is not None or field is None:
            return self.load_scene()
        try:
            return load_scene(recall_scene(field.info)).undistorted()
        except (OSError, ValueError):
            return None

    def open_field(self, name: str, path: Path) -> Any:
        """Open a field with fused features; a trained one without them computes them from the views of --scene, if given."""
        from ..fields import Linear, fuse_views

        field = open_field(name, path)
        fused = field.fused is not None or isinstance(field.decoder, Linear)
        if self.scene is None or (fused and field.cameras):
            return field
        scene = self.load_scene()
        trained = set(field.info.get("views", ())) or {scene.cameras[i].name for i in scene.splits.get("train", ())}
        voting = [camera for camera in scene.cameras if camera.name in trained]
        if not voting:
            raise ValueError(
                f"scene: expected the views that the field was trained on ({', '.join(sorted(trained)[:3])}, ...), got "
                f"{len(scene.cameras)} others in {self.scene}; pass the field's own scene, or --text instead"
            )
        return fuse_views(field, voting)


def load_views(scene: Path, images: Path | None, split: str) -> Any:
    """Load a scene as its pictures were taken, and print its notes."""
    from ..scenes import load_scene

    loaded = load_scene(scene, images=images)
    notes = tuple(note for note in loaded.notes if not isinstance(note, Repair))  # those are printed already
    if split == "all" and "all" not in loaded.splits:
        rule = f"split all: all {len(loaded)} views"
        notes = tuple(rule if note.startswith("split ") else note for note in notes)
    for note in notes:
        say(f"note: {note}")
    return loaded
