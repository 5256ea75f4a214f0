"""Open torch files that other people wrote, without running or importing anything that they name.

`torch.load(weights_only=True)` refuses Lightning's files, because their settings name classes; `weights_only=False` runs any
code in them. Here torch reads with `weights_only=True`, and each class that a file names is replaced by a placeholder that
does nothing. `pickle_check` checks the pickle first.
"""

from __future__ import annotations

import io
import re
import threading
import warnings
import zipfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor
from torch.serialization import (
    add_safe_globals,
    clear_safe_globals,
    get_safe_globals,
    get_unsafe_globals_in_checkpoint,
    safe_globals,
)

from .._check import one_line
from .pickle_check import STEPS, BrokenPickleError, OtherProtocolError, PickleNames, UnsafePickleError, check_pickle

_ZIP = b"PK\x03\x04"  # first bytes of files of torch >= 1.6; older files are a sequence of pickles
_LEGACY_MAGIC = b"\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19."  # 0x1950A86A20F9469CFC6C as a pickle
_AGAIN = "download it again or name another file"
_CONVERT = "save it again with torch.save and its default pickle_protocol, or as .safetensors, where you trust it"
FACTS = 1000  # opcodes of the magic number, the version and the facts about the system of a file of torch < 1.6
_LOCK = threading.Lock()  # the names that torch allows are global

_SIGNATURES: tuple[tuple[bytes, str], ...] = (
    (b"version https://git-lfs", "a Git LFS pointer, not the file itself: run `git lfs pull` where it came from"),
    (b"\x89PNG", "a PNG picture"),
    (b"\xff\xd8\xff", "a JPEG picture"),
    (b"GIF8", "a GIF picture"),
    (b"%PDF", "a PDF document"),
    (b"\x1f\x8b", "a gzip file: unpack it first"),
    (b"BZh", "a bzip2 file: unpack it first"),
    (b"\xfd7zXZ", "an xz file: unpack it first"),
    (b"7z\xbc\xaf", "a 7-zip archive: unpack it first"),
    (b"Rar!", "a RAR archive: unpack it first"),
    (b"\x28\xb5\x2f\xfd", "a zstandard file: unpack it first"),
    (b"\x89HDF", "an HDF5 file, as Keras writes: convert the weights to .safetensors"),
    (b"\x93NUMPY", "a numpy array (.npy)"),
    (b"GGUF", "a GGUF file of llama.cpp"),
    (b"ply\n", "a PLY point cloud"),
    (b"PK\x05\x06", "an empty zip archive"),
    (b"RIFF", "a RIFF file (WebP, WAV or AVI)"),
)


class TorchFileError(ValueError):
    """A file that cannot be read; one line that says what it is and what to do, without the file's name."""

    def __init__(self, got: str, todo: str = _AGAIN) -> None:
        super().__init__(f"{got}; {todo}")
        self.got, self.todo = got, todo


class Placeholder(type):
    """Stands for a class that a file names, which is not imported, and for its objects; `__name__` is the name.

    It is a metaclass, so that the placeholder of a class can also be its object: torch makes objects, and sets their state,
    only for classes on its list.
    """

    def __setstate__(cls, state: Any) -> None:
        """Ignore an object's state."""


def load_torch_file(path: Path) -> Any:
    """Read the object in a file of `torch.save`, on the CPU. Classes that the file names become a `Placeholder`.

    Objects with items (`defaultdict`, settings that derive from dict or list) become dicts and lists.

    **Memory**: tensors in a zip archive (torch >= 1.6) are views of the file, mapped privately: pages are read at first
    use, and writing to a tensor does not change the file. Older files are read whole.

    Raises:
        TorchFileError: if it is damaged, not of `torch.save`, or asks for something dangerous.
        OSError: if it cannot be read.
    """
    with path.open("rb") as file, _pickle_errors():
        head = file.read(1024)
        kind = _describe_kind(head, path.stat().st_size)
        if kind is not None:
            raise TorchFileError(kind)
        if str(path).endswith(".safetensors"):  # torch decides by the name
            raise TorchFileError("a file that is named .safetensors, but is none", "rename it to .pt")
        if not head.startswith(_ZIP):
            found = _load(path, *_pickle_in_legacy(file, head), mapped=False)
            _bare_tensors(found)
            return found
        data, sizes = _pickle_in_zip(file)
        found = _load(path, data, check_pickle(io.BytesIO(data)), mapped=True)
    if any(tensor.numel() and tensor.untyped_storage().nbytes() not in sizes for tensor in _bare_tensors(found)):
        raise TorchFileError("one with a tensor larger than its record in the archive: damaged")
    return found


