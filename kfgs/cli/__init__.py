"""The command line: `kfgs COMMAND ...`; `kfgs --help` lists the commands.

Every command names the files it wrote, shows progress on long work, and ends with 0 (done), 1 (bad input, with one
message that says what to do), 2 (wrong usage), 130 (interrupted; demo, features, fit, color and batch
continue where they stopped) or 141 (its output was closed). Heavy imports happen inside the commands, or by names of `kfgs`,
which are imported when first used, so that `kfgs --help` answers at once.
"""

from __future__ import annotations

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
from dataclasses import is_dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, get_type_hints

import tyro
from tyro.conf import DisallowNone, FlagCreatePairsOff, OmitArgPrefixes, PositionalMetavarFromFieldName

import kfgs

from .._card import error_line, short_of_memory
from .._interrupts import interruptible
from .ask import select, view
from .draw import evaluate, render, segment
from .features import features
from .files import check_outputs, notes_as_lines, say
from .fit import batch, color, demo, fit, sfm
from .splats import attach, convert, edit

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
STYLE = (DisallowNone, FlagCreatePairsOff, OmitArgPrefixes, PositionalMetavarFromFieldName)


def main(arguments: list[str] | None = None) -> int:
    """Run one command; return the exit code."""
    if arguments is None and sys.flags.optimize > 1:  # -OO: without docstrings, which help shows; -O keeps them
        os.environ |= {"PYTHONOPTIMIZE": "1", "PYTHONSAFEPATH": "" if sys.path[0] == os.getcwd() else "1"}  # no -m
        os.execv(sys.executable, [sys.executable, "-m", "kfgs", *sys.argv[1:]])
    # Read when torch is first imported: waiting threads sleep instead of spinning. With other busy programs this makes 25
    # training steps a second instead of one (measured on two cores).
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if not sys.stderr.isatty():  # read when tqdm is imported: a log gets two lines a minute, not ten a second
        os.environ.setdefault("TQDM_MININTERVAL", "30")
    home = os.path.expanduser("~")  # shells leave `--out=~/run` as it is
    words = sys.argv[1:] if arguments is None else arguments
    words = [re.sub("^(--[^=]+=|)~(?=/|$)", lambda start: start[1] + home, word) for word in words]
    name, *given = [word for word in words if word != STRICT] or [""]
    command = COMMANDS.get("convert" if name == "info" else name)  # `kfgs info PATH`: convert without a target
    names = {} if command is None else shown_names(command)
    names |= {"classes": names.get("text", "classes"), "folder": names.get("out", "folder")}  # those of functions

    def failed(message: object) -> int:
        say(f"error: {in_options(str(message), names)}", sys.stderr)
        return 1

    try:
        if os.stat(".").st_nlink == 0:  # torch's libraries would end the process
            raise OSError("expected a working directory, got one that was deleted; change to another (cd)")
        if name == "--version":
            say(f"kfgs {kfgs.__version__}")
        elif name in ("-h", "--help"):
            say(_overview())
        elif command is None:
            near = difflib.get_close_matches(name, COMMANDS, n=1)
            hint = f"did you mean {near[0]!r}?" if near else "`kfgs --help` lists them"
            say(f"error: expected a command, got {repr(name) if name else 'none'}; {hint}", sys.stderr)
            raise SystemExit(2)
        elif any(word == "" or re.fullmatch("--[^=]+=", word) for word in given):
            raise ValueError("argument: expected a text, got an empty one; leave it out, or write . for this folder")
        elif "set" in names and ("--set=help" in given or ("--set", "help") in pairwise(given)):  # needs no folders
            listing, prog = documented(command, Path(), Path()), f"kfgs {name}"
            tyro.cli(listing, prog=prog, args=given, config=STYLE, return_unknown_args=True)
        else:
            with interruptible(), notes_as_lines(lambda note: in_options(note, names), strict=STRICT in words):
                about = _description(command)
                tyro.cli(documented(command), prog=f"kfgs {name}", description=about, args=given, config=STYLE)
        sys.stdout.flush()
        return 0
    except KeyboardInterrupt:
        say("interrupted" + ("; the same command continues where it stopped" if name in RESUMED else ""), sys.stderr)
        return 130
    except BrokenPipeError:  # the reader has ended, for instance `head`
        with suppress(OSError):  # else the interpreter tries to write what is left, and complains
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (ValueError, TypeError, OSError, ImportError, IndexError, ArithmeticError, NotImplementedError) as error:
        return failed(error)
    except (MemoryError, RuntimeError) as error:
        if not short_of_memory(error):
            raise
        advice = "close other programs, give fewer or smaller inputs, or use a larger machine"
        return failed(f"expected enough memory, but it ran out ({error_line(error)}); {advice}")


