"""Check a folder of feature maps before a long run, and report everything that does not fit, by file."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field, replace
from pathlib import Path

from .._rows import EPS, row_norms
from ..scenes.files import some
from .finder import MapFinder
from .layouts import Reading, StoredMap, count_bad, fits_aspect, read_rows

HOLES = 0.5  # share of all-zero features from which a map gets a note
Shape = tuple[int, int, int]  # (h, w, D)
Size = tuple[int, int] | None  # (H, W) of a picture


@dataclass
class FeatureReport:
    """The problems of a folder of maps, by file."""

    folder: Path
    views: int
    """The number of views checked."""
    shape: Shape | None = None
    """(h, w, D) of most maps; None if none could be opened."""
    dtype: str = ""
    """The type of most maps' values: `float16`."""
    bytes: int = 0
    """Size of all maps on disk."""
    problems: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    """Why a map cannot be used, by the file's name (if there is none, the name it should have)."""
    notes: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    """Remarks about a file, or about the folder ('')."""

    @property
    def ok(self) -> bool:
        """Whether every view has a map that fits."""
        return not self.problems

    def __str__(self) -> str:
        """One line for the folder, and one for each file with a problem or a note."""
        size = "no map could be opened"
        if self.shape is not None:
            h, w, D = self.shape
            size = f"{h} x {w} cells, {D} channels, {self.dtype}"
        fit, disk = self.views - len(self.problems), self.bytes / 1e6
        lines = [f"{self.folder}: {fit} of {self.views} views have a map that fits; {size}, {disk:,.1f} MB"]
        lines += [f"{name}: {'; '.join(texts)}" for name, texts in self.problems.items()]
        lines += [f"note: {name + ': ' if name else ''}{'; '.join(texts)}" for name, texts in self.notes.items()]
        return "\n".join(lines)

    def raise_if_bad(self) -> None:
        """Raise a ValueError with the first five problems and their number, unless every map fits."""
        if self.ok:
            return
        first = [f"{name}: {'; '.join(texts)}" for name, texts in list(self.problems.items())[:5]]
        more = f" | and {len(self.problems) - 5} more" if len(self.problems) > 5 else ""
        raise ValueError(
            f"{self.folder}: expected a map that fits for each of {self.views} views, got {len(self.problems)} that do "
            f"not: {' | '.join(first)}{more}; encode these views again or leave them out"
        )


def check_maps(finder: MapFinder, sizes: dict[str, Size], reading: Reading, *, values: bool) -> FeatureReport:
    """Check the map of every view; see `FeatureFolder.check`.

    Args:
        finder: finds the maps of the folder.
        sizes: size of each view's picture, by stem.
        reading: how to read the maps; `reading.channels` is the expected D.
        values: whether to read the values too.
    """
    report = FeatureReport(finder.path, len(sizes))
    files = _find(finder, list(sizes), report)
    names = {stem: file.relative_to(finder.path).as_posix() for stem, file in files.items()}
    shapes: dict[str, Shape] = {}
    kinds: Counter[str] = Counter()
    for stem, file in files.items():
        record = finder.records.get(stem)
        if record and file == finder.path / record.file and (doubt := record.doubt(file, read=values)):
            report.notes[names[stem]].append(
                f"{doubt} since kfgs wrote it; `kfgs features` makes it again if it differs"
            )
        try:
            stored = finder.open(stem, file, replace(reading, size=sizes[stem]))
        except (ValueError, TypeError) as error:
            report.problems[names[stem]].append(str(error).removeprefix(f"{file}: "))
            continue
        h, w, D = map(int, stored.shape)
        shapes[stem] = h, w, D
        kinds[str(stored.dtype).removeprefix("torch.")] += 1
        if str(stored.dtype).endswith(("float64", "f8")):
            report.notes[names[stem]].append("double precision, which is read as single")
        if values:
            _check_values(names[stem], stored, report)
    report.bytes = sum(file.stat().st_size for file in files.values())
    if not shapes:
        return report
    common = Counter(shapes.values()).most_common(1)[0][0]
    report.shape, report.dtype = common, kinds.most_common(1)[0][0]
    channels, stretched = reading.channels or common[2], []
    for stem, (h, w, D) in shapes.items():
        size, same = sizes[stem], (h, w) == common[:2]
        if channels != D:
            report.problems[names[stem]].append(f"expected {channels} channels, got {D}")
        if not same:
            report.problems[names[stem]].append(
                f"expected {common[0]} x {common[1]} cells as most maps have, got {h} x {w}"
            )
        if size is None or fits_aspect((h, w), size):
            continue
        turned = _turned((h, w, D), size)
        if same and not turned:
            stretched.append(stem)
        else:
            text = f"expected the aspect of a picture of {size[0]} x {size[1]} pixels, got {h} x {w} cells"
            report.problems[names[stem]].append(text + turned)
    if stretched:
        text = f"maps of another aspect than their pictures: {len(stretched)} of {len(shapes)} ({some(stretched, 3)})"
        cells = f"{common[0]} x {common[1]} cells"
        report.notes[""].append(f"{text}, all of {cells}; each is taken to cover its whole picture")
    return report


def _find(finder: MapFinder, stems: list[str], report: FeatureReport) -> dict[str, Path]:
    """The map file of each view that has exactly one; missing, unclear and superfluous files go into the report."""
    found = finder.find(stems)
    for name, text in finder.faults(found).items():
        report.problems[name].append(text)
    missing = [stem for stem, files in found.items() if not files]
    if len(missing) == len(stems):
        report.notes[""].append(finder.explain_missing(stems, missing))
    discarded = [stem for stem in stems if finder.discarded(stem)]
    if discarded:
        report.notes[""].append(
            f"maps that were discarded once index maps had been made: {len(discarded)} of {len(stems)}"
        )
    chosen = {stem: files[0] for stem, files in found.items() if len(files) == 1 and stem not in discarded}
    others = sorted(set(finder.listed()) - set(stems)) if chosen else []
    if others:
        report.notes[""].append(f"maps of other views, which are not used: {len(others)} ({some(others, 3)})")
    return chosen


def _turned(shape: Shape, size: tuple[int, int]) -> str:
    """A hint if another order of its axes would give a map the aspect of its picture (H, W); else ''."""
    h, w, D = shape
    if fits_aspect((w, h), size):
        return " (transposed?)"
    other = fits_aspect((D, h), size) or fits_aspect(
        (w, D), size
    )  # [h, w, D] read as [D, h, w], or the other way round
    return f" (axes of {D} channels in another order?)" if other else ""


def _check_values(name: str, stored: StoredMap, report: FeatureReport) -> None:
    """Count values that are not finite, and features that are all-zero, a few rows at a time."""
    h, w, _ = stored.shape
    bad = zeros = 0
    try:
        for rows in read_rows(stored):
            bad += count_bad(rows)
            zeros += int((row_norms(rows) <= EPS).sum())
    except ValueError as error:  # mask numbers beyond the masks
        report.problems[name].append(str(error).rpartition(f"{name}: ")[2])
        return
    if bad:
        report.problems[name].append(f"{bad} NaN or infinite values")
    if zeros == h * w:
        report.problems[name].append("every feature is all-zero")
    elif zeros >= HOLES * h * w:
        report.notes[name].append(f"{100 * zeros / (h * w):.0f} % of the features are all-zero: nothing is known there")
