"""Small sound files for every reader. Each case is a folder, the file in it that is mutated, and the reader that opens it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

SEED = 5


@dataclass(frozen=True)
class Case:
    """One file of one reader."""

    name: str
    """Unique: "splats/a.spz"."""
    reader: str
    """A name in `readers.READERS`."""
    folder: Path
    """All that the reader needs."""
    file: str
    """The mutated file, in that folder."""
    opens: str = "."
    """What the reader gets, in that folder."""


Add = Callable[..., None]


def make_corpus(folder: Path) -> list[Case]:
    """Write all sound files to `folder`, which is emptied, and list the cases; the same bytes each time."""
    from . import corpus_fields, corpus_maps, corpus_scenes, corpus_splats, corpus_truth

    shutil.rmtree(folder, ignore_errors=True)
    cases: list[Case] = []
    for module in (corpus_splats, corpus_scenes, corpus_fields, corpus_maps, corpus_truth):
        group = module.__name__.rpartition("corpus_")[2]

        def add(reader: str, place: Path, *files: str, opens: str | None = None, group: str = group) -> None:
            """A case for each of the files; without `opens` the reader gets the file itself."""
            for file in files:
                assert (place / file).is_file(), f"{place / file} was not written"
                name = f"{group}/{place.name}/{file}"
                name += f" ({reader})" if name in {case.name for case in cases} else ""
                cases.append(Case(name, reader, place, file, file if opens is None else opens))

        module.make(folder / group, add)
    return cases
