"""Check a folder of feature maps before a long run, and report everything that does not fit, by file."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field, replace
from pathlib import Path

from .._rows import EPS, row_norms
from ..cameras.resample import fits_aspect
from ..scenes.files import some
from .finder import MapFinder
from .layouts import Reading, StoredMap, count_bad, read_rows

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
    own: set[str] = set()  # views whose maps are those that kfgs made
    kinds: Counter[str] = Counter()
    for stem, file in files.items():
        record = finder.records.get(stem)
        if record and file == finder.path / record.file:
            if doubt := record.doubt(file, read=values):
                text = f"{doubt} since kfgs wrote it; `kfgs features` makes it again if it differs"
                report.notes[names[stem]].append(text)
            else:
                own.add(stem)
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
    report.shape, report.dtype = Counter(shapes.values()).most_common(1)[0][0], kinds.most_common(1)[0][0]
    channels = reading.channels or report.shape[2]
    for stem, (_, _, D) in shapes.items():
        if channels != D:
            report.problems[names[stem]].append(f"expected {channels} channels, got {D}")
    cells = Counter((h, w) for h, w, _ in shapes.values()).most_common()
    if len(cells) > 1:
        listed = [f"{h} x {w} ({count})" for (h, w), count in cells]
        report.notes[""].append(f"maps of {len(cells)} sizes: {some(listed)}")
    known = {stem: size for stem, size in sizes.items() if size is not None and stem in shapes}
    misfits = [stem for stem, size in known.items() if not fits_aspect(shapes[stem][:2], size)]
    stretched = []
    for stem in misfits:
        (h, w, D), (H, W) = shapes[stem], known[stem]
        fixed = len(cells) == 1 and (
            stem in own or len(misfits) < len(known)
        )  # the encoder has one grid for all pictures
        turned = "" if fixed else _turned((h, w, D), (H, W))
        if turned or ((h, w) != cells[0][0] and stem not in own):
            text = f"expected the aspect of a picture of {H} x {W} pixels, got {h} x {w} cells{turned}"
            report.problems[names[stem]].append(text)
        else:
            stretched.append(stem)
    if stretched:
        text = f"maps of another aspect than their pictures: {len(stretched)} of {len(shapes)} ({some(stretched, 3)})"
        which = f", all of {cells[0][0][0]} x {cells[0][0][1]} cells" if len(cells) == 1 else ""
        report.notes[""].append(f"{text}{which}; each is taken to cover its whole picture")
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
    # [h, w, D] read as [D, h, w], or the other way round
    other = max(h / w, w / h) > 3 and (fits_aspect((D, h), size) or fits_aspect((w, D), size))
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
