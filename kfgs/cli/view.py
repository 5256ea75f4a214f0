"""The command view: explore a field or a labelled splat."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from .._files import check_output, real_path
from .files import is_field, open_field, open_splats
from .options import Classes, Given, Positional, Teacher
from .output import say, wrote
from .select import words_of

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
    from ..fields.store import NAME, find_field
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
    about = state.details().get("color")
    if about and about["total"] - about["none"] < FEW * about["total"]:
        say(
            f"note: only {about['total'] - about['none']:,} of {about['total']:,} colour Gaussians lie within lambda of "
            "the field; another frame? `kfgs attach` checks and aligns"
        )
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
    path = real_path(source)  # the title tells one page from another: the run of RUN/field.kfgs, else the file
    title = path.parent.name if path.name == NAME else path.stem
    viewer = Viewer(state, title=title, scene=classes.photos_of(getattr(meaning, "field", None)), out=out)
    if where == "html":
        out.mkdir(parents=True, exist_ok=True)
        wrote([viewer.save_html(out / "view.html")])
    else:
        viewer.serve(report=say)


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

    cameras = [] if classes.loaded is None else classes.loaded.cameras
    if is_field(source) or not source.exists():
        field = open_field("source", source)
        label_set, embed = words_of(classes, teacher, field)
        return FieldMeaning(field, label_set, embed=embed), list(field.cameras) or cameras
    return SplatMeaning(open_splats("source", source, labelled=True)), cameras
