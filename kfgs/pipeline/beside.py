"""What to say beside a score: rule for labels, level, which scored views were trained on, size of the pictures, teacher."""

from __future__ import annotations

from typing import Any

from .._check import one_line
from .._files import file_stem
from ..evaluation import Encode, FieldMethod, LabelSet
from ..evaluation.truth import MaskTruth
from ..fields.parts import teacher_name
from .question import LABELLED, Question


def notes_beside(question: Question, rule: str | None, method: Any, encode: Encode | LabelSet | None) -> list[str]:
    """Facts about a result that decide how its score is to be read; what is not known is left out.

    Args:
        question: what was asked.
        rule: the option `labels` of the report; None if the protocol takes no class per pixel.
        method: what was scored.
        encode: a label set, or the text encoder of a teacher.
    """
    field = method.field if isinstance(method, FieldMethod) else None
    notes = []
    if field is not None and field.method == "fused" and rule == "own" and question.protocol.name in LABELLED:
        notes.append(
            "the class of a pixel is the field's own, by votes of the Gaussians, not the text nearest to the rendered feature"
        )
    levels, level = getattr(method, "levels", 1), getattr(question.protocol, "level", None)
    if levels > 1 and isinstance(level, int):
        notes.append(f"level {level} of 0 to {levels - 1} is scored; level=N takes another")
    views = question.scored
    if field is not None:
        names = field.info.get("views") or [camera.name for camera in field.cameras]
        trained = {file_stem(str(name)) for name in names} & {view.stem for view in views}
        if trained:
            notes.append(f"{len(trained)} of {len(views)} scored views were trained on")
    sizes = sorted({view.camera.size for view in views}, key=lambda size: size[0] * size[1])
    if sizes:
        small, large = ("x".join(map(str, size)) for size in (sizes[0], sizes[-1]))
        several = f"{len(sizes)} sizes, {small} to {large}" if len(sizes) > 1 else small
        notes.append(f"scored pictures: {len(views)} of {several} (height x width)")
    if isinstance(question.truth, MaskTruth) and any(question.scene.masks or ()):
        notes.append(f"masks of photos are not used: {question.protocol.name} scores all pixels")
    teacher = _teacher_of(field, encode)
    return notes if teacher is None else [*notes, f"teacher: {one_line(teacher)}"]


def _teacher_of(field: Any, encode: Any) -> str | None:
    """The name of the field's teacher; if it is unknown, that of the texts."""
    found = None if field is None else teacher_name(field.info)
    if found is None and isinstance(encode, LabelSet):
        return teacher_name(encode.info)
    named = getattr(getattr(encode, "__self__", None), "name", None)  # of a teacher's method `encode_text`
    return str(named) if found is None and named is not None else found
