"""Which file of a folder is a view's map: found by the stem of its picture."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Container, Sequence
from pathlib import Path, PurePosixPath

from ..scenes.files import IMAGE_SUFFIXES
from .layouts import FEATURE_3DGS, LANGSPLAT, LAYOUTS, OWN, layout_of
from .manifest import MANIFEST


def list_maps(folder: Path, *, deep: bool = False, own: Container[Path] = ()) -> dict[str, list[Path]]:
    """The maps of a folder by stem; of several files of one stem the one to be read comes first.

    A file may also be named by the whole name of the picture (`rgb_1.png.npy`); the stem is `rgb_1` all the same.

    Args:
        folder: where to look; hidden files are left out.
        deep: look into its subfolders too (hidden ones left out, links not followed); a stem then names the subfolder
            as well.
        own: maps that kfgs wrote, see `layouts.layout_of`.
    """
    found: dict[str, list[Path]] = {}
    for here, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if deep and not name.startswith("."))
        for name in sorted(names):
            file = Path(here) / name
            layout = None if name.startswith(".") else layout_of(file, own)
            if layout is None or _is_partner(file, own):
                continue
            stem = file.relative_to(folder).as_posix().removesuffix(layout.suffix)
            ending = PurePosixPath(stem).suffix
            if file not in own and ending.lower() in IMAGE_SUFFIXES and PurePosixPath(stem).stem:
                stem = stem.removesuffix(ending)
            found.setdefault(stem, []).append(file)
    for files in found.values():
        files.sort(key=lambda file: _rank(file, own))
    return found


def find_maps(folder: Path, stems: Sequence[str], own: Container[Path] = ()) -> list[list[Path]]:
    """Each view's map: no file where there is none, several where it cannot be told which one is meant.

    A view's map lies in the folder under the picture's stem, in subfolders as the picture does. If no view has one
    there, maps are looked for by the last part of the stem, in the folder and all its subfolders.
    Maps in `own` are kfgs's, see `layouts.layout_of`.
    """
    found = [_direct(folder, stem, own) for stem in stems]
    if all(found):
        return found
    present = list_maps(folder, deep=True, own=own)
    found = [files or present.get(stem, [])[:1] for files, stem in zip(found, stems, strict=True)]
    if any(found):
        return found
    bases = Counter(PurePosixPath(stem).name for stem in stems)
    by_base: dict[str, list[Path]] = {}
    for stem, files in present.items():
        by_base.setdefault(PurePosixPath(stem).name, []).append(files[0])
    return [by_base.get(base, []) if bases[base] == 1 else [] for base in (PurePosixPath(stem).name for stem in stems)]


def explain_missing(folder: Path, stems: Sequence[str], missing: Sequence[str]) -> str:
    """What to say when views have no map: which, and how the maps that are there are called."""
    ours = (folder / MANIFEST).is_file()
    suffix = OWN.suffix if ours else FEATURE_3DGS.suffix
    named = ", ".join(stem + suffix for stem in missing[:5]) + (", ..." if len(missing) > 5 else "")
    text = f"expected a feature map for each of {len(stems)} views, {len(missing)} missing: {named}"
    if ours:  # the maps are called as the pictures were, so it is views that are missing, not names that differ
        return (
            f"{text}; make them with `kfgs features ... --split all --out {folder}` (or the split of these views), or leave "
            "them out of `stems`"
        )
    text += f" (or {missing[0]}.npy)"
    others = [stem for stem in list_maps(folder, deep=True) if stem not in set(stems)]
    if len(missing) == len(stems) and others:
        return (
            f"{text}; the maps there ({len(others)}) are called {three(others)}, but the pictures {three(list(stems))}: "
            "rename the maps by their pictures"
        )
    return f"{text}; encode these views or leave them out of `stems`"


def three(names: list[str]) -> str:
    """The first three names, for a message."""
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


def _direct(folder: Path, stem: str, own: Container[Path]) -> list[Path]:
    for layout in LAYOUTS:
        file = folder / f"{stem}{layout.suffix}"
        if file.is_file() and layout_of(file, own) is layout:
            return [file]
    return []


def _is_partner(file: Path, own: Container[Path]) -> bool:
    """Whether it is the second file of a map that is kept in two."""
    first = file.with_name(file.name.removesuffix(LANGSPLAT.partner) + LANGSPLAT.suffix)
    ours = file in own or first in own
    return not ours and file.name.endswith(LANGSPLAT.partner) and first.is_file()


def _rank(file: Path, own: Container[Path]) -> tuple[int, str]:
    layout = layout_of(file, own)
    return (LAYOUTS.index(layout) if layout else len(LAYOUTS)), file.name
