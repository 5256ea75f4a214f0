"""The command evaluate: score a result under a named protocol."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

from .._files import check_output
from .files import is_field, open_field
from .options import Classes, Flag, Given, LabelRule, Positional, Word
from .output import say, wrote

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.


def evaluate(
    field: Positional[Path],
    *,
    protocol: Word = "kfgs-pooled/1",
    truth: Given[Path] = None,
    labels: Given[LabelRule] = None,
    out: Given[Path] = None,
    long: Flag = False,
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
        labels: Who says the class of a pixel: the field itself (own), or the nearest text, as for other programs' results.
        out: JSON file of scores, rows, options, command and machine.
        long: Say how it was measured, and print every row.
    """
    from .._files import write_json
    from ..pipeline import evaluate as evaluate_result
    from ..pipeline import open_question

    if out is not None:
        check_output("out", out, "a file")
    loaded = open_field("field", field) if is_field(field) else None
    if classes.scene is None:
        if loaded is None:
            raise ValueError(
                f"scene: expected a scene folder, got none, and {field} is not a field with one; pass --scene"
            )
        classes = classes.of(loaded)
    assert classes.scene is not None
    question = open_question(classes.scene, protocol, truth=truth)
    colors = getattr(question.protocol, "of_colors", False)
    result = field if colors or loaded is None else loaded
    words = None if colors else classes.load_classes(loaded)
    command = shlex.join(["kfgs", *sys.argv[1:]])
    report = evaluate_result(result, question, encode=words, labels=labels, command=command)
    if out is not None:  # before anything is printed, whose reader may have ended
        write_json(out, report.to_json())
    say(report.text if long else "\n".join([str(report), *(f"note: {note}" for note in report.notes)]))
    if out is not None:
        wrote([out])
