"""Pack a field into bytes in memory; `SemanticField.save` writes the same bytes to a file."""

from __future__ import annotations

from .._typed import typed
from ..labels import LabelSet
from .precision import PrecisionName, Rounding
from .semantic_field import SemanticField
from .store import pack_parts, unpack_parts


@typed
def pack_field(field: SemanticField, precision: PrecisionName | Rounding = "small") -> bytes:
    """The bytes of one file with the field, and its classes if they can be read.

    Raises:
        ValueError: as `SemanticField.save` for one file.
    """
    words: LabelSet | None = None
    if field.has_classes:
        try:
            words = field.label_set()
        except (OSError, ValueError):  # their files are gone: the field is packed without
            words = None
    return pack_parts({**vars(field), "words": words}, precision)


def unpack_field(data: bytes) -> SemanticField:
    """The field of `pack_field`; a ValueError for other bytes."""
    return SemanticField(**unpack_parts(data))
