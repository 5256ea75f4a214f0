"""Commands that query a field or a labelled splat: select, label, info."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

from .._files import atomic_folder, check_output, real_path
from .files import check_alone, is_field, open_splats
from .options import Classes, Given, Positional, Rule, Teacher
from .output import lengths_odd, say, say_counts, wrote
from .text import ask

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.

Negatives = Literal["auto", "classes", "canonical", "none"]
Score = Literal["auto", "cosine", "softmax", "relevancy"]


def select(
    query: Positional[str],
    source: Positional[Path],
    *,
    out: Given[Path] = None,
    threshold: Given[float] = None,
    smallest: Given[int] = None,
    distance: Given[float] = None,
    negatives: Negatives = "auto",
    score: Score = "auto",
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
        smallest: List parts from this number of Gaussians on; by default from 5 % of the largest part. At most 100 are listed.
        distance: Gaussians at most this far apart are one part, in world units; by default from the spacing of the scene.
        negatives: Compare the query with all other classes, LERF's canonical words (object, things, stuff, texture), or
            nothing (field only). auto: the other classes for a class, the canonical words for another phrase.
        score: relevancy (against the most similar negative), softmax (over query and negatives) or cosine (field only).
            auto: relevancy, or cosine with --negatives none.
    """
    from .._check import check_range
    from ..labels import connected_parts
    from ..labels.components import component_distance

    if not source.exists() and Path(query).exists():
        raise ValueError(f"query, source: expected a class, then a file, got {query!r}, {str(source)!r}; swap them")
    if out is not None:
        check_output("out", out, "a folder")
    if threshold is not None:
        check_range("threshold", threshold, 0, 1)
    classes.check_images()
    asked_by_text = is_field(source)
    counted = not asked_by_text and threshold is None  # parts are numbered as `kfgs edit` does
    if asked_by_text:
        field = classes.open_field("source", source)
        label_set, target = ask(query, classes, teacher, field)
        query = target if isinstance(target, str) else query
        how = None if score == "auto" else score
        found = field.query(target, label_set, threshold, negatives=_negatives(negatives, score), score=how)
        cloud, cameras = field.gaussians.replace(scores=found.scores), field.cameras or None
        scene = classes.scene_of(field) if out is not None else None
    else:
        given = {"classes": classes.classes, "text": classes.text, "negatives": negatives, "score": score}
        for name, value in (given | dataclasses.asdict(teacher)).items():
            check_alone(name, None if value == "auto" else value, "with a splat, which has its own classes")
        cloud = open_splats("source", source, labelled=True, named=True)
        found = _of_class(cloud, query, threshold)
        scene = None if classes.scene is None else classes.load_scene().undistorted()
        cameras = None if scene is None else scene.cameras
    headline = f"{query}: {len(found)} of {len(cloud)} Gaussians, {found.summary}"
    if out is not None and len(found) == 0:
        say(headline)
        raise ValueError(f"query: expected Gaussians to save, got none of {query!r}; lower the threshold or drop --out")
    joined = distance
    if joined is None and len(found):
        joined = component_distance(cloud.means, found.mask)
    things = connected_parts(cloud, found, cameras, distance=joined, smallest=smallest)
    written: list[str] = []
    if out is not None:  # before anything is printed, whose reader may have ended
        with atomic_folder(out) as new:
            _save(new, query, cloud, found, things)
            _draw(new / "parts.png", query, cloud, things, cameras, scene)
            written += sorted(path.name for path in new.iterdir())
        for name in {"parts.png", "selection.ply.classes.json"} - set(written):
            (out / name).unlink(missing_ok=True)  # of an older selection
    say(headline)
    for number, (thing, times) in enumerate(zip(things, _times_as_long(things), strict=True), start=1):
        say((f"  {query}/{number}: {thing!r}" if counted else f"  {thing!r}") + times)
    if things:
        say(f"  parts are joined within {joined:.3g}; --distance changes it")
    if things and (left := things[0].total - len(things)):
        say(f"  {left} smaller part{'s are' if left > 1 else ' is'} not listed; --smallest 1 lists the 100 largest")
    elif not things and len(found) > 0:
        say(f"  no part has {smallest} Gaussians; give a smaller --smallest")
    if counted and things and distance is not None:
        say(f"with `kfgs edit`, add --distance {distance}")
    if out is not None:
        wrote([out / name for name in written])


