"""The command view: explore a field or a labelled splat."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from .files import check_alone, check_folder, is_field, open_splats
from .options import Classes, Given, Positional, Teacher
from .output import say, wrote
from .text import note_other_teacher, text_encoder

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.

Where = Literal["auto", "window", "browser", "picture"]
FEW = 0.05  # of a colour cloud within lambda, under which the frames probably differ


@dataclass(frozen=True)
class Display:
    """Options of the display and of the page."""

    show: Literal["labels", "rgb", "score", "latents"] = "labels"
    """The meaning of the colours at the start."""
    style: Literal["auto", "gaussians", "points"] = "auto"
    """gaussians as they are rasterised, points (quick); auto: Gaussians if a frame of them is quick."""
    host: str = "127.0.0.1"
    """Address on which the page listens. Anything but 127.0.0.1 lets others look and save."""
    port: int = 0
    """Port of the page; 0: a free one."""


def view(
    source: Positional[Path],
    *,
    color: Given[Path] = None,
    ask: Given[str] = None,
    distance: Given[float] = None,
    where: Where = "auto",
    out: Path = Path("kfgs_view"),
    teacher: Teacher,
    classes: Classes,
    display: Display,
) -> None:
    """Explore a field: type "chair", change gamma and lambda, click a Gaussian, save the selection.

    The semantic cloud and the colour cloud stand side by side, in a window or in a browser page that only this machine can
    open. A selection in the semantic cloud lights up in the colour cloud. Gamma is the score that a Gaussian must
    exceed; lambda is the distance within which the colour cloud lights up too.

    Examples:
        kfgs view run/field --color run/color.ply
        kfgs view labelled.ply --ask chair --where picture --out pictures/
        kfgs view run/field --teacher lseg --weights demo_e200.ckpt    # any text

    Args:
        source: A field folder (RUN/field), asked by text; or a splat with classes (`kfgs attach`), asked by class.
        color: Colour splat in the same frame, any splat file; without it the source is shown alone.
        ask: A first question.
        distance: Lambda at the start, in world units; by default from the clouds' spacing.
        where: window, browser, or picture (writes OUT/view.png and ends). auto: a window if there is a display, else the
            browser.
        out: Folder for saved pictures and selections.
    """
    from .._check import check_range, check_whole
    from ..viz.explorer import Exploration, ExploreOptions, Explorer
    from ..viz.explorer.entry import check_place, find_place
    from ..viz.headless import require

    check_folder("out", out)
    check_whole("port", display.port, 0, 65535)
    if distance is not None:
        check_range("distance", distance, 0, closed=(False, False))
    classes.check_images()
    place = where if where != "auto" else "window" if find_place() == "window" else "browser"
    if place != "browser":
        for name, given, usual in (("host", display.host, "127.0.0.1"), ("port", display.port, 0)):
            check_alone(name, None if given == usual else given, "without --where browser, whose page listens there")
    try:
        check_place(place)
        require()
    except RuntimeError as error:  # nothing to open, or nothing draws here
        raise ValueError(str(error)) from error
    say("reading")
    meaning, cameras = open_meaning(source, classes, teacher)
    cloud = None if color is None else open_splats("color", color).gaussians
    state = Exploration(meaning, cloud, cameras=cameras, distance=distance)
    _note(state)
    height, width = (680, 980) if place == "window" else (600, 1200)  # a window has a panel next to the clouds
    options = ExploreOptions(height=height, width=width, style=display.style, out=out)
    with Explorer(state, options, off_screen=place != "window") as explorer:
        explorer.set_show(display.show)
        if ask is not None:
            explorer.ask(ask)
        for line in explorer.lines():
            say(line)
        _open(explorer, place, display.host, display.port)


def _open(explorer: Any, place: Where, host: str, port: int) -> None:
    """Show an explorer until the user closes it, or write its picture."""
    from ..viz.explorer import open_window, serve

    if place == "picture":
        explorer.screenshot(explorer.options.out / "view.png")
        wrote([explorer.options.out / "view.png"])
    elif place == "window":
        open_window(explorer)
    else:
        serve(explorer, host=host, port=port, report=say)


def open_meaning(source: Path, classes: Classes, teacher: Teacher) -> tuple[Any, list[Any]]:
    """The answers to questions, and the cameras of the scene (those that a field was trained on)."""
    from ..viz.explorer import FieldMeaning, SplatMeaning

    if is_field(source) or not source.exists():
        field = classes.open_field("source", source)
        label_set, embed = _words_of(classes.of_field(field), teacher)
        return FieldMeaning(field, label_set, embed=embed), list(field.cameras)
    given = {"classes": classes.classes, "text": classes.text} | dataclasses.asdict(teacher)
    for name, value in given.items():
        check_alone(name, value, "with a splat, which has its own classes")
    cameras = [] if classes.scene is None else classes.load_scene().undistorted().cameras
    return SplatMeaning(open_splats("source", source, labelled=True)), cameras


def _words_of(label_set: Any, teacher: Teacher) -> tuple[Any, Callable[[str], Any] | None]:
    """The label set, and a function that turns a phrase into a row of the teacher's space, in the table's templates.

    The teacher is loaded here, so that a wrong file is reported at once. If the table has no canonical words to compare a
    phrase with, the teacher embeds them.
    """
    if teacher.teacher is None:
        teacher.check_weights()
        return label_set, None
    from ..labels import CANONICAL

    encode, templates = text_encoder(teacher), label_set.info.get("templates")
    probe = encode(["thing"], templates=templates, negatives=CANONICAL)
    note_other_teacher(probe, label_set)
    if label_set.negatives is None and probe.dim == label_set.dim:
        label_set = dataclasses.replace(label_set, negatives=probe.negatives, negative_names=probe.negative_names)

    @functools.cache
    def embed(phrase: str) -> Any:
        return encode([phrase], templates=templates).embeddings[0]

    return label_set, embed


def _note(state: Any) -> None:
    """Print a note if the clouds are probably in different frames."""
    color = state.details().get("color")
    if color and color["total"] - color["orphaned"] < FEW * color["total"]:
        say(
            f"note: only {color['total'] - color['orphaned']:,} of {color['total']:,} colour Gaussians lie within lambda of "
            "the field; another frame? `kfgs attach` checks and aligns, --distance sets lambda"
        )
