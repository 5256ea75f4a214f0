"""Options that several commands share, each described once: scene, images, classes, text, teacher, weights, training."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

import tyro
from tyro.conf import Positional as Positional
from tyro.constructors import PrimitiveConstructorSpec

from .._notes import Repair
from .files import check_alone, open_field
from .output import say

# Heavy imports happen inside the functions, so that `kfgs --help` answers at once.

T = TypeVar("T")
_quiet = tyro.conf.arg(help_behavior_hint="")  # no "(default: None)" in the help
Given = Annotated[T | None, _quiet]  # None when the option is not given
Flag = Annotated[bool, _quiet]
Name = Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")]
Device = Annotated[str, tyro.conf.arg(metavar="NAME")]
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


Mode = Literal["decouple", "adc", "adc+sc"]  # of the paper's Table 1
By = Literal["views", "distance"]
LabelRule = Literal["own", "nearest"]  # of `kfgs evaluate`: who says the class of a pixel
Walk = Literal["orbit", "cameras"] | Path  # paths of cameras
Rule = Literal["fused", "paper"]
GivenWalk = Annotated[Walk | None, _quiet]
GivenMode = Annotated[Mode | None, _choice(Mode), _quiet]
Matching = Literal["exhaustive", "sequential"]  # of `kfgs sfm`: which pairs of pictures are compared
GivenMatching = Annotated[Matching | None, _choice(Matching), _quiet]
GivenBy = Annotated[By | None, _choice(By), _quiet]
Precision = Literal["lossless", "fine", "small", "tiny"]  # `fields.precision`, without its imports
GivenPrecision = Annotated[Precision | None, _choice(Precision), _quiet]
GivenRule = Annotated[LabelRule | None, _choice(LabelRule), _quiet]

SceneFolder = Annotated[
    Path, Positional, tyro.conf.arg(help="Folder with images and a COLMAP model or transforms.json.")
]


@dataclass(frozen=True)
class Views:
    """Which pictures of the scene are used."""

    images: Given[Path] = None
    """Folder of the pictures, if it is not SCENE/images."""
    split: Annotated[str, tyro.conf.arg(metavar="NAME")] = "train"
    """Which views: train, test, all, or another split that SCENE/split.json names."""

    def load(self, scene: Path) -> Any:
        """Load the scene (not undistorted), and print its notes."""
        from ..scenes import load_scene

        loaded = load_scene(scene, images=self.images)
        notes = tuple(note for note in loaded.notes if not isinstance(note, Repair))  # those are printed already
        if self.split == "all" and "all" not in loaded.splits:
            rule = f"split all: all {len(loaded)} views"
            notes = tuple(rule if note.startswith("split ") else note for note in notes)
        for note in notes:
            say(f"note: {note}")
        return loaded


@dataclass(frozen=True)
class CameraSearch:
    """How cameras are found."""

    matching: GivenMatching = None
    """sequential for the frames of a video, exhaustive for everything else; by default so."""
    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP's name of the lens model."""
    no_single_camera: Flag = False
    """The photographs were taken with several cameras, or with changes of zoom."""
    min_registered: float = 0.9
    """Share of the images that must be placed; fewer is an error."""
    ignore_poses: Flag = False
    """Estimate poses also if the folder has some."""


@dataclass(frozen=True)
class Maps:
    """Feature maps that exist already."""

    features: Given[Path] = None
    """Folder of maps by `kfgs features` or Feature 3DGS; SCENE/features when not given."""
    undistorted_features: Flag = False
    """The teacher saw undistorted pictures, so no lens has to be removed from its maps."""

    def folder(self, scene: Path) -> Path:
        """The folder of maps of a scene (a folder, or a transforms.json); a ValueError if there is none."""
        folder = self.features or (scene if scene.is_dir() else scene.parent) / "features"
        if not folder.is_dir():
            raise ValueError(
                f"features: expected a folder of feature maps, got {folder}, which is none; name another, or make them with "
                "`kfgs features`"
            )
        return folder


