"""Commands that score results under named protocols: evaluate, compare."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import tyro

from .._files import check_output, real_path
from .files import is_field
from .options import Classes, Flag, Given, GivenRule, Name, Positional, Several, Teacher
from .output import say, wrote

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.


def evaluate(
    field: Positional[Path],
    *,
    protocol: Annotated[str, tyro.conf.arg(metavar="NAME")] = "kfgs-pooled/1",
    truth: Given[Path] = None,
    split: Name = None,
    labels: GivenRule = None,
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
        labels: Who says the class of a pixel in a field of kfgs: the field itself (own), or the nearest text, as for other
            results. By default own in kfgs's protocols, nearest in those of others.
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
        check_output("out", out, "a file")
    check_kind(field, protocol)
    classes = with_scene(classes, field)
    encode = find_encoder(teacher, classes, field)
    options = find_options(protocol, set, encode)
    asked: dict[str, Any] = {
        "truth": truth,
        "split": split,
        "images": classes.images,
        "options": options,
        "labels": labels,
    }
    assert classes.scene is not None
    question = open_question(classes.scene, protocol, **asked)
    command = shlex.join(["kfgs", *getattr(sys, "argv", [])[1:]])
    found = evaluate_result(field, question, encode=encode, with_file=with_file, command=command)
    if out is not None:
        inputs = {"field": field, "with_file": with_file, "truth": truth, **dataclasses.asdict(classes)}
        places = {name: None if place is None else str(real_path(place)) for name, place in inputs.items()}
        words = {"split": split, "labels": labels, "set": list(set), **dataclasses.asdict(teacher)}
        write_json(out, {**found.to_json(), "inputs": {**places, **words}})
    say(found.text if long else "\n".join([str(found), *(f"note: {note}" for note in found.notes)]))
    if out is not None:
        wrote([out])


def compare(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(help_behavior_hint="")],
    *,
    out: Given[Path] = None,
    protocol: Name = None,
    truth: Given[Path] = None,
    split: Name = None,
    labels: GivenRule = None,
    set: Several = (),
    with_file: Several = (),
    pictures: int = 3,
    teacher: Teacher,
    classes: Classes,
) -> None:
    """Compare results under one protocol: a table, and pictures of photograph, truth, each result and its errors.

    Numbers of different protocols, options or data are refused. Results that `kfgs evaluate --out` kept are not computed again,
    and say how the others are scored.

    Examples:
        kfgs compare run_a run_b --out compared/
        kfgs compare a.json b.json output/figurines --out compared/ --pictures 5
        kfgs compare run output/figurines --with-file best_ckpt.pth
        kfgs compare output/a output/b --with-file output/a=a_ckpt.pth --with-file output/b=b_ckpt.pth

    Args:
        runs: Two or more: whatever `kfgs evaluate` takes, or JSON files that it wrote.
        out: Folder for compare.txt, compare.json and a picture of each view.
        protocol: Its name; by default that of the first JSON file, else kfgs-pooled/1.
        truth: Folder or file of the ground truth, if it is not in the scene.
        split: Which views, as for `kfgs evaluate`.
        labels: The rule for labels, as for `kfgs evaluate`.
        set: An option of the protocol, threshold=0.5. Can be given several times.
        with_file: A second file of a foreign result, as for `kfgs evaluate`; RUN=FILE if several results are foreign. Can be
            given several times.
        pictures: How many views are drawn.
    """
    from .._check import check_range
    from ..pipeline.results import Results

    check_range("pictures", pictures, 0)
    if out is not None:
        check_output("out", out, "a folder")
    results = Results.read(runs, with_file)
    protocol = protocol or (results.first.report.protocol if results.first else "kfgs-pooled/1")
    results.check(protocol)
    question, encode, draw = None, None, out is not None and pictures > 0
    missing = []
    if results.new or draw:
        words = {"protocol": protocol, "truth": truth, "split": split, "labels": labels, "set": set}
        try:
            question, encode = _ask_alike(results, words, teacher, classes)
        except FileNotFoundError as error:  # scores that were kept need no files
            if results.new:
                raise
            missing = [f"no pictures: {error}"]
    compared = results.score(question, encode, draw=draw)
    written = [] if out is None else compared.write(out, question, encode, pictures)
    say("\n".join([str(compared), *(f"note: {note}" for note in (*missing, *compared.notes))]))
    if out is None:
        return
    if draw and question is not None and not any(path.suffix == ".png" for path in written):
        say(f"note: no pictures: {question.protocol.name} scores no pictures of its own")
    wrote(written)


def _ask_alike(results: Any, words: dict[str, Any], teacher: Teacher, classes: Classes) -> tuple[Any, Any]:
    """The question and the text encoder of a comparison: options, and what they leave open as the first JSON file has it."""
    from ..pipeline.question import open_question

    first: dict[str, Any] = results.first.inputs if results.first else {}
    remembered = {name: Path(place) for name in ("scene", "images", "classes", "text") if (place := first.get(name))}
    given = {name: place for name, place in dataclasses.asdict(classes).items() if place is not None}
    classes = with_scene(Classes(**{**remembered, **given}), (results.new or results.paths)[0])
    teacher = teacher if teacher.teacher else Teacher(first.get("teacher"), first.get("weights"))
    encode = find_encoder(teacher, classes, (results.new or [Path(str(first.get("field")))])[0])
    asked: dict[str, Any] = {
        "truth": words["truth"] if words["truth"] is not None else first.get("truth"),
        "split": words["split"] or first.get("split"),
        "labels": words["labels"] or first.get("labels"),
        "images": classes.images,
        "options": find_options(words["protocol"], words["set"] or tuple(first.get("set", ())), encode),
    }
    assert classes.scene is not None
    return open_question(classes.scene, words["protocol"], **asked), encode


def with_scene(classes: Classes, field: Path) -> Classes:
    """The options with the scene that a field remembers, if none is given."""
    if classes.scene is not None:
        return classes
    if not is_field(field):
        raise ValueError(
            f"scene: expected a scene folder, got none, and {field} is no field that remembers one; pass --scene"
        )
    from ..fields import SemanticField, recall_scene
    from ..fields.store import find_field

    loaded = SemanticField.load(find_field(field) or field)
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
        from ..fields.store import find_field

        loaded = SemanticField.load(find_field(field) or field)
        return loaded.label_set() if loaded.has_classes else None
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
