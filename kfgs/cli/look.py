"""The command that looks: view."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from .._check import check_range, check_whole
from .checks import check_alone, check_folder, open_splats
from .say import field_classes, open_answering, say, wrote
from .words import note_other_teacher, text_encoder

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.

Where = Literal["auto", "window", "browser", "picture"]
Style = Literal["auto", "gaussians", "points"]
Show = Literal["labels", "rgb", "score", "latents"]
FEW = 0.05  # of a colour cloud within lambda, under which the frames probably differ


def view(
    source: Annotated[Path, tyro.conf.Positional],
    color: Path | None = None,
    scene: Path | None = None,
    classes: Path | None = None,
    text: Path | None = None,
    teacher: str | None = None,
    weights: str | None = None,
    images: Path | None = None,
    ask: str | None = None,
    show: Show = "labels",
    distance: float | None = None,
    where: Where = "auto",
    style: Style = "auto",
    out: Path = Path("kfgs_view"),
    host: str = "127.0.0.1",
    port: int = 0,
) -> None:
    """Look at what a scene means: type "chair", move gamma and lambda, pick a Gaussian, save what was found.

    Both clouds side by side in a window, or in a browser page that only this machine can open. What is selected in the
    semantic cloud lights up, through lambda, in the colour cloud.

    Args:
        source: a field folder (`RUN/field`), asked by text; or a splat with classes (`kfgs attach`), asked by class.
        color: the colour scene in the same frame, any splat file; without it the source is shown alone.
        scene: scene folder: classes.json and text.npy, or text.safetensors; a field remembers its own. For a splat, the cameras
            that tell who sees a Gaussian.
        classes: JSON list of class names; SCENE/classes.json when not given.
        text: .npy of one embedding per class, or a table that `kfgs text` made (.safetensors); SCENE/text.npy or
            SCENE/text.safetensors when not given.
        teacher: ask any phrase, with this teacher's text encoder: lseg, clip, siglip, ...; of a field.
        weights: the teacher's checkpoint file (lseg), or folder or hub id (the others).
        images: folder of the scene's pictures, if it is not SCENE/images.
        ask: a first question.
        show: what colours stand for at first.
        distance: the paper's lambda at first, world units; from the clouds' spacing when not given.
        where: `window`, `browser`, or `picture` (writes OUT/view.png and ends). `auto`: a window where there is a display,
            else the browser.
        style: `gaussians` as the rasteriser draws them, `points` (quick), `auto`: Gaussians where a frame of them is quick.
        out: folder for the pictures and selections that are saved while looking.
        host: address on which the page listens. Anything but 127.0.0.1 lets others look and save.
        port: of the page; 0: a free one.
    """
    from ..viz.explorer import Exploration, ExploreOptions, Explorer
    from ..viz.explorer.entry import check_place, find_place
    from ..viz.headless import require

    check_folder("out", out)
    check_whole("port", port, 0, 65535)
    if distance is not None:
        check_range("distance", distance, 0, closed=(False, False))
    if scene is None:
        check_alone("images", images, "without --scene, whose pictures they are")
    place = where if where != "auto" else "window" if find_place() == "window" else "browser"
    if place != "browser":
        for name, given, usual in (("host", host, "127.0.0.1"), ("port", port, 0)):
            check_alone(name, None if given == usual else given, "without --where browser, whose page listens there")
    try:
        check_place(place)
        require()
    except RuntimeError as error:  # nothing to open, or nothing draws here
        raise ValueError(str(error)) from error
    say("reading")
    meaning, cameras = _meaning(source, (scene, classes, text), teacher, weights, images)
    cloud = None if color is None else open_splats("color", color).gaussians
    state = Exploration(meaning, cloud, cameras=cameras, distance=distance)
    _note(state)
    height, width = (680, 980) if place == "window" else (600, 1200)  # beside the clouds a window has a panel
    options = ExploreOptions(height=height, width=width, style=style, out=out)
    with Explorer(state, options, off_screen=place != "window") as explorer:
        explorer.set_show(show)
        if ask is not None:
            explorer.ask(ask)
        for line in explorer.lines():
            say(line)
        _open(explorer, place, host, port)


def _open(explorer: Any, place: Where, host: str, port: int) -> None:
    """Show an explorer where it is wanted, until the user has seen enough; or write its picture."""
    from ..viz.explorer import open_window, serve

    if place == "picture":
        explorer.screenshot(explorer.options.out / "view.png")
        wrote([explorer.options.out / "view.png"])
    elif place == "window":
        open_window(explorer)
    else:
        serve(explorer, host=host, port=port, say=say)


def _meaning(
    source: Path,
    words: tuple[Path | None, Path | None, Path | None],
    teacher: str | None,
    weights: str | None,
    images: Path | None,
) -> tuple[Any, list[Any]]:
    """What can be asked, and the cameras of the scene (those that a field was trained on)."""
    from ..scenes import load_scene
    from ..viz.explorer import FieldMeaning, SplatMeaning

    scene, classes, text = words
    if (source / "field.json").is_file() or not source.is_file():
        field = open_answering(source, scene, images)
        label_set, embed = _words_of(field_classes(field, scene, classes, text), teacher, weights)
        return FieldMeaning(field, label_set, embed=embed), list(field.cameras)
    for name, value in {"classes": classes, "text": text, "teacher": teacher, "weights": weights}.items():
        check_alone(name, value, "beside a splat, which has its own classes")
    cameras = [] if scene is None else load_scene(scene, images=images).undistorted().cameras
    return SplatMeaning(open_splats("source", source, labelled=True)), cameras


def _words_of(label_set: Any, teacher: str | None, weights: str | None) -> tuple[Any, Callable[[str], Any] | None]:
    """The label set, and what turns a phrase into a row of the teacher's space, in the templates of the table.

    The teacher is loaded here, so that a wrong file is told at once; where the table has no canonical words to tell a
    phrase from, the teacher embeds them.
    """
    if teacher is None:
        check_alone("weights", weights, "without --teacher, whose weights they are")
        return label_set, None
    from ..labels import CANONICAL

    encode, templates = text_encoder(teacher, weights), label_set.info.get("templates")
    probe = encode(["thing"], templates=templates, negatives=CANONICAL)
    note_other_teacher(probe, label_set)
    if label_set.negatives is None and probe.dim == label_set.dim:
        label_set = dataclasses.replace(label_set, negatives=probe.negatives, negative_names=probe.negative_names)

    @functools.cache
    def embed(phrase: str) -> Any:
        return encode([phrase], templates=templates).embeddings[0]

    return label_set, embed


def _note(state: Any) -> None:
    """Say what would make a person wonder: clouds in different frames."""
    color = state.facts().get("color")
    if color and color["total"] - color["orphaned"] < FEW * color["total"]:
        say(
            f"note: only {color['total'] - color['orphaned']:,} of {color['total']:,} colour Gaussians lie within lambda of "
            "the field; another frame? `kfgs attach` checks and aligns, --distance sets lambda"
        )