def documented(command: Callable[..., None], *folders: Path) -> Callable[..., None]:
    """The command, after its first `folders`, as tyro reads it: each option's text on one line. It writes over no input."""
    signature = inspect.signature(functools.partial(command, *folders))

    def run(*arguments: Any, **options: Any) -> None:
        given = signature.bind(*arguments, **options).arguments
        groups = [vars(value) for value in given.values() if is_dataclass(value)]
        named = given | {name: value for group in groups for name, value in group.items()}
        check_outputs(named, "features" if command is features else None)
        command(*folders, *arguments, **options)

    run.__annotations__ = get_type_hints(command, include_extras=True)
    vars(run)["__signature__"] = signature
    run.__doc__ = re.sub(r"\n {8,}(?!kfgs)", " ", inspect.getdoc(command) or "")
    return run


def _overview() -> str:
    """The text of `kfgs --help`: a line for each command."""
    about = "Decoupled semantic fields of 3-D Gaussians: distil, compress, segment, label, edit."
    lines = ["usage: kfgs COMMAND ...", "", about]
    for title, commands in GROUPS.items():
        lines += ["", f"{title}:"]
        for command in commands:
            summary = (inspect.getdoc(command) or "").split("\n\n")[0]
            lines.append(_wrap(f"  {command.__name__:<10s}{' '.join(summary.split())}", " " * 12))
    return "\n".join(lines) + (
        "\n\n`kfgs COMMAND --help` has the options and examples; `kfgs --version` says which kfgs this is.\n"
        f"{STRICT}, with any command, refuses files of which broken parts are otherwise left out with a note."
    )


def _description(command: Callable[..., None]) -> str:
    """A command's docstring without the options. The indent keeps tyro from joining lines."""
    first, *more = (inspect.getdoc(command) or "").split("\n\nArgs:")[0].split("\n\n")
    parts = ["\n" + part if part.startswith("Examples:") else _wrap("  " + part, "  ") for part in more]
    return "\n".join([_wrap(first, "  "), *parts])


def _wrap(text: str, indent: str = "") -> str:
    return textwrap.fill(text, min(100, shutil.get_terminal_size().columns) - 2, subsequent_indent=indent)


def shown_names(kind: Any) -> dict[str, str]:
    """The command-line names of a command's parameters, or of the fields of its options: SCENE, --splat-scene."""
    shown: dict[str, str] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if is_dataclass(hint):
            shown |= shown_names(hint)
        elif name != "return":
            positional = tyro.conf.Positional in getattr(hint, "__metadata__", ())
            shown[name] = name.upper() if positional else "--" + name.replace("_", "-")
    return shown


def in_options(message: str, names: dict[str, str]) -> str:
    """A message about arguments as one about options: "splat_scene: expected" becomes "--splat-scene: expected"."""
    about, colon, rest = message.partition(": ")
    arguments = about.split(", ")
    if colon and all(argument in names for argument in arguments):
        about = ", ".join(dict.fromkeys(names[argument] for argument in arguments))
    return about + colon + rest
