"""What a protocol says about a method: scores that carry the protocol's name, and all that is needed to get them again."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from .._typed import typed

SHOWN = 4
"""An option with more values is only counted in the short form."""
Row = Mapping[str, Any]
"""One line of a report's table: "view", "text" or "class", and numbers."""


@typed
@dataclass(frozen=True, eq=False)
class Report:
    """Scores under a named protocol.

    `str(report)` is the short form, `mIoU 0.831 (kfgs-pooled/1)`; `report.text` says how it was measured.
    """

    protocol: str
    """Name and version: "lerf-ovs-2d/1"."""
    scores: Mapping[str, float]
    """By name; the first is the headline. NaN where nothing could be measured."""
    rows: tuple[Row, ...] = ()
    """What the scores are made of, for each view or class."""
    method: str = ""
    """What was scored."""
    about: str = ""
    """What the protocol measures, in words."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """The protocol's options, plain values."""
    changed: tuple[str, ...] = ()
    """Options that are not as published."""
    always: tuple[str, ...] = ()
    """Options that are printed even if they are: they move the score so much."""
    digests: Mapping[str, str] = field(default_factory=dict)
    """Of the data and of the field, by name."""
    command: str = ""
    """What was run."""
    machine: str = ""
    """Where it was run."""
    notes: tuple[str, ...] = ()
    """What the protocol decided by the data: which texts were asked, which names were not scored."""

    def __post_init__(self) -> None:
        if not self.scores:
            raise ValueError("scores: expected at least one, got none; name what was measured")

    def __getitem__(self, name: str) -> float:
        """A score by its name."""
        if name not in self.scores:
            raise KeyError(f"no score {name!r}; expected one of {', '.join(self.scores)}")
        return self.scores[name]

    @property
    def value(self) -> float:
        """The headline score."""
        return next(iter(self.scores.values()))

    def __str__(self) -> str:
        """All scores, the protocol, and the options that differ from it as published or are always named."""
        numbers = ", ".join(f"{name} {value:.3f}" for name, value in self.scores.items())
        named = [name for name in self.options if name in self.changed or name in self.always]
        return f"{numbers} ({', '.join([self.protocol, *(f'{name}={_short(self.options[name])}' for name in named)])})"

    def __repr__(self) -> str:
        return f"Report({self}, {len(self.rows)} rows)"

    @property
    def text(self) -> str:
        """The long form: the scores, the protocol in words, every option, and the table."""
        lines = [f"{self.method}: {self}" if self.method else str(self)]
        lines += [f"  {self.about}"] if self.about else []
        lines += [f"  {name} = {value}" for name, value in self.options.items()]
        lines += [f"  note: {note}" for note in self.notes]
        lines += [f"  {name}: {value}" for name, value in self.digests.items()]
        lines += [f"  command: {self.command}"] if self.command else []
        lines += [f"  machine: {self.machine}"] if self.machine else []
        for row in self.rows:
            parts = (f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items())
            lines.append("    " + ", ".join(parts))
        return "\n".join(lines)

    def of(self, *, command: str = "", digests: Mapping[str, str] | None = None, machine: str = "") -> Report:
        """The same report with the command that made it, digests of data and field, and the machine."""
        both = {**self.digests, **(digests or {})}
        return replace(self, command=command or self.command, digests=both, machine=machine or self.machine)

    def to_json(self) -> dict[str, Any]:
        """Plain values: protocol, version, options, scores, rows, digests, command.

        A number that is not finite is null; but an infinite score, such as the PSNR of equal pictures, is the text "inf".
        """
        name, _, version = self.protocol.partition("/")
        return {
            "protocol": self.protocol,
            "name": name,
            "version": int(version) if version.isdigit() else version,
            "about": self.about,
            "method": self.method,
            "options": plain(self.options),
            "changed": list(self.changed),
            "always": list(self.always),
            "scores": {name: str(score) if math.isinf(score) else plain(score) for name, score in self.scores.items()},
            "rows": plain(self.rows),
            "digests": plain(self.digests),
            "command": self.command,
            "machine": self.machine,
            "notes": list(self.notes),
        }

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> Report:
        """The report that `to_json` gave; a score that is null becomes NaN.

        Raises:
            ValueError: if it is something else.
        """
        try:
            scores = {str(name): math.nan if score is None else float(score) for name, score in value["scores"].items()}
            texts = ("protocol", "about", "method", "command", "machine")
            parts: dict[str, Any] = {name: str(value[name]) for name in texts if name in value}
            parts |= {name: dict(value[name]) for name in ("options", "digests") if name in value}
            parts |= {name: tuple(map(str, value.get(name, ()))) for name in ("changed", "always", "notes")}
            return Report(scores=scores, rows=tuple(dict(row) for row in value["rows"]), **parts)
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise ValueError(
                f"value: expected a report in JSON, as `kfgs evaluate --out` writes it, got something else ({error!r})"
            ) from error


def make_report(
    protocol: Any,
    method: str,
    scores: Mapping[str, float],
    rows: list[Row] | tuple[Row, ...],
    notes: Sequence[str] = (),
) -> Report:
    """The report of a protocol: a frozen dataclass with `name` and `about`, whose fields are its options."""
    options = {option.name: plain(getattr(protocol, option.name)) for option in fields(protocol)}
    usual = type(protocol)()
    changed = tuple(name for name in options if getattr(protocol, name) != getattr(usual, name))
    return Report(
        protocol=protocol.name,
        scores=dict(scores),
        rows=tuple(rows),
        method=method,
        about=protocol.about,
        options=options,
        changed=changed,
        always=getattr(protocol, "always", ()),
        notes=tuple(notes),
    )


@typed
def average(reports: Sequence[Report]) -> Report:
    """The plain mean of a protocol's scores over several scenes, as published tables have it; one row for each scene.

    Args:
        reports: of one method, protocol and options. The row of a report is named by its digest "scene", or counted.

    Raises:
        ValueError: if there is none, or protocols, options or methods differ.
    """
    if not reports:
        raise ValueError("reports: expected at least one, got none; score some scenes")
    first = reports[0]
    for i, report in enumerate(reports):
        for name in ("protocol", "options", "method"):
            if getattr(report, name) != getattr(first, name):
                raise ValueError(
                    f"reports[{i}]: expected the {name} of the first, {getattr(first, name)!r}, got "
                    f"{getattr(report, name)!r}; score all scenes alike"
                )
    rows = [{"scene": report.digests.get("scene", i), **report.scores} for i, report in enumerate(reports)]
    scores = {name: mean(report.scores[name] for report in reports) for name in first.scores}
    notes = tuple(dict.fromkeys(note for report in reports for note in report.notes))
    return replace(first, scores=scores, rows=tuple(rows), notes=notes, digests={}, command="")


def mean(values: Iterable[float]) -> float:
    """The plain mean; NaN of nothing."""
    listed = list(values)
    return sum(listed) / len(listed) if listed else math.nan


def _short(value: Any) -> str:
    if isinstance(value, list | tuple) and len(value) > SHOWN:
        return f"{len(value)} values"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def plain(value: Any) -> Any:
    """A value as JSON holds it: numbers that are not finite become None, tuples lists, tensors nested lists."""
    if isinstance(value, bool | str | int) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset | range):
        return [plain(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return {entry.name: plain(getattr(value, entry.name)) for entry in fields(value)}
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"value: expected something that JSON can hold, got {type(value).__name__}; convert it first")
