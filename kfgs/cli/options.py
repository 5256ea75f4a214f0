"""Options that several commands share, each described once: scene, words, teacher."""

from __future__ import annotations

import ast
import difflib
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, is_dataclass, replace
from functools import cached_property
from pathlib import Path
from textwrap import fill
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import docstring_parser
from tyro.conf import Positional as Positional
from tyro.conf import UseAppendAction, arg

import kfgs

from .._files import read_json
from .._notes import Repair
from .files import say

T = TypeVar("T")
Given = Annotated[T | None, arg(help_behavior_hint="")]  # None if the option is not given
Flag = Annotated[bool, arg(help_behavior_hint="")]
Word = Annotated[str, arg(metavar="NAME")]
Name = Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")]
Several = Annotated[tuple[str, ...], UseAppendAction, arg(metavar="TEXT")]
Walk = Literal["orbit", "cameras"] | Path  # paths of cameras
Setting = tuple[list[type], str, str]  # an option for --set: the types of its values, its value as written, its text
KINDS = {int, float, bool, str, tuple, NoneType}  # of such values
SceneFolder = Annotated[Path, Positional, arg(help="Folder with images and a COLMAP model or transforms.json.")]


@dataclass(frozen=True)
class Settings:
    """How it is made."""

    steps: Given[int] = None
    """Training steps, by default those of the method or preset; the schedule is stretched (not by --set training.steps=N)."""
    set: Annotated[tuple[str, ...], UseAppendAction, arg(metavar="NAME=VALUE")] = ()
    """Any other option of the method, as in "codebook.maximum=50" or "uplift.max_gaussians=none". May be given several times;
    --set help lists all of them."""

    def of(self, options: Any, chosen: str) -> Any:
        """The options of a method or preset, `chosen` as in "--method paper", with these values."""
        if self.steps is not None:
            color = getattr(options, "color", options)
            color = replace(color, training=color.training.with_steps(self.steps))
            options = color if hasattr(options, "training") else replace(options, color=color)
        table = settings_of(options) if self.set else {}
        if "help" in self.set:
            say(f"Options of {chosen} and their values for --set; none leaves a whole group out:")
            lines = [f"{name}={written}  {text}" for name, (_, written, text) in table.items()]
            say("\n".join(fill(line, 98, subsequent_indent="    ") for line in lines))
            raise SystemExit(0)
        values: dict[str, Any] = {}
        for given in self.set:
            name, _, text = (part.strip() for part in given.lstrip("-").partition("="))
            name, value = name.replace("-", "_"), text
            if name not in table:
                raise ValueError(f"set: expected an option of {chosen}, got {given!r}; {hints_for(name, table)}")
            kinds, *_ = table[name]
            with suppress(ValueError, SyntaxError):  # otherwise it is a text
                value = ast.literal_eval(text.title() if text.lower() in ("none", "true", "false") else text)
            values[name] = float(value) if type(value) is int and float in kinds else value
            if type(values[name]) not in kinds:
                words = ("none" if kind is NoneType else kind.__name__ for kind in kinds)
                raise ValueError(f"set: expected {name} as {' or '.join(words)}, got {given!r}; give one")
            if values[name] is None:  # a group that is left out has no options
                table = {other: setting for other, setting in table.items() if not other.startswith(f"{name}.")}
        return with_values(options, values, table)


def settings_of(options: Any, place: str = "") -> dict[str, Setting]:
    """The table of all settings of a method or preset, by name, as in training.densify.maximum."""
    table: dict[str, Setting] = {}
    hints, documented = get_type_hints(type(options)), docstring_parser.parse_from_object(type(options)).params
    texts = {entry.arg_name: " ".join((entry.description or "").split()) for entry in documented}
    for name, value in vars(options).items():
        members = get_args(hints[name]) if isinstance(hints[name], UnionType) else [hints[name]]
        kinds, written = [get_origin(member) or member for member in members], str(value).strip("()").replace(" ", "")
        if is_dataclass(value):  # a group, which can only be left out
            kinds = [kind for kind in kinds if kind is NoneType]
        if kinds and KINDS.issuperset(kinds):
            written = "none" if value is None or is_dataclass(value) else written
            table[place + name] = kinds, written, texts.get(name, "")
        if is_dataclass(value):
            table |= settings_of(value, f"{place}{name}.")
    return table


def hints_for(name: str, table: Mapping[str, Setting]) -> str:
    """The groups of a table, and names that are like a wrong one, or whose text has it as a symbol of the paper."""
    symbol = name.rpartition(".")[2]
    alike = difflib.get_close_matches(symbol, {full.rpartition(".")[2] for full in table}, n=2)
    pattern = rf"\({re.escape(symbol)}[,)]"  # (alpha, Eq. 8)
    near = [n for n in table if n.rpartition(".")[2] in alike or re.search(pattern, table[n][2], re.IGNORECASE)]
    hint = f"did you mean {' or '.join(near)}?" if near else "--set help lists all"
    return f"its groups: {', '.join({n.split('.')[0]: 0 for n in table})}; {hint}"


def with_values(options: Any, values: Mapping[str, Any], table: Mapping[str, Setting], place: str = "") -> Any:
    """The options with new values by name; each group checks its own."""
    new = {}
    for name in dict.fromkeys(full.removeprefix(place).partition(".")[0] for full in values if full.startswith(place)):
        full = place + name
        new[name] = values[full] if full in values else with_values(getattr(options, name), values, table, f"{full}.")
    try:
        return replace(options, **new)
    except ValueError as error:
        kinds, *_ = table.get(f"{place}{error}".partition(": ")[0], ([], "", ""))
        also = "; none is allowed, too" if NoneType in kinds[1:] else ""
        raise ValueError(f"set: {place}{error}{also}") from error


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
        with suppress(OSError, ValueError):
            return self.of(field).loaded
        return None
