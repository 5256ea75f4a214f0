"""The command features: a teacher's maps of a scene, and tables of the words, or examples, that are asked for."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import kfgs

from .._files import check_output, read_json, read_text
from .files import open_field, say, wrote
from .options import Classes, Flag, Given, Name, Positional, Teacher, Views

TABLE = "text.safetensors"


def features(
    source: Positional[Given[Path]] = None,
    *,
    out: Given[Path] = None,
    words: Name = None,
    examples: Given[Path] = None,
    fast: Flag = False,
    views: Views,
    teacher: Teacher,
) -> None:
    """Run a teacher over a scene's pictures and store its feature maps, and embed the words that you will ask for.

    Pictures are processed one at a time; after a kill, the same command continues with the next picture. Without a teacher,
    existing maps are checked. Other commands take the table of words as --text, and find SCENE/text.safetensors themselves.

    Examples:
        kfgs features scene/ --words wall,floor,chair,plant --teacher lseg --weights demo_e200.ckpt
        kfgs features scene/ --teacher dinov2 --weights facebook/dinov2-small --out maps/
        kfgs features scene/ --out maps/    # checks maps by Feature 3DGS, or in .npy or .safetensors
        kfgs features --words "chair;armchair,plant" --teacher lseg --weights demo_e200.ckpt --out words.safetensors
        kfgs features run/field.kfgs --examples clicks.json --out shown.safetensors    # for a teacher without text

    In clicks.json each class has its examples: {"chair": [{"view": "a.png", "points": [[x, y]]}, {"view": "b.png",
    "box": [x0, y0, x1, y1]}, {"gaussians": [3, 14]}], ...}. A mask of Segment Anything is {"view": "a.png", "segmentation":
    {"size": ..., "counts": ...}}, or {"view": "a.png", "masks": "a.json", "index": 3} for one of a file. An annotations.json
    in the format of COCO will do, too: each category is a class.

    Args:
        source: A scene: folder with images and a COLMAP model or transforms.json. With --examples, the field. Without it, only
            --words are embedded.
        out: Folder for the maps, by default SCENE/features. Without a scene: the table to write (.safetensors). With
            --examples, a picture of them is written next to it (OUT.png): see there whether the clicks hit what you mean.
        words: Words between commas, a .txt file (a class a line), or a .json file (a list). Synonyms follow a semicolon:
            "chair;armchair;seat" is called chair. With a scene they go to SCENE/text.safetensors.
        examples: A .json file of examples, or COCO's annotations, instead of words.
        fast: One pass over each picture instead of the exact evaluation at several scales (lseg).
    """
    from torch import Tensor

    from ..evaluation.coco import load_coco_examples
    from ..fields.examples import read_examples
    from ..scenes.load import scene_root
    from ..viz import draw_examples
    from ..viz.films import show_photos
    from ..viz.pictures import save_picture

    if examples is not None:
        if source is None:
            raise ValueError("source: expected the field of the examples, got none; pass RUN/field.kfgs")
        file, field, content = _table(out), open_field("source", source), read_json(examples)
        coco = isinstance(content, dict) and {"images", "annotations", "categories"} <= set(content)
        shown = load_coco_examples(examples) if coco else read_examples(examples)
        made = kfgs.label_set_from_examples(field, shown)
        made.save(file)
        written, photos = [file], Classes().photos_of(field)
        if photos is not None and any(not isinstance(example, Tensor) for kind in shown.values() for example in kind):
            written.append(file.with_name(f"{file.name}.png"))
            save_picture(written[-1], draw_examples(field.cameras, shown, show_photos(photos)))
        say(f"{len(made)} classes, {made.dim} channels each, by examples: {', '.join(made.names)}")
        wrote(written)
        return
    if source is None and words is None:
        raise ValueError("source, words: expected a scene, or words to embed, got neither; see `kfgs features --help`")
    folder = None if source is None else scene_root(source)
    table = None if words is None else _table(out if folder is None else folder / TABLE)
    if table is not None and teacher.teacher is None:
        raise ValueError("words: expected --teacher with it, whose text encoder embeds them, got none; pass --teacher")
    listed = [] if words is None else read_words(words)
    target = None if folder is None else out or folder / "features"
    if target is not None:
        check_output("out", target, "a folder")
    scene = None if source is None else views.load(source)
    network = teacher.load(**({"fast": True} if fast else {}))
    if table is not None:
        made = kfgs.make_label_set(network, listed)
        made.save(table)
        templates = ", ".join(map(repr, made.info["templates"]))
        say(f"{len(made)} classes, {made.dim} channels each, by {made.info['teacher']['name']}, as {templates}")
        for name, more in made.info["synonyms"].items():
            say(f"  {name}: also {', '.join(more)}")
    if target is not None:
        _make_maps(network, scene, target, views.split)
        given = "" if out is None else f" --features {out}"
        say(f"next: kfgs fit {source} --out run{given}" + ("" if views.split == "train" else f" --split {views.split}"))
    if network is not None:
        wrote([place for place in (table, target) if place is not None])


def _make_maps(network: Any, scene: Any, target: Path, split: str) -> None:
    """Make the maps of a teacher; without one, check those that are there."""
    if network is not None:
        kfgs.extract_features(network, scene, target, split, progress=True)
        maps = kfgs.FeatureFolder(target).of(scene, split)
        teacher = (maps.identity or {}).get("name", "unknown")
        say(f"{len(maps)} maps of {' x '.join(map(str, maps.shape))} by {teacher}")
        return
    if not target.is_dir():
        raise ValueError(f"teacher: expected a teacher, or maps in {target} to check, got neither; pass --teacher")
    problems, count = kfgs.FeatureFolder(target).check(scene, split), len(scene.views(split))
    say(f"{target}: {count - len(problems)} of {count} views have a map that fits")
    for name, text in problems.items():
        say(f"{name}: {text}")
    if problems:
        raise ValueError(
            f"out: expected a map that fits for each of the {count} views of split {split!r}, got {len(problems)} that are "
            "missing or do not fit (named above); make these maps again, or name the photos to use in SCENE/split.json"
        )


def _table(out: Path | None) -> Path:
    """The file of a table, checked."""
    table = Path(TABLE) if out is None else out
    if table.suffix != ".safetensors" or table.is_dir():
        raise ValueError(f"out: expected a file whose name ends in .safetensors, got {table}; give another name")
    check_output("out", table, "a file")
    return table


def read_words(words: str) -> list[str]:
    """Class names from a .json list, a .txt file with a class a line, or words between commas.

    Text with neither ending is words, even if a folder has the same name; a file with another ending is an error.
    """
    kind = Path(words).suffix.lower()
    listed: Any = words.split(",")
    if kind == ".json":
        listed = read_json(words, "a JSON file with a list of classes")
    elif kind == ".txt":
        listed = read_text(words, "a text file with a class a line").splitlines()
    elif os.path.isfile(words):  # False, not an error, for words that no file name could hold
        expected = "a .json or .txt file, or words between commas"
        raise ValueError(f"words: expected {expected}, got {words}; write one of these")
    if not isinstance(listed, list) or not all(isinstance(word, str) for word in listed):
        expected = f'a list of words like ["wall", "floor"] in {words}'
        raise ValueError(f"words: expected {expected}, got {listed!r:.80}; write one")
    listed = [word.strip() for word in listed if word.strip()]
    if not listed:
        raise ValueError(f"words: expected at least one word, got none in {words!r}; write wall,floor or name a file")
    return listed