@dataclass(frozen=True)
class Teacher:
    """The network whose features, or whose text encoder, is used."""

    teacher: Name = None
    """lseg, clip, siglip, ... (a wrong name lists all), or package.module:name of your own."""
    weights: Name = None
    """Its checkpoint file (lseg, sam), or a folder or hub id (the others)."""

    def check_weights(self) -> None:
        """Raise a ValueError if there are weights and no teacher."""
        if self.teacher is None:
            check_alone("weights", self.weights, "without --teacher, whose weights they are")


@dataclass(frozen=True)
class MapTeacher(Teacher):
    """The network that makes the feature maps."""

    fast: Flag = False
    """One pass over each picture instead of the exact evaluation at several scales (lseg)."""
    size: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N [N]", help_behavior_hint="")] = ()
    """Height and width of the maps (lseg), or the longer side of the pictures in pixels (the others)."""


@dataclass(frozen=True)
class FieldMethod:
    """How a field is made."""

    method: Literal["uplift", "paper"] = "uplift"
    """uplift: average the features in 3-D, then compress; paper: compress each map, then train Gaussians on it (DF-3DGS)."""
    preset: Literal["cpu", "paper"] = "cpu"
    """cpu (minutes on two cores) or paper (30,000 steps of training)."""
    mode: GivenMode = None
    """For --method paper: adc+sc (the default: codebook and autoencoder), adc (codebook) or decouple (raw features)."""


@dataclass(frozen=True)
class Training:
    """How long and where to train."""

    steps: Given[int] = None
    """Training steps; the preset's when not given."""
    max_gaussians: Given[int] = None
    """At most this many Gaussians in the result, 0: all of the splat; the preset's when not given."""
    seed: int = 0
    """Every random choice follows from it."""
    device: Device = "auto"
    """auto (a GPU if there is one), cpu or cuda."""


@dataclass(frozen=True)
class SceneOption:
    """The scene, if its cameras and pictures are needed."""

    scene: Given[Path] = None
    """Scene folder in the same frame: cameras, pictures and classes."""
    images: Given[Path] = None
    """Folder of its pictures, if it is not SCENE/images."""

    def check_images(self) -> None:
        """Raise a ValueError if there are images and no scene."""
        if self.scene is None:
            check_alone("images", self.images, "without --scene, whose pictures they are")

    def load_scene(self) -> Any:
        """The scene as its pictures were taken."""
        from ..scenes import load_scene

        assert self.scene is not None
        return load_scene(self.scene, images=self.images)


