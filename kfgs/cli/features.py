"""The command features: make feature maps, or check them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from .._files import check_output
from .files import check_alone
from .options import Device, Flag, Given, MapTeacher, SceneFolder, Views
from .output import say, wrote

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.


def features(
    scene: SceneFolder,
    *,
    out: Given[Path] = None,
    overwrite: Flag = False,
    check: Given[Path] = None,
    device: Device = "auto",
    teacher: MapTeacher,
    views: Views,
) -> None:
    """Run a teacher over a scene's pictures and store its feature maps; or check existing maps.

    Pictures are processed one at a time. After a kill, the same command continues with the next picture.

    Examples:
        kfgs features scene/ --teacher lseg --weights demo_e200.ckpt
        kfgs features scene/ --teacher dinov2 --weights facebook/dinov2-small --out maps/
        kfgs features scene/ --check maps/    # by Feature 3DGS, or in .npy or .safetensors

    Args:
        out: Folder for the maps; by default SCENE/features.
        overwrite: Replace maps that kfgs made with another teacher, other weights or other options; without it they are an
            error. Maps of other programs always are.
        check: Check this folder of maps instead, and report every file that does not fit.
        device: Where the teacher runs: auto (a GPU if there is one), cpu or cuda.
    """
    from ..scenes import FeatureFolder, extract_features

    if check is not None:
        for name, given in (("teacher", teacher.teacher), ("weights", teacher.weights), ("out", out)):
            check_alone(name, given, "with --check, which encodes nothing")
    target = out if out is not None else scene_folder(scene) / "features"
    if check is None:
        check_output("out", target, "a folder")
    loaded = views.load(scene)
    chosen = "" if views.split == "train" else f" --split {views.split}"
    if check is not None:
        problems, count = FeatureFolder(check).check(loaded, views.split), len(loaded.views(views.split))
        say(f"{check}: {count - len(problems)} of {count} views have a map that fits")
        for name, text in problems.items():
            say(f"{name}: {text}")
        if problems:
            raise ValueError(
                f"check: expected a map that fits for each of the {count} views of split {views.split!r}, got "
                f"{len(problems)} that are missing or do not fit (named above); make these maps again, or name the "
                "photos to use in SCENE/split.json"
            )
        say(f"next: kfgs fit {scene} --out run --features {check}{chosen}")
        return
    network = choose_teacher(teacher.teacher, teacher.weights, teacher.fast, teacher.size, device)
    extract_features(network, loaded, target, views.split, overwrite=overwrite, progress=True)
    maps = FeatureFolder(target).of(loaded, views.split)
    say(f"{len(maps)} maps of {' x '.join(map(str, maps.shape))} by {teacher_words(maps.identity or {})}")
    say(f"next: kfgs fit {scene} --out run" + ("" if out is None else f" --features {out}") + chosen)
    wrote([target])


def choose_teacher(name: str | None, weights: str | None, fast: bool, size: tuple[int, ...], device: str) -> Any:
    """Load the teacher of a command on its device; a ValueError if none is named, or an option does not fit."""
    from ..pipeline.train import training_device
    from ..teachers.load import load_teacher, teacher_names

    if name is None:
        raise ValueError(
            f"teacher: expected one of {', '.join(teacher_names())}, or package.module:name, got none; pass --teacher "
            "(and --weights), or --check FOLDER to check existing maps"
        )
    target = training_device(device)
    teacher = load_teacher(name, weights, **teacher_options(name, fast, size))
    return teacher.to(target) if hasattr(teacher, "to") else teacher


def teacher_options(name: str, fast: bool, size: tuple[int, ...]) -> dict[str, Any]:
    """The teacher's options for --fast and --size.

    Raises:
        ValueError: if the teacher has no such option, or takes another number of numbers.
    """
    options: dict[str, Any] = {}
    if fast:
        if name != "lseg":
            raise ValueError(f"fast: expected none with teacher {name!r}, which has one pass only; leave it out")
        options["fast"] = True
    if size:
        wanted = 2 if name == "lseg" else 1
        if len(size) != wanted or ":" in name:
            what = "HEIGHT WIDTH" if name == "lseg" else "the long side in pixels" if ":" not in name else "none"
            raise ValueError(
                f"size: expected {what} for teacher {name!r}, got {' '.join(map(str, size))}; correct --size"
            )
        options["size"] = size if name == "lseg" else size[0]
    return options


def stored_maps(scene: Any, views: list[int], folder: Path) -> Any:
    """The maps of some views of a scene."""
    from ..scenes import FeatureFolder

    return FeatureFolder(folder).of(scene, views)


def scene_folder(scene: Path) -> Path:
    """The folder of a scene that is given as a folder or as a transforms.json."""
    return scene if scene.is_dir() else scene.parent


def teacher_words(identity: dict[str, Any]) -> str:
    """A teacher's identity in a few words: `lseg (weights 3f2a...)`."""
    from .._check import one_line

    weights, options = identity.get("weights"), identity.get("options")
    words = [one_line(identity.get("name", "unknown"))]
    words += [f"weights {one_line(weights)[:12]}"] if weights else []
    words += (
        [f"{name} {json.dumps(value)}" for name, value in sorted(options.items())] if isinstance(options, dict) else []
    )
    return ", ".join(words)
