"""The commands select and view: ask a field or a labelled splat, in the terminal or in the viewer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import kfgs

from .._files import atomic_folder, check_output, real_path, write_json
from .files import is_field, open_field, open_splats, say, wrote
from .options import Classes, Given, Positional, Teacher

Where = Literal["browser", "html", "window", "picture"]
FEW = 0.05  # of a colour cloud within lambda, under which the frames probably differ


def select(
    query: Positional[str],
    source: Positional[Path],
    *,
    out: Given[Path] = None,
    threshold: Given[float] = None,
    distance: Given[float] = None,
    teacher: Teacher,
    classes: Classes,
) -> None:
    """Find the Gaussians of a class or phrase: how many, where, how large, and the view that shows them best.

    Connected parts are listed one by one, the largest first. Those of a labelled splat have names, chair/1, chair/2, which
    `kfgs edit` understands.

    Examples:
        kfgs select chair run/field.kfgs
        kfgs select chair labelled.ply --scene scene/ --out chairs/
        kfgs select "the red chair by the window" run/field.kfgs --teacher lseg --weights demo_e200.ckpt

    Args:
        query: A class name, "chair"; with --teacher any phrase.
        source: A field (RUN/field.kfgs), or a splat with classes.
        out: Folder for selection.json (with the indices), selection.ply (the Gaussians) and parts.png (each part in its best
            view, if the cameras are known).
        threshold: Scores must be above it. For a field it is the paper's gamma; by default 0.5 for a relevancy, else derived
            from the scores. For a splat the default takes every Gaussian of the class.
        distance: Gaussians at most this far apart are one part, in world units. By default the views of a field tell things
            apart, and the column `instance` of a splat; without both, the spacing of the scene decides.
    """
    from .._check import check_range
    from ..labels import Selection, number_instances
    from ..viz.films import show_cloud, show_photos, write_parts

    if out is not None:
        check_output("out", out, "a folder")
    if threshold is not None:
        check_range("threshold", threshold, 0, 1)
    if is_field(source):
        field = open_field("source", source)
        label_set, embed = words_of(classes, teacher, field)
        phrase = None if embed is None or label_set.knows(query) else embed(query)
        try:
            query = query if phrase is not None else label_set.names[label_set.index(query)]
        except ValueError as error:
            advice = "for any other phrase pass --teacher and --weights, or add it to the table of words"
            raise ValueError(f"{error}; {advice}") from error
        selection = field.query(query if phrase is None else phrase, label_set, threshold)
        by_views = phrase is None and distance is None and field.cameras
        cloud = number_instances(field.label(label_set), field.cameras) if by_views else field.gaussians
        cloud, cameras = cloud.replace(scores=selection.scores), field.cameras or None
        scene = classes.photos_of(field) if out is not None else None
    else:
        scene, cloud = classes.loaded, open_splats("source", source, named=True)
        cameras, selection = None if scene is None else scene.cameras, kfgs.OfClass(query).select(cloud)
        if cloud.scores is not None:
            mask = selection.mask if threshold is None else selection.mask & (cloud.scores > threshold)
            selection = Selection(mask, cloud.scores, threshold, selection.how)
    headline = f"{query}: {len(selection)} of {len(cloud)} Gaussians, {selection.summary}"
    if out is not None and len(selection) == 0:
        say(headline)
        raise ValueError(f"query: expected Gaussians to save, got none of {query!r}; lower the threshold or drop --out")
    parts = kfgs.connected_parts(cloud, selection, cameras, distance=distance)
    if out is not None:  # before anything is printed, whose reader may have ended
        facts = {"query": query, "threshold": selection.threshold, "how": selection.how, "count": len(selection)}
        under = None if cloud.sh is None else show_cloud(cloud, color_by="rgb")
        under = under if scene is None else show_photos(scene)
        with atomic_folder(out) as new:
            write_json(new / "selection.json", facts | {"parts": [part.to_json() for part in parts]})
            kfgs.write_splats(cloud.select(selection.mask), new / "selection.ply")
            write_parts(new / "parts.png", cloud, parts, cameras or (), under, query)
            written = sorted(path.name for path in new.iterdir())
        for name in {"parts.png", "selection.ply.classes.json"} - set(written):
            (out / name).unlink(missing_ok=True)  # of an older selection
    say(headline)
    say_parts(parts, None if is_field(source) or threshold is not None else query)
    if out is not None:
        wrote([out / name for name in written])


def say_parts(parts: Sequence[Any], name: str | None) -> None:
    """List parts, each with its number as `kfgs edit` counts the parts of a class, if its `name` is given."""
    for part in parts:
        say(f"  {part!r}" if name is None else f"  {name}/{part.number}: {part!r}")
    left = parts[0].total - len(parts) if parts else 0
    if left:
        say(f"  {left} smaller part{'s are' if left > 1 else ' is'} not listed")


def words_of(classes: Classes, teacher: Teacher, field: Any) -> tuple[Any, Callable[[str], Any] | None]:
    """The label set, and a function that turns a phrase into a row of the teacher's space, in the table's templates.

    The teacher is loaded here, so that a wrong file is reported at once. The canonical words, with which a phrase is
    compared, are then its own. It may be asked without a table of words, too.
    """
    from ..labels.label_set import teacher_mismatch

    network = teacher.load()
    if network is None:
        return classes.load_classes(field), None
    known = classes.text is not None or classes.scene is not None or field.classes is not None
    label_set = classes.load_classes(field) if known else None
    templates = None if label_set is None else label_set.info.get("templates")
    asked = kfgs.make_label_set(network, ["thing"], templates=templates)
    label_set = label_set or asked
    if (difference := teacher_mismatch(asked.info, label_set.info)) is not None:
        say(
            "note: --text: expected a table by the query's teacher (from --teacher and --weights), got one by another "
            f"({difference}); they cannot be compared: use the table's teacher for the query, or pass a table of the "
            "query's teacher as --text"
        )
    if asked.dim == label_set.dim:  # otherwise the query raises an error
        label_set = replace(label_set, negatives=asked.negatives, negative_names=asked.negative_names, info=asked.info)

    @cache
    def embed(phrase: str) -> Any:
        return kfgs.make_label_set(network, [phrase], templates=templates, negatives=None).embeddings[0]

    return label_set, embed


def view(
    source: Positional[Path],
    *,
    color: Given[Path] = None,
    ask: Given[str] = None,
    where: Where = "browser",
    up: Given[Literal["x", "y", "z", "x-down", "y-down", "z-down"]] = None,
    out: Path = Path("kfgs_view"),
    teacher: Teacher,
    classes: Classes,
) -> None:
    """Explore a field or a splat: type "chair", change gamma and lambda, click a Gaussian, select, edit, save.

    It opens a page in the browser, which only this machine can open. A selection in the semantic cloud lights up in the colour
    cloud. Gamma is the score that a Gaussian must exceed; lambda the distance within which the colour cloud lights up.

    Examples:
        kfgs view run/
        kfgs view run/ --where html    # one file to share
        kfgs view labelled.ply --ask chair --where picture --out pictures/
        kfgs view run/ --teacher lseg --weights demo_e200.ckpt    # any text

    Args:
        source: A run folder of `kfgs fit` or its field, asked by text; or any splat, asked by its classes (`kfgs attach`) if any.
        color: Colour splat in the same frame, any splat file. Of a field, by default: RUN/color.ply, or the splat it was made on.
        ask: A first question.
        where: browser; html (writes OUT/view.html, one file that any browser opens without kfgs, and ends); window (pyvista:
            two clouds side by side); or picture (writes OUT/view.png and ends). The first two also show small photos.
        up: The axis that points up, or down; by default that of the cameras, else y-down. The key R changes it.
        out: Folder for saved pictures and selections.
    """
    from ..fields.store import NAME
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
    meaning, cameras = open_meaning(source, classes, teacher)
    colors = open_colors(source, color, meaning)
    state = Exploration(meaning, None if colors is meaning.gaussians else colors, cameras=cameras)
    if up is not None:
        state.up = [(-1.0 if "down" in up else 1.0) * (axis == up[0]) for axis in "xyz"]
    about = state.details().get("color")
    if about and (near := about["total"] - about["none"]) < FEW * about["total"]:
        few = f"only {near:,} of {about['total']:,} colour Gaussians lie within lambda of the field"
        say(f"note: {few}; another frame? `kfgs attach` checks and aligns")
    state.ask(ask)
    say("\n".join(state.lines()))
    if where in ("window", "picture"):
        with Explorer(state, out=out, off_screen=where == "picture") as explorer:
            explorer.set_show("labels" if meaning.names else state.first_show)
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


def open_colors(source: Path, color: Path | None, meaning: Any) -> Any:
    """The colour cloud: the given one, the source's own, or that of the run; None if there is none."""
    from ..fields.store import find_field, read_description

    if color is not None:
        return open_splats("color", color)
    if meaning.gaussians.sh is not None:
        return meaning.gaussians
    if (field := find_field(source)) is not None:
        geometry = read_description(field).get("info", {}).get("geometry")
        for place in (field.parent / "color.ply", Path(str(geometry))):
            if place.is_file() and not is_field(place):
                say(f"colours: {place}")
                return open_splats("color", place)
    return None


def open_meaning(source: Path, classes: Classes, teacher: Teacher, *, labelled: bool = False) -> tuple[Any, list[Any]]:
    """The answers to questions, and the cameras of the scene (those that a field was trained on)."""
    from ..viewer import FieldMeaning, SplatMeaning

    cameras = [] if classes.loaded is None else classes.loaded.cameras
    if is_field(source) or not source.exists():
        field = open_field("source", source)
        label_set, embed = words_of(classes, teacher, field)
        return FieldMeaning(field, label_set, embed=embed), list(field.cameras) or cameras
    return SplatMeaning(open_splats("source", source, labelled=labelled)), cameras
