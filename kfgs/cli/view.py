"""The command view: explore a field or a labelled splat."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from .._files import check_output, real_path
from .files import check_alone, is_field, open_splats
from .options import Classes, Given, Positional, Teacher
from .output import say, wrote
from .places import check_apart
from .text import note_other_teacher, text_encoder

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.

Where = Literal["auto", "browser", "html", "window", "picture"]
FEW = 0.05  # of a colour cloud within lambda, under which the frames probably differ


@dataclass(frozen=True)
class Display:
    """Options of the display and of the page."""

    show: Given[Literal["labels", "rgb", "score", "latents"]] = None
    """The meaning of the colours at the start. When not given: the page shows colours if there are any, all else labels."""
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

    It opens a page in the browser, which only this machine can open. A selection in the semantic cloud lights up in the colour
    cloud. Gamma is the score that a Gaussian must exceed; lambda is the distance within which the colour cloud
    lights up too.

    Examples:
        kfgs view run/
        kfgs view run/ --where html    # one file to share
        kfgs view labelled.ply --ask chair --where picture --out pictures/
        kfgs view run/ --teacher lseg --weights demo_e200.ckpt    # any text

    Args:
        source: A run folder of `kfgs fit` or its field, asked by text; or a splat with classes (`kfgs attach`), asked by class.
        color: Colour splat in the same frame, any splat file. Of a field, by default: RUN/color.ply, or the splat it was made on.
        ask: A first question.
        distance: Lambda at the start, in world units; by default from the clouds' spacing.
        where: browser; html (writes OUT/view.html, one file that any browser opens without kfgs, and ends); window (pyvista:
            two clouds side by side); or picture (writes OUT/view.png and ends). auto: browser. The first two show small
            photos of the scene, too.
        out: Folder for saved pictures and selections.
    """
    place = "browser" if where == "auto" else where
    if where in ("html", "picture") or out.exists():  # the others write only when asked
        check_output("out", out, "a folder")
    read = functools.partial(_read, source, color, ask, distance, out, classes, teacher)
    if place == "browser":
        _viewer(read(), source, out, classes, display).serve(display.host, display.port, report=say)
        return
    for name, given, usual in (("host", display.host, "127.0.0.1"), ("port", display.port, 0)):
        check_alone(name, None if given == usual else given, "without --where browser, whose page listens there")
    _check_drawing(place)
    state = read()
    if place == "html":
        out.mkdir(parents=True, exist_ok=True)
        wrote([_viewer(state, source, out, classes, display).save_html(out / "view.html")])
    else:
        _draw(state, place, out, display)


def _check_drawing(place: Where) -> None:
    """Raise a ValueError if a window or a picture is impossible here."""
    from ..viz.plotter import has_display, require

    if place == "window" and not has_display():
        raise ValueError("where: expected a display for a window, got none; use browser or picture")
    try:
        if place in ("window", "picture"):
            require()
    except RuntimeError as error:  # nothing draws here
        raise ValueError(str(error)) from error


def _read(
    source: Path,
    color: Path | None,
    ask: str | None,
    distance: float | None,
    out: Path,
    classes: Classes,
    teacher: Teacher,
) -> Any:
    """The exploration, whose pictures and selections go to `out`."""
    from .._check import check_range
    from ..fields.store import find_field
    from ..viewer import Exploration

    if distance is not None:
        check_range("distance", distance, 0, closed=(False, False))
    check_apart("view", {"source": source, "color": color, "out": out, "classes": classes})
    classes.check_images()
    say("reading")
    found = find_field(source)
    meaning, cameras = open_meaning(found or source, classes, teacher)
    colors = open_colors(found, color, meaning)
    cloud = None if colors is meaning.gaussians else colors
    state = Exploration(meaning, cloud, cameras=cameras, distance=distance)
    _note(state)
    if ask is not None:
        state.ask(ask)
    for line in state.lines():
        say(line)
    return state


def _viewer(state: Any, source: Path, out: Path, classes: Classes, display: Display) -> Any:
    from ..viewer import Viewer

    state.set_show(display.show or state.first_show)
    scene = classes.scene_of(getattr(state.meaning, "field", None))
    return Viewer(state, title=_title(source), scene=scene, out=out)


def _title(source: Path) -> str:
    """What tells one page from another: the run of RUN/field.kfgs, else the file."""
    from ..fields.store import NAME

    path = real_path(source)
    return path.parent.name if path.name == NAME else path.stem


def _draw(state: Any, place: Where, out: Path, display: Display) -> None:
    """Open a window until the user closes it, or write its picture."""
    from ..viewer import Explorer

    with Explorer(state, out=out, off_screen=place != "window") as explorer:
        explorer.set_show(display.show or "labels")
        if place == "window":
            explorer.show()
        else:
            explorer.screenshot(out / "view.png")
            wrote([out / "view.png"])


def open_colors(field: Path | None, color: Path | None, meaning: Any) -> Any:
    """The colour cloud: the given one, the source's own, or that of the run; None if there is none."""
    from ..fields.store import read_description

    if color is not None:
        return open_splats("color", color)
    if meaning.gaussians.sh is not None:
        return meaning.gaussians
    if field is None:
        return None
    geometry = read_description(field).get("info", {}).get("geometry")
    for place in (field.parent / "color.ply", Path(str(geometry))):
        if place.is_file() and not is_field(place):
            say(f"colours: {place}")
            return open_splats("color", place)
    return None


def open_meaning(source: Path, classes: Classes, teacher: Teacher) -> tuple[Any, list[Any]]:
    """The answers to questions, and the cameras of the scene (those that a field was trained on)."""
    from ..viewer import FieldMeaning, SplatMeaning

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
    if color and color["total"] - color["none"] < FEW * color["total"]:
        say(
            f"note: only {color['total'] - color['none']:,} of {color['total']:,} colour Gaussians lie within lambda of "
            "the field; another frame? `kfgs attach` checks and aligns, --distance sets lambda"
        )
