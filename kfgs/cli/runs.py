"""The command runs: the fields of a run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import tyro

from .files import check_alone
from .options import Positional
from .output import say

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.

Key = Annotated[str | None, tyro.conf.arg(metavar="KEY", help_behavior_hint="")]


def runs(run: Positional[Path], *, compare: Key = None, restore: Key = None) -> None:
    """List the fields of a run folder: the current one, and earlier ones that `kfgs fit` kept when another took their place.

    Examples:
        kfgs runs run/
        kfgs runs run/ --compare 3f2a    # what differs from the current one
        kfgs runs run/ --restore 3f2a    # RUN/field is that one again; the current one is kept

    Args:
        run: The folder that `kfgs fit` wrote to (its --out).
        compare: Key of an earlier field, or its first digits: say what differs between it and the current one.
        restore: Key of an earlier field, or its first digits: make it the current one.
    """
    from ..pipeline.runs import find_run_field, list_fields, restore_field

    if restore is not None:
        check_alone("compare", compare, "with --restore")
        field = restore_field(run, restore)
        say(f"{field.path} is now {field}")
        return
    fields = list_fields(run)
    if compare is not None:
        _compare(find_run_field(run, compare), fields[0])
        return
    for field in fields:
        say(f"{'current' if field.current else '       '}  {field}")
    if len(fields) > 1:
        say(f"next: kfgs runs {run} --compare KEY, or --restore KEY; to delete an earlier one, delete its folder")


def _compare(field: Any, current: Any) -> None:
    from ..pipeline.runs import compare_fields

    rows = compare_fields(field, current)
    if not rows:
        say(f"{field.key} and {current.key}: no difference")
        return
    rows = [("", field.key, current.key + (" (current)" if current.current else "")), *rows]
    widths = [max(len(row[i]) for row in rows) for i in range(2)]
    for name, one, other in rows:
        say(f"{name:<{widths[0]}}  {one:<{widths[1]}}  {other}")
    say(f"their scores: kfgs compare {field.path} {current.path}")
