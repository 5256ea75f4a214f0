"""Split views into training and test views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from .._check import check_choice
from .._files import Names, file_stem, read_text
from .files import SceneError, read_scene_json, some

SplitRule = Literal["df3dgs", "feature3dgs", "holdout8", "all"]
RULES: tuple[SplitRule, ...] = ("df3dgs", "feature3dgs", "holdout8", "all")
SCANNETPP = "train_test_lists.json"
LONG_VIDEO = 200  # frames of Replica: neighbours show the same, so that every tenth is enough


def split_every(count: int, *, step: int, test_start: int = 0, train_start: int | None = None) -> dict[str, list[int]]:
    """Take every `step`-th view for the test; train on every `step`-th from `train_start`, or on all the rest.

    Args:
        count: number of views, in order.
        step: distance between two test views (and between two training views).
        test_start: the first test view, counted from 0.
        train_start: the first training view; None trains on everything that is not tested.

    Returns:
        `{"train": indices, "test": indices}`, ascending and disjoint.

    Raises:
        ValueError: if `step` is not positive, a start is outside `[0, step)`, or the two starts coincide.

    Example:
        >>> split_every(20, step=10, train_start=5)
        {'train': [5, 15], 'test': [0, 10]}
    """
    if step < 1:
        raise ValueError(f"step: expected a positive number of views, got {step}; 10 is the paper's")
    for name, start in (("test_start", test_start), ("train_start", train_start)):
        if start is not None and not 0 <= start < step:
            raise ValueError(f"{name}: expected a view in [0, {step}) (step), got {start}; count the first view as 0")
    if train_start == test_start:
        raise ValueError(f"train_start: expected another view than test_start, got {train_start} for both; shift one")
    test = list(range(test_start, count, step))
    if train_start is not None:
        return {"train": list(range(train_start, count, step)), "test": test}
    held = set(test)
    return {"train": [i for i in range(count) if i not in held], "test": test}


def make_split(count: int, rule: SplitRule) -> dict[str, list[int]]:
    """Split `count` views (in natural order of their names) by a named rule.

    Args:
        count: number of views.
        rule: `"df3dgs"`: the paper's, every 10th view from the 1st tests, every 10th from the 6th trains, the others
            are unused (Sec. 4.1); `"feature3dgs"`: Feature 3DGS's of Replica, every 8th from the 3rd tests, the rest trains;
            `"holdout8"`: every 8th from the 1st tests, the rest trains; `"all"`: all train.

    Raises:
        ValueError: if the rule is unknown.
    """
    check_choice("split", rule, RULES)
    if rule == "df3dgs":
        return split_every(count, step=10, train_start=5)
    if rule == "feature3dgs":
        return split_every(count, step=8, test_start=2)
    if rule == "holdout8":
        return split_every(count, step=8)
    return {"train": list(range(count)), "test": []}


def choose_split(count: int, video: bool = False) -> SplitRule:
    """The rule for a scene without a split: `"holdout8"` from 8 images, else `"all"`; of a long video the paper's."""
    if video and count >= LONG_VIDEO:
        return "df3dgs"
    return "holdout8" if count >= 8 else "all"


def read_split(path: str | Path, names: Sequence[str]) -> tuple[dict[str, list[int]], list[str]]:
    """Read a split.json: `{"train": [names], "test": [names]}`; more splits are allowed. Without test, `val` is tested.

    Args:
        path: the file.
        names: the views of the scene in order; those in the file may lack the suffix.

    Returns:
        The indices of each split in the order of the scene, and a note if the scene does not have all names.

    Raises:
        FileNotFoundError: if there is no such file.
        SceneError: if the file is something else, no training view is in the scene, or a view is in both train and test.
    """
    value = read_scene_json(path, "repair the file or remove it")
    if not _is_split(value):
        raise SceneError(
            f'{path}: expected {{"train": [names], "test": [names]}}, got {str(value)[:80]}; '
            "list file stems under at least 'train'"
        )
    return split_by_lists(str(path), value, names)


