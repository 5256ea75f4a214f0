"""Words and teachers: the command text, and any phrase as a query."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from .checks import check_alone, open_field
from .say import field_classes, find_classes, load_classes, say, wrote

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.


def text(
    names: Annotated[str | None, tyro.conf.Positional] = None,
    teacher: str | None = None,
    out: Path = Path("text.safetensors"),
    weights: str | None = None,
    templates: str | None = None,
    negatives: bool = True,
    examples: Path | None = None,
    field: Path | None = None,
) -> None:
    """Make classes for all other commands (--text): embed words with a teacher's text encoder, or show examples.

    Args:
        names: classes.json (a list), a .txt file (a class a line), or words between commas. A class may have synonyms:
            "chair;armchair;seat" is called chair.
        teacher: lseg, clip, siglip, ... (a wrong name lists them), or package.module:name of your own.
        examples: a .json file in place of words, for a teacher without text: {"chair": [{"view": "a.png", "points": [[x, y]]},
            {"view": "b.png", "box": [x0, y0, x1, y1]}, {"gaussians": [3, 14]}], ...}; beside --field.
        field: the field folder that the examples are shown in.
        out: the table to write, .safetensors; as SCENE/text.safetensors it is found by itself.
        weights: checkpoint file (lseg), or folder or hub id (the others).
        templates: bare (as LSeg and the paper), clip7, tcl9, siglip, or one of your own with {} for the word; what suits
            the teacher when not given.
        negatives: embed LERF's canonical words (object, things, stuff, texture) as well, for `kfgs select --negatives
            canonical`.
    """
    from ..labels import CANONICAL
    from ..labels.label_set import SUFFIX
    from ..teachers.prompts import template_set

    if out.suffix != SUFFIX or out.is_dir():
        raise ValueError(f"out: expected a file whose name ends in {SUFFIX}, got {out}; give another name")
    if examples is not None:
        for name, given in (("names", names), ("teacher", teacher), ("weights", weights), ("templates", templates)):
            check_alone(name, given, "beside --examples, which take the place of words")
        if field is None:
            raise ValueError(
                "field: expected --field beside --examples, got none; pass the field that they are shown in"
            )
        from ..fields import label_set_from_examples, read_examples

        shown = label_set_from_examples(open_field(field), read_examples(examples))
        shown.save(out)
        say(f"{len(shown)} classes, {shown.dim} channels each, by examples: {', '.join(shown.names)}")
        wrote([out])
        return
    check_alone("field", field, "without --examples, which are shown in it")
    if names is None or teacher is None:
        raise ValueError(
            "names, teacher: expected words and --teacher, or --examples and --field, got neither whole pair"
        )
    words, patterns = read_words(names), None if templates is None else template_set(templates)
    made = embed(teacher, weights, words, templates=patterns, negatives=CANONICAL if negatives else None)
    made.save(out)
    templates_used = ", ".join(map(repr, made.info["templates"]))
    say(f"{len(made)} classes, {made.dim} channels each, by {made.info['teacher']['name']}, as {templates_used}")
    for name, more in made.info["synonyms"].items():
        say(f"  {name}: also {', '.join(more)}")
    wrote([out])


def read_words(names: str) -> list[str]:
    """Class names out of a .json list, a .txt file with a class a line, or words between commas.

    What ends in neither is words, even where a folder has the same name; a file without these endings is an error.

    Raises:
        FileNotFoundError: if the file is not there.
        ValueError: if it is of another kind, or holds no words.
    """
    found: Any
    kind = Path(names).suffix.lower()
    if kind in (".json", ".txt"):
        found = _words_of_file(names, kind)
    elif os.path.isfile(names):  # False, not an error, for words that no file name could hold
        raise ValueError(
            f"names: expected a .json or .txt file, or words between commas, got {names}; write one of these"
        )
    else:
        found = names.split(",")
    if not isinstance(found, list) or not all(isinstance(word, str) for word in found):
        raise ValueError(
            f'names: expected a list of words like ["wall", "floor"] in {names}, got {found!r:.80}; write one'
        )
    words = [word.strip() for word in found if word.strip()]
    if not words:
        raise ValueError(f"names: expected at least one word, got none in {names!r}; write wall,floor or name a file")
    return words


def _words_of_file(name: str, kind: str) -> Any:
    """What a .json file holds, or the lines of a .txt file."""
    from .._files import read_json

    if not os.path.isfile(name):
        what = (
            "a JSON file there, with a list of classes" if kind == ".json" else "a text file there with a class a line"
        )
        raise FileNotFoundError(f"{name}: no such file; expected {what}")
    if kind == ".json":
        return read_json(name)
    try:
        return Path(name).read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{name}: expected a text file in UTF-8, but it cannot be read ({error}); save it so"
        ) from error


def embed(teacher: str, weights: str | None, names: Sequence[str], **options: Any) -> Any:
    """The label set that a teacher makes of words, once; `text_encoder` for more than once."""
    return text_encoder(teacher, weights)(names, **options)


def text_encoder(teacher: str, weights: str | None) -> Callable[..., Any]:
    """A function that makes label sets of words (`teachers.prompts.make_label_set`) with a teacher that is loaded now.

    The function raises a ValueError if the teacher has no text encoder.
    """
    from ..teachers.load import load_teacher
    from ..teachers.prompts import make_label_set

    loaded = load_teacher(teacher, weights)

    def encode(names: Sequence[str], **options: Any) -> Any:
        try:
            return make_label_set(loaded, names, **options)
        except NotImplementedError as error:
            raise ValueError(str(error)) from error

    return encode


def ask(
    query: str,
    sources: tuple[Path | None, Path | None, Path | None],
    teacher: str | None,
    weights: str | None,
    field: Any,
) -> tuple[Any, Any]:
    """The label set to look a query up in, and what to ask for: a class's name, or a phrase's embedding.

    Without a teacher the query is a class of the table. With one it may be any phrase, embedded in the table's templates;
    canonical negatives come from the teacher.

    Args:
        query: class name or phrase.
        sources: scene, classes and text, as `load_classes` takes them; without any the field's own.
        teacher: name of a teacher with text.
        weights: its weights.
        field: whose own label set counts where no source is given.
    """
    if teacher is None:
        check_alone("weights", weights, "without --teacher, whose weights they are")
        label_set = field_classes(field, *sources)
        try:
            return label_set, label_set.names[label_set.index(query)]
        except ValueError as error:
            raise ValueError(
                f"{error}; for any other phrase pass --teacher and --weights, or add it to the table with `kfgs text`"
            ) from error
    found = find_classes(*sources)
    there = found is not None and (any(sources[1:]) or all(path.is_file() for path in found))
    label_set = load_classes(*sources) if there else field.label_set() if "classes" in field.info else None
    asked = embed(teacher, weights, [query], templates=None if label_set is None else label_set.info.get("templates"))
    if label_set is None:
        return asked, asked.names[0]
    note_other_teacher(asked, label_set)
    name = asked.names[0]
    known = label_set.knows(name)
    if asked.dim == label_set.dim:  # else the query says what does not fit
        label_set = dataclasses.replace(
            label_set, negatives=asked.negatives, negative_names=asked.negative_names, info=asked.info
        )
    return label_set, label_set.names[label_set.index(name)] if known else asked.embeddings[0]


def note_other_teacher(asked: Any, table: Any) -> None:
    """Say where a query and the table whose classes it joins were embedded by different teachers.

    Whether the query fits the field is told apart from this, by `SemanticField.query`.
    """
    from ..labels.label_set import teacher_difference

    found = teacher_difference(asked.info, table.info)
    if found is not None:
        key, query, classes = found
        say(
            f"note: text: expected a table by the query's teacher ({key} {query!r:.40}, from --teacher and --weights), got one "
            f"by another ({classes!r:.40}); their spaces do not mix: take the table's teacher for the query, or pass a table "
            "of the query's teacher as --text"
        )
