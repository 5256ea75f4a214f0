"""Docstrings as the reference needs them.

The comments beside a function's arguments, `means: Tensor,  # [N, 3]`, become a line of its page, and those beside the fields
of a class their descriptions. `|x|` is a length: in reStructuredText alone it would be the name of a substitution. `~a` is an
operation: the default role would take the `~` for a sign of its own.
"""

from __future__ import annotations

import ast
import functools
import inspect
import io
import re
import textwrap
import tokenize
from typing import Any

from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer

plain: dict[str, list[str]] = {}  # texts of attributes, as they are written


def shapes_of(function: Any) -> list[str]:
    """What the comments of a function's arguments and of its result say, in the order of its lines."""
    try:
        source = textwrap.dedent(inspect.getsource(function))
    except (OSError, TypeError):
        return []
    tree = ast.parse(source).body[0]
    if not isinstance(tree, ast.FunctionDef):
        return []
    last = tree.body[0].lineno
    lines = {}
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and token.start[0] < last:
            lines[token.start[0]] = token.string.lstrip("# ")
    arguments = [*tree.args.posonlyargs, *tree.args.args, *tree.args.kwonlyargs]
    end = tree.returns.end_lineno if tree.returns else None
    gives = ast.unparse(tree.returns) if tree.returns else ""
    shapes = []
    for number, text in lines.items():
        names = [
            argument.arg for argument in arguments if argument.lineno == number and argument.arg not in ("self", "cls")
        ]
        named = re.match(r"(\w+): (.*)", text)
        if text.startswith(("noqa", "type:")):
            continue
        if named:  # "points: [N, 3]"
            shapes.append(f"``{named[1]}`` {named[2]}")
        elif number == end and "->" in text:  # "[N, 3] -> [N] bool", of all that is on the line
            shapes.append(re.sub(r"^->", "returns", text))
        elif number == end and (not names or re.search("Tensor|Array|ndarray", gives)):
            shapes.append(f"returns {text}")
        elif len(names) == 1:
            shapes.append(f"``{names[0]}`` {text}")
    return shapes


@functools.cache  # autodoc asks for a module's comments thousands of times
def comments_of(source: str) -> dict[tuple[str, str], str]:
    """The comments beside the fields of classes, `mask: Tensor  # [N] bool`, by the names of class and field."""
    fields = {
        field.end_lineno: (kind.name, field.target.id)
        for kind in ast.walk(ast.parse(source))
        if isinstance(kind, ast.ClassDef)
        for field in kind.body
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
    }
    comments = {}
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and token.start[0] in fields:
            text = re.sub(r"^(type: ignore\S*|noqa\S*( \S+)?) *#? *", "", token.string.lstrip("# "))
            if text:
                comments[fields[token.start[0]]] = text
    return comments


read_source = ModuleAnalyzer.analyze


def analyze(module: ModuleAnalyzer) -> None:
    """Read a module for autodoc; a comment beside a field is its description, if it has no other."""
    read_source(module)
    for key, text in comments_of(module.code).items():
        module.attr_docs.setdefault(key, [text, ""])


def add_shapes(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Put the shapes after the first paragraph of a docstring, and a backslash before each bar outside of code."""
    for number, line in enumerate(lines):
        if not line.lstrip().startswith((">>>", "...")):
            line = re.sub(r"(?<!`)`(~[^`]*)`(?!`)", r"``\1``", line)
            lines[number] = re.sub(r"(`[^`]*`)|\|", lambda match: match[1] or r"\|", line)
    if what == "attribute" or (what == "property" and "" not in lines[:-1]):  # a property may have sections
        plain[name] = list(lines)
    if what not in ("function", "method"):
        return
    shapes = shapes_of(inspect.unwrap(thing))
    if shapes:
        at = lines.index("") if "" in lines else len(lines)
        lines[at:at] = ["", "*Shapes:* " + "; ".join(shapes).replace("\\", "\\\\") + "."]


def keep_plain(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Undo what napoleon makes of an attribute's text: it takes the words before a colon for a type."""
    if what in ("attribute", "property"):
        lines[:] = plain.pop(name, lines)


def short_defaults(app: Sphinx, what: str, name: str, thing: Any, options: Any, sign: str | None, back: Any) -> Any:
    """Write `...` for a default that is made by a function: what stands there is not Python. A protocol has no arguments."""
    if what == "class" and getattr(thing, "_is_protocol", False):
        return ("", back)
    return (sign.replace("<factory>", "..."), back) if sign else None


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the hooks, before and after napoleon's, which has 500."""
    ModuleAnalyzer.analyze = analyze  # type: ignore[method-assign]
    app.connect("autodoc-process-docstring", add_shapes, priority=400)
    app.connect("autodoc-process-docstring", keep_plain, priority=600)
    app.connect("autodoc-process-signature", short_defaults)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