def check_plain(tensor: Tensor) -> None:
    """Raise unless this is a dense tensor whose values all lie in its file.

    Raises:
        TorchFileError: if it is sparse, quantised, nested, without values, or expanded from fewer values.
    """
    odd = tensor.layout != torch.strided or tensor.is_nested or tensor.is_meta or tensor.is_quantized
    if odd or tensor.is_conj() or tensor.is_neg():
        raise TorchFileError("not a plain dense tensor", "save it dense")
    held = tensor.untyped_storage().nbytes() // tensor.element_size()
    if tensor.numel() > held:  # a few bytes could fill the memory
        size = list(tensor.shape)[:8]
        raise TorchFileError(
            f"of size {size}, but has only {held} values: its values are repeated by strides", "save it contiguous"
        )


def read_torch(path: Path, expected: str) -> Any:
    """The object in a file of `torch.save`; nothing in it is run.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is something else, or damaged.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected {expected} there")
    try:
        return load_torch_file(path)
    except TorchFileError as error:
        raise ValueError(f"{path}: expected {expected}, got {error}") from error


def plain_tensor(
    path: Path, name: str, value: object, dtype: torch.dtype = torch.float32, *, finite: bool = True
) -> Tensor:
    """A tensor of a file as floats, without its graph.

    Raises:
        ValueError: if it is no dense tensor, or of numbers that are not `finite`.
    """
    if not isinstance(value, Tensor):
        raise ValueError(
            f"{path}: expected a tensor for {name}, got {type(value).__name__}; is this another program's file?"
        )
    try:
        check_plain(value)
    except TorchFileError as error:
        raise ValueError(f"{path}: {name} is {error}") from error
    found = value.detach().to(dtype)
    if finite and not bool(torch.isfinite(found).all()):
        raise ValueError(f"{path}: expected finite numbers for {name}, got NaN or infinity; did the training diverge?")
    return found


@contextmanager
def _pickle_errors() -> Iterator[None]:
    """Turn errors of a pickle into a one-line TorchFileError."""
    try:
        yield
    except UnsafePickleError as error:
        raise TorchFileError(
            f"one whose pickle asks to run {one_line(error.args[0])}; nothing was run",
            "do not trust this file, get the weights from their authors, as .safetensors if there are",
        ) from error
    except OtherProtocolError as error:
        raise TorchFileError(f"one whose pickle torch does not read ({error})", _CONVERT) from error
    except BrokenPickleError as error:
        raise TorchFileError(f"one whose pickle cannot be read: damaged or cut short ({error})") from error


def _load(path: Path, data: bytes, names: PickleNames, *, mapped: bool) -> Any:
    """Let torch read the file, with placeholders for the classes that its pickle names."""
    with _LOCK, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about protocols and old storages; what matters is raised
        trusted = get_safe_globals()  # another library may have allowed classes of its own: not in these files
        clear_safe_globals()
        try:
            unknown = _unknown_names(data)
            if names.called - unknown:  # torch would make sparse and nested tensors, or a bytearray of any size
                odd = ", ".join(sorted(names.called - unknown))
                raise TorchFileError(
                    f"one with something else than dense tensors ({one_line(odd, 120)})",
                    "save the state_dict alone, dense",
                )
            classes: list[Any] = [(_placeholder(name, names.filled.get(name)), name) for name in unknown]
            with safe_globals([*classes, Placeholder]):
                return torch.load(path, map_location="cpu", mmap=mapped, weights_only=True)
        except (TorchFileError, OSError):
            raise
        except Exception as error:  # torch on hostile bytes raises almost anything
            raise BrokenPickleError(_reason(error)) from error
        finally:
            add_safe_globals(trusted)


def _placeholder(name: str, like: type | None) -> Placeholder:
    """The placeholder for class `name`. A call returns the placeholder itself, or a dict or list if the file fills it."""

    def make(cls: Placeholder, *_: Any) -> Any:
        if like is None:
            return cls
        items: Any = [] if like is list else Counter()  # of all dicts the one that torch lets have items and a state
        if like is dict:
            items.__setstate__ = lambda state: None
        return items

    return Placeholder(name, (), {"__new__": make})


def _unknown_names(data: bytes) -> set[str]:
    """The names in a pickle that torch does not allow by itself."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:  # torch looks into archives only, not into its older files
        file.writestr("x/data.pkl", data)
        file.writestr("x/version", b"3\n")
    archive.seek(0)
    return set(get_unsafe_globals_in_checkpoint(archive))


