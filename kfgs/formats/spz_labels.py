"""kfgs's extension record of SPZ files: the class of each Gaussian, how sure it is, and the names of the classes.

Record type 0x4B460001 (vendor 0x4B46 "KF", extension 1); other readers skip it. The payload, little-endian:

| bytes | what |
|---|---|
| u16 | layout version, 1 |
| u16 | flags: 1 = scores follow |
| u32 | N, the number of Gaussians, as in the file's header |
| u32 | J, bytes of JSON: at most 1 MiB |
| rest | one Zstandard frame of N int32 class_id (-1 = none), N float32 score if flagged, J bytes of a JSON list of names |

Records may grow: a reader of version 1 refuses others.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

TYPE = 0x4B460001
_VERSION, _HAS_SCORE = 1, 0x1
_HEAD = struct.Struct("<HHII")
_MAX_NAMES = 1 << 20


class LabelRecord(NamedTuple):
    """What the record holds."""

    class_id: NDArray[np.int32]  # [N], -1 = none
    score: NDArray[np.float32] | None  # [N]
    classes: tuple[str, ...]


def pack_labels(record: LabelRecord) -> bytes:
    """The payload of a record.

    Raises:
        ValueError: if the names take more than 1 MiB.
    """
    names = json.dumps(list(record.classes), ensure_ascii=False).encode() if record.classes else b""
    if len(names) > _MAX_NAMES:
        raise ValueError(f"classes: expected names of at most {_MAX_NAMES} bytes, got {len(names)}; shorten them")
    parts = [record.class_id.astype("<i4").tobytes(), names]
    if record.score is not None:
        parts.insert(1, record.score.astype("<f4").tobytes())
    head = _HEAD.pack(_VERSION, 0 if record.score is None else _HAS_SCORE, len(record.class_id), len(names))
    return head + zstandard.compress(b"".join(parts), 12)


def unpack_labels(path: Path, payload: bytes, count: int) -> LabelRecord:
    """Read a record of a file of `count` Gaussians.

    Raises:
        ValueError: if it is damaged, of another version, or of another number of Gaussians.
    """
    version, flags, n, names_size = _HEAD.unpack_from(payload) if len(payload) >= _HEAD.size else (0, 0, 0, 0)
    if version != _VERSION:
        raise ValueError(
            f"{path}: expected labels of layout {_VERSION}, got {version}; update kfgs, or write them again"
        )
    if n != count or names_size > _MAX_NAMES:
        raise ValueError(
            f"{path}: expected labels of {count} Gaussians and at most {_MAX_NAMES} bytes of names, got {n} and {names_size}; "
            "the record is damaged"
        )
    scores = flags & _HAS_SCORE
    size = n * (8 if scores else 4) + names_size
    try:
        if zstandard.get_frame_parameters(payload[_HEAD.size :]).content_size != size:
            raise zstandard.ZstdError("of another size")
        plain = zstandard.ZstdDecompressor().decompress(payload[_HEAD.size :], allow_extra_data=False) if size else b""
        classes = json.loads(plain[size - names_size :]) if names_size else []
    except (zstandard.ZstdError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: expected {size} bytes of labels, but they cannot be read ({error})") from error
    class_id = np.frombuffer(plain, "<i4", n).astype(np.int32)
    score = np.frombuffer(plain, "<f4", n, 4 * n).astype(np.float32) if scores else None
    if (class_id < -1).any() or not isinstance(classes, list) or not all(isinstance(name, str) for name in classes):
        raise ValueError(f"{path}: expected class_id of -1 or more and a list of names; the labels are damaged")
    return LabelRecord(class_id, score, tuple(classes))
