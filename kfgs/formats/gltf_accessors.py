"""Accessors of glTF: typed arrays inside a buffer, read with every promise checked, and written as float32."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .gltf_container import Document

_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_FLOAT, _UNSIGNED_BYTE = 5126, 5121
_ARRAY_BUFFER = 34962


def read_accessor(document: Document, index: object, width: int, count: int | None) -> NDArray[np.float32]:
    """The values of an accessor as float32 [N, width]; normalised integers become [-1, 1] or [0, 1].

    Args:
        document: the document.
        index: which accessor.
        width: expected numbers per element; 0: any.
        count: expected number of elements; None: any.

    Raises:
        ValueError: if it is damaged, sparse, or not of that width and count.
    """
    accessor, where = document.item("accessors", index), f"accessors[{index}]"
    kind = accessor.get("type")
    have = _WIDTHS.get(kind, 0) if isinstance(kind, str) else 0
    if have == 0 or width not in (0, have):
        raise document.wrong(f"{where}.type", f"a type of {width or 'few'} numbers", kind)
    component = accessor.get("componentType")
    if not isinstance(component, int) or component not in _COMPONENTS:
        raise document.wrong(f"{where}.componentType", f"one of {', '.join(map(str, _COMPONENTS))}", component)
    rows = document.whole(accessor, "count", where)
    if count is not None and rows != count:
        raise document.wrong(f"{where}.count", f"{count}, as many as POSITION has", rows)
    if "sparse" in accessor or "bufferView" not in accessor:
        raise document.wrong(where, "an accessor with a bufferView and not sparse", sorted(accessor))
    values = _take(document, accessor, where, rows, have, np.dtype(_COMPONENTS[component]))
    if not accessor.get("normalized") or values.dtype.kind == "f":
        return values.astype(np.float32)
    return np.maximum(values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max), np.float32(-1))


def _take(
    document: Document, accessor: dict[str, Any], where: str, rows: int, width: int, dtype: np.dtype[Any]
) -> NDArray[Any]:  # [rows, width]
    """A strided view of the bytes."""
    content, stride = document.view(accessor["bufferView"])
    start = document.whole(accessor, "byteOffset", where, 0)
    size = width * dtype.itemsize
    step = stride or size
    needed = start + (rows - 1) * step + size if rows else start
    if step < size or needed > len(content):
        raise document.wrong(where, f"{rows} elements in {len(content)} bytes", f"{needed} bytes, {step} apart")
    if rows == 0:
        return np.zeros((0, width), dtype)
    return np.ndarray((rows, width), dtype, content, start, (step, dtype.itemsize))


class AccessorWriter:
    """Collects columns into one buffer, with the views and accessors that describe them."""

    def __init__(self) -> None:
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        self._parts: list[bytes] = []
        self._length = 0

    def add(self, values: NDArray[Any], *, bounds: bool = False) -> int:
        """Add float32 values, or bytes that mean [0, 1], [N] or [N, width]; returns the accessor's index.

        `bounds` adds minimum and maximum of each component, which glTF requires for positions.
        """
        normalized = values.dtype == np.uint8
        content = np.ascontiguousarray(values if normalized else values.astype("<f4"))
        width = 1 if content.ndim == 1 else content.shape[1]
        assert content.strides[0] % 4 == 0  # glTF aligns every element of a vertex attribute to four bytes
        accessor: dict[str, Any] = {
            "bufferView": len(self.views),
            "componentType": _UNSIGNED_BYTE if normalized else _FLOAT,
            "count": len(content),
            "type": next(name for name, n in _WIDTHS.items() if n == width),
        }
        if normalized:
            accessor["normalized"] = True
        if bounds:
            accessor |= {"min": content.min(0).tolist(), "max": content.max(0).tolist()}
        self.views.append(
            {"buffer": 0, "byteOffset": self._length, "byteLength": content.nbytes, "target": _ARRAY_BUFFER}
        )
        self.accessors.append(accessor)
        self._parts.append(content.tobytes())
        self._length += content.nbytes
        return len(self.accessors) - 1

    def binary(self) -> bytes:
        """The buffer."""
        return b"".join(self._parts)
