"""Checkpoints read without running them: the state dict of a `.ckpt`, `.pt`, `.pth` or `.safetensors` file.

torch's files are pickles, and a pickle is a program. `weights_only=True` refuses those of Lightning, whose settings name
its classes; `weights_only=False` runs whatever they say. Here the pickle is read as data (`pickles`), and each tensor is
a checked view of the memory-mapped file.
"""

from __future__ import annotations

import errno
import io
import mmap
import re
import struct
import sys
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._check import one_line
from .._files import digest_file
from .file_kinds import describe_kind, describe_text
from .pickles import BrokenPickleError, Global, Inert, UnsafePickleError, read_pickle
from .torch_pickles import BUILDERS, Entry, Storage, Storages, Views

_EXPECTED = "expected a checkpoint (.ckpt, .pt, .pth or .safetensors)"
_AGAIN = "download it again or name another file"
_ZIP, _LEGACY_MAGIC = b"PK\x03\x04", 0x1950A86A20F9469CFC6C  # torch >= 1.6 writes zip archives, older ones pickles
_STATES = ("state_dict", "model_state_dict", "model", "module", "net", "network", "params")  # where people put it


def read_checkpoint(path: str | Path) -> dict[str, Tensor]:
    """The tensors of a checkpoint by name, on the CPU; nothing in the file is run, and its values are not read yet.

    Understood are what torch saves (zip archives, and the pickles of torch before 1.6) and safetensors, told apart by
    content, not by name. The state dict is the file itself, or lies under `state_dict` (Lightning), `model_state_dict`,
    `model`, `module`, `net`, `network` or `params`, in this order. What is no tensor is left out.

    **Memory**: tensors are views of the file, mapped privately: pages are read when looked at, writing to a tensor does
    not change the file. The exceptions are storages that are not aligned (in the old format), each of which is copied
    once. The file may be deleted or replaced by another of its name, but not be written over while the tensors are in use.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no checkpoint, cut short, inconsistent, or its pickle names something dangerous. The message
            is one line that says what the file is.
    """
    path = Path(path)
    with _readable(path):
        with path.open("rb") as file:
            head = file.read(1024)
        kind = describe_kind(head, path.stat().st_size)
        if kind is not None:
            raise _refusal(path, kind)
        return _read(path, head)


def weights_digest(path: str | Path) -> str:
    """SHA-256 of a checkpoint's file, in hexadecimal: what identifies the weights.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is a folder, or cannot be read.
    """
    path = Path(path)
    with _readable(path):
        return digest_file(path)


