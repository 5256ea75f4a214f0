"""The command that asks: select."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from .._check import check_range
from .checks import check_alone, check_folder, open_splats
from .say import open_answering, say, wrote
from .words import ask

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.

Negatives = Literal["auto", "classes", "canonical", "none"]
Score = Literal["auto", "cosine", "softmax", "relevancy"]


def select(
    query: Annotated[str, tyro.conf.Positional],
    source: Annotated[Path, tyro.conf.Positional],
    out: Path | None = None,
    scene: Path | None = None,
    classes: Path | None = None,
    text: Path | None = None,
    threshold: float | None = None,
    negatives: Negatives = "auto",
    score: Score = "auto",
    teacher: str | None = None,
    weights: str | None = None,
    images: Path | None = None,
) -> None:
    """Which Gaussians are the chair? How many there are, where, how large, and the view that shows each best.

    Connected parts are listed one by one, the largest first. Those of a labelled splat have names, chair/1, chair/2, by
    which `kfgs edit` takes them.

    Args:
        query: a class name, "chair"; of a field with --teacher any phrase, "the red chair by the window".
        source: a field folder (`RUN/field`), asked by text; or a splat with classes, asked by label.
        out: folder for selection.json (with the indices) and selection.ply (the Gaussians), if wanted.
        scene: scene folder: classes.json and text.npy, or text.safetensors. A field remembers its own; for a splat, the
            cameras that tell which view shows a part best.
        classes: JSON list of class names; SCENE/classes.json when not given.
        text: .npy of one embedding per class, or a table that `kfgs text` made (.safetensors), which needs no classes;
            SCENE/text.npy or SCENE/text.safetensors when not given.
        threshold: scores must be above it. Of a field the paper's gamma: when not given 0.5 for a relevancy, else read off
            the scores' distribution. Of a splat all of the class are taken when not given.
        negatives: what to tell the query from: all other classes, LERF's canonical words, or nothing; of a field.
            `auto`: the classes for one of them, the canonical words for any other phrase.
        score: relevancy (against the most similar negative), softmax (over query and negatives) or cosine; of a field.
            `auto`: relevancy, or with --negatives none cosine.
        teacher: embed the query with this teacher's text encoder: lseg, clip, siglip, ...; of a field.
        weights: the teacher's checkpoint file (lseg), or folder or hub id (the others).
        images: folder of the scene's pictures, if it is not SCENE/images.
    """
    from ..formats import SplatFile
    from ..labels import connected_parts
    from ..pipeline.apply import select_labelled
    from ..scenes import load_scene

    if not source.exists() and Path(query).exists():
        raise ValueError(f"query, source: expected a class, then a file, got {query!r}, {str(source)!r}; swap them")
    if out is not None:
        check_folder("out", out)
    if threshold is not None:
        check_range("threshold", threshold, 0, 1)
    if scene is None:
        check_alone("images", images, "without --scene, whose pictures they are")
    is_field = (source / "field.json").is_file()
    counted = not is_field and threshold is None  # parts are numbered as `kfgs edit` does
    if is_field:
        field = open_answering(source, scene, images)
        label_set, target = ask(query, (scene, classes, text), teacher, weights, field)
        query = target if isinstance(target, str) else query
        how = None if score == "auto" else score
        found = field.query(target, label_set, threshold, negatives=_negatives(negatives, score), score=how)
        cloud, cameras = SplatFile(field.gaussians, {"score": found.scores.numpy()}), field.cameras or None
    else:
        given = {"classes": classes, "text": text, "negatives": negatives, "score": score, "teacher": teacher}
        for name, value in (given | {"weights": weights}).items():
            check_alone(name, None if value == "auto" else value, "beside a splat, which has its own classes")
        cloud = open_splats("source", source, labelled=True)
        found = select_labelled(cloud, query, threshold)
        cameras = None if scene is None else load_scene(scene, images=images).undistorted().cameras
    say(f"{query}: {len(found)} of {len(cloud)} Gaussians, {found.words}")
    things = connected_parts(cloud.gaussians, found, cameras)
    for number, thing in enumerate(things, start=1):
        say(f"  {query}/{number}: {thing!r}" if counted else f"  {thing!r}")
    if out is not None:
        if len(found) == 0:
            raise ValueError(
                f"query: expected Gaussians to save, got none of {query!r}; lower the threshold or drop --out"
            )
        wrote(_save(out, query, cloud, found, things))


def _save(out: Path, query: str, cloud: Any, found: Any, things: list[Any]) -> list[Path]:
    """Write a selection as numbers (JSON) and as Gaussians (PLY)."""
    from .._files import write_json
    from ..formats import write_splats

    parts = [thing.to_json() for thing in things]
    facts = {"query": query, "threshold": found.threshold, "how": found.how, "count": len(found), "parts": parts}
    write_json(out / "selection.json", facts)
    return [out / "selection.json", *write_splats(out / "selection.ply", cloud.select(found.mask)).paths]


def _negatives(negatives: Negatives, score: Score) -> Any:
    """As asked, if the score can use it.

    Raises:
        ValueError: if it cannot.
    """
    if score == "cosine" and negatives not in ("auto", "none"):
        raise ValueError(f"negatives: expected none beside --score cosine, got {negatives}; leave one of both out")
    if score in ("softmax", "relevancy") and negatives == "none":
        raise ValueError(f"negatives: expected classes or canonical for --score {score}, got none; leave it out")
    return negatives
