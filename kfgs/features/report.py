"""Looking over a folder of feature maps before a long run: every view, all that does not fit, by file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from .._check import check_whole
from .._rows import EPS, row_norms
from .langsplat import parse_level
from .layouts import FEATURE_3DGS, OWN, ROW_BLOCK, Reading, StoredMap, count_bad, fits_aspect, open_map, read_block
from .manifest import MANIFEST, Manifest, read_manifest
from .map_store import doubt_file
from .stems import explain_missing, find_maps, list_maps, three

HOLES = 0.5  # share of all-zero features from which a map is worth a note


@dataclass(frozen=True)
class FeatureReport:
    """What is wrong with a folder of maps, file by file."""

    folder: Path
    views: int
    """Pictures that a map was looked for."""
    shape: tuple[int, int, int] | None
    """(h, w, D) of most maps; None if none could be opened."""
    dtype: str
    """The kind of floats of most maps: `float16`."""
    bytes: int
    """Of all maps on disk."""
    problems: dict[str, list[str]]
    """What keeps a map from being used, by the file's name (the name it should have, where there is none)."""
    notes: dict[str, list[str]]
    """What is worth knowing about a file, or about the folder ('')."""

    @property
    def ok(self) -> bool:
        """Whether every view has a map that fits."""
        return not self.problems

    def __str__(self) -> str:
        """A line for the folder, and one for each file that has something said about it."""
        size = "no map could be opened" if self.shape is None else f"{' x '.join(map(str, self.shape))} {self.dtype}"
        fit, disk = self.views - len(self.problems), self.bytes / 1e6
        lines = [f"{self.folder}: {fit} of {self.views} views have a map that fits; {size}, {disk:,.1f} MB"]
        lines += [f"{name}: {'; '.join(texts)}" for name, texts in self.problems.items()]
        lines += [f"note: {name + ': ' if name else ''}{'; '.join(texts)}" for name, texts in self.notes.items()]
        return "\n".join(lines)

    def raise_if_bad(self) -> None:
        """Do nothing if every map fits.

        Raises:
            ValueError: with the first five problems and how many there are.
        """
        if self.ok:
            return
        first = [f"{name}: {'; '.join(texts)}" for name, texts in list(self.problems.items())[:5]]
        more = f" | and {len(self.problems) - 5} more" if len(self.problems) > 5 else ""
        raise ValueError(
            f"{self.folder}: expected a map that fits for each of {self.views} views, got {len(self.problems)} that do "
            f"not: {' | '.join(first)}{more}; encode these views again or leave them out"
        )


@dataclass
class _Findings:
    """What has been found so far."""

    problems: dict[str, list[str]] = field(default_factory=dict)
    notes: dict[str, list[str]] = field(default_factory=dict)

    def problem(self, name: str, text: str) -> None:
        self.problems.setdefault(name, []).append(text)

    def note(self, name: str, text: str) -> None:
        self.notes.setdefault(name, []).append(text)


