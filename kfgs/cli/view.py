"""The command view: explore a field or a labelled splat."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from .._files import check_output, real_path
from .features import text_encoder
from .files import is_field, open_splats
from .options import Classes, Given, Positional, Teacher
from .output import say, wrote
from .select import note_other_teacher

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.

Where = Literal["browser", "html", "window", "picture"]
FEW = 0.05  # of a colour cloud within lambda, under which the frames probably differ


def view(
    source: Positional[Path],
    *,
    color: Given[Path] = None,
    ask: Given[str] = None,
    where: Where = "browser",
    out: Path = Path("kfgs_view"),
    teacher: Teacher,
    classes: Classes,
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
        where: browser; html (writes OUT/view.html, one file that any browser opens without kfgs, and ends); window (pyvista:
            two clouds side by side); or picture (writes OUT/view.png and ends). The first two show small photos of the
            scene, too.
        out: Folder for saved pictures and selections.
    """
    from ..fields.store import find_field
    from ..viewer import Exploration, Explorer, Viewer
    from ..viz.plotter import has_display, require

    if where in ("html", "picture") or out.exists():  # the others write only when asked
        check_output("out", out, "a folder")
    if where == "window" and not has_display():
        raise ValueError("where: expected a display for a window, got none; use browser or picture")
    if where in ("window", "picture"):
        try:
            require()
        except RuntimeError as error:  # nothing draws here
            raise ValueError(str(error)) from error
    say("reading")
    field = find_field(source)
    meaning, cameras = open_meaning(field or source, classes, teacher)
    colors = open_colors(field, color, meaning)
    state = Exploration(meaning, None if colors is meaning.gaussians else colors, cameras=cameras)
    _note(state)
    if ask is not None:
        state.ask(ask)
    for line in state.lines():
        say(line)
    if where in ("window", "picture"):
        with Explorer(state, out=out, off_screen=where == "picture") as explorer:
            explorer.set_show("labels")
            if where == "window":
                explorer.show()
            else:
                explorer.screenshot(out / "view.png")
                wrote([out / "view.png"])
        return
    state.set_show(state.first_show)
    scene = classes.photos_of(getattr(meaning, "field", None))
    viewer = Viewer(state, title=_title(source), scene=scene, out=out)
    if where == "html":
        out.mkdir(parents=True, exist_ok=True)
        wrote([viewer.save_html(out / "view.html")])
    else:
        viewer.serve(report=say)


def _title(source: Path) -> str:
    """What tells one page from another: the run of RUN/field.kfgs, else the file."""
    from ..fields.store import NAME

    path = real_path(source)
    return path.parent.name if path.name == NAME else path.stem


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
        label_set, embed = _words_of(classes.load_classes(field), teacher)
        return FieldMeaning(field, label_set, embed=embed), list(field.cameras)
    scene = classes.load_scene()
    return SplatMeaning(open_splats("source", source, labelled=True)), [] if scene is None else scene.cameras


def _words_of(label_set: Any, teacher: Teacher) -> tuple[Any, Callable[[str], Any] | None]:
    """The label set, and a function that turns a phrase into a row of the teacher's space, in the table's templates.

    The teacher is loaded here, so that a wrong file is reported at once. If the table has no canonical words to compare a
    phrase with, the teacher embeds them.
    """
    from ..labels.scores import CANONICAL

    network = teacher.load()
    if network is None:
        return label_set, None
    encode, templates = text_encoder(network), label_set.info.get("templates")
    probe = encode(["thing"], templates=templates, negatives=CANONICAL)
    note_other_teacher(probe, label_set)
    if label_set.negatives is None and probe.dim == label_set.dim:
        label_set = replace(label_set, negatives=probe.negatives, negative_names=probe.negative_names)

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
            "the field; another frame? `kfgs attach` checks and aligns"
        )
