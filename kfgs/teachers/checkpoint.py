"""Checkpoints: the state dict of a `.ckpt`, `.pt`, `.pth` or `.safetensors` file."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torch import Tensor

from .._check import one_line
from .._files import as_path, digest_file
from .._torch_files import Placeholder, TorchFileError, check_plain, load_torch_file

_EXPECTED = "expected a checkpoint (.ckpt, .pt, .pth or .safetensors)"
_STATES = ("state_dict", "model_state_dict", "model", "module", "net", "network", "params")  # usual keys


def read_checkpoint(path: str | Path) -> dict[str, Tensor]:
    """Read the tensors of a checkpoint by name, on the CPU. Nothing in the file is run, and values are not read yet.

    Files of `torch.save` and safetensors are read; the content shows which it is. The state dict is the whole file, or is
    under `state_dict` (Lightning), `model_state_dict`, `model`, `module`, `net`, `network` or `params`, in this order.
    Anything that is not a tensor is left out.

    **Memory**: tensors are views of the file, mapped privately: pages are read at first use, and writing to a tensor does
    not change the file. Only files of torch before 1.6 are read whole. While the tensors are in use, the file may be
    deleted or replaced, but not overwritten.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a checkpoint, is damaged, or names something dangerous. The message is one line that says
            what the file is.
    """
    path = as_path(path)
    with _readable(path):
        with path.open("rb") as file:
            head = file.read(9)
        return _read_safetensors(path) if _is_safetensors(head) else _read_torch(path)


def weights_digest(path: str | Path) -> str:
    """SHA-256 of a checkpoint's file, in hexadecimal, to identify the weights.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is a folder, or cannot be read.
    """
    path = as_path(path)
    with _readable(path):
        return digest_file(path)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Raise unless the file exists. Errors inside become one line that names it."""
    try:
        if path.is_dir():
            raise TorchFileError("a folder", "name the file of weights in it")
        if not path.is_file():
            raise FileNotFoundError(f"{path}: {_EXPECTED}, got no such file; check its name")
        yield
    except FileNotFoundError:
        raise
    except TorchFileError as error:
        raise ValueError(f"{path}: {_EXPECTED}, got {error}") from error
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise FileNotFoundError(f"{path}: {_EXPECTED}, got a name too long for a file; check it") from error
        raise ValueError(
            f"{path}: {_EXPECTED}, got one that cannot be read ({error.strerror}); check the file"
        ) from error


def _read_torch(path: Path) -> dict[str, Tensor]:
    """The tensors of the state dict in a file of `torch.save`."""
    found = load_torch_file(path)
    state = _find_state(found, set())
    if state is None:
        raise TorchFileError(f"a file of {_describe_object(found)}, without a state dict (names to tensors)")
    tensors = {}
    for name, entry in state.items():
        if type(name) is str and isinstance(entry, Tensor):
            try:
                check_plain(entry)
            except TorchFileError as error:
                raise TorchFileError(f"one whose tensor {one_line(name)} is {error.got}", error.todo) from error
            tensors[name] = entry.detach()
    return tensors


def _find_state(found: Any, seen: set[int], depth: int = 0) -> dict[Any, Any] | None:
    """The dict that holds tensors, or the one under one of the usual keys; each is visited once."""
    if not isinstance(found, dict) or depth > 3 or id(found) in seen:
        return None
    seen.add(id(found))
    inner = (_find_state(found.get(key), seen, depth + 1) for key in _STATES)
    outer = found if any(isinstance(value, Tensor) for value in found.values()) else None
    return next((state for state in inner if state is not None), outer)


def _describe_object(found: Any) -> str:
    """Describe an object in a few words."""
    if isinstance(found, Placeholder):
        return f"one object, {one_line(found.__name__)} (save its state_dict() where it was made)"
    if isinstance(found, dict):
        some = [key if isinstance(key, str | int) else type(key).__name__ for key in list(found)[:5]]
        keys = ", ".join(one_line(key, 30) for key in some)
        return f"a dict with keys {keys}" if keys else "an empty dict"
    return "one tensor" if isinstance(found, Tensor) else f"one {type(found).__name__}"


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    from safetensors import SafetensorError  # slow to import, and seldom needed
    from safetensors.torch import load_file

    try:
        tensors: dict[str, Tensor] = load_file(path, device="cpu")
    except (SafetensorError, ValueError, KeyError, RuntimeError) as error:
        why = one_line(str(error), 100)
        raise TorchFileError(f"a .safetensors file that is damaged or cut short ({why})") from error
    if not tensors:
        raise TorchFileError("a .safetensors file without tensors")
    return tensors


def _is_safetensors(head: bytes) -> bool:
    """Whether the file begins with a length of 8 bytes, the upper ones zero (at most 100 MB), and a JSON header."""
    return head[8:9] == b"{" and int.from_bytes(head[:8], "little") < 2**27
