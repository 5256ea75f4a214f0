"""A scene: posed cameras, the image files they took, a point cloud, and the views that train and that are held out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import index
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._card import html_card
from .._check import ORIGIN, check_choice, check_shapes
from .._files import Names, file_stem, read_json, read_text
from ..cameras.camera import NEAR, Camera, view_named
from ..cameras.paths import camera_extent
from ..cameras.resample import undistort
from .files import SceneError, read_alpha, read_image, read_mask, scene_error, shrink_mask, some

NEAR_SHARE = 0.1  # of the extent: 3DGS's near plane of 0.2 suits cameras 2 m apart; smaller scenes need less
ROUNDING = 1e-3  # a pixel that takes less than this from masked ones, when a lens is removed, takes nothing
RULES = {"df3dgs": slice(0, None, 10), "feature3dgs": slice(2, None, 8), "holdout8": slice(0, None, 8), "all": slice(0)}
"""Rules for splits, with the views that test."""
SCANNETPP = "train_test_lists.json"


@dataclass(frozen=True, eq=False)
class Scene(Sequence[Camera]):
    """V posed views of one place. Images are read from disk at each access.

    `scene["f01"]` is the camera of a view, `scene.image("f01")` its picture; both also take the view's index. `for camera in
    scene` goes through all, `scene.select("train")` is the scene of one split.

    **Convention**: world to camera, pixel centres on halves (`Camera`), world units of the file. Loaders put the views in
    natural order of their names.
    """

    cameras: list[Camera]
    """V cameras; a camera's name is its image's file name relative to the image folder."""
    image_paths: list[Path]
    """V files."""
    points: Tensor  # [P, 3] float32
    """The sparse cloud with its outliers (see `robust_bounds`), counted from `origin`; it may be empty (P = 0)."""
    colors: Tensor  # [P, 3] uint8
    """The colours of the cloud."""
    splits: dict[str, list[int]] = field(default_factory=dict)
    """Named lists of views; loaders give at least `train` and `test`."""
    notes: tuple[str, ...] = ()
    """Missing files and assumptions found when the scene was read."""
    lenses: list[Camera] | None = None
    """Only in an undistorted scene: the cameras with the distortion that the files on disk still have."""
    folder: Path | None = None
    """The path that the scene was loaded from."""
    masks: list[Path | None] | None = None
    """V masks of the pictures on disk, None for a view without one: what is black in it is ignored by everything."""

    def __post_init__(self) -> None:
        check_shapes(("points", self.points, "P 3"), ("colors", self.colors, "P 3"))
        views = len(self.cameras)
        for name, values in (("image_paths", self.image_paths), ("lenses", self.lenses), ("masks", self.masks)):
            if values is not None and len(values) != views:
                raise ValueError(f"{name}: expected {views} (one per camera), got {len(values)}; give one for each")
        twice = [stem for stem, n in Counter(file_stem(camera.name) for camera in self.cameras).items() if n > 1]
        if twice:
            advice = "move one of the two images away, or rename it here and in the file of the poses"
            expected = "names that differ before the suffix (features and labels are found by them)"
            raise SceneError(f"cameras: expected {expected}, got {twice[0]!r} twice; {advice}")
        for name, indices in self.splits.items():
            wrong = [i for i in indices if not 0 <= i < views]
            if wrong:
                raise ValueError(f"splits[{name!r}]: expected numbers in [0, {views}), got {wrong[0]}; correct it")
        origins = {camera.origin for camera in [*self.cameras, *(self.lenses or [])]}
        if len(origins) > 1:
            raise ValueError(f"cameras: expected one origin, got {sorted(origins)[:2]}; use camera.with_origin()")

    def __len__(self) -> int:
        return len(self.cameras)

    def __getitem__(self, view: int | str | slice) -> Any:
        """The camera of a view, by its name or index as in `index`; of a slice, a list."""
        return self.cameras[view if isinstance(view, slice) else self.index(view)]

    def __contains__(self, view: object) -> bool:
        return any(view in (camera, camera.name, file_stem(camera.name)) for camera in self.cameras)

    def index(self, view: int | str | Camera) -> int:  # type: ignore[override]  # that of a list has a start and an end
        """The index of a view from its name (with or without folder and suffix), camera or index; errors offer the nearest."""
        if isinstance(view, str | Camera):
            return self.cameras.index(view_named(self.cameras, getattr(view, "name", view), "view"))
        if not -len(self) <= index(view) < len(self):
            raise IndexError(f"view: expected a name or an index below {len(self)} (the number of views), got {view!r}")
        return range(len(self))[index(view)]

    @property
    def origin(self) -> tuple[float, float, float]:
        """The place in the world that cameras and points are counted from, in float64; (0, 0, 0) unless they are far from it."""
        return self.cameras[0].origin if self.cameras else ORIGIN

    def __repr__(self) -> str:
        splits = ", ".join(f"{name} {len(views)}" for name, views in self.splits.items())
        return f"Scene({len(self)} views, {len(self.points)} points, splits: {splits or 'none'})"

    def _repr_html_(self) -> str:
        facts = {
            "folder": None if self.folder is None else str(self.folder),
            "views": len(self),
            **{f"split {name}": len(views) for name, views in self.splits.items()},
            "pixels": some(sorted({f"{camera.width}x{camera.height}" for camera in self.cameras}), 3),
            "lens": "distorted: use scene.undistorted()" if self.distorted else "pinhole",
            "masks": None if self.masks is None else sum(mask is not None for mask in self.masks),
            "points": len(self.points),
            "extent": f"{self.extent:.4g} world units" if len(self) else None,
            "origin": ", ".join(f"{value:.15g}" for value in self.origin) if any(self.origin) else None,
            **{f"note {i}": note for i, note in enumerate(self.notes, 1)},
        }
        return html_card("Scene", facts)

    def stem(self, i: int) -> str:
        """The name of view `i` without its suffix, which its feature and label files have too."""
        return file_stem(self.cameras[i].name)

    def views(self, split: str) -> list[int]:
        """The views of a split ("all" are all views); a ValueError if there is no such split, or it is empty."""
        if split == "all" and "all" not in self.splits:
            return list(range(len(self)))
        if not self.splits.get(split):
            named = "".join(f"{name}, " for name, views in self.splits.items() if views and name != "all")
            advice = f"list its views in split.json (names of views are given as a list: [{split!r}])"
            raise ValueError(f"split: expected one of {named}all, got {split!r}; {advice}")
        return self.splits[split]

    def image(self, view: int | str | Camera) -> Tensor:  # [H, W, 3] in [0, 1]
        """Read the picture of a view; in an undistorted scene the lens is removed on the way. Transparent pixels are black."""
        i = self.index(view)
        lens = (self.lenses or self.cameras)[i]
        image = read_image(self.image_paths[i], "black")
        if image.shape[:2] != lens.size:
            expected = f"{lens.width}x{lens.height} pixels as its camera says, got {image.shape[1]}x{image.shape[0]}"
            raise SceneError(f"{self.image_paths[i]}: expected {expected}; replace it by a copy of that size")
        return image if self.lenses is None else undistort(image, lens)[0]

    def mask(self, view: int | str | Camera) -> Tensor:  # [H, W] bool
        """Which pixels of a view count: not those that are black in its mask, nor those beyond an undistorted picture."""
        i = self.index(view)
        lens = (self.lenses or self.cameras)[i]
        path = None if self.masks is None else self.masks[i]
        mask = torch.ones(lens.size, dtype=torch.bool) if path is None else read_mask(path, lens.size)
        if self.lenses is None:
            return mask
        share, _, recorded = undistort((~mask).float()[..., None], lens)
        return recorded & (share[..., 0] < ROUNDING)

    def alpha(self, i: int) -> Tensor | None:  # [H, W] in [0, 1]
        """The opacity of the picture of view `i`; None if no pixel is transparent. What is transparent is empty space."""
        alpha = read_alpha(self.image_paths[i])
        if alpha is None or self.lenses is None:
            return alpha
        return undistort(alpha[..., None], self.lenses[i])[0][..., 0]

    def counted(self, i: int, size: tuple[int, int]) -> Tensor | None:  # [h, w] bool
        """Where a map of view `i` shows something that is neither masked nor mostly transparent; None: everywhere."""
        alpha, masked = self.alpha(i), self.masks is not None and self.masks[i] is not None
        if alpha is None and not masked:
            return None
        counted = shrink_mask(self.mask(i), size) if masked else torch.ones(size, dtype=torch.bool)
        if alpha is not None:
            counted &= torch.nn.functional.adaptive_avg_pool2d(alpha[None], size)[0] > 0.5
        return counted

    @property
    def distorted(self) -> bool:
        """Whether a camera still has its lens; such a scene cannot be rasterised before `undistorted()`."""
        return any(camera.distortion is not None for camera in self.cameras)

    def undistorted(self) -> Scene:
        """The same scene without lens distortion: pinhole cameras of the same K and size, pictures undistorted lazily.

        Pixels that the lens did not record are black, and `mask` is False there.
        """
        if not self.distorted:
            return self
        return replace(self, cameras=[replace(c, distortion=None) for c in self.cameras], lenses=list(self.cameras))

    @property
    def extent(self) -> float:
        """1.1 times the largest distance of a training camera from the training cameras' mean; see `camera_extent`.

        3DGS scales the steps of positions with this length. If the `train` split is empty, all views count.
        """
        return camera_extent([self.cameras[i] for i in self.splits.get("train") or range(len(self))], self.points)

    def with_near(self) -> Scene:
        """The same scene with every camera's `near` at 0.2 world units or, if that is less, a tenth of the extent.

        Loaders call this; a scene made by hand keeps the `near` of its cameras until then.
        """
        if len(self) == 0:
            return self
        near = min(NEAR, NEAR_SHARE * replace(self, splits={}).extent) or NEAR  # 0: everything is in one point
        return replace(self, cameras=[replace(camera, near=near) for camera in self.cameras])

    def select(self, which: str | Iterable[str] | Iterable[int]) -> Scene:
        """The scene with some of its views, in the order given; points stay, splits keep their names.

        Args:
            which: the name of a split, or "all" (see `views`); or names of views (with or without suffix), or their indices.
        """
        views = self.views(which) if isinstance(which, str) else which
        indices = [self.index(view) for view in views]
        position = {view: n for n, view in enumerate(indices)}
        if len(position) != len(indices):
            raise ValueError("which: expected each view once, got one twice; remove the repetition")
        lists = {name: getattr(self, name) for name in ("cameras", "image_paths", "lenses", "masks")}
        chosen: Any = {name: values and [values[i] for i in indices] for name, values in lists.items()}
        splits = {name: sorted(position[i] for i in views if i in position) for name, views in self.splits.items()}
        return replace(self, splits=splits, **chosen)


def check_is_scene(scene: object) -> None:
    """Raise a TypeError for anything else than a scene, such as its folder."""
    if not isinstance(scene, Scene):
        raise TypeError(f"scene: expected a Scene, got {type(scene).__name__}; pass load_scene(folder)")


def as_taken(scene: Scene) -> Scene:
    """The scene with its lenses."""
    return scene if scene.lenses is None else replace(scene, cameras=scene.lenses, lenses=None)


def make_split(count: int, rule: str) -> dict[str, list[int]]:
    """Split `count` views (in natural order of their names) by a named rule.

    `"df3dgs"`: the paper's, every 10th view from the 1st tests, every 10th from the 6th trains, the others are unused
    (Sec. 4.1); `"feature3dgs"`: Feature 3DGS's of Replica, every 8th from the 3rd tests, the rest trains; `"holdout8"`: every 8th
    from the 1st tests, the rest trains; `"all"`: all train.
    """
    check_choice("split", rule, tuple(RULES))
    test = list(range(count)[RULES[rule]])
    train = range(5, count, 10) if rule == "df3dgs" else sorted(set(range(count)) - set(test))
    return {"train": list(train), "test": test}


def read_split(folder: Path, names: Sequence[str]) -> tuple[dict[str, list[int]], list[str]] | None:
    """The split that lists of views in a folder give, as indices of the scene's `names`, and notes; None if there is none.

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
) -> tuple[dict[str, list[int]], list[str]]:
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
    wanted = list(dict.fromkeys(name for words in lists.values() for name in words))
    unknown = [name for name in wanted if known.find(name) is None]
    if not splits["train"] or not listed:
        got = f"none of {len(wanted)} listed is there" if unknown else "all of them for the test"
        expected = f"training views among the scene's {len(names)} pictures ({some(list(names), 3)})"
        raise SceneError(f"{where}: expected {expected}, got {got} ({some(unknown or wanted, 3)}); correct the names")
    notes = []
    if unknown:
        advice = known.advice(unknown[0])
        notes.append(f"{len(unknown)} names in {where} are not in the scene: {some(unknown)} ({advice})")
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
