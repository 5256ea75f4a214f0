"""The reference of the command line, made from the commands themselves: the directive `{kfgs-commands}`."""

from __future__ import annotations

import inspect
import textwrap
import warnings
from collections.abc import Iterator
from typing import Any

import tyro
from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from kfgs import cli

REQUIRED = "(required)"


def described(command: Any) -> str:
    """What a command does, as Markdown; its examples are a block of code."""
    text = (inspect.getdoc(command) or "").split("\n\nArgs:")[0]
    says, _, examples = text.partition("\n\nExamples:\n")
    return f"{says}\n\n```bash\n{textwrap.dedent(examples).rstrip()}\n```\n"


def options_of(command: Any) -> Iterator[tuple[str, str, list[tuple[str, str]]]]:
    """Title, text and options of each group of a command's options; an option is how it is written, and its help."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        run, prog = cli.documented(command), f"kfgs {command.__name__}"
        parser = tyro.extras.get_parser(run, prog=prog, config=cli.STYLE)
    for group in parser._action_groups:
        rows = []
        for action in group._group_actions:
            if action.dest != "help":
                name = action.option_strings[-1] if action.option_strings else ""
                rows.append((" ".join(filter(None, [name, str(action.metavar or "")])), _help_of(action)))
        if rows:
            title = (group.title or "").removesuffix(" options")
            yield (
                {"positional arguments": "what to give", "options": "options"}.get(title, title),
                group.description or "",
                rows,
            )


def _help_of(action: Any) -> str:
    """What an option does; argparse writes a percent sign twice."""
    return str(action.help or "").strip().replace("%%", "%")


def table(command: Any) -> str:
    """All options of a command as Markdown tables, one for each group."""
    parts = []
    for title, text, rows in options_of(command):
        head = "| option | what it does |\n|---|---|"
        lines = [
            f"| `{name.replace('|', chr(92) + '|')}` | {told.replace('|', chr(92) + '|')} |" for name, told in rows
        ]
        about = f"**{title}**" + (f": {text}" if text else "")
        parts.append(f"{about}\n\n{head}\n" + "\n".join(lines) + "\n")
    return "\n".join(parts)


class Commands(SphinxDirective):
    """A section for each group of commands, and in it one for each command."""

    def run(self) -> list[nodes.Node]:
        """Make the sections."""
        return [
            self._section(title, [self._command(command) for command in group]) for title, group in cli.GROUPS.items()
        ]

    def _command(self, command: Any) -> nodes.section:
        inside = nodes.Element()
        text = described(command) + "\n" + table(command)
        self.state.nested_parse(StringList(text.splitlines(), "kfgs"), self.content_offset, inside)
        return self._section(f"kfgs {command.__name__}", inside.children)

    def _section(self, title: str, content: Any) -> nodes.section:
        name = nodes.make_id(title)
        section = nodes.section("", nodes.title(title, title), *content, ids=[name], names=[name])
        self.state.document.note_explicit_target(section)
        return section


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("kfgs-commands", Commands)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
