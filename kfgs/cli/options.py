"""Options that several commands share, each described once: scene, words, teacher."""

from __future__ import annotations

import ast
import difflib
import inspect
import re
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, is_dataclass, replace
from functools import cached_property, reduce
from pathlib import Path
from textwrap import fill
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
    """Training steps, by default those of the method or preset; the schedule is stretched (not by --set training.steps=N)."""
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Any other option of the method, as in "codebook.maximum=50" or "uplift.max_gaussians=none". May be given several times;
    --set help lists all of them."""

    def of(self, options: Any, chosen: str) -> Any:
        """The options of a method or preset, `chosen` as in "--method paper", with these values."""
        if self.steps is not None:
            color = getattr(options, "color", options)
            color = replace(color, training=color.training.with_steps(self.steps))
            options = color if hasattr(options, "training") else replace(options, color=color)
        if "help" in self.set:
            say(f"Options of {chosen} and their values for --set; none leaves a whole group out:")
            lines = [f"{name}={value}  {text}" for name, (_, value, text) in settable(options).items()]
            say("\n".join(fill(line, 98, subsequent_indent="    ") for line in lines))
            raise SystemExit(0)
        options = deepcopy(options)
        for given in self.set:
            name, _, text = (part.strip() for part in given.lstrip("-").partition("="))
            kinds = known_kinds(name := name.replace("-", "_"), options, f"an option of {chosen}, got {given!r}")
            value: Any = text
            with suppress(ValueError, SyntaxError):  # otherwise it is a text
                value = ast.literal_eval(text.title() if text.lower() in ("none", "true", "false") else text)
            value = float(value) if type(value) is int and "float" in kinds else value
            if (str(value) if value is None else type(value).__name__) not in kinds:
                raise ValueError(f"set: expected {name} as {' or '.join(kinds).lower()}, got {given!r}; give one")
            *groups, field = name.split(".")
            object.__setattr__(reduce(getattr, groups, options), field, value)  # of the copy
        known = settable(options)
        for place in {name[: name.rfind(".") + 1] for name in known}:
            try:
                replace(reduce(getattr, place.split(".")[:-1], options))  # checks the values
            except ValueError as error:
                kinds, *_ = known.get(f"{place}{error}".partition(": ")[0], ([], "", ""))
                also = "; none is allowed, too" if "None" in kinds[1:] else ""
                raise ValueError(f"set: {place}{error}{also}") from error
        return options


def settable(options: Any, place: str = "") -> dict[str, tuple[list[str], str, str]]:
    """What --set can change, by name: the kinds of its values, the value as it is written, and its text."""
    known: dict[str, tuple[list[str], str, str]] = {}
    fields = r'^    (\w+): ([^=\n]+) = .*\n(?:    """((?s:.*?))""")?'  # as written, since only the source has the texts
    for name, kind, text in re.findall(fields, inspect.getsource(type(options)), re.MULTILINE):
        value, kinds = getattr(options, name), kind.replace("[int, ...]", "").split(" | ")
        written = "none" if value is None or is_dataclass(value) else str(value).strip("()").replace(" ", "")
        kinds = kinds[-1:] if is_dataclass(value) else kinds  # a group can only be left out
        if set(kinds) <= {"int", "float", "bool", "str", "tuple", "None"}:
            known[place + name] = (kinds, written, " ".join(text.split()))
        known |= settable(value, f"{place}{name}.") if is_dataclass(value) else {}
    return known


def known_kinds(name: str, options: Any, wrong: str) -> list[str]:
    """The kinds of an option's values. A ValueError with the groups and similar names, or those of a symbol of the paper."""
    known, symbol = settable(options), name.rpartition(".")[2]
    if name in known:
        return known[name][0]
    alike = difflib.get_close_matches(symbol, {full.rpartition(".")[2] for full in known}, n=2)
    pattern = rf"\({re.escape(symbol)}[,)]"  # (alpha, Eq. 8)
    near = [n for n in known if n.rpartition(".")[2] in alike or re.search(pattern, known[n][2], re.IGNORECASE)]
    hint = f"did you mean {' or '.join(near)}?" if near else "--set help lists all"
    raise ValueError(f"set: expected {wrong}; its groups: {', '.join({n.split('.')[0]: 0 for n in known})}; {hint}")


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
        from ..teachers.load import check_teacher_name

        check_teacher_name(self.teacher, self.weights)
        if self.teacher is None:
            return None
        teacher = kfgs.load_teacher(self.teacher, self.weights, **options)
        return teacher.to(training_device()) if hasattr(teacher, "to") else teacher


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