def label(
    field: Positional[Path],
    out: Path,
    *,
    query: Given[str] = None,
    threshold: Given[float] = None,
    cloud: Given[Path] = None,
    distance: Given[float] = None,
    rule: Rule = "fused",
    classes: Classes,
) -> None:
    """Label the Gaussians of a field, and carry the labels to a cloud of points by distance.

    Examples:
        kfgs label run/field.kfgs --out labelled/
        kfgs label run/field.kfgs --out labelled/ --cloud points.ply --distance 0.05

    Args:
        field: The folder that `kfgs fit` wrote (RUN/field.kfgs).
        out: Folder for gaussians.ply, and cloud.ply if there is a --cloud.
        query: Label only the Gaussians of this class, as `kfgs select` finds them.
        threshold: The paper's gamma for --query: scores must be above it; see `kfgs select`.
        cloud: PLY of points in the field's frame that receive the labels. For a splat `kfgs attach` does better.
        distance: The paper's lambda: the distance within which a label is carried over, in world units; by default from the
            clouds' spacing.
        rule: fused: the training views decide the class of a Gaussian; paper: its own latent (Sec. 3.4).
    """
    import torch

    from .._check import check_range
    from ..pipeline import label_cloud, save_labelled

    for name, value, other, needed in (
        ("threshold", threshold, "query", query),
        ("distance", distance, "cloud", cloud),
    ):
        if value is not None and needed is None:
            raise ValueError(f"{name}: expected --{other} with it, got none; it would have no effect")
    check_output("out", out, "a folder")
    if distance is not None:
        check_range("distance", distance, 0, closed=(False, False))
    if cloud is not None and real_path(cloud) in {real_path(out / name) for name in ("gaussians.ply", "cloud.ply")}:
        raise ValueError(f"out: expected another folder than that of --cloud, got {out}; {cloud} would be overwritten")
    loaded = classes.open_field("field", field)
    asked = loaded.paper if rule == "paper" else loaded
    label_set = classes.of_field(loaded)
    if query is None:
        labels, scores = asked.classify(label_set)
        who = "what the views show of each Gaussian" if rule == "fused" else "each Gaussian's own latent (Sec. 3.4)"
        how = f"{who}; score = cosine"
    else:
        found = asked.query(query, label_set, threshold)
        labels, scores = torch.where(found.mask, label_set.index(query), -1), found.scores
        how = f"{query}: {len(found)} Gaussians above gamma = {found.threshold:.4f} ({found.how})"
    gaussians = loaded.gaussians.replace(labels=labels, scores=scores, names=label_set.names)
    moved = None
    with atomic_folder(out) as new:
        save_labelled(new / "gaussians.ply", gaussians, rule=how)
        if cloud is not None:
            moved, _ = label_cloud(gaussians, cloud, new / "cloud.ply", distance=distance)
        written = sorted(path.name for path in new.iterdir())
    say(f"labelled by {how}")
    if query is None:
        say_counts(labels, label_set.names)
    if moved is not None:
        say(str(moved))
    wrote([out / name for name in written])


def info(path: Positional[Path]) -> None:
    """Describe a field, a run, the runs of a batch, a scene, a folder of feature maps, a splat or a PLY of points.

    Examples:
        kfgs info run/field.kfgs
        kfgs info scene/

    Args:
        path: A field, run folder, --out folder of a batch, scene folder, folder of feature maps, splat file, or .ply of
            points.
    """
    from ..batch import describe_batch
    from ..pipeline import describe

    say(describe_batch(path) or describe(path))


def _of_class(splats: Any, name: str, threshold: float | None) -> Any:
    """The Gaussians of a labelled splat that have a class, and a score above the threshold."""
    from ..labels import OfClass, Selection

    chosen = OfClass(name).select(splats)
    if splats.scores is None:
        check_alone("threshold", threshold, "with a splat that has no scores")
        return chosen
    mask = chosen.mask if threshold is None else chosen.mask & (splats.scores > threshold)
    return Selection(mask, splats.scores, threshold, chosen.how)


def _times_as_long(things: list[Any]) -> list[str]:
    """What is said of parts that may be two things in one."""
    odd = lengths_odd([2 * float(thing.box.half.max()) for thing in things])
    return ["" if one is None else f" ? ({one:.1f} times as long as the median: two in one?)" for one in odd]


def _save(folder: Path, query: str, cloud: Any, found: Any, things: list[Any]) -> None:
    """Write a selection as numbers (JSON) and as Gaussians (PLY)."""
    from .._files import write_json
    from ..formats import write_splats

    parts = [thing.to_json() for thing in things]
    facts = {"query": query, "threshold": found.threshold, "how": found.how, "count": len(found), "parts": parts}
    write_json(folder / "selection.json", facts)
    write_splats(cloud.select(found.mask), folder / "selection.ply")


def _draw(path: Path, query: str, gaussians: Any, things: list[Any], cameras: Any, scene: Any) -> None:
    """Draw the parts over photographs; without them over the cloud's own colours, if it has some."""
    from ..pipeline.label import write_parts
    from ..viz import show_cloud
    from ..viz.films import show_photos

    under = None if gaussians.sh is None else show_cloud(gaussians, color_by="rgb")
    under = under if scene is None else show_photos(scene)
    write_parts(path, gaussians, things, cameras or (), under, query)


def _negatives(negatives: Negatives, score: Score) -> Negatives:
    """Return the negatives; a ValueError if the score cannot use them."""
    if score == "cosine" and negatives not in ("auto", "none"):
        raise ValueError(f"negatives: expected none with --score cosine, got {negatives}; leave one of the two out")
    if score in ("softmax", "relevancy") and negatives == "none":
        raise ValueError(f"negatives: expected classes or canonical for --score {score}, got none; leave it out")
    return negatives
