"""The result of a protocol: scores that carry its name, and what is needed to get them again."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

SHOWN = 4
"""Of an option with more values, the short form only prints the number."""
Row = Mapping[str, Any]
"""One line of a report's table: "view", "text" or "class", and numbers."""


@dataclass(frozen=True, eq=False)
class Report:
    """Scores under a named protocol.

    `str(report)` is the short form, `mIoU 0.831 (kfgs-pooled/1)`; `report.text` says how it was measured.
    """

    protocol: str
    """Name and version: "kfgs-pooled/1"."""
    scores: Mapping[str, float]
    """By name; the first is the headline. NaN where nothing could be measured."""
    rows: tuple[Row, ...] = ()
    """The scores of each view or class."""
    method: str = ""
    """What was scored."""
    about: str = ""
    """What the protocol measures, in words."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """The protocol's options, plain values."""
    changed: tuple[str, ...] = ()
    """The options that are printed with the score, because they are not as published."""
    notes: tuple[str, ...] = ()
    """What decides how the score is to be read: views that were trained on, sizes, the teacher."""
    command: str = ""
    machine: str = ""

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
        """All scores, the protocol, and the options that differ from it as published."""
        numbers = ", ".join(f"{name} {value:.3f}" for name, value in self.scores.items())
        options = [f"{name}={_short(self.options[name])}" for name in self.options if name in self.changed]
        return f"{numbers} ({', '.join([self.protocol, *options])})"

    def __repr__(self) -> str:
        return f"Report({self}, {len(self.rows)} rows)"

    @property
    def text(self) -> str:
        """The long form: the scores, the protocol in words, every option, and the table."""
        lines = [f"{self.method}: {self}" if self.method else str(self)]
        lines += [f"  {self.about}"] if self.about else []
        lines += [f"  {name} = {value}" for name, value in self.options.items()]
        lines += [f"  note: {note}" for note in self.notes]
        lines += [f"  {name}: {value}" for name in ("command", "machine") if (value := getattr(self, name))]
        for row in self.rows:
            parts = (f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items())
            lines.append("    " + ", ".join(parts))
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """Plain values. NaN is null; an infinite score, such as the PSNR of equal pictures, is the text "inf"."""
        values = {entry.name: plain(getattr(self, entry.name)) for entry in fields(self)}
        infinite = {name: str(score) for name, score in self.scores.items() if math.isinf(score)}
        return values | {"scores": values["scores"] | infinite}


def make_report(
    protocol: Any, method: str, scores: Mapping[str, float], rows: Sequence[Row], notes: Sequence[str] = ()
) -> Report:
    """The report of a protocol: a frozen dataclass with `name` and `about`, whose fields are its options."""
    options = {option.name: plain(getattr(protocol, option.name)) for option in fields(protocol)}
    usual = type(protocol)()
    changed = tuple(name for name in options if getattr(protocol, name) != getattr(usual, name))
    return Report(protocol.name, dict(scores), tuple(rows), method, protocol.about, options, changed, tuple(notes))


def mean(values: Iterable[float]) -> float:
    """The plain mean; NaN of nothing."""
    listed = list(values)
    return sum(listed) / len(listed) if listed else math.nan


def plain(value: Any) -> Any:
    """A value as JSON holds it: numbers that are not finite become None, tuples lists."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


def _short(value: Any) -> str:
    if isinstance(value, list | tuple) and len(value) > SHOWN:
        return f"{len(value)} values"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
