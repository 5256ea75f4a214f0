"""What every command shares: talking to a person, and finding classes and configurations."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

Preset = Literal["cpu", "paper"]
Method = Literal["fuse", "paper"]
Mode = Literal["decouple", "adc", "adc+sc"]


def say(text: str) -> None:
    """Print a line at once."""
    print(text, flush=True)  # noqa: T201 - this is the place that talks to a person


def wrote(paths: list[Path]) -> None:
    """Name the files that a command left behind."""
    say("wrote:")
    for path in paths:
        say(f"  {path}" + (f"  ({sum(1 for p in path.iterdir())} files)" if path.is_dir() else ""))


def say_lost(written: Any) -> None:
    """Tell what the format of a splat file (`Written`) could not hold, and whether it has put the Gaussians in order."""
    for words in written.lost:
        say(f"note: {words}")
    if written.order is not None:
        say("note: neighbours now lie side by side (Morton order), so indices into the old file do not fit the new one")


def fit_config(
    preset: Preset,
    method: Method,
    mode: Mode | None,
    seed: int,
    steps: int | None,
    max_gaussians: int | None,
    split: str,
) -> Any:
    """The options of a fit, from a preset and what was given beside it."""
    from ..pipeline import FitConfig
    from ..pipeline.color import ColorConfig

    if mode is not None and method != "paper":
        raise ValueError(f"mode: expected none for method {method!r}, got {mode!r}; pass --method paper as well")
    config = FitConfig.cpu() if preset == "cpu" else FitConfig.paper(method=method, color=ColorConfig.paper())
    config = dataclasses.replace(config, method=method, mode=mode or config.mode, seed=seed, split=split)
    if steps is not None:
        color = dataclasses.replace(config.color, field=config.color.field.with_steps(steps))
        config = dataclasses.replace(config, color=color, field=config.field.with_steps(steps))
    if max_gaussians is not None:
        fields = dataclasses.replace(config.field, max_gaussians=max_gaussians)
        uplift = dataclasses.replace(config.uplift, max_gaussians=max_gaussians)
        config = dataclasses.replace(config, field=fields, uplift=uplift)
    return config


def field_classes(field: Any, scene: Path | None, classes: Path | None, text: Path | None) -> Any:
    """The label set that options name, or else the one that a field remembers."""
    given = any(path is not None for path in (scene, classes, text))
    return load_classes(scene, classes, text) if given or "classes" not in field.info else field.label_set()


def open_answering(path: Path, scene: Path | None, images: Path | None) -> Any:
    """A field whose Gaussians can answer by themselves: an older one asks the views of its scene, if that is given."""
    from .checks import open_field

    field = open_field(path)
    if field.linear is not None and (field.cameras or scene is None):
        return field
    if scene is None:
        say(
            "note: this field was made before fields kept what the views show of each Gaussian; each one's own latent answers, "
            "which is noisy. Pass --scene, or fit it again"
        )
        return field
    return field.with_answers(training_cameras(field, scene, images))


def load_classes(scene: Path | None, classes: Path | None, text: Path | None) -> Any:
    """The label set of a scene folder, of two files, or of one table that `kfgs text` made.

    The scene's `classes.json`, where there is one, chooses and orders the classes of the scene's own table, since label
    pictures hold indices into it. A table given by name is taken whole unless classes are given too.
    """
    from ..labels import load_label_set

    found = find_classes(scene, classes, text)
    if found is None:
        raise ValueError(
            "classes, text: expected class names (.json) and embeddings (.npy), or a table of words (.safetensors), got none; "
            "pass --classes and --text, or --scene, or --text alone with what `kfgs text` made"
        )
    label_set = load_label_set(*found)
    listed = None if scene is None else scene / "classes.json"
    if text is not None and len(found) == 1 and listed is not None and listed.is_file():
        from .._files import read_json

        if tuple(read_json(listed)) != label_set.names:
            say(
                f"note: labels count the classes of {text}, not those of {listed}; --classes {listed} chooses the latter"
            )
    return label_set


def find_classes(scene: Path | None, classes: Path | None, text: Path | None) -> tuple[Path, ...] | None:
    """The files that `load_label_set` takes: a table alone, or names and rows; None where nothing says where they are."""
    if classes is not None and classes.suffix == ".safetensors":
        if text is not None:
            raise ValueError(f"text: expected none beside the table {classes}, got {text}; leave it out")
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


@contextmanager
def warnings_as_notes() -> Iterator[None]:
    """Say the warnings of kfgs's own functions about words and teachers as notes, in a line each."""
    with warnings.catch_warnings():
        warnings.filterwarnings("always", message="classes: ")

        def note(message: Warning | str, *_: Any, **__: Any) -> None:
            say(f"note: {message}")

        warnings.showwarning = note
        yield


def training_cameras(field: Any, scene: Path | None, images: Path | None) -> list[Any]:
    """The cameras that a field was trained with, found again in its scene by name."""
    from ..scenes import load_scene

    if scene is None:
        raise ValueError("scene: expected the field's own scene, got none; pass --scene, whose cameras it needs")
    loaded = load_scene(scene, images=images).undistorted()
    cameras = loaded.cameras
    trained = set(field.info.get("views", ())) or {cameras[i].name for i in loaded.splits.get("train", ())}
    voting = [camera for camera in cameras if camera.name in trained]
    if not voting:
        raise ValueError(
            f"scene: expected the views that the field was trained on ({', '.join(sorted(trained)[:3])}, ...), got "
            f"{len(cameras)} others in {scene}; pass the field's own scene, or --classes and --text instead of a scene"
        )
    return voting


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    return (
        path.stat().st_size
        if path.is_file()
        else sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    )
