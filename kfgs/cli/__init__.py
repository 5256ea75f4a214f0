"""The command line: `kfgs COMMAND ...`; `kfgs --help` lists the commands.

Every command names the files it wrote, shows progress on long work, and ends with 0 (done), 1 (bad input, with one
message that says what to do), 2 (wrong usage), 130 (interrupted; demo, features, fit and color continue where they stopped)
or 141 (its output was closed).
"""

from __future__ import annotations

import dataclasses
import difflib
import inspect
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable
from typing import Any, get_type_hints

import tyro

from .._interrupts import interruptible
from .blocks import blocks, join
from .evaluate import compare, evaluate
from .features import features, plan
from .fit import color, demo, fit, sfm, uplift
from .output import called, said_on_stderr, say, warnings_as_notes
from .pack import pack
from .query import info, label, segment, select
from .render import render
from .runs import runs
from .splats import attach, convert, edit
from .text import text
from .view import view

GROUPS: dict[str, tuple[Any, ...]] = {
    "Start here": (demo, info),
    "Make a semantic field": (sfm, plan, features, text, fit, uplift),
    "More than one machine": (blocks, join),
    "Ask it": (select, segment, label, view, render),
    "Store it": (pack, runs),
    "Score it": (evaluate, compare),
    "Colour splats": (color, attach, edit, convert),
}
COMMANDS = {command.__name__: command for group in GROUPS.values() for command in group}
RESUMED = {"demo", "features", "fit", "color", "blocks"}  # commands that reuse their earlier work
STYLE = (
    tyro.conf.DisallowNone,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.OmitArgPrefixes,
    tyro.conf.PositionalMetavarFromFieldName,
)


def main(arguments: list[str] | None = None) -> int:
    """Run one command; return the exit code."""
    # Read when torch is first imported: waiting threads sleep instead of spinning. With other busy programs this makes 25
    # training steps a second instead of one (measured on two cores).
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if not sys.stderr.isatty():  # read when tqdm is imported: a log gets two lines a minute, not ten a second
        os.environ.setdefault("TQDM_MININTERVAL", "30")
    name, *given = [_expand_home(word) for word in (sys.argv[1:] if arguments is None else arguments)] or [""]
    if name in ("-h", "--help"):
        say(_overview())
        return 0
    if name == "--version":
        from .. import __version__

        say(f"kfgs {__version__}")
        return 0
    if name not in COMMANDS:
        say(_unknown(name), sys.stderr)
        raise SystemExit(2)
    command = COMMANDS[name]
    called[:] = ["kfgs", name, *given]
    names: dict[str, str] = {}

    def spoken(message: str) -> str:
        return _in_options(message, names)

    try:
        _check_words(given)
        with interruptible(), warnings_as_notes(spoken), said_on_stderr():
            names |= _shown_names(command)
            command.__doc__ = re.sub(
                r"\n {8,}(?!kfgs)", " ", inspect.getdoc(command) or ""
            )  # an option's text on one line
            tyro.cli(command, prog=f"kfgs {name}", description=_description(command), args=given, config=STYLE)
    except KeyboardInterrupt:
        say("interrupted" + ("; the same command goes on where it stopped" if name in RESUMED else ""), sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of the output has ended, for instance `head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or the interpreter complains when it ends
        return 141
    except (ValueError, TypeError, OSError, ImportError, ArithmeticError) as error:
        say(f"error: {spoken(str(error))}", sys.stderr)
        return 1
    return 0


def _expand_home(word: str) -> str:
    """A word of the command line with `~` as the home folder: `~/scene`, `--out=~/run`."""
    from .._files import as_path

    option, _, value = word.partition("=")
    if option.startswith("--") and value.startswith("~"):
        return f"{option}={as_path(value)}"
    return str(as_path(word)) if word.startswith("~") else word


def _check_words(words: list[str]) -> None:
    """Raise a ValueError for an empty word, which as a path would be the current folder."""
    for before, word in zip(["", *words], words, strict=False):
        option = word[:-1] if word.startswith("--") and word.endswith("=") else before if not word else None
        if option is not None:
            about = option if option.startswith("-") else "arguments"
            raise ValueError(f"{about}: expected a name, got an empty text; leave it out, or write . for this folder")


def _overview() -> str:
    """The text of `kfgs --help`: a line for each command."""
    lines = [
        "usage: kfgs COMMAND ...",
        "",
        "Decoupled semantic fields of 3-D Gaussians: distil, compress, segment, label, edit.",
    ]
    for title, commands in GROUPS.items():
        lines += ["", f"{title}:"]
        for command in commands:
            summary = (inspect.getdoc(command) or "").split("\n\n")[0]
            lines.append(_wrap(f"  {command.__name__:<10s}{' '.join(summary.split())}", " " * 12))
    return "\n".join(
        [*lines, "", "`kfgs COMMAND --help` has the options and examples; `kfgs --version` says which kfgs this is."]
    )


def _unknown(name: str) -> str:
    near = difflib.get_close_matches(name, COMMANDS, n=1)
    hint = f"did you mean {near[0]!r}?" if near else "`kfgs --help` lists them"
    return f"error: expected a command, got {repr(name) if name else 'none'}; {hint}"


def _description(command: Callable[..., None]) -> str:
    """A command's docstring without the options. The indent keeps tyro from joining lines."""
    first, *more = (inspect.getdoc(command) or "").split("\n\nArgs:")[0].split("\n\n")
    lines = [_wrap(first, "  ")]
    for part in more:
        lines.append("\n" + part if part.startswith("Examples:") else _wrap("  " + part, "  "))
    return "\n".join(lines)


def _wrap(text: str, indent: str = "") -> str:
    return textwrap.fill(text, min(100, shutil.get_terminal_size().columns) - 2, subsequent_indent=indent)


def _shown_names(kind: Any) -> dict[str, str]:
    """The command-line names of a command's parameters, or of the fields of its options: SCENE, --splat-scene."""
    found: dict[str, str] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if dataclasses.is_dataclass(hint):
            found |= _shown_names(hint)
        elif name != "return":
            positional = tyro.conf.Positional in getattr(hint, "__metadata__", ())
            shown = name.upper() if positional else "--" + name.replace("_", "-")
            found |= {name: shown, name.removeprefix("no_"): shown}
    return found


def _in_options(message: str, names: dict[str, str]) -> str:
    """A message about arguments as one about options: "splat_scene: expected" becomes "--splat-scene: expected".

    What is said in brackets for Python alone, "(in Python: ...)", is left out.
    """
    message = re.sub(r" \(in Python: (?:[^()]|\([^()]*\))*\)", "", message)
    about, colon, rest = message.partition(": ")
    arguments = about.replace("-", "_").split(", ")
    if colon and all(argument in names for argument in arguments):
        about = ", ".join(names[argument] for argument in arguments)
    for name in (name for name in names if "_" in name):  # in the text, replace only names that are no English words
        rest = re.sub(rf"\b{name}(=\w+)?\b", names[name], rest)
    return about + colon + rest
