"""Split views into training and test views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from .._check import check_choice
from .._files import file_stem
from .files import SceneError, read_scene_json

SplitRule = Literal["df3dgs", "feature3dgs", "holdout8", "all"]
RULES: tuple[SplitRule, ...] = ("df3dgs", "feature3dgs", "holdout8", "all")
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


def read_split(path: str | Path, stems: Sequence[str]) -> tuple[dict[str, list[int]], list[str]]:
    """Read a split.json: `{"train": [stems], "test": [stems]}`; more splits are allowed.

    Args:
        path: the file.
        stems: the views of the scene in order; the names in the file may have a suffix.

    Returns:
        The indices of each split in the order of the scene, and the names that the scene does not have.

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
    index = {stem: i for i, stem in enumerate(stems)}
    splits: dict[str, list[int]] = {"train": [], "test": []}
    unknown: list[str] = []
    for name, listed in value.items():
        found = [index.get(stem, index.get(file_stem(stem))) for stem in listed]
        splits[name] = sorted({i for i in found if i is not None})
        unknown += [stem for stem, i in zip(listed, found, strict=True) if i is None]
    if not splits["train"]:
        raise SceneError(
            f"{path}: expected training views among the scene's {len(stems)} ({', '.join(stems[:3])}, ...), none of "
            f"the {len(value['train'])} listed is there ({', '.join(value['train'][:3])}); correct the names"
        )
    both = sorted(set(splits["train"]) & set(splits["test"]))
    if both:
        raise SceneError(
            f"{path}: expected train and test without a common view, {stems[both[0]]} and {len(both) - 1} more are in "
            "both; scores on training views mean nothing: remove them from one"
        )
    return splits, unknown


def read_test_list(path: Path, stems: Sequence[str]) -> dict[str, list[int]]:
    """Read a `test.txt` beside a COLMAP model, as 3DGS and Occam's LGS do: a held-out picture per line; the others train.

    Raises:
        SceneError: if a name is not in the scene, or none is left to train.
    """
    names = [line.strip() for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    index = {stem: i for i, stem in enumerate(stems)}
    found = [index.get(name, index.get(file_stem(name))) for name in names]
    unknown = [name for name, i in zip(names, found, strict=True) if i is None]
    test = {i for i in found if i is not None}
    if unknown or not 0 < len(test) < len(stems):
        got = f"{unknown[0]!r:.80}" if unknown else f"{len(test)} of them"
        raise SceneError(
            f"{path}: expected names of some of the scene's {len(stems)} pictures ({', '.join(stems[:3])}, ...), got {got}; "
            "correct the list, or choose another split"
        )
    return {"train": [i for i in range(len(stems)) if i not in test], "test": sorted(test)}


def _is_split(value: Any) -> bool:
    if not isinstance(value, dict) or "train" not in value:
        return False
    return all(isinstance(v, list) and all(isinstance(s, str) and s for s in v) for v in value.values())