def check_feature_folder(
    folder: str | Path,
    pictures: Sequence[tuple[str, tuple[int, int]]],
    channels: int | None = None,
    *,
    values: bool = True,
    level: int | str = 0,
    stride: int | None = None,
) -> FeatureReport:
    """Look at the map of every view, and report all that does not fit at once.

    A problem is: no map, or several; a file that cannot be read or holds no map of floats; other channels than expected;
    another size than most maps have, or one that looks transposed beside the picture; NaN or infinite values; a map of
    nothing but zeros; a map that kfgs did not write among its own. A note is: maps of one size whose aspect is not the
    pictures', up to one cell, as encoders of a fixed grid make them; double precision, many all-zero features, maps of no
    view, discarded maps, maps of kfgs that changed since they were written.

    One map is looked at at a time, a few rows in memory.

    Args:
        folder: folder of maps, in any layout that `FeatureFolder` reads.
        pictures: stem and (height, width) of each view's picture.
        channels: D that is expected, if it is known.
        values: False looks at the shape and the kind only, in milliseconds, and reads no value; a map that may have been
            copied rather than changed is not told from one that was.
        level: of LangSplat's masks, as for `FeatureFolder`.
        stride: of LangSplat's masks, as for `FeatureFolder`.

    Raises:
        NotADirectoryError: if `folder` is no folder.
        ValueError: if there is no picture, or `features.json` is damaged.
    """
    root = Path(folder)
    if not root.is_dir():
        raise NotADirectoryError(f"folder: expected a folder of feature maps, got {root}; check its name")
    if not pictures:
        raise ValueError("pictures: expected at least one view, got none; name the views to look at")
    if stride is not None:
        check_whole("stride", stride, 1)
    found, stems = _Findings(), [stem for stem, _ in pictures]
    manifest = read_manifest(root)
    own = manifest.files(root) if manifest else frozenset()
    files = _present(root, stems, manifest, found)
    if manifest is not None:
        _look_at_records(root, files, manifest, found, values=values)
    reading = {
        stem: Reading(channels, (int(size[0]), int(size[1])), parse_level(level), stride) for stem, size in pictures
    }
    shapes: dict[str, tuple[int, int, int]] = {}
    kinds: Counter[str] = Counter()
    for stem, file in files.items():
        name = file.relative_to(root).as_posix()
        stored = _open(file, reading[stem], root, own, found)
        if stored is None:
            continue
        h, w, D = map(int, stored.shape)
        shapes[stem] = h, w, D
        kinds[str(stored.dtype).removeprefix("torch.")] += 1
        if str(stored.dtype).endswith(("float64", "f8")):
            found.note(name, "double precision, which is read as single")
        if values:
            _look_at_values(name, stored, found)
    common = Counter(shapes.values()).most_common(1)[0][0] if shapes else None
    stretched = []
    for stem, shape in shapes.items():
        size = reading[stem].size or (1, 1)
        for text in _misfits(shape, common or shape, size, channels):
            found.problem(files[stem].relative_to(root).as_posix(), text)
        stretched += [stem] if _is_stretched(shape, common or shape, size) else []
    if stretched and common:
        found.note(
            "",
            f"maps of another aspect than their pictures: {len(stretched)} of {len(shapes)} ({three(stretched)}), all of "
            f"{common[0]} x {common[1]} cells; each is taken to cover its whole picture",
        )
    used = sum(file.stat().st_size for file in files.values())
    kind = kinds.most_common(1)[0][0] if kinds else ""
    return FeatureReport(root, len(pictures), common, kind, used, found.problems, found.notes)


def _present(root: Path, stems: list[str], manifest: Manifest | None, found: _Findings) -> dict[str, Path]:
    """The one file of each view that has one; what is missing, doubtful or superfluous goes into the findings."""
    own = manifest.files(root) if manifest else frozenset()
    gone = manifest.gone(root) if manifest else {}
    discarded = [stem for stem in stems if stem in gone]
    rest = [stem for stem in stems if stem not in gone]
    maps = dict(zip(rest, find_maps(root, rest, own), strict=True))
    missing = [stem for stem, files in maps.items() if not files]
    for stem in missing:
        if manifest is None:
            found.problem(stem + FEATURE_3DGS.suffix, "missing, and no other layout of this view either")
        else:
            found.problem(stem + OWN.suffix, "missing; `kfgs features` with the --split of this view makes it")
    if len(missing) == len(stems):
        found.note("", explain_missing(root, stems, missing))
    for stem, files in maps.items():
        if len(files) > 1:
            names = ", ".join(file.relative_to(root).as_posix() for file in files[:3])
            found.problem(stem + FEATURE_3DGS.suffix, f"{len(files)} maps may be meant: {names}")
    if discarded:
        found.note("", f"maps that were discarded once index maps had been made: {len(discarded)} of {len(stems)}")
    chosen = {stem: files[0] for stem, files in maps.items() if len(files) == 1}
    for file in chosen.values():
        if manifest is not None and file not in own:
            text = f"{MANIFEST} does not tell of it: of another program, or of a process that was killed"
            found.problem(file.relative_to(root).as_posix(), text)
    others = sorted(set(list_maps(root, own=own)) - set(stems)) if chosen else []
    if others:
        found.note("", f"maps of none of these views: {len(others)} ({three(others)})")
    return chosen


