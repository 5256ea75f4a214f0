"""What torch's pickles are made of, as records: storages, tensors and dicts, checked before they become views of a file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .._check import one_line
from .pickles import BrokenPickleError, Global, Inert, string_items

_DTYPES = {
    "DoubleStorage": torch.float64,
    "FloatStorage": torch.float32,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
    "ComplexFloatStorage": torch.complex64,
    "ComplexDoubleStorage": torch.complex128,
    "UntypedStorage": torch.uint8,
}


_DIMS = 64  # torch's own limit
_KEY = 256  # characters of a storage's key, which are digits


@dataclass(frozen=True, slots=True)
class Storage:
    """Numbers in a row in the file; `offset` elements are skipped (the views of torch before 0.4)."""

    key: str
    dtype: torch.dtype
    numel: int
    offset: int = 0


@dataclass(frozen=True, slots=True)
class Entry:
    """A tensor as its pickle describes it, not checked yet."""

    storage: Storage
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]


def _rebuild_tensor(storage: Any, offset: Any, size: Any, stride: Any, *more: Any) -> Any:
    """`torch._utils._rebuild_tensor_v2(storage, offset, size, stride, requires_grad, hooks, metadata)` as a record."""
    if (
        not isinstance(storage, Storage)
        or not _are_counts((offset,))
        or not _are_counts(size)
        or not _are_counts(stride)
    ):
        raise BrokenPickleError("a tensor of it has no storage, or sizes that are no whole numbers from 0 (64 at most)")
    if len(size) != len(stride):
        raise BrokenPickleError(f"a tensor of it has {len(size)} sizes and {len(stride)} strides")
    if more[2:] and more[2]:  # bits "conjugate" and "negative"
        return Inert("torch._utils._rebuild_tensor_v2 with metadata")
    return Entry(storage, offset, size, stride)


def _rebuild_parameter(data: Any, *_: Any) -> Any:
    return data


def _new_dict(pairs: Any = (), *_: Any) -> dict[str, Any]:
    listed = pairs if type(pairs) is list else []  # Python 2 wrote an OrderedDict as a list of [key, value]
    return string_items(pair for pair in listed if type(pair) in (list, tuple) and len(pair) == 2)


BUILDERS: dict[str, Callable[..., Any]] = {
    "collections.OrderedDict": _new_dict,
    "collections.defaultdict": lambda *_: {},
    "torch._utils._rebuild_tensor": _rebuild_tensor,
    "torch._utils._rebuild_tensor_v2": _rebuild_tensor,
    "torch._utils._rebuild_parameter": _rebuild_parameter,
    "torch._utils._rebuild_parameter_with_state": _rebuild_parameter,
}


def _are_counts(values: Any) -> bool:
    """Whether this is a tuple, no longer than a tensor has axes, of whole numbers from 0."""
    if type(values) is not tuple or len(values) > _DIMS:
        return False
    return all(type(value) is int and 0 <= value < 2**48 for value in values)


class Storages:
    """The storages that a pickle refers to, by key; the first reference decides, as in torch."""

    def __init__(self) -> None:
        self.by_key: dict[str, Storage] = {}

    def __call__(self, key: Any) -> Storage:
        """The storage of a persistent id, `("storage", type, key, location, numel[, view])`."""
        if type(key) is not tuple or len(key) not in (5, 6) or key[0] not in ("storage", b"storage"):
            raise BrokenPickleError("it refers to something else than a storage")
        _, kind, name, _, numel = key[:5]
        dtype = _DTYPES.get(kind.name.rpartition(".")[2]) if isinstance(kind, Global) else None
        if dtype is None or type(name) is not str or len(name) > _KEY or not _are_counts((numel,)):
            raise BrokenPickleError(f"it has a storage of unknown type {one_line(getattr(kind, 'name', type(kind)))}")
        whole = self.by_key.setdefault(name, Storage(name, dtype, numel))
        if len(key) == 5 or key[5] is None:
            return whole
        view = key[5]
        if type(view) is not tuple or len(view) != 3 or not _are_counts(view[1:]):
            raise BrokenPickleError("it has a view of a storage that is none")
        return Storage(name, whole.dtype, view[2], view[1])


class Views:
    """Tensors as views of a memory-mapped file.

    Storages whose first byte does not lie as their type asks for are copied, each once: tensors that share one go on
    sharing. The copies together are never larger than the file.
    """

    def __init__(self, file: torch.UntypedStorage) -> None:
        self.file = file
        self.copies: dict[tuple[int, int], torch.UntypedStorage] = {}  # by first byte and length
        self.copied = 0  # bytes

    def tensor(self, entry: Entry, first: int, length: int) -> Tensor:
        """The tensor that `entry` describes, whose storage has `length` bytes of the file from byte `first`.

        Raises:
            BrokenPickleError: if it reaches beyond its storage, or has more values than that (an expanded tensor, which a
                few bytes make as large as you like), or if storages that must be copied overlap.
        """
        storage, itemsize = entry.storage, entry.storage.dtype.itemsize
        count, last = 1, entry.offset
        for size, stride in zip(entry.size, entry.stride, strict=True):
            count *= size
            last += (size - 1) * stride
        held = max(length // itemsize - storage.offset, 0)
        if storage.numel > held or count > storage.numel or (count and last >= storage.numel):
            inside = storage.numel <= held and last < storage.numel
            why = " (its values are repeated by strides; save it contiguous)" if inside else ""
            raise BrokenPickleError(
                f"of size {list(entry.size)[:8]} does not fit into the {held} values of its storage{why}"
            )
        if not count:
            try:
                return torch.empty(entry.size, dtype=storage.dtype)
            except RuntimeError as error:  # 0 x 2^40 x 2^40
                raise BrokenPickleError(f"has an impossible size {list(entry.size)[:8]}") from error
        source, start = (self.file, first) if first % itemsize == 0 else (self._copy(first, length), 0)
        start += storage.offset * itemsize
        part = source[start : start + storage.numel * itemsize]
        return torch.empty(0, dtype=storage.dtype).set_(part, entry.offset, entry.size, entry.stride)

    def _copy(self, first: int, length: int) -> torch.UntypedStorage:
        if (first, length) not in self.copies:
            self.copied += length
            if self.copied > self.file.nbytes():
                raise BrokenPickleError("lies in a storage that overlaps others")
            self.copies[first, length] = self.file[first : first + length].clone()
        return self.copies[first, length]
