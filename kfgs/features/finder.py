"""Find the map of each view in a folder, by the name of its picture and by the manifest that kfgs writes."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path, PurePosixPath

from .._files import Names, as_path, folded_name
from ..scenes.files import IMAGE_SUFFIXES, some
from .layouts import LAYOUTS, OWN, Reading, StoredMap, layout_of, open_map
from .manifest import MANIFEST, MapRecord, read_manifest


class MapFinder:
    """Finds the maps in a folder.

    Raises:
        NotADirectoryError: if `path` is no folder.
        ValueError: if its manifest is damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = as_path(path)
        if not self.path.is_dir():
            got = "a file" if self.path.exists() else "nothing there"
            raise NotADirectoryError(f"{self.path}: expected a folder of feature maps, got {got}; check its name")
        self.manifest = read_manifest(self.path)
        self.records: dict[str, MapRecord] = self.manifest.maps if self.manifest else {}
        self.own = frozenset(self.path / record.file for record in self.records.values())
        """The files of the maps that kfgs wrote, including discarded ones."""

    def record(self, stem: str, file: Path) -> MapRecord | None:
        """The record of a view's file, which may be discarded; None if the file is another one or may have changed."""
        record = self.records.get(stem)
        if record is None or file != self.path / record.file:
            return None
        return None if file.is_file() and record.doubt(file, read=False) else record

    def open(self, stem: str, file: Path, reading: Reading) -> StoredMap:  # [h, w, D]
        """Map a view's file into memory, see `layouts.open_map`; a record tells the order of the axes."""
        record = self.record(stem, file)
        return open_map(file, replace(reading, channels=record.shape[2]) if record else reading, self.own)

    def discarded(self, stem: str) -> Path | None:
        """The former path of a discarded map; None if it exists, was never made, or was not discarded."""
        if self.manifest is None or not self.manifest.discarded or stem not in self.records:
            return None
        file = self.path / self.records[stem].file
        return None if file.is_file() else file

    def listed(self, *, deep: bool = False) -> dict[str, list[Path]]:
        """The maps in the folder by stem; of several files with one stem, the one to read comes first.

        A file may also have the whole name of the picture (`rgb_1.png.npy`); the stem is `rgb_1` even then. Hidden files
        are left out.

        Args:
            deep: look into subfolders too (not into hidden ones or links); the stem then starts with the subfolder.
        """
        found: dict[str, list[tuple[int, str, Path]]] = {}
        for here, folders, names in os.walk(self.path):
            folders[:] = sorted(name for name in folders if deep and not name.startswith("."))
            for name in names:
                file = Path(here) / name
                layout = None if name.startswith(".") else layout_of(file, self.own)
                if layout is None:
                    continue
                stem = file.relative_to(self.path).as_posix().removesuffix(layout.suffix)
                ending = PurePosixPath(stem).suffix
                if file not in self.own and ending.lower() in IMAGE_SUFFIXES and PurePosixPath(stem).stem:
                    stem = stem.removesuffix(ending)
                found.setdefault(stem, []).append((LAYOUTS.index(layout), name, file))
        return {stem: [file for _, _, file in sorted(files)] for stem, files in found.items()}

    def find(self, stems: Sequence[str]) -> dict[str, list[Path]]:
        """The map files of each view: an empty list if there is none, several files if it is not clear which one to use.

        A map has the stem of its picture, perhaps with other letters for the same (`folded_name`); if the picture is in a
        subfolder, so is the map. If no view has a map there, the last part of the stem is searched for in the folder and all
        its subfolders. A discarded map counts as its former file.
        """
        gone = {stem: [file] for stem in stems if (file := self.discarded(stem)) is not None}
        found = {stem: self.named(stem) for stem in stems if stem not in gone}
        if not all(found.values()):
            present = self.listed(deep=True)
            others = Names(stem for stem in present if stem not in found)
            for stem in [stem for stem, files in found.items() if not files]:
                near = others.find(stem)
                same = stem if stem in present else near if near and folded_name(near) == folded_name(stem) else None
                found[stem] = [] if same is None else present[same][:1]
            if not any(found.values()):
                bases = Counter(map(_base, found))
                by_base: dict[str, list[Path]] = {}
                for stem, files in present.items():
                    by_base.setdefault(_base(stem), []).append(files[0])
                found = {stem: by_base.get(_base(stem), []) if bases[_base(stem)] == 1 else [] for stem in found}
        return {stem: gone[stem] if stem in gone else found[stem] for stem in stems}

    def named(self, stem: str) -> list[Path]:
        """The file named `stem` with the suffix of a layout, in a list; an empty list if there is none."""
        files = ((self.path / f"{stem}{layout.suffix}", layout) for layout in LAYOUTS)
        return [file for file, layout in files if file.is_file() and layout_of(file, self.own) is layout][:1]

    def faults(self, found: dict[str, list[Path]]) -> dict[str, str]:
        """The problems of the files that `find` returned, by file name (of the expected file, if there is none).

        In a folder that kfgs filled, a map without a record is a fault, because another teacher may have made it.
        """
        faults = {}
        for stem, files in found.items():
            names = [file.relative_to(self.path).as_posix() for file in files]
            expected = stem + self._suffix
            if len(files) > 1:
                text = (
                    f"expected one map for view {stem!r}, got {len(files)}: {some(names, 3)}; name the subfolder itself"
                )
                faults[expected] = text
            elif not files and self.manifest:
                faults[expected] = "missing; `kfgs features` with the --split of this view makes it"
            elif not files:
                faults[expected] = "missing"
            elif self.manifest and files[0] not in self.own:
                faults[names[0]] = (
                    f"expected a map that {MANIFEST} lists, as kfgs filled this folder, got one without a record; move it "
                    "away if another program made it, then run `kfgs features`, which makes (or overwrites) it"
                )
        return faults

    def explain_missing(self, stems: Sequence[str], missing: Sequence[str]) -> str:
        """The message for views without a map: which views, and the names of the maps that exist."""
        named = some([stem + self._suffix for stem in missing])
        text = f"expected a feature map for each of {len(stems)} views, {len(missing)} missing: {named}"
        there = self.listed(deep=True)
        others = sorted(set(there) - set(stems))
        if self.manifest:  # its maps have the names of the pictures, so views are missing, and no name is wrong
            hint = f"make them with `kfgs features ... --split all --out {self.path}` (or the split of these views)"
        elif len(missing) == len(stems) and others:
            return (
                f"{text}; the maps there ({len(others)}) are called {some(others, 3)}, but the pictures "
                f"{some(list(stems), 3)}: rename the maps to the names of the pictures"
            )
        else:
            hint = "make them with the program that made the others" if there else "make them with `kfgs features`"
        return f"{text}; {hint}, or leave these views out"

    @cached_property
    def _suffix(self) -> str:
        """The ending of a map that is missing: that of most maps in the folder; if there are none, that of kfgs's maps."""
        kinds = Counter(layout_of(files[0], self.own) for files in self.listed(deep=True).values())
        common = None if self.manifest else next((kind for kind, _ in kinds.most_common(1)), None)
        return (common or OWN).suffix


def _base(stem: str) -> str:
    return PurePosixPath(folded_name(stem)).name
