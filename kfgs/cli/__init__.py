"""The command line: `kfgs demo | sfm | plan | features | text | fit | uplift | segment | label | info | color | attach |
select | edit | convert | view`.

Every command names the files it wrote, shows progress on long work, and ends with 0 (done), 1 (bad input, with one
message that says what to do), 2 (wrong usage), 130 (interrupted; demo, features, fit and color go on where they stopped) or 141
(nobody reads its lines any more).
"""

from __future__ import annotations

import os
import sys
from typing import Any

import tyro

from .color import attach, color, convert, edit
from .look import view
from .query import select
from .say import warnings_as_notes
from .semantic import demo, fit, info, label, segment, sfm, uplift
from .teach import features, plan
from .words import text

COMMANDS: dict[str, Any] = {
    command.__name__: command
    for command in (
        demo,
        sfm,
        plan,
        features,
        text,
        fit,
        uplift,
        segment,
        label,
        info,
        color,
        attach,
        select,
        edit,
        convert,
        view,
    )
}
RESUMED = {"demo", "features", "fit", "color"}  # commands that find what they did before


def main(arguments: list[str] | None = None) -> int:
    """Run one command; return the exit code."""
    # Read when torch is first imported: waiting threads sleep instead of spinning, which beside other busy programs is
    # the difference between 25 training steps a second and one (measured on two cores).
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        with warnings_as_notes():
            tyro.extras.subcommand_cli_from_dict(
                COMMANDS,
                prog="kfgs",
                description="Decoupled semantic fields of 3-D Gaussians: distil, compress, segment, label, edit.",
                args=arguments,
            )
    except KeyboardInterrupt:
        given = sys.argv[1:] if arguments is None else arguments
        goes_on = "; the same command goes on where it stopped" if RESUMED.intersection(given[:1]) else ""
        print(f"interrupted{goes_on}", file=sys.stderr)  # noqa: T201
        return 130
    except BrokenPipeError:  # whoever read our lines has gone, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or the interpreter complains when it ends
        return 141
    except (ValueError, TypeError, OSError, ImportError, ArithmeticError) as error:
        print(f"error: {error}", file=sys.stderr)  # noqa: T201
        return 1
    return 0
