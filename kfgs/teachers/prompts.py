"""Turn class names into embeddings with a teacher's text encoder, synonyms and templates."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from .._check import check_shapes
from .._rows import EPS, row_norms, unit_rows
from ..labels.label_set import LabelSet
from ..labels.scores import CANONICAL
from .protocol import PROMPTS_AT_ONCE, Teacher, as_teacher, identify

_CLIP7 = (
    "itap of a {}.",
    "a bad photo of the {}.",
    "a origami {}.",
    "a photo of the large {}.",
    "a {} in a video game.",
    "art of the {}.",
    "a photo of the small {}.",
)
TEMPLATES: dict[str, tuple[str, ...]] = {
    "bare": ("{}",),  # LSeg, Feature 3DGS, the paper, LERF
    "clip7": _CLIP7,  # the seven that CLIP's authors found enough on ImageNet
    "tcl9": (*_CLIP7, "a photo of many {}.", "a photo of {}s."),  # TCL, and TIPSv2 on ADE20K
    "siglip": ("This is a photo of {}.",),
}


def make_label_set(
    teacher: Teacher | Callable[[Tensor], Tensor],
    names: Sequence[str],
    *,
    templates: str | Sequence[str] | None = None,
    synonyms: Mapping[str, Sequence[str]] | None = None,
    negatives: Sequence[str] | None = CANONICAL,
) -> LabelSet:
    """Make classes from words: each name with its embedding by the teacher's text encoder, on the CPU.

    Each word of a class is encoded in each template, as unit rows, whose mean is normalised.

    Args:
        teacher: a teacher with a text encoder.
        names: C class names. One may contain synonyms as in ADE20K, "chair;armchair;seat": the first is the class's name.
            Underscores become spaces in prompts. Repeated words count once.
        templates: "bare", "clip7", "tcl9", "siglip", one template, or several; `{}` is replaced by the word. None: the
            teacher's `templates` if it has any, else bare words, as for LSeg.
        synonyms: further words of a class, by its name.
        negatives: words that a query is compared with if there is no other class (LERF's canonical words), or None.

    Raises:
        ValueError: if there is no name, one is empty or repeated, synonyms belong to no class, a template has no `{}`, or
            the encoder's rows are not finite.
        NotImplementedError: if the teacher has no text encoder.
    """
    teacher = as_teacher(teacher)
    words, patterns = _words(names, synonyms), _templates_of(teacher, templates)
    rows = _embed(teacher, words, patterns)
    info = {
        "teacher": identify(teacher),
        "templates": list(patterns),
        "synonyms": {name: more for name, (_, *more) in words.items() if more},
    }
    against = tuple(negatives or ())
    other = _embed(teacher, _words(against, None), patterns) if against else None
    return LabelSet(tuple(words), rows, other, against, info)


def _embed(
    teacher: Teacher, words: dict[str, list[str]], patterns: tuple[str, ...]
) -> Tensor:  # [C, D] float32, unit rows
    """The mean direction of the words of each class in all templates."""
    prompts = [[pattern.replace("{}", word) for word in group for pattern in patterns] for group in words.values()]
    distinct = list(dict.fromkeys(prompt for group in prompts for prompt in group))
    rows = _encode(teacher, distinct).cpu()
    place = {prompt: i for i, prompt in enumerate(distinct)}
    means = torch.stack([rows[[place[prompt] for prompt in group]].mean(dim=0) for group in prompts])
    lost = row_norms(means) <= EPS
    if bool(lost.any()):
        raise ValueError(
            f"names: expected prompts with a common direction, got none for {list(words)[int(lost.nonzero()[0])]!r}; "
            "use fewer templates or synonyms"
        )
    return unit_rows(means)


def _templates_of(teacher: Teacher, templates: str | Sequence[str] | None) -> tuple[str, ...]:
    """The templates of a named set, the given ones, or the teacher's; a ValueError if one has no `{}`."""
    named = getattr(teacher, "templates", "bare") if templates is None else templates
    patterns = TEMPLATES.get(named, (named,)) if isinstance(named, str) else tuple(named)
    wrong = next((pattern for pattern in patterns if "{}" not in pattern), None if patterns else "none")
    if wrong is not None:
        near = difflib.get_close_matches(wrong, TEMPLATES, n=1)
        raise ValueError(
            f"templates: expected one of {', '.join(TEMPLATES)}, or text with {{}} for the word, got {wrong!r}; "
            + (f"did you mean {near[0]!r}?" if near else 'write it as in "a photo of a {}."')
        )
    return patterns


def _words(names: Sequence[str], synonyms: Mapping[str, Sequence[str]] | None) -> dict[str, list[str]]:
    """The words of each class, as written in prompts, by the class's name, which is its first word."""
    if isinstance(names, str):
        raise TypeError(f"names: expected a list of class names, got the text {names!r}; put it into a list")
    groups = [[part.strip() for part in name.split(";")] for name in names]
    keys, more = [group[0] for group in groups], dict(synonyms or {})
    if not keys or any(not part.replace("_", "").strip() for group in groups for part in group):
        raise ValueError(f"names: expected at least one name and no empty word, got {list(names)!r:.200}; leave it out")
    twice = next((key for key in keys if keys.count(key) > 1), None)
    if twice is not None:
        raise ValueError(f"names: expected different names, got {twice!r} more than once; leave out repeats")
    for name, others in more.items():
        if name not in keys or isinstance(others, str):
            raise ValueError(
                f"synonyms: expected a list of words for names of {', '.join(keys[:10])}, got {name!r}: {others!r:.80}; "
                "name the first word of a class"
            )
    return {
        key: list(dict.fromkeys(" ".join(word.replace("_", " ").split()) for word in [*group, *more.get(key, ())]))
        for key, group in zip(keys, groups, strict=True)
    }


def _encode(teacher: Teacher, prompts: list[str]) -> Tensor:  # [n, D] float32, unit rows
    """The prompts' rows, a chunk at a time."""
    parts = []
    with torch.no_grad():
        for start in range(0, len(prompts), PROMPTS_AT_ONCE):
            chunk = prompts[start : start + PROMPTS_AT_ONCE]
            rows = teacher.encode_text(chunk)
            check_shapes((f"text of {teacher.name}", rows, (len(chunk), "D")))
            norms = row_norms(rows.float())
            bad = ~(torch.isfinite(norms) & (norms > EPS))
            if bool(bad.any()):
                raise ValueError(
                    f"text of {teacher.name}: expected finite rows with a direction, got another for "
                    f"{chunk[int(bad.nonzero()[0])]!r}; leave the word out, or check the weights"
                )
            parts.append(unit_rows(rows.float()))
    return torch.cat(parts)
