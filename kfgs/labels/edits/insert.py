"""The edit that adds the Gaussians of another splat file."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, ClassVar

import torch

from ..._files import real_path
from ...cameras.similarity import Similarity
from ...formats.splat_file import SplatFile
from ...formats.table import read_splats
from .._json import number_of, numbers_of
from .edit import Edit
from .merge import join
from .motion import transformed


@dataclass(frozen=True, eq=False)
class Insert(Edit):
    """Add the Gaussians of another splat file after those of the scene; `join` says what happens to labels and columns.

    The file is read when the edit is applied. Two inserts are equal if they have the same similarity and name the same file,
    relative to the working folder or in full.
    """

    op: ClassVar[str] = "insert"
    source: str | Path | SplatFile
    """A splat file of any known format, or a cloud in memory (which JSON cannot hold)."""
    similarity: Similarity | None = None
    """From the axes of the source to those of the scene; None: both have the same axes."""

    def __post_init__(self) -> None:
        if not isinstance(self.source, str | Path | SplatFile) or self.source == "":
            raise TypeError(
                f"source: expected a path or a SplatFile, got {self.source!r:.80}; wrap Gaussians in SplatFile(...)"
            )
        if not isinstance(self.source, SplatFile):
            _check_path("source", os.fspath(self.source))
        if self.similarity is not None and not isinstance(self.similarity, Similarity):
            raise TypeError(
                f"similarity: expected a Similarity, got {type(self.similarity).__name__}; build one with "
                "Similarity(scale, rotation, translation) or Similarity.from_matrix"
            )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Insert) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key()[0])

    def _key(self) -> tuple[Any, Any]:
        source = id(self.source) if isinstance(self.source, SplatFile) else os.path.realpath(self.source)
        return source, _similarity_json(self.similarity)

    def apply(self, splats: SplatFile) -> SplatFile:
        """See `Edit.apply`; reads the file if it is one."""
        part = self.source if isinstance(self.source, SplatFile) else read_splats(self.source)
        if self.similarity is not None:
            part = part.replace(gaussians=transformed(part.gaussians, self.similarity, splats.gaussians.origin))
        return join(splats, part)

    def to_json(self) -> dict[str, Any]:
        """Plain values that JSON can hold; see `Edit.to_json`.

        Raises:
            ValueError: if the source is a cloud in memory.
        """
        if isinstance(self.source, SplatFile):
            raise ValueError(
                "source: expected a path to save this edit, got a SplatFile in memory; write it with write_splats and "
                "insert the file"
            )
        return {"op": self.op, "source": os.fspath(self.source), "similarity": _similarity_json(self.similarity)}

    def seen_from(self, folder: Path) -> Insert:
        """The same edit with its path relative to the folder if it lies in it, else in full."""
        if isinstance(self.source, SplatFile):
            return self
        path, folder = real_path(self.source), real_path(folder)
        inside = path.is_relative_to(folder)
        return replace(self, source=path.relative_to(folder).as_posix() if inside else str(path))


def read_similarity(value: Any, name: str) -> Similarity | None:
    """Read what `Insert.to_json` wrote. Raises a ValueError if it is something else, or not a similarity."""
    if value is None:
        return None
    needed = {"scale", "rotation", "translation"}
    if not isinstance(value, Mapping) or set(value) != needed or not _is_matrix(value["rotation"]):
        raise ValueError(
            f"{name}: expected scale, rotation [[3], [3], [3]] and translation [3], got {value!r:.80}; write all three"
        )
    try:
        rotation = torch.tensor([numbers_of("rotation", row, 3) for row in value["rotation"]], dtype=torch.float64)
        translation = torch.tensor(numbers_of("translation", value["translation"], 3), dtype=torch.float64)
        return Similarity(number_of("scale", value["scale"]), rotation, translation)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}.{error}") from error


def read_source(value: Any, name: str, folder: Path, anywhere: bool) -> Path:
    """The file that a saved edit names. Unless `anywhere`, it must lie in the folder of the edits or below.

    Raises:
        ValueError: if it is not a path, leads out of the folder (an absolute path, `..`, a link), or is a folder without a
            `meta.json` (an unpacked SOG).
        FileNotFoundError: if there is no such file.
    """
    if not isinstance(value, str) or not value:
        raise ValueError(f"{name}: expected the path of a splat file, got {value!r:.80}; write it as a string")
    _check_path(name, value)
    parts = PurePosixPath(value).parts + PureWindowsPath(value).parts
    rooted = PurePosixPath(value).is_absolute() or bool(PureWindowsPath(value).drive or PureWindowsPath(value).root)
    path = folder / value
    real = Path(os.path.realpath(path))  # unlike resolve(), also of a name that no file system takes
    if not anywhere and (rooted or ".." in parts or not real.is_relative_to(real_path(folder))):
        raise ValueError(
            f"{name}: expected a file in {folder} or below, got {value!r:.200}; copy it there, or load with "
            "anywhere=True if you trust these edits"
        )
    if not os.path.exists(path):
        raise FileNotFoundError(f"{name}: expected a splat file at {path!s:.400}, got none; put it there")
    if path.is_dir() and not (path / "meta.json").is_file():
        raise ValueError(f"{name}: expected a splat file at {path!s:.400}, got a folder; name the file in it")
    return path


def _check_path(name: str, value: str) -> None:
    """Raise a ValueError if no file system could hold a file of that name."""
    try:
        usable = b"\0" not in os.fsencode(value)
    except UnicodeEncodeError:  # half a surrogate pair, which JSON can write
        usable = False
    if not usable:
        raise ValueError(f"{name}: expected the path of a splat file, got {value!r:.80}; rename the file")


def _is_matrix(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3


def _similarity_json(similarity: Similarity | None) -> dict[str, Any] | None:
    if similarity is None:
        return None
    return {
        "scale": similarity.scale,
        "rotation": similarity.rotation.tolist(),
        "translation": similarity.translation.tolist(),
    }