def _pickle_in_zip(file: BinaryIO) -> tuple[bytes, set[int]]:
    """The pickle of a zip archive NAME/{data.pkl, data/0, data/1, ...}, and the sizes of its other records."""
    try:
        with zipfile.ZipFile(file) as archive:
            records = {info.filename: info for info in archive.infolist()}
            pickles = [name for name in records if re.fullmatch(r"[^/]+/data\.pkl", name)]
            if len(pickles) != 1 or len(records) != len(archive.infolist()):
                some = ", ".join(one_line(name, 30) for name in list(records)[:3]) or "nothing"
                raise TorchFileError(f"a zip archive that torch.save did not write (it holds {some})")
            root = pickles[0].removesuffix("data.pkl")
            if root + "constants.pkl" in records or any(name.startswith(root + "code/") for name in records):
                raise TorchFileError(
                    "a TorchScript archive, which is a program", "save its state_dict() where it was made"
                )
            if any(info.compress_type or info.flag_bits & 1 for info in records.values()):
                raise TorchFileError("an archive that is compressed or encrypted, which torch.save never does")
            data = archive.read(pickles[0])
            if _reads_otherwise(file, archive, data):
                raise TorchFileError("a zip archive that two readers read differently, which torch.save never writes")
            return data, {info.file_size for info in records.values()}
    except TorchFileError:
        raise
    except Exception as error:  # zipfile on hostile bytes raises struct.error, ValueError, NotImplementedError, ...
        raise TorchFileError("a zip archive that is damaged, or without its end: the download was cut short") from error


def _reads_otherwise(file: BinaryIO, archive: zipfile.ZipFile, data: bytes) -> bool:
    """Whether torch finds another pickle in the archive than zipfile; then the wrong one would be checked.

    torch's reader ignores the case of names, and takes the directory's offset literally; zipfile allows for bytes before
    the archive.
    """
    names = [name.lower() for name in archive.namelist()]
    end = zipfile._EndRecData(file)  # type: ignore[attr-defined]
    if len(set(names)) != len(names) or end is None or end[zipfile._ECD_OFFSET] != archive.start_dir:  # type: ignore[attr-defined]
        return True
    return bool(torch._C.PyTorchFileReader(str(file.name)).get_record("data.pkl") != data)


def _pickle_in_legacy(file: BinaryIO, head: bytes) -> tuple[bytes, PickleNames]:
    """The pickle of a file of torch < 1.6: it follows those of a magic number, a version and facts about the system."""
    if _LEGACY_MAGIC not in head[:32]:
        what = "a plain pickle" if head.startswith(b"\x80") else "a file of an unknown kind"
        raise TorchFileError(f"{what}, not what torch.save writes")
    with mmap(file.fileno(), 0, access=ACCESS_READ) as data:  # its read(n) reserves no more memory than there are bytes
        starts, names = [], []
        for most in (FACTS, FACTS, FACTS, STEPS, STEPS):  # the last: the keys of the storages, whose values follow
            starts.append(data.tell())
            names.append(check_pickle(data, most))
        return data[starts[3] : starts[4]], names[3]


def _bare_tensors(found: Any) -> list[Tensor]:
    """The tensors in dicts, lists and tuples of any depth.

    Attributes that the file gives to dicts and tensors are removed: one named `values` would replace the method.
    """
    seen: set[int] = set()
    tensors = []
    rest = [found]
    while rest:
        value = rest.pop()
        if isinstance(value, Tensor | dict):
            getattr(value, "__dict__", {}).clear()
        if isinstance(value, Tensor):
            tensors.append(value)
        elif isinstance(value, dict | list | tuple) and id(value) not in seen:
            seen.add(id(value))
            rest += value.values() if isinstance(value, dict) else value
    return tensors


def _reason(error: Exception) -> str:
    """Torch's error in one line; for `weights_only` it writes a page, with the reason inside."""
    text = str(error)
    lines = (text.partition("WeightsUnpickler error:")[2] or text).strip().splitlines()
    return one_line(lines[0] if lines else type(error).__name__, 120)


def _describe_kind(head: bytes, size: int) -> str | None:
    """The kind of a file, from its size and its first kilobyte `head`; None if it may be a checkpoint."""
    if size == 0:
        return "an empty file: the download failed"
    for signature, words in _SIGNATURES:
        if head.startswith(signature):
            return words
    if head[257:262] == b"ustar":
        return "a tar archive (torch before 0.2, or a packed folder): unpack it, or save its weights again"
    if not head.strip(b"\0"):
        return "a file of zeros: the download was interrupted"
    text = head.decode("utf-8-sig", "replace").rstrip("\ufffd")  # the last character may be cut in two
    if not all(char.isprintable() or char in "\t\n\r\f" for char in text) or "\ufffd" in text:
        return None
    start = text.strip().lower()
    if start.startswith(("<!doctype html", "<html", "<head")):
        return "an HTML page: the download failed, most likely behind a login or a warning"
    if start.startswith("<?xml"):
        return "an XML document: the download failed, most likely (storage servers answer so)"
    if start.startswith(("{", "[")):
        return "a JSON file (settings, or the index of a checkpoint in several parts), not the weights"
    return f"a text file that begins {text.strip().splitlines()[0][:40]!r}" if start else "a blank text file"
