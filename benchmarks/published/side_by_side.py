"""Several results under one protocol: a table of their scores, and pictures of what each says of a view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kfgs.evaluation import LabelTruth, Report, View, label_view
from kfgs.evaluation.label_pictures import load_label_map
from kfgs.evaluation.method import best_labels
from kfgs.evaluation.teacher_agreement import ade20k_words
from kfgs.evaluation.texts import Encode, encode_unit
from kfgs.pipeline.evaluate import Question
from kfgs.splat import rasterize
from kfgs.viz import overlay_labels
from kfgs.viz.pictures import draw_legend, picture_grid, resize_photo, save_picture

from .mask_truth import MaskTruth

LOUDEST = 0.2  # a channel that is wrong by this much has the full colour of an error
WIDTH = 320  # pixels of a picture


class Answer(NamedTuple):
    """What a method says of a view."""

    picture: Any  # [H, W, 3]
    errors: Any  # [H, W, 3]
    share: float
    """The share of wrong pixels; of colours, the mean difference."""


def table_text(reports: Mapping[str, Report]) -> str:
    """A table of scores by title, the best headline first (NaN last), and the protocol below."""
    value = {title: report.value for title, report in reports.items()}
    ordered = sorted(reports, key=lambda title: -value[title] if value[title] == value[title] else float("inf"))
    first = reports[ordered[0]]
    wide = max(len(title) for title in reports)
    widths = {name: max(len(name), 6) for name in first.scores}
    lines = ["  ".join([" " * wide, *(f"{name:>{w}s}" for name, w in widths.items())])]
    for title in ordered:
        lines.append(
            "  ".join([f"{title:<{wide}s}", *(f"{reports[title][name]:>{w}.3f}" for name, w in widths.items())])
        )
    return "\n".join([*lines, f"({str(first).rpartition(' (')[2]}"])


def write_pictures(
    folder: Path, question: Question, methods: Mapping[str, Any], encode: Encode | None, count: int
) -> list[Path]:
    """Draw a PNG for each of some views, evenly spread: photograph, truth, every method and its errors, and a legend.

    Args:
        folder: where to write.
        question: what was scored; of points nothing is drawn.
        methods: by title.
        encode: the text encoder of the scores; not needed for colours.
        count: how many views.
    """
    scene, views = question.scene, question.scored
    index = {scene.stem(i): i for i in range(len(scene))}
    places = sorted({int(i) for i in np.linspace(0, len(views) - 1, min(count, len(views))).round()})
    written = []
    for view in (views[i] for i in places):
        photo = resize_photo(scene.image(index[view.stem]), view.camera.size)
        if encode is None:
            truth, names, labels = photo, (), torch.empty(0, dtype=torch.int64)
            answers = {title: _colors_of(method, view, photo) for title, method in methods.items()}
        else:
            truth, names, labels, answers = _labels_of(question, view, photo, methods, encode)
        blank = torch.ones_like(photo)
        above = [[photo, truth, *(answer.picture for answer in answers.values())]]
        below = [[blank, blank, *(answer.errors for answer in answers.values())]]
        wrong = [f"wrong: {100 * answer.share:.1f} %" for answer in answers.values()]
        sheets = [
            picture_grid(above, [f"photo {view.stem}", "truth", *answers], width=WIDTH),
            picture_grid(below, ["", "", *wrong], width=WIDTH),
        ]
        sheets += [draw_legend(labels, names, width=sheets[0].shape[1])] if names else []
        written.append(folder / f"{view.stem}.png")
        save_picture(written[-1], np.concatenate(sheets))
    return written


def _colors_of(method: Any, view: View, photo: Tensor) -> Answer:
    with torch.no_grad():
        rendered = rasterize(method.replace(features=None), view.camera).map.clamp(0, 1)
    error = (rendered - photo).abs().amax(-1)
    return Answer(rendered, draw_errors(photo, error / LOUDEST), float(error.mean()))


def _labels_of(
    question: Question, view: View, photo: Tensor, methods: Mapping[str, Any], encode: Encode
) -> tuple[Any, Sequence[str], Tensor, dict[str, Answer]]:
    """The picture of the truth, the names of the classes, all labels that occur, and the answers."""
    truth, names, asked = _truth_of(question, view, encode)
    text = encode_unit(encode, [names[i] for i in asked])
    level, places = getattr(question.protocol, "level", 0), torch.tensor(asked)
    answers, seen = {}, [truth]
    for title, method in methods.items():
        if isinstance(level, int):
            best = label_view(method, view, text, level).cpu()
        else:  # the largest cosine of any level
            cosines = method.cosines(view, text)  # [levels, H, W, K]
            highest = cosines.masked_fill(cosines.isnan(), -torch.inf).amax(0)
            best = best_labels(highest.masked_fill(highest.isinf(), torch.nan)).cpu()
        labels = places[best.clamp_min(0)].where(best >= 0, -1)
        wrong = (labels != truth) & (truth >= 0)
        errors = draw_errors(photo, wrong.float(), truth < 0)
        share = float(wrong.sum() / (truth >= 0).sum().clamp_min(1))
        answers[title] = Answer(overlay_labels(photo, labels, names, legend=False), errors, share)
        seen.append(labels)
    return overlay_labels(photo, truth, names, legend=False), names, torch.stack(seen), answers


def _truth_of(question: Question, view: View, encode: Encode) -> tuple[Tensor, Sequence[str], list[int]]:
    """The true labels of a view, the names of classes, and which of them are asked there."""
    truth = question.truth
    if isinstance(truth, LabelTruth):
        stored = truth.maps[view.stem]
        labels = stored if isinstance(stored, Tensor) else load_label_map(stored)
        return labels.cpu(), truth.names, list(range(len(truth.names)))
    if isinstance(truth, MaskTruth):
        closed = hasattr(question.protocol, "rule")  # pixels choose from all texts, not from those of the view
        texts = (question.protocol.texts or truth.listed or truth.texts) if closed else truth.texts
        labels = torch.full(view.camera.size, -1, dtype=torch.int64)
        for text, (mask, _) in truth.frames[view.stem].items():  # a later mask covers an earlier one
            labels[mask] = texts.index(text)
        return labels, texts, [texts.index(text) for text in (texts if closed else truth.frames[view.stem])]
    words = tuple(ade20k_words()) if question.protocol.texts is None else question.protocol.texts
    return label_view(truth, view, encode_unit(encode, words)).cpu(), words, list(range(len(words)))


def draw_errors(photo: Tensor, wrong: Tensor, void: Tensor | None = None) -> Tensor:  # [H, W, 3], [H, W] -> [H, W, 3]
    """The photograph in light grey, errors in vermilion of Okabe and Ito, what is not scored in plain grey."""
    grey = (0.5 + 0.5 * photo.mean(-1, keepdim=True)).expand_as(photo)
    share = 0.85 * wrong.clamp(0, 1)[..., None]
    drawn = (1 - share) * grey + share * torch.tensor((0.835, 0.369, 0.0)).to(photo)
    return drawn if void is None else drawn.where(~void[..., None], 0.5)
