"""The command text, which makes a table of classes from words or examples; and helpers to query any phrase."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from .._files import check_output
from .files import check_alone, open_field
from .options import Classes, Flag, Given, Name, Positional, Teacher
from .output import say, wrote

# Heavy imports happen inside the functions, so that `kfgs --help` answers at once.


def text(
    names: Positional[Given[str]] = None,
    *,
    out: Path = Path("text.safetensors"),
    templates: Name = None,
    no_negatives: Flag = False,
    examples: Given[Path] = None,
    field: Given[Path] = None,
    teacher: Teacher,
) -> None:
    """Make a table of classes: embed words with a teacher's text encoder, or learn classes from examples.

    Other commands take the table as --text; SCENE/text.safetensors is found without it.

    Examples:
        kfgs text wall,floor,chair,plant --teacher lseg --weights demo_e200.ckpt --out scene/text.safetensors
        kfgs text "chair;armchair;seat,plant" --teacher clip --weights openai/clip-vit-base-patch16
        kfgs text --examples clicks.json --field run/field.kfgs    # for a teacher without text

    In clicks.json each class has its examples: {"chair": [{"view": "a.png", "points": [[x, y]]}, {"view": "b.png",
    "box": [x0, y0, x1, y1]}, {"gaussians": [3, 14]}], ...}. A mask of Segment Anything is {"view": "a.png", "segmentation":
    {"size": ..., "counts": ...}}, or {"view": "a.png", "masks": "a.json", "index": 3} for one of a file. An annotations.json
    in the format of COCO will do, too: each category is a class.

    Args:
        names: Words between commas, a .txt file (a class a line), or a .json file (a list). Synonyms follow a semicolon:
            "chair;armchair;seat" is called chair.
        out: The table to write (.safetensors). With --examples, if the field's scene is at hand, a picture of them is
            written beside it (OUT.png): see there whether the clicks hit what you mean.
        templates: Sentences around each word: bare (none, as LSeg and the paper), clip7, tcl9, siglip, or your own with {}
            for the word; by default those of the teacher.
        no_negatives: Leave out LERF's canonical words (object, things, stuff, texture), which `kfgs select --negatives
            canonical` needs.
        examples: A .json file of examples, or COCO's annotations, instead of words.
        field: The field of the examples.
    """
    from ..labels import CANONICAL
    from ..labels.label_set import SUFFIX
    from ..teachers.prompts import template_set

    if out.suffix != SUFFIX or out.is_dir():
        raise ValueError(f"out: expected a file whose name ends in {SUFFIX}, got {out}; give another name")
    check_output("out", out, "a file")
    if examples is not None:
        for name, given in ({"names": names, "templates": templates} | dataclasses.asdict(teacher)).items():
            check_alone(name, given, "with --examples, which replace words")
        if field is None:
            raise ValueError("field: expected --field with --examples, got none; pass the field of the examples")
        _text_of_examples(out, open_field("field", field), _examples(examples))
        return
    check_alone("field", field, "without --examples, which are shown in it")
    if names is None or teacher.teacher is None:
        raise ValueError(
            "names, teacher: expected words and --teacher, or --examples and --field, got neither whole pair; "
            "see `kfgs text --help`"
        )
    words, patterns = read_words(names), None if templates is None else template_set(templates)
    made = text_encoder(teacher)(words, templates=patterns, negatives=None if no_negatives else CANONICAL)
    made.save(out)
    templates_used = ", ".join(map(repr, made.info["templates"]))
    say(f"{len(made)} classes, {made.dim} channels each, by {made.info['teacher']['name']}, as {templates_used}")
    for name, more in made.info["synonyms"].items():
        say(f"  {name}: also {', '.join(more)}")
    wrote([out])


def _text_of_examples(out: Path, field: Any, examples: dict[str, Any]) -> None:
    """Write a table of examples and, if the photographs of their views are at hand, a picture of what was shown."""
    from ..fields import label_set_from_examples
    from ..viz import draw_examples, save_picture
    from ..viz.films import show_photos

    scene = Classes().scene_of(field)
    drawn = scene is not None and any(hasattr(one, "view") for shown in examples.values() for one in shown)
    made = label_set_from_examples(field, examples)
    made.save(out)
    written = [out]
    if drawn:
        written.append(out.with_name(f"{out.name}.png"))
        save_picture(written[-1], draw_examples(field.cameras, examples, show_photos(scene)))
    say(f"{len(made)} classes, {made.dim} channels each, by examples: {', '.join(made.names)}")
    wrote(written)


def _examples(path: Path) -> dict[str, Any]:
    """The examples of a file, which may be COCO's."""
    from .._files import read_json
    from ..evaluation.coco import load_coco_examples
    from ..fields import read_examples

    content = read_json(path)
    coco = isinstance(content, dict) and {"images", "annotations", "categories"} <= set(content)
    return load_coco_examples(path) if coco else read_examples(path)


def read_words(names: str) -> list[str]:
    """Class names from a .json list, a .txt file with a class a line, or words between commas.

    Text with neither ending is words, even if a folder has the same name; a file with another ending is an error.

    Raises:
        FileNotFoundError: if the file does not exist.
        ValueError: if it is no list of words, or empty.
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
    """The content of a .json file, or the lines of a .txt file."""
    from .._files import read_json, read_text

    if kind == ".json":
        return read_json(name, "a JSON file with a list of classes")
    return read_text(name, "a text file with a class a line").splitlines()


def text_encoder(teacher: Teacher) -> Callable[..., Any]:
    """Load a teacher now, and return a function that makes label sets of words (`teachers.prompts.make_label_set`).

    The function raises a ValueError if the teacher has no text encoder.
    """
    from ..teachers.load import load_teacher
    from ..teachers.prompts import make_label_set

    assert teacher.teacher is not None
    loaded = load_teacher(teacher.teacher, teacher.weights)

    def encode(names: Sequence[str], **options: Any) -> Any:
        try:
            return make_label_set(loaded, names, **options)
        except NotImplementedError as error:
            raise ValueError(str(error)) from error

    return encode


def ask(query: str, classes: Classes, teacher: Teacher, field: Any) -> tuple[Any, Any]:
    """The label set and the target of a query: the name of a class, or the embedding of a phrase.

    Without a teacher the query must be a class of the table. With a teacher it may be any phrase, embedded in the table's
    templates; canonical negatives then come from the teacher. If the options name no table, the field's classes are used.
    """
    if teacher.teacher is None:
        teacher.check_weights()
        label_set = classes.of_field(field)
        try:
            return label_set, label_set.names[label_set.index(query)]
        except ValueError as error:
            raise ValueError(
                f"{error}; for any other phrase pass --teacher and --weights, or add it to the table with `kfgs text`"
            ) from error
    found = classes.files()
    named = classes.classes is not None or classes.text is not None
    there = found is not None and (named or all(path.is_file() for path in found))
    label_set = classes.load_classes() if there else field.classes
    templates = None if label_set is None else label_set.info.get("templates")
    asked = text_encoder(teacher)([query], templates=templates)
    if label_set is None:
        return asked, asked.names[0]
    note_other_teacher(asked, label_set)
    name = asked.names[0]
    known = label_set.knows(name)
    if asked.dim == label_set.dim:  # otherwise the query raises an error
        label_set = dataclasses.replace(
            label_set, negatives=asked.negatives, negative_names=asked.negative_names, info=asked.info
        )
    return label_set, label_set.names[label_set.index(name)] if known else asked.embeddings[0]


def note_other_teacher(asked: Any, table: Any) -> None:
    """Print a note if a query and its table were embedded by different teachers.

    `SemanticField.query` checks whether the query fits the field.
    """
    from ..labels.label_set import teacher_mismatch

    difference = teacher_mismatch(asked.info, table.info)
    if difference is not None:
        say(
            f"note: --text: expected a table by the query's teacher (from --teacher and --weights), got one by another "
            f"({difference}); they cannot be compared: use the table's teacher for the query, or pass a "
            "table of the query's teacher as --text"
        )
