"""Several results under one protocol: a table of their scores, and pictures of what each says of a view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .._card import short_repr
from ..evaluation import Encode, LabelTruth, MaskTruth, Method, PointTruth, Report, View, best_labels, label_view
from ..evaluation.class_lists import load_classes
from ..evaluation.relevancy import encode_unit
from ..evaluation.segmentation import load_label_map
from ..splat import rasterize
from ..viz import overlay_labels, save_picture
from ..viz.pictures import legend_strip, picture_grid, resize_photo
from .question import LABELLED, OF_COLORS, Question, colors_of

WRONG = (0.835, 0.369, 0.0)  # vermilion of Okabe and Ito, over a grey photograph
VOID = 0.5  # grey, as the palette's "no class"
LOUDEST = 0.2  # a channel that is wrong by this much has the full colour of an error
WIDTH = 320  # pixels of a picture


class Shown(NamedTuple):
    """What a view shows: the picture, the truth, and for each method its picture and its errors."""

    photo: Tensor  # [H, W, 3]
    truth: Any  # [H, W, 3]
    answers: dict[str, tuple[Any, Any, float]]
    """By title: picture, errors, share of wrong pixels (of colours, the mean difference)."""
    labels: Any  # all labels that occur, for the legend
    names: Sequence[str]

    def __repr__(self) -> str:
        return short_repr(self)


def check_comparable(reports: Mapping[str, Report]) -> None:
    """Raise a ValueError unless scores are of one protocol and names, with the same options, of the same data.

    Args:
        reports: by title, at least two. Digests of fields may differ.
    """
    check_several(len(reports))
    (first, one), *others = reports.items()
    for title, other in others:
        found: list[tuple[str, Any, Any]] = [("protocol", one.protocol, other.protocol)]
        if one.protocol == other.protocol:
            found += [("scores", list(one.scores), list(other.scores))]
            found += [
                (f"option {key}", one.options.get(key), other.options.get(key))
                for key in sorted({*one.options, *other.options})
            ]
            kept = sorted({*one.digests, *other.digests} - {"field"})
            found += [(f"digest of the {key}", one.digests.get(key), other.digests.get(key)) for key in kept]
        different = [f"{name} ({_short(a)} and {_short(b)})" for name, a, b in found if a != b]
        if different:
            raise ValueError(
                f"runs: expected scores that can be compared, but {first} and {title} differ in {'; '.join(different)}; score "
                "both in the same way, on the same data"
            )


def check_several(count: int) -> None:
    """Raise a ValueError unless there are two results or more."""
    if count < 2:
        raise ValueError(f"runs: expected at least two different results, got {count}; name others to compare with")


def table_text(reports: Mapping[str, Report]) -> str:
    """A table of scores, best headline first, and the protocol below."""
    ordered = rank(reports)
    names = list(next(iter(reports.values())).scores)
    wide = max(len(title) for title in reports)
    widths = [max(len(name), 6) for name in names]
    lines = ["  ".join([" " * wide, *(f"{name:>{w}s}" for name, w in zip(names, widths, strict=True))])]
    for title, report in ordered.items():
        lines.append(
            "  ".join([f"{title:<{wide}s}", *(f"{report[n]:>{w}.3f}" for n, w in zip(names, widths, strict=True))])
        )
    return "\n".join([*lines, f"({str(ordered[next(iter(ordered))]).rpartition(' (')[2]}"])


def rank(reports: Mapping[str, Report]) -> dict[str, Report]:
    """Reports by title, the best headline first; NaN comes last."""
    return dict(
        sorted(reports.items(), key=lambda one: -one[1].value if one[1].value == one[1].value else float("inf"))
    )


def show_views(
    question: Question, methods: Mapping[str, Any], encode: Encode | None, count: int = 3
) -> dict[str, Shown]:
    """What each method says of some views, evenly spread; nothing for protocols of points and of edits.

    Args:
        question: what was scored.
        methods: by title.
        encode: the text encoder of the scores.
        count: how many views.
    """
    protocol = question.protocol
    if isinstance(question.truth, PointTruth) or (protocol.name in OF_COLORS and question.inputs):
        return {}
    index = {question.scene.stem(i): i for i in range(len(question.scene))}
    views = question.scored
    places = sorted({int(i) for i in np.linspace(0, len(views) - 1, min(count, len(views))).round()})
    found = {}
    for view in (views[i] for i in places):
        photo = question.scene.image(index[view.stem])
        if protocol.name in OF_COLORS:
            found[view.stem] = _show_colors(photo, view, methods, protocol.name)
        else:
            assert encode is not None
            found[view.stem] = _show_labels(question, photo, view, methods, encode)
    return found


def write_pictures(folder: Path, shown: Mapping[str, Shown]) -> list[Path]:
    """Draw a PNG for each view: photograph, truth and every method, its errors below it, and a legend."""
    written = []
    for stem, one in shown.items():
        blank = torch.ones_like(one.photo)
        titles = [f"photo {stem}", "truth", *one.answers]
        above = picture_grid([[one.photo, one.truth, *(a for a, _, _ in one.answers.values())]], titles, width=WIDTH)
        wrong = [f"wrong: {100 * share:.1f} %" for _, _, share in one.answers.values()]
        errors = [[blank, blank, *(e for _, e, _ in one.answers.values())]]
        below = picture_grid(errors, ["", "", *wrong], width=WIDTH)
        sheets = [above, below]
        if one.names:
            sheets.append(legend_strip(one.labels, one.names, above.shape[1]))
        written.append(folder / f"{stem}.png")
        save_picture(written[-1], np.concatenate(sheets))
    return written


def _show_colors(photo: Tensor, view: View, methods: Mapping[str, Any], name: str) -> Shown:
    answers = {}
    for title, method in methods.items():
        with torch.no_grad():
            rendered = rasterize(colors_of(method, name).replace(features=None), view.camera).map.clamp(0, 1)
        error = (rendered - photo).abs().amax(-1)
        answers[title] = (rendered, draw_errors(photo, error / LOUDEST), float(error.mean()))
    return Shown(photo, photo, answers, np.empty(0, np.int64), ())


def _show_labels(question: Question, photo: Tensor, view: View, methods: Mapping[str, Method], encode: Encode) -> Shown:
    size = view.camera.size
    photo = resize_photo(photo, size)
    truth, names, asked = _truth_of(question, view, encode)
    text = encode_unit(encode, [names[i] for i in asked])
    level = getattr(question.protocol, "level", 0)
    places, answers, seen = torch.tensor(asked), {}, [truth]
    for title, method in methods.items():
        if isinstance(level, int):
            found = label_view(method, view, text, level).cpu()
        else:
            cosines = method.cosines(view, text)  # [levels, H, W, K]
            best = cosines.masked_fill(cosines.isnan(), -torch.inf).amax(0)
            found = best_labels(best.masked_fill(best.isinf(), torch.nan)).cpu()
        labels = places[found.clamp_min(0)].where(found >= 0, -1)
        wrong = (labels != truth) & (truth >= 0)
        share = float(wrong.sum() / (truth >= 0).sum().clamp_min(1))
        answers[title] = (
            overlay_labels(photo, labels, names, legend=False),
            draw_errors(photo, wrong.float(), truth < 0),
            share,
        )
        seen.append(labels)
    return Shown(photo, overlay_labels(photo, truth, names, legend=False), answers, torch.stack(seen), names)


def _truth_of(question: Question, view: View, encode: Encode) -> tuple[Tensor, Sequence[str], list[int]]:
    """The true labels of a view, the names of classes, and which of them are asked there."""
    truth = question.truth
    if isinstance(truth, LabelTruth):
        found = truth.maps[view.stem]
        labels = found if isinstance(found, Tensor) else load_label_map(found)
        return labels.cpu(), truth.names, list(range(len(truth.names)))
    if isinstance(truth, MaskTruth):
        closed = question.protocol.name in LABELLED  # then pixels choose from all texts, not from those of the view
        names = (question.protocol.texts or truth.listed or truth.texts) if closed else truth.texts
        labels = torch.full(view.camera.size, -1, dtype=torch.int64)
        for text, (mask, _) in truth.frames[view.stem].items():  # a later mask covers an earlier one
            labels[mask] = names.index(text)
        return labels, names, [names.index(text) for text in (names if closed else truth.frames[view.stem])]
    texts = question.protocol.texts
    names = tuple(load_classes("ade20k")[texts]) if isinstance(texts, str) else texts
    assert isinstance(truth, Method)
    return label_view(truth, view, encode_unit(encode, names)).cpu(), names, list(range(len(names)))


def draw_errors(photo: Tensor, wrong: Tensor, void: Tensor | None = None) -> Tensor:  # [H, W, 3], [H, W] -> [H, W, 3]
    """The photograph in light grey, errors in vermilion, what is not scored in plain grey."""
    grey = (0.5 + 0.5 * photo.mean(-1, keepdim=True)).expand_as(photo)
    share = 0.85 * wrong.clamp(0, 1)[..., None]
    found = (1 - share) * grey + share * torch.tensor(WRONG).to(photo)
    return found if void is None else found.where(~void[..., None], VOID)


def _short(value: Any) -> str:
    text = str(value)
    return f"{text[:12]}..." if len(text) > 40 else text
