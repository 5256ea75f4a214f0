"""The command select: the Gaussians of a class or phrase."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from .._files import atomic_folder, check_output
from .features import text_encoder
from .files import is_field, open_splats
from .options import Classes, Given, Positional, Teacher
from .output import say, wrote

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.


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
        distance: Gaussians at most this far apart are one part, in world units; by default from the spacing of the scene.
    """
    from .._check import check_range
    from ..labels import connected_parts
    from ..labels.components import component_distance

    if out is not None:
        check_output("out", out, "a folder")
    if threshold is not None:
        check_range("threshold", threshold, 0, 1)
    named = not is_field(source) and threshold is None  # parts are numbered as `kfgs edit` does
    if is_field(source):
        field = classes.open_field("source", source)
        label_set, target = ask(query, classes, teacher, field)
        query = target if isinstance(target, str) else query
        selection = field.query(target, label_set, threshold)
        cloud, cameras = field.gaussians.replace(scores=selection.scores), field.cameras or None
        scene = classes.photos_of(field) if out is not None else None
    else:
        cloud = open_splats("source", source, labelled=True, named=True)
        selection = _of_class(cloud, query, threshold)
        scene = classes.load_scene()
        cameras = None if scene is None else scene.cameras
    headline = f"{query}: {len(selection)} of {len(cloud)} Gaussians, {selection.summary}"
    if out is not None and len(selection) == 0:
        say(headline)
        raise ValueError(f"query: expected Gaussians to save, got none of {query!r}; lower the threshold or drop --out")
    joined = distance
    if joined is None and len(selection):
        joined = component_distance(cloud.means, selection.mask)
    parts = connected_parts(cloud, selection, cameras, distance=joined)
    written: list[str] = []
    if out is not None:  # before anything is printed, whose reader may have ended
        with atomic_folder(out) as new:
            _save(new, query, cloud, selection, parts)
            _draw(new / "parts.png", query, cloud, parts, cameras, scene)
            written += sorted(path.name for path in new.iterdir())
        for name in {"parts.png", "selection.ply.classes.json"} - set(written):
            (out / name).unlink(missing_ok=True)  # of an older selection
    say(headline)
    for number, part in enumerate(parts, start=1):
        say(f"  {query}/{number}: {part!r}" if named else f"  {part!r}")
    if parts:
        say(f"  parts are joined within {joined:.3g}; --distance changes it")
    if parts and (left := parts[0].total - len(parts)):
        say(f"  {left} smaller part{'s are' if left > 1 else ' is'} not listed")
    if out is not None:
        wrote([out / name for name in written])


def _of_class(splats: Any, name: str, threshold: float | None) -> Any:
    """The Gaussians of a labelled splat that have a class, and a score above the threshold."""
    from ..labels import OfClass, Selection

    chosen = OfClass(name).select(splats)
    if splats.scores is None or threshold is None:
        return chosen if splats.scores is None else Selection(chosen.mask, splats.scores, None, chosen.how)
    return Selection(chosen.mask & (splats.scores > threshold), splats.scores, threshold, chosen.how)


def _save(folder: Path, query: str, cloud: Any, selection: Any, parts: list[Any]) -> None:
    """Write a selection as numbers (JSON) and as Gaussians (PLY)."""
    from .._files import write_json
    from ..formats import write_splats

    listed = [part.to_json() for part in parts]
    facts = {"query": query, "threshold": selection.threshold, "how": selection.how, "count": len(selection)}
    write_json(folder / "selection.json", {**facts, "parts": listed})
    write_splats(cloud.select(selection.mask), folder / "selection.ply")


def _draw(path: Path, query: str, gaussians: Any, parts: list[Any], cameras: Any, scene: Any) -> None:
    """Draw the parts over photographs; without them over the cloud's own colours, if it has some."""
    from ..pipeline.label import write_parts
    from ..viz import show_cloud
    from ..viz.films import show_photos

    under = None if gaussians.sh is None else show_cloud(gaussians, color_by="rgb")
    under = under if scene is None else show_photos(scene)
    write_parts(path, gaussians, parts, cameras or (), under, query)


def ask(query: str, classes: Classes, teacher: Teacher, field: Any) -> tuple[Any, Any]:
    """The label set and the target of a query: the name of a class, or the embedding of a phrase.

    Without a teacher the query must be a class of the table. With a teacher it may be any phrase, embedded in the table's
    templates; canonical negatives then come from the teacher. If the options name no table, the field's classes are used.
    """
    network = teacher.load()
    if network is None:
        label_set = classes.load_classes(field)
        try:
            return label_set, label_set.names[label_set.index(query)]
        except ValueError as error:
            raise ValueError(
                f"{error}; for any other phrase pass --teacher and --weights, or add it to the table of words"
            ) from error
    known = classes.text is not None or classes.scene is not None or field.classes is not None
    label_set = classes.load_classes(field) if known else None
    templates = None if label_set is None else label_set.info.get("templates")
    asked = text_encoder(network)([query], templates=templates)
    name = asked.names[0]
    if label_set is None:
        return asked, name
    note_other_teacher(asked, label_set)
    knows = label_set.knows(name)
    if asked.dim == label_set.dim:  # otherwise the query raises an error
        label_set = replace(label_set, negatives=asked.negatives, negative_names=asked.negative_names, info=asked.info)
    return label_set, label_set.names[label_set.index(name)] if knows else asked.embeddings[0]


def note_other_teacher(asked: Any, table: Any) -> None:
    """Print a note if a query and its table were embedded by different teachers.

    `SemanticField.query` checks whether the query fits the field.
    """
    from ..labels.label_set import teacher_mismatch

    difference = teacher_mismatch(asked.info, table.info)
    if difference is not None:
        say(
            f"note: --text: expected a table by the query's teacher (from --teacher and --weights), got one by another "
            f"({difference}); they cannot be compared: use the table's teacher for the query, or pass a "
            "table of the query's teacher as --text"
        )
