"""The command line: `kfgs COMMAND ...`; `kfgs --help` lists the commands.

Every command names the files it wrote, shows progress on long work, and ends with 0 (done), 1 (bad input, with one
message that says what to do), 2 (wrong usage), 130 (interrupted; demo, features, fit, color and batch
continue where they stopped) or 141 (its output was closed).
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import inspect
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable
from contextlib import suppress
from typing import Any, get_type_hints

import tyro

from .._card import error_line, short_of_memory
from .._interrupts import interruptible
from .batch import batch
from .evaluate import evaluate
from .features import features
from .files import check_outputs
from .fit import color, demo, fit, sfm
from .output import open_streams, said_on_stderr, said_whole, say, warnings_as_notes
from .render import render
from .segment import segment
from .select import select
from .splats import attach, convert, edit
from .view import view

GROUPS: dict[str, tuple[Any, ...]] = {
    "Start here": (demo,),
    "Make a semantic field": (sfm, features, fit),
    "More than one machine": (batch,),
    "Ask it": (select, segment, view, render),
    "Score it": (evaluate,),
    "Splats": (color, attach, edit, convert),
}
COMMANDS = {command.__name__: command for group in GROUPS.values() for command in group}
RESUMED = {"demo", "features", "fit", "color", "batch"}  # commands that reuse their earlier work
STRICT = "--strict"  # of every command that reads files
NARROW = 40  # columns: in a few, tyro never ends
STYLE = (
    tyro.conf.DisallowNone,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.OmitArgPrefixes,
    tyro.conf.PositionalMetavarFromFieldName,
)


def main(arguments: list[str] | None = None) -> int:
    """Run one command; return the exit code."""
    open_streams()
    # Read when torch is first imported: waiting threads sleep instead of spinning. With other busy programs this makes 25
    # training steps a second instead of one (measured on two cores).
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if not sys.stderr.isatty():  # read when tqdm is imported: a log gets two lines a minute, not ten a second
        os.environ.setdefault("TQDM_MININTERVAL", "30")
    if shutil.get_terminal_size().columns < NARROW:
        os.environ["COLUMNS"] = str(NARROW)
    words, names = sys.argv[1:] if arguments is None else arguments, dict[str, str]()

    def failed(message: object) -> int:
        with suppress(OSError):  # nobody can be told
            say(f"error: {_in_options(str(message), names)}", sys.stderr)
        return 1

    try:
        return _run(words, names)
    except KeyboardInterrupt:
        goes_on = bool(RESUMED & {*words[:1]})
        with suppress(OSError):  # the same Ctrl-C may have ended who read it
            say("interrupted" + ("; the same command continues where it stopped" if goes_on else ""), sys.stderr)
        return 130
    except BrokenPipeError:
        return 141
    except (ValueError, TypeError, OSError, ImportError, ArithmeticError) as error:
        return failed(error)
    except (MemoryError, RuntimeError) as error:
        if not short_of_memory(error):
            raise
        advice = "close other programs, give fewer or smaller inputs, or use a larger machine"
        return failed(f"expected enough memory, but it ran out ({error_line(error)}); {advice}")


def _run(words: list[str], names: dict[str, str]) -> int:
    """Run the command that the words ask for; `names` receives the command-line names of its parameters."""
    name, *given = [_expand_home(word) for word in words] or [""]
    given, strict = [word for word in given if word != STRICT], STRICT in given
    name = "convert" if name == "info" else name  # `kfgs info PATH`: convert without a target
    if name not in COMMANDS:
        told = {"-h": _overview, "--help": _overview, "--version": _version}.get(name)
        say(told() if told else _unknown(name), None if told else sys.stderr)
        if told:
            return 0
        raise SystemExit(2)
    try:
        os.getcwd()
    except FileNotFoundError as error:  # torch's libraries would end the process
        raise OSError("expected a working directory, got one that was deleted; change to another (cd)") from error
    if any(word == "" or (word.startswith("--") and word.endswith("=")) for word in given):
        raise ValueError("arguments: expected a name, got an empty text; leave it out, or write . for this folder")
    command = documented(COMMANDS[name])

    def spoken(message: str) -> str:
        return _in_options(message, names)

    with interruptible(), warnings_as_notes(spoken, strict=strict), said_on_stderr(), said_whole():
        names |= _shown_names(command)
        names.setdefault("classes", names.get("text", "classes"))  # the classes come from there
        tyro.cli(command, prog=f"kfgs {name}", description=_description(command), args=given, config=STYLE)
    return 0


def documented(command: Callable[..., None]) -> Callable[..., None]:
    """The command with each option's text on one line, as tyro reads it, and with `check_outputs` before its work."""

    @functools.wraps(command)
    def run(*arguments: Any, **options: Any) -> None:
        given = inspect.signature(command).bind(*arguments, **options).arguments
        grouped = [vars(group) for group in given.values() if dataclasses.is_dataclass(group)]
        named = dict(given) | {name: value for group in grouped for name, value in group.items()}
        check_outputs(named, "features" if command.__name__ == "features" else None)
        command(*arguments, **options)

    del run.__wrapped__  # tyro would read the text of the command itself
    run.__annotations__ = get_type_hints(command, include_extras=True)
    vars(run)["__signature__"] = inspect.signature(command)
    run.__doc__ = re.sub(r"\n {8,}(?!kfgs)", " ", inspect.getdoc(command) or "")
    return run


def _version() -> str:
    from .. import __version__

    return f"kfgs {__version__}"


def _expand_home(word: str) -> str:
    """A word of the command line with `~` as the home folder: `~/scene`, `--out=~/run`."""
    from .._files import as_path

    option, _, value = word.partition("=")
    if option.startswith("--") and value.startswith("~"):
        return f"{option}={as_path(value)}"
    return str(as_path(word)) if word.startswith("~") else word


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
        [
            *lines,
            "",
            "`kfgs COMMAND --help` has the options and examples; `kfgs --version` says which kfgs this is.",
            f"{STRICT}, with any command, refuses files of which broken parts are otherwise left out with a note.",
        ]
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
    """A message about arguments as one about options: "splat_scene: expected" becomes "--splat-scene: expected"."""
    about, colon, rest = message.partition(": ")
    arguments = about.split(", ")
    if colon and all(argument in names for argument in arguments):
        about = ", ".join(dict.fromkeys(names[argument] for argument in arguments))
    return about + colon + rest
