"""Commands that score results under named protocols: evaluate, compare."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import tyro

from .files import check_file, check_folder, is_field
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
        inputs = {"field": field, "with_file": with_file, "truth": truth, **dataclasses.asdict(classes)}
        places = {name: None if place is None else str(place.resolve()) for name, place in inputs.items()}
        words = {"split": split, "set": list(set), **dataclasses.asdict(teacher)}
        write_json(out, {**found.to_json(), "inputs": {**places, **words}})
        wrote([out])


def compare(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(help_behavior_hint="")],
    *,
    out: Given[Path] = None,
    protocol: Name = None,
    truth: Given[Path] = None,
    split: Name = None,
    set: Several = (),
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

    Args:
        runs: Two or more: whatever `kfgs evaluate` takes, or JSON files that it wrote.
        out: Folder for compare.txt, compare.json and a picture of each view.
        protocol: Its name; by default that of the first JSON file, else kfgs-pooled/1.
        truth: Folder or file of the ground truth, if it is not in the scene.
        split: Which views, as for `kfgs evaluate`.
        set: An option of the protocol, threshold=0.5. Can be given several times.
        pictures: How many views are drawn.
    """
    from .._check import check_range
    from ..evaluation import LabelSet
    from ..evaluation.encoders import TableEncoder
    from ..pipeline.evaluate import check_kind, digest_method, open_result
    from ..pipeline.evaluate import evaluate as evaluate_result
    from ..pipeline.question import open_question
    from ..pipeline.side_by_side import check_comparable, rank, show_views, table_text, write_pictures

    check_range("pictures", pictures, 0)
    if out is not None:
        check_folder("out", out)
    kept = {path: _read_kept(path) for path in runs if path.suffix == ".json"}
    first: dict[str, Any] = next(iter(kept.values()))[1] if kept else {}
    plain = [path for path in runs if path not in kept]
    protocol = protocol or (next(iter(kept.values()))[0].protocol if kept else "kfgs-pooled/1")
    for path in plain:
        check_kind(path, protocol)
    reports = {path: report for path, (report, _) in kept.items()}
    if len({*runs}) < 2 or not plain:
        check_comparable({str(path): report for path, report in reports.items()})  # before anything is computed
    draw = out is not None and pictures > 0
    opened: dict[Path, Any] = {}
    if plain or draw:
        remembered = {
            name: Path(place) for name in ("scene", "images", "classes", "text") if (place := first.get(name))
        }
        given = {name: place for name, place in dataclasses.asdict(classes).items() if place is not None}
        classes = with_scene(Classes(**{**remembered, **given}), (plain or runs)[0])
        teacher = teacher if teacher.teacher else Teacher(first.get("teacher"), first.get("weights"))
        encode = find_encoder(teacher, classes, (plain or [Path(str(first.get("field")))])[0])
        options = find_options(protocol, set or tuple(first.get("set", ())), encode)
        place = truth if truth is not None else first.get("truth")
        words: dict[str, Any] = {"truth": place, "split": split or first.get("split"), "images": classes.images}
        assert classes.scene is not None
        question = open_question(classes.scene, protocol, options=options, **words)
        for path in runs:
            if path in kept:
                if draw:
                    _reopen(path, kept[path], question, opened, open_result, digest_method)
                continue
            method = opened[path] = open_result(path, question)
            reports[path] = evaluate_result(method, question, encode=encode)
    titles = _titles({path: reports[path] for path in runs})
    named = {titles[path]: reports[path] for path in dict.fromkeys(runs)}
    check_comparable(named)
    text = table_text(named)
    say(text)
    if out is None:
        return
    from .._files import atomic_path, write_json

    write_json(out / "compare.json", {title: report.to_json() for title, report in rank(named).items()})
    with atomic_path(out / "compare.txt") as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
    written = [out / "compare.txt", out / "compare.json"]
    if draw:
        asked = TableEncoder(encode) if isinstance(encode, LabelSet) else encode
        shown = show_views(question, {titles[path]: opened[path] for path in runs if path in opened}, asked, pictures)
        if not shown:
            say(f"note: no pictures: {question.protocol.name} scores no pictures of its own")
        written += write_pictures(out, shown)
    wrote(written)


def _read_kept(path: Path) -> tuple[Any, dict[str, Any]]:
    """The report that `kfgs evaluate --out` kept, and what it was asked with."""
    from .._files import read_json
    from ..evaluation import Report

    top = read_json(path)
    try:
        return Report.from_json(top), dict(top.get("inputs", {}))
    except (ValueError, AttributeError, TypeError) as error:
        raise ValueError(
            f"{path}: {str(error).removeprefix('value: ')}; give what `kfgs evaluate --out` wrote"
        ) from error


def _reopen(
    path: Path, kept: Any, question: Any, opened: dict[Path, Any], open_result: Any, digest_method: Any
) -> None:
    """Open the result that a JSON file is about, to draw it; a note says why if that is not possible."""
    report, inputs = kept
    try:
        found = open_result(Path(inputs["field"]), question, inputs.get("with_file"))
    except (KeyError, TypeError, ValueError, OSError) as error:
        say(f"note: {path} is not drawn: {error}")
        return
    if digest_method(found) != report.digests.get("field"):
        say(f"note: {path} is not drawn: {inputs['field']} has changed since it was scored")
        return
    opened[path] = found


def _titles(reports: dict[Path, Any]) -> dict[Path, str]:
    """The name of each method; with its file or folder where several have one name."""
    names = [report.method for report in reports.values()]
    short = {path: path.name if not report.method else report.method for path, report in reports.items()}
    long = {path: f"{short[path]} ({path.stem if path.suffix == '.json' else path.name})" for path in reports}
    titles = {path: long[path] if names.count(report.method) > 1 else short[path] for path, report in reports.items()}
    repeated = [title for title in titles.values() if list(titles.values()).count(title) > 1]
    return {path: f"{short[path]} ({path})" if title in repeated else title for path, title in titles.items()}


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
