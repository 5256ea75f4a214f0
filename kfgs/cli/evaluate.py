"""Commands that score results under named protocols: evaluate, compare."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import tyro

from .files import check_file, is_field
from .options import Classes, Flag, Given, Name, Positional, Several, Teacher
from .output import say, wrote

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.


def evaluate(
    field: Positional[Path],
    *,
    protocol: Annotated[str, tyro.conf.arg(metavar="NAME")] = "kfgs-pooled/1",
    truth: Given[Path] = None,
    split: Name = None,
    set: Several = (),
    with_file: Given[Path] = None,
    out: Given[Path] = None,
    long: Flag = False,
    teacher: Teacher,
    classes: Classes,
) -> None:
    """Score a result under a named protocol. docs/protocols.md lists the protocols, docs/datasets.md the layouts of truth.

    Examples:
        kfgs evaluate run
        kfgs evaluate run --scene scene/ --out scores.json --long
        kfgs evaluate output/figurines --with-file best_ckpt.pth --scene lerf_ovs/figurines \
--protocol lerf-ovs-2d --teacher clip
        kfgs evaluate edited.ply --scene room/ --protocol kfgs-removal --set before=labelled.ply --set removed=chair

    Args:
        field: A run or field folder, a splat with features, a result of another program, or a folder of a teacher's maps.
            For kfgs-color, -removal and -recolor a colour splat, or a run that has one.
        protocol: Its name, with or without version; a wrong name lists all.
        truth: Folder or file of the ground truth, if it is not in the scene; the teacher's maps for feature3dgs-teacher.
        split: Which views: train, test, another split, or all. By default test views with labels, or all views with masks.
        set: An option of the protocol, threshold=0.5; --long shows them. texts=classes asks the scene's classes. Can be
            given several times.
        with_file: A second file of a foreign result: LangSplat's autoencoder, LEGaussians' codebook, or features of a splat.
        out: JSON file of scores, rows, options, digests, command and machine.
        long: Say how it was measured, and print every row.
    """
    from .._files import write_json
    from ..pipeline.evaluate import check_kind
    from ..pipeline.evaluate import evaluate as evaluate_result
    from ..pipeline.question import open_question

    if out is not None:
        check_file("out", out)
    check_kind(field, protocol)
    classes = with_scene(classes, field)
    encode = find_encoder(teacher, classes, field)
    options = find_options(protocol, set, encode)
    asked: dict[str, Any] = {"truth": truth, "split": split, "images": classes.images, "options": options}
    assert classes.scene is not None
    question = open_question(classes.scene, protocol, **asked)
    command = shlex.join(["kfgs", *getattr(sys, "argv", [])[1:]])
    found = evaluate_result(field, question, encode=encode, with_file=with_file, command=command)
    say(found.text if long else str(found))
    if out is not None:
        inputs = {"field": field, "with_file": with_file, "scene": classes.scene, "truth": truth}
        places = {name: None if place is None else str(place.resolve()) for name, place in inputs.items()}
        write_json(out, {**found.to_json(), "inputs": {**places, "split": split, "set": list(set)}})
        wrote([out])


def with_scene(classes: Classes, field: Path) -> Classes:
    """The options with the scene that a field remembers, if none is given."""
    if classes.scene is not None:
        return classes
    if not is_field(field):
        raise ValueError(
            f"scene: expected a scene folder, got none, and {field} is no field that remembers one; pass --scene"
        )
    from ..fields import SemanticField, recall_scene

    folder = field if (field / "field.json").is_file() else field / "field"
    loaded = SemanticField.load(folder)
    return dataclasses.replace(classes, scene=recall_scene(loaded.info, loaded.folder))


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

        loaded = SemanticField.load(field if (field / "field.json").is_file() else field / "field")
        return loaded.label_set() if "classes" in loaded.info else None
    return None


def find_options(protocol: str, words: tuple[str, ...], encode: Any) -> dict[str, Any]:
    """The options of --set; texts=classes are the names of the label set."""
    from ..evaluation import LabelSet, get_protocol
    from ..evaluation.option_words import parse_options
    from ..pipeline.question import EDIT_INPUTS

    inputs = EDIT_INPUTS.get(get_protocol(protocol).name, ())
    options = parse_options(protocol, words, inputs)
    if options.get("texts") == ("classes",):
        if not isinstance(encode, LabelSet):
            raise ValueError(
                "set: expected a label set for texts=classes, got none; pass --classes and --text, or a scene's"
            )
        options["texts"] = encode.names
    return options
