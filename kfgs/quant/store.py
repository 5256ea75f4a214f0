"""Files of learnt things: named tensors in one .safetensors file, whose header names the kind of thing. No pickle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Self

from torch import Tensor

from .._arrays import read_safetensors, reading, save_tensors
from .._files import atomic_path

VERSION = "1"  # of all these files


class Stored:
    """Gives a dataclass of tensors `to`, `save` and `load`. Another class has its own `state_dict` and `from_state_dict`."""

    kind: str  # as the file's header names it

    def state_dict(self) -> dict[str, Any]:
        """The tensors by name, as `torch.nn.Module` has it."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        return {name: value for name, value in values.items() if isinstance(value, Tensor)}

    @classmethod
    def from_state_dict(cls, tensors: Mapping[str, Tensor]) -> Self:
        """The inverse of `state_dict`; other names are ignored."""
        return cls(**{f.name: tensors[f.name] for f in fields(cls) if f.name in tensors})  # type: ignore[arg-type]

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """A copy with the tensors moved or converted as `Tensor.to` does."""
        moved = {name: value.to(*args, **kwargs) for name, value in self.state_dict().items()}
        return replace(self, **moved)  # type: ignore[type-var]

    def save(self, path: str | Path) -> None:
        """Write the tensors to a .safetensors file, whole or not at all."""
        with atomic_path(path) as temporary:
            save_tensors(temporary, self.state_dict(), {"kfgs": self.kind, "version": VERSION})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what `save` wrote; an error names a file that is missing, damaged, or of another kind."""
        expected = f"a kfgs {cls.kind} (.safetensors)"
        tensors, _ = read_safetensors(path, expected, "pass another file", kfgs=(cls.kind, VERSION))
        with reading(path, expected):
            return cls.from_state_dict(tensors)
