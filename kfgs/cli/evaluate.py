"""The command evaluate: score a result under a named protocol."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import tyro

from .._files import check_output
from .files import is_field
from .options import Classes, Flag, Given, GivenRule, Name, Positional, Teacher
from .output import say, wrote

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.


def evaluate(
    field: Positional[Path],
    *,
    protocol: Annotated[str, tyro.conf.arg(metavar="NAME")] = "kfgs-pooled/1",
    truth: Given[Path] = None,
    split: Name = None,
    labels: GivenRule = None,
    out: Given[Path] = None,
    long: Flag = False,
    teacher: Teacher,
    classes: Classes,
) -> None:
    """Score a result under a named protocol. docs/protocols.md lists the protocols, docs/datasets.md the layouts of truth.

    Examples:
        kfgs evaluate run
        kfgs evaluate run --scene scene/ --out scores.json --long
        kfgs evaluate run --protocol feature3dgs-teacher
        kfgs evaluate color.ply --scene scene/ --protocol kfgs-color

    Args:
        field: A run or field, or a folder of a teacher's maps; for kfgs-color a colour splat, or a run that has one.
        protocol: Its name, with or without version; a wrong name lists all.
        truth: Folder or file of the ground truth, if it is not in the scene; the teacher's maps for feature3dgs-teacher.
        split: Which views: train, test, another split, or all. By default test views with labels.
        labels: Who says the class of a pixel: the field itself (own), or the nearest text, as for other programs' results.
        out: JSON file of scores, rows, options, command and machine.
        long: Say how it was measured, and print every row.
    """
    from .._files import write_json
    from ..pipeline import evaluate as evaluate_result

    if out is not None:
        check_output("out", out, "a file")
    classes = with_scene(classes, field)
    assert classes.scene is not None
    report = evaluate_result(
        field,
        classes.scene,
        protocol,
        encode=find_encoder(teacher, classes, field),
        labels=labels,
        command=shlex.join(["kfgs", *getattr(sys, "argv", [])[1:]]),
        truth=truth,
        split=split,
        images=classes.images,
    )
    if out is not None:  # before anything is printed, whose reader may have ended
        write_json(out, report.to_json())
    say(report.text if long else "\n".join([str(report), *(f"note: {note}" for note in report.notes)]))
    if out is not None:
        wrote([out])


def with_scene(classes: Classes, field: Path) -> Classes:
    """The options with the scene that a field remembers, if none is given."""
    if classes.scene is not None:
        return classes
    if not is_field(field):
        raise ValueError(
            f"scene: expected a scene folder, got none, and {field} is not a field that remembers one; pass --scene"
        )
    from ..fields import SemanticField, recall_scene
    from ..fields.store import find_field

    loaded = SemanticField.load(find_field(field) or field)
    return dataclasses.replace(classes, scene=recall_scene(loaded.info))


def find_encoder(teacher: Teacher, classes: Classes, field: Path) -> Any:
    """The teacher's text encoder, the label set of the options, or that of the field; None if there is none."""
    if teacher.teacher is not None:
        from ..teachers.load import load_teacher

        return load_teacher(teacher.teacher, teacher.weights).encode_text
    teacher.check_weights()
    files = classes.files()
    if classes.classes is not None or classes.text is not None or (files and all(file.is_file() for file in files)):
        return classes.load_classes()
    if is_field(field):
        from ..fields import SemanticField
        from ..fields.store import find_field

        loaded = SemanticField.load(find_field(field) or field)
        return loaded.classes
    return None