def _look_at_records(root: Path, files: dict[str, Path], manifest: Manifest, found: _Findings, *, values: bool) -> None:
    """Note the maps that are not as they were written; a file is read only if it has the size, but not the time."""
    touched = []
    for stem, file in files.items():
        record = manifest.maps.get(stem)
        if record is None or file != root / record.file:
            continue
        info = file.stat()
        if info.st_size == record.bytes and not values:
            touched += [stem] if info.st_mtime_ns != record.mtime_ns else []
        elif doubt_file(file, record) is not None:
            found.note(record.file, "has changed since it was written; `kfgs features` makes it again")
    if touched:
        text = f"maps copied or changed since they were written: {len(touched)} of {len(files)} ({three(touched)})"
        found.note("", text)


def _open(file: Path, reading: Reading, root: Path, own: Collection[Path], found: _Findings) -> StoredMap | None:
    try:
        return open_map(file, reading, own)
    except (ValueError, TypeError) as error:
        found.problem(file.relative_to(root).as_posix(), str(error).removeprefix(f"{file}: "))
        return None


def _misfits(
    shape: tuple[int, int, int], common: tuple[int, int, int], size: tuple[int, int], channels: int | None
) -> Iterator[str]:
    """What is wrong with a map's sizes, beside those of most maps and of its picture (H, W)."""
    (h, w, D), (H, W) = shape, size
    if (common[2] if channels is None else channels) != D:
        yield f"expected {common[2] if channels is None else channels} channels, got {D}"
    if (h, w) != common[:2]:
        yield f"expected {common[0]} x {common[1]} cells as most maps have, got {h} x {w}"
    if not fits_aspect((h, w), size) and not _is_stretched(shape, common, size):
        hint = f" ({_turned(shape, size)})" if _turned(shape, size) else ""
        yield f"expected the aspect of a picture of {H} x {W} pixels, got {h} x {w} cells{hint}"


def _turned(shape: tuple[int, int, int], size: tuple[int, int]) -> str:
    """What another order of its axes would explain about a map that does not have the aspect of its picture (H, W)."""
    h, w, D = shape
    if fits_aspect((w, h), size):
        return "transposed?"
    # [h, w, D] that is taken for [D, h, w], or the other way round
    return f"axes of {D} channels in another order?" if fits_aspect((D, h), size) or fits_aspect((w, D), size) else ""


def _is_stretched(shape: tuple[int, int, int], common: tuple[int, int, int], size: tuple[int, int]) -> bool:
    """Whether a map has the cells of most maps, though in no order of its axes the aspect of its picture (H, W)."""
    return shape[:2] == common[:2] and not fits_aspect(shape[:2], size) and not _turned(shape, size)


def _look_at_values(name: str, stored: StoredMap, found: _Findings) -> None:
    """Count what is not finite, and features of nothing but zeros, a few rows at a time."""
    h, w, _ = stored.shape
    bad = zeros = 0
    try:
        for start in range(0, h, ROW_BLOCK):
            rows = read_block(stored, slice(start, start + ROW_BLOCK))
            bad += count_bad(rows)
            zeros += int((row_norms(rows) <= EPS).sum())
    except ValueError as error:  # mask numbers beyond the masks
        found.problem(name, str(error).rpartition(f"{name}: ")[2])
        return
    if bad:
        found.problem(name, f"{bad} NaN or infinite values")
    if zeros == h * w:
        found.problem(name, "every feature is all-zero")
    elif zeros >= HOLES * h * w:
        found.note(name, f"{100 * zeros / (h * w):.0f} % of the features are all-zero: nothing is known there")