@dataclass(frozen=True)
class Classes(SceneOption):
    """A field remembers its scene and classes. These options name others."""

    classes: Given[Path] = None
    """List of class names (.json); SCENE/classes.json when not given."""
    text: Given[Path] = None
    """Text embeddings: a table of `kfgs text` (.safetensors) or a row for each class (.npy); SCENE/text.* when not given."""

    def files(self) -> tuple[Path, ...] | None:
        """The arguments of `load_label_set`: a table, or names and rows; None if neither is given."""
        scene, classes, text = self.scene, self.classes, self.text
        if classes is not None and classes.suffix == ".safetensors":
            check_alone("text", text, f"with the table {classes}")
            return (classes,)
        if text is not None and classes is None and text.suffix == ".safetensors":
            return (text,)
        if scene is not None:
            if text is None:
                rows, table = scene / "text.npy", scene / "text.safetensors"
                text = table if table.is_file() and not rows.is_file() else rows
            listed = scene / "classes.json"
            if classes is None and text.suffix == ".safetensors" and not listed.is_file():
                return (text,)
            classes = listed if classes is None else classes
        return None if classes is None or text is None else (classes, text)

    def load_classes(self, field: Any | None = None) -> Any:
        """The label set of these files; an error names the `field` that they are for.

        Label pictures hold indices into the scene's `classes.json`. If there is one, only its classes are taken from the
        scene's table, in its order. A table that is named by --text is used whole, unless --classes is given too.
        """
        from ..labels import load_label_set

        found = self.files()
        if found is None:
            place = getattr(field, "folder", None) or "RUN/field.kfgs"
            raise ValueError(
                "classes, text: expected class names (.json) and embeddings (.npy), or a table (.safetensors), got none; "
                "pass --classes and --text, or --scene, or --text alone with a table of `kfgs text`. Without words, show "
                f"examples: `kfgs text --examples clicks.json --field {place} --out shown.safetensors`"
            )
        label_set = load_label_set(*found)
        listed = None if self.scene is None else self.scene / "classes.json"
        if self.text is not None and len(found) == 1 and listed is not None and listed.is_file():
            from .._files import read_json

            if tuple(read_json(listed)) != label_set.names:
                say(
                    f"note: label numbers follow the class list of {self.text}, which differs from {listed}. "
                    f"Pass --classes {listed} to use that list"
                )
        return label_set

    def of_field(self, field: Any) -> Any:
        """The label set of these options; without options, that of the field."""
        given = any(path is not None for path in (self.scene, self.classes, self.text))
        return self.load_classes(field) if given or field.classes is None else field.classes

    def scene_of(self, field: Any | None) -> Any:
        """The scene of --scene or of the field, for its photographs; None if there is none, or it is gone."""
        from ..scenes import load_scene

        if self.scene is not None:
            return self.load_scene().undistorted()
        folder = None if field is None else remembered_scene(field)
        try:
            return None if folder is None else load_scene(folder).undistorted()
        except (OSError, ValueError):
            return None

    def open_field(self, name: str, path: Path) -> Any:
        """Open a field with fused features; a trained one without them computes them from the views of --scene, if given."""
        from ..fields import Linear, fuse_views

        field = open_field(name, path)
        fused = field.fused is not None or isinstance(field.decoder, Linear)
        if self.scene is None or (fused and field.cameras):
            return field
        loaded = self.load_scene().undistorted()
        trained = set(field.info.get("views", ())) or {loaded.cameras[i].name for i in loaded.splits.get("train", ())}
        voting = [camera for camera in loaded.cameras if camera.name in trained]
        if not voting:
            raise ValueError(
                f"scene: expected the views that the field was trained on ({', '.join(sorted(trained)[:3])}, ...), got "
                f"{len(loaded.cameras)} others in {self.scene}; pass the field's own scene, or --classes and --text instead"
            )
        return fuse_views(field, voting)


def remembered_scene(field: Any) -> Path | None:
    """The scene folder that a field remembers; None if there is none, or it is gone."""
    from ..fields import recall_scene

    try:
        return recall_scene(field.info)
    except (OSError, ValueError):
        return None


def fit_method(given: FieldMethod, splat: Path | None = None, *, training: Training | None = None) -> Any:
    """The method of a fit, from a preset and the given options."""
    from ..fields import UpliftConfig
    from ..pipeline import Paper, Uplift

    training = training or Training()
    if given.mode is not None and given.method != "paper":
        raise ValueError(f"mode: expected none for method uplift, got {given.mode!r}; pass --method paper as well")
    if given.method == "paper":
        check_alone("splat", splat, "with --method paper, which trains its own Gaussians")
        paper = Paper.paper() if given.preset == "paper" else Paper()
        paper = replace(paper, training=trained(paper.training, training))
        if given.mode == "decouple":
            return replace(paper, codebook=None, autoencoder=None)
        return replace(paper, autoencoder=None) if given.mode == "adc" else paper
    uplift = Uplift.paper() if given.preset == "paper" else Uplift()
    color = replace(uplift.color, training=trained(uplift.color.training, replace(training, max_gaussians=None)))
    options = uplift.uplift
    if training.max_gaussians is not None:
        options = UpliftConfig(max_gaussians=training.max_gaussians or None)
    return replace(uplift, splat=splat, color=color, uplift=options)


def trained(options: Any, training: Training) -> Any:
    """The options of a training with the given number of steps and Gaussians."""
    options = options if training.steps is None else options.with_steps(training.steps)
    return options.with_maximum(training.max_gaussians or None)
