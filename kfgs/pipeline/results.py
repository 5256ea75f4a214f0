"""Results that are put side by side: some are scored now, some were scored before and lie in a JSON file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from .._card import short_repr
from .._files import as_path, atomic_path, read_json, write_json
from ..evaluation import Encode, LabelSet, Report, get_protocol
from ..evaluation.encoders import TableEncoder
from ..fields.store import describes_field
from .evaluate import check_kind, digest_method, evaluate, is_maps, open_result
from .question import Question
from .side_by_side import check_comparable, check_several, rank, show_views, table_text, write_pictures


class Kept(NamedTuple):
    """What `kfgs evaluate --out` kept."""

    report: Report
    inputs: dict[str, Any]
    """What it was asked with: field, scene, truth, and the words of the command line."""


class Compared(NamedTuple):
    """Several results under one protocol, by title; `print` shows a table of scores, the best first.

    A title is the name of the method, followed by its file or folder if several have the same name.
    """

    reports: dict[str, Report]
    """The scores."""
    methods: dict[str, Any]
    """The results that can be drawn."""
    notes: tuple[str, ...]
    """Which results could not be opened to be drawn, and what the protocol decided by the data."""

    def __repr__(self) -> str:
        return short_repr(self)

    def __str__(self) -> str:
        return table_text(self.reports)

    def write(
        self, folder: Path, question: Question | None, encode: Encode | LabelSet | None, count: int
    ) -> list[Path]:
        """Write `compare.txt`, `compare.json`, and pictures of some views.

        Args:
            folder: where to write.
            question: what was asked; None: no pictures.
            encode: as in `Results.score`.
            count: number of views to draw.

        Returns:
            What was written.
        """
        write_json(folder / "compare.json", {title: one.to_json() for title, one in rank(self.reports).items()})
        with atomic_path(folder / "compare.txt") as temporary:
            temporary.write_text(table_text(self.reports) + "\n", encoding="utf-8")
        written = [folder / "compare.txt", folder / "compare.json"]
        if question is None or count == 0:
            return written
        asked = TableEncoder(encode) if isinstance(encode, LabelSet) else encode
        return written + write_pictures(folder, show_views(question, self.methods, asked, count))


@dataclass(frozen=True)
class Results:
    """Results to compare: `Results.read` finds them, `score` asks all of them the same question."""

    paths: tuple[Path, ...]
    """All results, each once."""
    kept: Mapping[Path, Kept]
    """Those that were scored before: JSON files of `kfgs evaluate --out`."""
    files: Mapping[Path, Path]
    """The second files of results of other programs."""

    @staticmethod
    def read(paths: Sequence[str | Path], with_file: Sequence[str] = ()) -> Results:
        """Read the JSON files among some results, and find which result each second file belongs to.

        Args:
            paths: whatever `evaluate` takes, or JSON files of `kfgs evaluate --out`.
            with_file: `FILE` if one result is of another program, else `RESULT=FILE` for each that needs one.

        Raises:
            FileNotFoundError: if a JSON file is missing.
            ValueError: if one has another content, or it is unclear which result a file belongs to.
        """
        each = tuple(dict.fromkeys(as_path(path) for path in paths))
        kept = {path: _read_kept(path) for path in each if path.suffix == ".json"}
        return Results(each, kept, _second_files([path for path in each if path not in kept], with_file))

    @property
    def new(self) -> list[Path]:
        """The results that must be scored now."""
        return [path for path in self.paths if path not in self.kept]

    @property
    def first(self) -> Kept | None:
        """The first result that was scored before: new ones are scored the same way."""
        return next(iter(self.kept.values()), None)

    def check(self, protocol: str) -> None:
        """Check what can be checked before anything is computed.

        Raises:
            TypeError: if a protocol of Gaussians is asked about a teacher's maps.
            ValueError: if there are fewer than two, or scores that were kept cannot be compared.
        """
        for path in self.new:
            check_kind(path, protocol)
        check_several(len(self.paths))
        if not self.new:
            check_comparable({str(path): kept.report for path, kept in self.kept.items()})
            return
        others = [path for path, one in self.kept.items() if get_protocol(protocol).name != one.report.protocol]
        if others:
            raise ValueError(
                f"protocol: expected {self.kept[others[0]].report.protocol}, that of {others[0]}, got {protocol}; leave it out, "
                "or score its field again"
            )

    def score(
        self, question: Question | None, encode: Encode | LabelSet | None = None, *, draw: bool = False
    ) -> Compared:
        """Score the new results; with `draw`, also open those that were scored before.

        Args:
            question: what new results are asked; None if there are none and nothing is drawn.
            encode: a label set, or the teacher's text encoder.
            draw: open results that were scored before, so that `Compared.write` can draw them.

        Raises:
            FileNotFoundError: if a result is missing.
            ValueError: if one cannot be scored, or scores cannot be compared.
        """
        reports, methods, notes = (
            {path: kept.report for path, kept in self.kept.items()},
            dict[Path, Any](),
            list[str](),
        )
        for path in self.paths if question is not None else ():
            assert question is not None
            if path not in self.kept:
                methods[path] = open_result(path, question, self.files.get(path))
                reports[path] = evaluate(methods[path], question, encode=encode)
            elif draw:
                method, why = _reopen(self.kept[path], question)
                if why:
                    notes.append(f"{path} is not drawn: {why}")
                else:
                    methods[path] = method
        titles = _titles({path: reports[path] for path in self.paths})
        named = {titles[path]: reports[path] for path in self.paths}
        check_comparable(named)
        notes += _all_notes(named)
        return Compared(named, {titles[path]: methods[path] for path in self.paths if path in methods}, tuple(notes))


def _all_notes(reports: Mapping[str, Report]) -> list[str]:
    """The notes of all reports, each once; a note that not all of them have names its report."""
    shared = set.intersection(*(set(report.notes) for report in reports.values()))
    each = ((title, note) for title, report in reports.items() for note in report.notes)
    return list(dict.fromkeys(note if note in shared else f"{title}: {note}" for title, note in each))


def _read_kept(path: Path) -> Kept:
    top = read_json(path)
    try:
        report, inputs = Report.from_json(top), dict(top.get("inputs", {}))
        words = {name: value for name, value in inputs.items() if name != "set"}
        if not all(isinstance(word, str | None) for word in (*words.values(), *inputs.get("set", ()))):
            raise ValueError("expected texts in 'inputs', got other values")
        return Kept(report, inputs)
    except (ValueError, AttributeError, TypeError) as error:
        raise ValueError(
            f"{path}: {str(error).removeprefix('value: ')}; give what `kfgs evaluate --out` wrote"
        ) from error


def _second_files(paths: Sequence[Path], words: Sequence[str]) -> dict[Path, Path]:
    """The file of each result that has one."""
    found: dict[Path, Path] = {}
    own = [path for path in paths if is_maps(path) or any(describes_field(one) for one in (path, path / "field"))]
    foreign = [path for path in paths if path not in own]
    for word in words:
        ends = [i for i, letter in enumerate(word) if letter == "=" and Path(word[:i]) in paths]
        if ends:  # a name may have "=" in it, too
            path, file = Path(word[: ends[-1]]), word[ends[-1] + 1 :]
        elif len(foreign) == 1:
            path, file = foreign[0], word
        else:
            names = ", ".join(str(path) for path in foreign)
            hint = f"write {foreign[0]}=FILE" if foreign else "leave it out"
            raise ValueError(
                f"with_file: expected RUN=FILE with one of {names or 'no run'} (results of other programs), got {word}; {hint}"
            )
        if path in found:
            raise ValueError(f"with_file: expected one file for {path}, got {found[path]} and {file}; leave one out")
        found[path] = as_path(file)
    return found


def _reopen(kept: Kept, question: Question) -> tuple[Any, str]:
    """The result that a JSON file is about, or why it cannot be drawn."""
    try:
        found = open_result(Path(kept.inputs["field"]), question, kept.inputs.get("with_file"))
    except (KeyError, TypeError, ValueError, OSError) as error:
        return None, str(error)
    same = digest_method(found) == kept.report.digests.get("field")
    return found, "" if same else f"{kept.inputs['field']} has changed since it was scored"


def _titles(reports: dict[Path, Report]) -> dict[Path, str]:
    """The name of each method; with its file or folder where several have one name."""
    names = [report.method for report in reports.values()]
    short = {path: path.name if not report.method else report.method for path, report in reports.items()}
    long = {path: f"{short[path]} ({path.stem if path.suffix == '.json' else path.name})" for path in reports}
    titles = {path: long[path] if names.count(report.method) > 1 else short[path] for path, report in reports.items()}
    repeated = [title for title in titles.values() if list(titles.values()).count(title) > 1]
    return {path: f"{short[path]} ({path})" if title in repeated else title for path, title in titles.items()}