def split_by_lists(
    where: str, lists: Mapping[str, Sequence[str]], names: Sequence[str]
) -> tuple[dict[str, list[int]], list[str]]:
    """Splits from lists of names. What no list has is in no split; without a list for training, it trains.

    Args:
        where: the lists come from, for messages.
        lists: names of views by split, with or without their folders and suffixes. Without test, `val` is tested too.
        names: the views of the scene in order.

    Returns:
        The indices of each split in the order of the scene, and a note if the scene does not have all names.

    Raises:
        SceneError: if no training view is in the scene, or a view is in both train and test.
    """
    known, place = Names(names, bare=True), {name: i for i, name in enumerate(names)}
    found = {split: [known.find(name) for name in listed] for split, listed in lists.items()}
    splits = {split: sorted({place[name] for name in listed if name is not None}) for split, listed in found.items()}
    splits["test"] = splits.get("test") or splits.get("val", [])
    listed = {i for views in splits.values() for i in views}
    splits = {"train": [i for i in range(len(names)) if i not in listed], **splits}
    wanted = [name for names_of in lists.values() for name in names_of]
    unknown = [name for name in wanted if known.find(name) is None]
    if not splits["train"] or not listed:
        got = f"none of {len(wanted)} listed is there" if unknown else "all of them for the test"
        raise SceneError(
            f"{where}: expected training views among the scene's {len(names)} pictures ({some(list(names), 3)}), got {got} "
            f"({some(unknown or wanted, 3)}); correct the names"
        )
    both = sorted(set(splits["train"]) & {*splits["test"], *splits.get("val", ())})
    if both:
        shown = f"{file_stem(names[both[0]])} and {len(both) - 1} more"
        raise SceneError(
            f"{where}: expected train and test without a common view, {shown} are in both; scores on training views mean "
            "nothing: remove them from one"
        )
    advice = known.advice(unknown[0]) if unknown else ""
    note = f"{len(unknown)} names in {where} are not in the scene: {some(unknown)} ({advice})"
    return splits, [note] if unknown else []


def read_lists(folder: Path, names: Sequence[str]) -> tuple[dict[str, list[int]], list[str]] | None:
    """Read the lists of views in a folder, as other programs write them; None if there is none.

    They are `train.txt`, `val.txt` and `test.txt`, also as `train_list.txt`: a name per line (3DGS and Occam's LGS put a
    `test.txt` beside the model); or ScanNet++'s `train_test_lists.json`.

    Raises:
        SceneError: if a list is no text, or no training view is in the scene.
    """
    lists: dict[str, list[str]] = {}
    for split in ("train", "val", "test"):
        file = next(
            (folder / name for name in (f"{split}.txt", f"{split}_list.txt") if (folder / name).is_file()), None
        )
        if file is not None:
            try:
                lines = read_text(file, "a list of names of views").split("\n")
            except ValueError as error:
                raise SceneError(str(error)) from error
            lists[split] = [line.strip() for line in lines if line.strip()]
    where = ", ".join(f"{split}.txt" if (folder / f"{split}.txt").is_file() else f"{split}_list.txt" for split in lists)
    if not lists and (folder / SCANNETPP).is_file():
        value, where = read_scene_json(folder / SCANNETPP, "correct it or remove it"), SCANNETPP
        lists = {name: value[name] for name in ("train", "val", "test") if isinstance(value, dict) and name in value}
        if not _is_split(lists):
            raise SceneError(
                f"{folder / SCANNETPP}: expected lists train and test, got {value!r:.80}; correct it or remove it"
            )
    return split_by_lists(str(folder / where), lists, names) if any(lists.values()) else None


def _is_split(value: Any) -> bool:
    if not isinstance(value, dict) or "train" not in value:
        return False
    return all(isinstance(v, list) and all(isinstance(s, str) and s for s in v) for v in value.values())