def _read(path: Path, head: bytes) -> dict[str, Tensor]:
    """Read by content."""
    try:
        if _is_safetensors(head):
            return _read_safetensors(path)
        with _mapped(path) as data:
            read = _read_zip if head.startswith(_ZIP) else _read_legacy
            return read(path, data, head)
    except UnsafePickleError as error:
        raise ValueError(
            f"{path}: {_EXPECTED}, but its pickle asks to run {one_line(error.args[0])}; nothing was run; do not trust this "
            "file, get the weights from their authors, as .safetensors if there are"
        ) from error
    except BrokenPickleError as error:
        raise _refusal(
            path, f"one whose pickle cannot be read: damaged or cut short ({one_line(str(error), 120)})"
        ) from error


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Raise unless there is such a file; what the system refuses inside becomes a line that names it."""
    try:
        if path.is_dir():
            raise ValueError(f"{path}: {_EXPECTED}, got a folder; name the file of weights in it")
        if not path.is_file():
            raise FileNotFoundError(f"{path}: {_EXPECTED}, got no such file; check its name")
        yield
    except FileNotFoundError:
        raise
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise FileNotFoundError(f"{path}: {_EXPECTED}, got a name too long for a file; check it") from error
        raise ValueError(
            f"{path}: {_EXPECTED}, got one that cannot be read ({error.strerror}); check the file"
        ) from error


def _read_zip(path: Path, data: mmap.mmap, head: bytes) -> dict[str, Tensor]:
    """A file of torch >= 1.6: a zip archive NAME/{data.pkl, data/0, data/1, ...}, nothing compressed."""
    try:
        with zipfile.ZipFile(path) as archive:
            records = {info.filename: info for info in archive.infolist()}
    except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError) as error:
        raise _refusal(path, "a zip archive without its end: the download was cut short") from error
    pickles = [name for name in records if re.fullmatch(r"[^/]+/data\.pkl", name)]
    if len(pickles) != 1:
        some = ", ".join(one_line(name, 30) for name in list(records)[:3]) or "nothing"
        raise _refusal(path, f"a zip archive that torch.save did not write (it holds {some})")
    root = pickles[0].removesuffix("data.pkl")
    if root + "constants.pkl" in records or any(name.startswith(root + "code/") for name in records):
        raise ValueError(
            f"{path}: {_EXPECTED}, got a TorchScript archive, which is a program; save its state_dict() where it was made"
        )

    def extent(name: str) -> tuple[int, int]:
        """First byte and number of bytes of a record."""
        info = records.get(root + name)
        if info is None:
            raise _refusal(path, f"an archive without its record {one_line(name)}: damaged")
        start = info.header_offset
        header = data[start : start + 30] if start >= 0 else b""
        if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1 or info.file_size != info.compress_size:
            raise _refusal(path, "an archive that is compressed or encrypted, which torch.save never does")
        if len(header) < 30 or not header.startswith(_ZIP):
            raise _refusal(path, "a zip archive whose table of contents is wrong: damaged")
        first = start + 30 + sum(struct.unpack("<HH", header[26:30]))
        if first + info.file_size > len(data):
            raise _refusal(path, "a zip archive with a record past its end: cut short")
        return first, info.file_size

    if root + "byteorder" in records:
        first, length = extent("byteorder")
        _check_order(path, data[first : first + length] == b"little")
    first, length = extent("data.pkl")
    found = read_pickle(io.BytesIO(data[first : first + length]), BUILDERS, Storages())
    return _tensors(path, found, lambda storage: extent(f"data/{storage.key}"))


def _read_legacy(path: Path, data: mmap.mmap, head: bytes) -> dict[str, Tensor]:
    """A file of torch < 1.6: pickles of a magic number, a version, the system and the object; keys; raw storages."""
    storages = Storages()
    try:
        magic = read_pickle(data, BUILDERS, storages)
    except BrokenPickleError as error:
        if head.startswith(b"\x80"):
            raise
        raise _refusal(path, describe_text(head) or "a file of an unknown kind") from error
    if type(magic) is not int or magic != _LEGACY_MAGIC:
        raise _refusal(path, f"a plain pickle of {_kind_of(magic)}, not what torch.save writes")
    _, system = (read_pickle(data, BUILDERS) for _ in range(2))
    _check_order(path, not (isinstance(system, dict) and system.get("little_endian") is False))
    found = read_pickle(data, BUILDERS, storages)
    keys = read_pickle(data, BUILDERS)
    extents: dict[str, tuple[int, int]] = {}
    for key in keys if type(keys) is list else []:
        storage = storages.by_key.get(key) if type(key) is str else None
        header = data.read(8)
        if storage is None or len(header) < 8 or (numel := struct.unpack("<q", header)[0]) < 0:
            raise _refusal(path, "a checkpoint whose storages are missing: cut short")
        length = numel * storage.dtype.itemsize
        extents[key] = data.tell(), length
        if data.tell() + length > len(data):
            raise _refusal(path, f"a checkpoint with {len(data)} bytes of at least {data.tell() + length}: cut short")
        data.seek(length, io.SEEK_CUR)
    return _tensors(path, found, lambda storage: extents.get(storage.key, (0, -1)))


def _tensors(path: Path, found: Any, extent: Callable[[Storage], tuple[int, int]]) -> dict[str, Tensor]:
    """The tensors of an unpickled object's state dict, or words about what it is instead."""
    state = _find_state(found, set())
    if state is None:
        raise _refusal(path, f"a file of {_kind_of(found)}, without a state dict (names to tensors)")
    # mapped privately: a page is copied when it is written to
    file: Any = torch.UntypedStorage.from_file(str(path), False, path.stat().st_size)
    views = Views(file)
    tensors = {}
    for name, entry in state.items():
        if _is_odd_tensor(entry):
            raise _refusal(path, f"one whose entry {one_line(name)} is no plain dense tensor ({one_line(entry.name)})")
        if isinstance(entry, Entry):
            try:
                tensors[name] = views.tensor(entry, *extent(entry.storage))
            except BrokenPickleError as error:
                got = f"one whose tensor {one_line(name)} {error}"
                if "save it contiguous" in got:
                    raise ValueError(f"{path}: {_EXPECTED}, got {got}") from error
                raise _refusal(path, f"{got}: damaged") from error
    return tensors


def _is_odd_tensor(value: Any) -> bool:
    """Whether this would be a sparse, quantised or other tensor that is not read; dropping it would hide that."""
    return isinstance(value, Inert) and value.name.startswith(("torch._utils.", "torch._tensor."))


def _find_state(found: Any, seen: set[int], depth: int = 0) -> dict[str, Any] | None:
    """The dict that holds tensors, itself or under one of the usual keys; each is looked into once."""
    if type(found) is not dict or depth > 3 or id(found) in seen:
        return None
    seen.add(id(found))
    inner = (_find_state(found.get(key), seen, depth + 1) for key in _STATES)
    own = found if any(isinstance(value, Entry) or _is_odd_tensor(value) for value in found.values()) else None
    return next((state for state in inner if state is not None), own)


def _kind_of(found: Any) -> str:
    """What an unpickled object is, in words."""
    if isinstance(found, Inert | Global):
        return f"one object, {one_line(found.name)} (save its state_dict() where it was made)"
    if isinstance(found, dict):
        keys = ", ".join(one_line(key, 30) for key in list(found)[:5])
        return f"a dict with keys {keys}" if keys else "an empty dict"
    return "one tensor" if isinstance(found, Entry) else f"one {type(found).__name__}"


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    from safetensors import SafetensorError  # slow to import, and seldom needed
    from safetensors.torch import load_file

    try:
        tensors: dict[str, Tensor] = load_file(path, device="cpu")
    except (SafetensorError, ValueError, KeyError, RuntimeError) as error:
        why = one_line(str(error), 100)
        raise _refusal(path, f"a .safetensors file that is damaged or cut short ({why})") from error
    if not tensors:
        raise _refusal(path, "a .safetensors file without tensors")
    return tensors


def _is_safetensors(head: bytes) -> bool:
    """Whether a JSON header follows its length: 8 bytes, of which the upper ones are zero (at most 100 MB)."""
    return head[8:9] == b"{" and int.from_bytes(head[:8], "little") < 2**27


@contextmanager
def _mapped(path: Path) -> Iterator[mmap.mmap]:
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        yield data


def _check_order(path: Path, little: bool) -> None:
    if little != (sys.byteorder == "little"):
        raise _refusal(path, "one written on a machine of the other byte order: save it as .safetensors there")


def _refusal(path: Path, got: str) -> ValueError:
    return ValueError(f"{path}: {_EXPECTED}, got {got}; {_AGAIN}")
