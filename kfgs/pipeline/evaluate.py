"""Score a result under a named protocol: a field of kfgs, a result of another program, or the teacher itself."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from .._files import as_path, digest_file
from ..evaluation import Encode, FieldMethod, LabelSet, Method, Report
from ..evaluation.digests import digest_data
from ..evaluation.encoders import TableEncoder
from ..evaluation.foreign import SplattedMethod, load_foreign
from ..fields import SemanticField
from ..fields.store import field_data, find_field
from ..formats import read_splats
from ..gaussians import Gaussians
from ..scenes.extract import MANIFEST
from .beside import notes_beside
from .question import IN_SPACE, OF_COLORS, Question, colors_of, open_question, read_teacher

MAPS = ("*_fmap_CxHxW.pt", "*_s.npy", "*.npy")  # files of maps in a folder that kfgs did not fill


def evaluate(
    field: str | Path | Method | Gaussians,
    scene: str | Path | Question,
    protocol: str = "kfgs-pooled/1",
    *,
    encode: Encode | LabelSet | None = None,
    with_file: str | Path | None = None,
    command: str = "",
    **asked: Any,
) -> Report:
    """Score a result in a scene under a protocol.

    Args:
        field: a field folder or a run folder of kfgs, a result of another program (`load_foreign`), a splat with features, a
            folder of a teacher's feature maps; or a `Method`. For colours and edits, a colour splat.
        scene: its folder; or a question that was opened before (`open_question`), to ask several methods the same.
        protocol: a name of `kfgs.evaluation.PROTOCOLS`; a question has its own.
        encode: a label set, or the teacher's text encoder. Not needed for colours and edits.
        with_file: a second file of a foreign result, see `load_foreign`.
        command: kept in the report.
        **asked: `truth`, `split`, `images`, `options` and `labels`, as in `open_question`; not with a question.

    Returns:
        Scores with protocol, options, digests of data and field, command and machine. Its notes say what belongs beside a
        score: the rule for labels, which views were trained on, the size of the pictures, the teacher.

    Raises:
        FileNotFoundError: if the result, the scene or its truth is missing.
        ValueError: if something does not fit, such as an unknown protocol, or texts without embeddings.
        TypeError: if a protocol of Gaussians is asked about a teacher, or a question and something that belongs to it are given.
    """
    if isinstance(scene, Question):
        if asked:
            raise TypeError(
                f"scene: expected a folder with {', '.join(asked)}, got a question, which has these; pass them to open_question"
            )
        question = scene
    else:
        check_kind(field, protocol)
        question = open_question(scene, protocol, **asked)
    method = open_result(field, question, with_file) if isinstance(field, str | Path) else field
    name = question.protocol.name
    encoder = TableEncoder(encode) if isinstance(encode, LabelSet) else encode
    report = question.score(colors_of(method, name) if name in OF_COLORS else method, encoder)
    beside = notes_beside(question, report.options.get("labels"), method, encode)
    report = replace(report, notes=(*report.notes, *beside))
    return report.of(command=command, digests={"field": digest_method(method)}, machine=this_machine())


def check_kind(field: Any, protocol: str) -> None:
    """Raise a TypeError if a protocol of Gaussians or colours is asked about a folder of a teacher's maps."""
    name = next((one for one in (*IN_SPACE, *OF_COLORS) if protocol in (one, one.partition("/")[0])), None)
    if name is not None and isinstance(field, str | Path) and is_maps(as_path(field)):
        raise TypeError(
            f"field: expected a result with Gaussians for {name}, got {field}, a teacher's feature maps; use a protocol of views"
        )


def open_result(path: str | Path, question: Question, with_file: str | Path | None = None) -> Method | Gaussians:
    """Read a result as a method that the question's protocol can score; of colours and edits, Gaussians.

    Raises:
        FileNotFoundError: if it is missing.
        ValueError: if it is of no known kind.
    """
    path = as_path(path)
    folder = find_field(path)
    if with_file is not None and (folder is not None or is_maps(path)):
        raise ValueError(f"with_file: expected none with a result of kfgs, got {with_file}; leave it out")
    if question.protocol.name in OF_COLORS:
        places: tuple[Path, ...] = (path, path / "color.ply", path.parent / "color.ply" if folder == path else path)
        places = tuple(one for one in places if one != folder)
        splat = next((one for one in places if one.is_file() and one.suffix not in (".pth", ".pt")), None)
        if splat is not None:
            return read_splats(splat).gaussians
        if folder is not None:
            raise FileNotFoundError(
                f"{path / 'color.ply'}: no such file; expected a colour splat for {question.protocol.name}; name one"
            )
    if folder is not None:
        return FieldMethod(SemanticField.load(folder), own_labels=question.rule == "own")
    if (path / "stages").is_dir() and (path / "color.ply").is_file():
        raise ValueError(
            f"field: expected a result with features for {question.protocol.name}, got {path}, which has colours (color.ply) "
            f"but no features; give it some with `kfgs fit SCENE --out {path}`, or with `kfgs uplift SCENE "
            f"{path / 'color.ply'} --out FIELD`"
        )
    if (path / "stages").is_dir():
        raise ValueError(f"field: expected a finished run, got {path}, an unfinished one; fit it again to go on")
    if is_maps(path):
        return read_teacher(path, question.scene, question.scored, align_corners=False)
    return load_foreign(path, with_file)


def is_maps(path: Path) -> bool:
    """Whether a folder has a teacher's feature maps."""
    if not path.is_dir() or find_field(path) == path:
        return False
    return (
        (path / MANIFEST).is_file()
        or any(next(path.glob(name), None) is not None for name in MAPS[:2])
        or (next(path.glob(MAPS[2]), None) is not None and not (path / "images").is_dir())
    )


def digest_method(method: Any) -> str:
    """SHA-256 of what decides a method's answers: a field's file, Gaussians and decoders, or a teacher's maps of the views."""
    if isinstance(method, FieldMethod):
        folder = method.field.folder
        file = None if folder is None else field_data(folder)
        if file is not None and file.is_file():
            return digest_file(file)
        return digest_data([method.field.gaussians, method.field.features])
    if isinstance(method, Gaussians):
        return digest_data(method)
    if isinstance(method, SplattedMethod):
        return digest_data([list(method.parts)])
    maps = getattr(method, "maps", None)
    if isinstance(maps, Mapping):
        return digest_data({stem: digest_data(maps[stem]) for stem in maps})
    return digest_data([method.name, method.gaussians])


def this_machine() -> str:
    """Processor, threads, GPU if there is one, and the version of torch, in a line."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        found = re.search(r"model name\s*:\s*(.+)", info.read_text(encoding="utf-8", errors="replace"))
        model = found[1].strip() if found else model
    gpu = f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""
    return f"{model}, {torch.get_num_threads()} of {os.cpu_count()} threads{gpu}, torch {torch.__version__}"
