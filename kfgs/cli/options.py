"""Options that several commands share, each described once: scene, words, teacher."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import tyro
from tyro.conf import Positional as Positional

import kfgs

from .._files import read_json
from .._notes import Repair
from .files import say

T = TypeVar("T")
Given = Annotated[T | None, tyro.conf.arg(help_behavior_hint="")]  # None if the option is not given
Flag = Annotated[bool, tyro.conf.arg(help_behavior_hint="")]
Word = Annotated[str, tyro.conf.arg(metavar="NAME")]
Name = Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")]
Several = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="TEXT")]
Walk = Literal["orbit", "cameras"] | Path  # paths of cameras
SceneFolder = Annotated[
    Path, Positional, tyro.conf.arg(help="Folder with images and a COLMAP model or transforms.json.")
]


@dataclass(frozen=True)
class Settings:
    """How it is made."""

    steps: Given[int] = None
    """Training steps; the schedule is stretched to them. Those of the method or preset when not given."""
    set: Several = ()
    """Any other option of the method, by its name and value, as in "codebook.maximum=50" or "uplift.keep=0.99". May be given
    several times; --set help lists all of them."""

    def of(self, options: Any) -> Any:
        """The options of a method with these values; a wrong name or value ends the command, as for any option."""
        if self.steps is not None:
            color = getattr(options, "color", options)
            color = replace(color, training=color.training.with_steps(self.steps))
            options = color if hasattr(options, "training") else replace(options, color=color)
        kind, words = type(options), [re.sub("=none$", "=None", f"--{text}") for text in self.set]
        style = (tyro.conf.AvoidSubcommands, tyro.conf.FlagConversionOff)
        try:
            return tyro.cli(kind, default=options, args=words, prog="--set", config=style) if words else options
        except SystemExit as ended:
            if ended.code:
                say("--set help lists the names of all options", sys.stderr)
            raise


@dataclass(frozen=True)
class Views:
    """The pictures of the scene."""

    images: Given[Path] = None
    """Folder of the pictures, if it is not SCENE/images."""
    split: Word = "train"
    """Which views: train, test, all, or another split that SCENE/split.json names; df3dgs: those that train by the paper."""

    def load(self, scene: Path) -> Any:
        """Load a scene as its pictures were taken, and print its notes."""
        loaded = kfgs.load_scene(scene, images=self.images, split="df3dgs" if self.split == "df3dgs" else "auto")
        if self.split == "df3dgs":
            loaded = replace(loaded, splits={**loaded.splits, self.split: loaded.splits["train"]})
        for note in loaded.notes:
            if self.split == "all" and "all" not in loaded.splits and note.startswith("split "):
                note = f"split all: all {len(loaded)} views"
            if not isinstance(note, Repair):  # those are printed already
                say(f"note: {note}")
        return loaded


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

        self.check()
        if self.teacher is None:
            return None
        teacher = kfgs.load_teacher(self.teacher, self.weights, **options)
        return teacher.to(training_device()) if hasattr(teacher, "to") else teacher

    def check(self) -> None:
        """Raise a ValueError if weights are given without their teacher."""
        if self.teacher is None and self.weights is not None:
            raise ValueError(f"weights: expected --teacher with it, whose weights they are, got {self.weights} alone")


@dataclass(frozen=True)
class Classes:
    """A field remembers its scene and classes. These options name others."""

    scene: Given[Path] = None
    """Scene folder in the same frame: cameras, pictures and classes."""
    text: Given[Path] = None
    """Words: a table of `kfgs features --words`, or a .npy with a row for each class of the classes.json next to it; by
    default those of SCENE (text.safetensors, or text.npy and classes.json)."""

    def of(self, field: Any) -> Classes:
        """The same with the scene that a field remembers, if none is given."""
        from ..fields.store import recall_scene

        return self if self.scene is not None else replace(self, scene=recall_scene(field.info))

    @cached_property
    def loaded(self) -> Any:
        """The scene without distortion of its lens; None if none is given."""
        return None if self.scene is None else kfgs.load_scene(self.scene).undistorted()

    def load_classes(self, field: Any | None = None) -> Any:
        """The label set that is named by --text, else that of the scene, else that of the field.

        If the scene has a `classes.json`, whose indices its label pictures hold, only these classes are taken from the
        scene's table, in their order. A table that is named by --text is used whole.
        """
        from ..fields.store import find_classes
        from ..scenes.load import scene_root

        folder = None if self.scene is None else scene_root(self.scene)
        if self.text is not None:
            beside = self.text.with_name("classes.json")
            files = [beside, self.text] if self.text.suffix == ".npy" else [self.text]
            label_set = kfgs.load_label_set(*files)
            listed = None if folder is None else folder / "classes.json"
            if listed is not None and listed.is_file() and tuple(read_json(listed)) != label_set.names:
                say(f"note: label numbers follow the class list of {self.text}, which differs from {listed}")
            return label_set
        if folder is not None and (classes := find_classes(folder)) is not None:
            return classes
        if field is None or field.classes is None:
            raise ValueError(
                "text: expected a table of words, got none; make one with `kfgs features --words chair,table --teacher NAME`, or "
                "by examples with `kfgs features FIELD --examples clicks.json`, and pass it as --text"
            )
        return field.classes

    def photos_of(self, field: Any | None) -> Any:
        """The scene of --scene or of the field, for its photographs; None if there is none, or it is gone."""
        if self.scene is not None or field is None:
            return self.loaded
        try:
            return self.of(field).loaded
        except (OSError, ValueError):
            return None
