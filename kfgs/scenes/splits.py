"""Split views into training and test views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from .._check import check_choice
from .._files import Names, file_stem, read_json, read_text
from .files import SceneError, scene_error, some

SplitRule = Literal["df3dgs", "feature3dgs", "holdout8", "all"]
RULES: tuple[SplitRule, ...] = ("df3dgs", "feature3dgs", "holdout8", "all")
SCANNETPP = "train_test_lists.json"
LONG_VIDEO = 200  # frames of Replica: neighbours show the same, so that every tenth is enough
Split = tuple[dict[str, list[int]], list[str]]
"""The indices of each split in the order of the scene, and notes."""


def make_split(count: int, rule: SplitRule) -> dict[str, list[int]]:
    """Split `count` views (in natural order of their names) by a named rule.

    `"df3dgs"`: the paper's, every 10th view from the 1st tests, every 10th from the 6th trains, the others are unused
    (Sec. 4.1); `"feature3dgs"`: Feature 3DGS's of Replica, every 8th from the 3rd tests, the rest trains; `"holdout8"`: every 8th
    from the 1st tests, the rest trains; `"all"`: all train.
    """
    check_choice("split", rule, RULES)
    if rule == "all":
        return {"train": list(range(count)), "test": []}
    step, first = {"df3dgs": (10, 0), "feature3dgs": (8, 2), "holdout8": (8, 0)}[rule]
    test = list(range(first, count, step))
    train = range(5, count, step) if rule == "df3dgs" else sorted(set(range(count)) - set(test))
    return {"train": list(train), "test": test}


def choose_split(count: int, video: bool = False) -> SplitRule:
    """The rule for a scene without a split: `"holdout8"` from 8 images, else `"all"`; of a long video the paper's."""
    if video and count >= LONG_VIDEO:
        return "df3dgs"
    return "holdout8" if count >= 8 else "all"


def read_split(folder: Path, names: Sequence[str]) -> Split | None:
    """The split that lists of views in a folder give; None if there is none.

    They are in `split.json`, {"train": [names], "test": [names], ...}; else in `train.txt`, `val.txt` and `test.txt`, also as
    `train_list.txt`, a name per line (3DGS and Occam's LGS put a `test.txt` next to the model); else in ScanNet++'s
    `train_test_lists.json`.
    """
    places = [(split, folder / f"{split}{end}") for end in ("_list.txt", ".txt") for split in ("train", "val", "test")]
    texts = {split: file for split, file in places if file.is_file()}
    tables = [folder / name for name in ("split.json", SCANNETPP) if (folder / name).is_file()]
    if texts and tables[:1] != [folder / "split.json"]:
        with scene_error():
            lines = {split: read_text(file, "a list of names of views").split("\n") for split, file in texts.items()}
        lists = {split: [line.strip() for line in text if line.strip()] for split, text in lines.items()}
        where = folder / ", ".join(file.name for file in texts.values())
        return split_by_lists(str(where), lists, names) if any(lists.values()) else None
    if not tables:
        return None
    with scene_error(after="; repair the file or remove it"):
        value = read_json(tables[0])
    lists = {name: words for name, words in value.items() if isinstance(words, list)} if isinstance(value, dict) else {}
    if "train" not in lists or not all(isinstance(word, str) and word for words in lists.values() for word in words):
        expected = '{"train": [names], "test": [names]} (stems are enough)'
        raise SceneError(f"{tables[0]}: expected {expected}, got {str(value)[:80]}; there must be a 'train'")
    return split_by_lists(str(tables[0]), lists, names)


def split_by_lists(
    where: str, lists: Mapping[str, Sequence[str]], names: Sequence[str], *, held_out_wins: bool = False
) -> Split:
    """Splits from lists of names, with or without their folders and suffixes; `where` is the lists' place, for messages.

    What no list has is in no split; without a list for training, it trains. Without test, `val` is tested too. A view for
    training that is held out, too, is an error; or it does not train, unless no other does (`held_out_wins`).
    """
    known, place = Names(names, bare=True), {name: i for i, name in enumerate(names)}
    indices = {split: [place.get(known.find(name) or "") for name in listed] for split, listed in lists.items()}
    splits = {split: sorted({i for i in found if i is not None}) for split, found in indices.items()}
    splits["test"] = splits.get("test") or splits.get("val", [])
    listed = {i for views in splits.values() for i in views}
    splits = {"train": [i for i in range(len(names)) if i not in listed], **splits}
    wanted = [name for words in lists.values() for name in words]
    unknown = [name for name in wanted if known.find(name) is None]
    if not splits["train"] or not listed:
        got = f"none of {len(wanted)} listed is there" if unknown else "all of them for the test"
        expected = f"training views among the scene's {len(names)} pictures ({some(list(names), 3)})"
        raise SceneError(f"{where}: expected {expected}, got {got} ({some(unknown or wanted, 3)}); correct the names")
    advice = known.advice(unknown[0]) if unknown else ""
    notes = [f"{len(unknown)} names in {where} are not in the scene: {some(unknown)} ({advice})"] * (len(unknown) > 0)
    both = sorted(set(splits["train"]) & {*splits["test"], *splits.get("val", ())})
    if both and not held_out_wins:
        got = f"{file_stem(names[both[0]])} and {len(both) - 1} more are in both"
        advice = "scores on training views mean nothing: remove them from one"
        raise SceneError(f"{where}: expected train and test without a common view, {got}; {advice}")
    if both and (own := [i for i in splits["train"] if i not in both]):
        splits["train"] = own
        notes.append(f"{len(both)} views for training are validation or test views, too: they do not train")
    elif both:
        splits = {"train": both, "test": []}
        notes.append("all training views are validation or test views, too: none is held out")
    return splits, notes
