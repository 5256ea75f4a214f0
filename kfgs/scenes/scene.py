"""A scene: posed cameras, the image files they took, a point cloud, and which views are held out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from operator import index
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._card import html_card
from .._check import ORIGIN, check_shapes
from .._files import Names, file_stem
from ..cameras.camera import NEAR, Camera
from ..cameras.paths import camera_extent
from ..cameras.resample import undistort
from .files import SceneError, read_alpha, read_image, read_mask, shrink_mask, some

# Of the extent: 3DGS's near plane of 0.2 suits cameras 2 m apart; in smaller scenes it must be smaller.
NEAR_SHARE = 0.1
ROUNDING = 1e-3  # a pixel that takes less than this from masked ones, when a lens is removed, takes nothing


@dataclass(frozen=True, eq=False)
class Scene:
    """V posed views of one place. Images are read from disk at each access.

    `scene.select("train").cameras` and `.image_paths` belong to one split; `scene.image(i)` is a picture.

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
            raise ValueError(f"split: expected one of {named}all, got {split!r}; list its views in split.json")
        return self.splits[split]

    def image(self, i: int) -> Tensor:  # [H, W, 3] in [0, 1]
        """Read the picture of view `i`; in an undistorted scene the lens is removed on the way. Transparent pixels are black."""
        lens = (self.lenses or self.cameras)[i]
        image = read_image(self.image_paths[i], "black")
        if image.shape[:2] != lens.size:
            expected = f"{lens.width}x{lens.height} pixels as its camera says, got {image.shape[1]}x{image.shape[0]}"
            raise SceneError(f"{self.image_paths[i]}: expected {expected}; replace it by a copy of that size")
        return image if self.lenses is None else undistort(image, lens)[0]

    def mask(self, i: int) -> Tensor:  # [H, W] bool
        """Which pixels of view `i` count: not those that are black in its mask, nor those beyond an undistorted picture."""
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
        chosen = self.splits.get("train") or range(len(self))
        return camera_extent([self.cameras[i] for i in chosen], self.points)

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
            which: the name of a split, for instance "train"; or names of views (with or without suffix), or their indices.
        """
        if isinstance(which, str):
            if which not in self.splits:
                expected = f"one of the splits {sorted(self.splits)}"
                raise ValueError(f"which: expected {expected}, got {which!r}; pass a list to select views by name")
            which = self.splits[which]
        place = {camera.name: i for i, camera in enumerate(self.cameras)}
        names, indices = Names(place, bare=True), list[int]()
        for view in which:
            i = place.get(names.find(view) or "", -1) if isinstance(view, str) else index(view)  # also torch's integers
            if not 0 <= i < len(self):
                advice = names.advice(view) if isinstance(view, str) else f"names are like {self.cameras[0].name!r}"
                raise ValueError(f"which: expected names or indices of the {len(self)} views, got {view!r}; {advice}")
            indices.append(i)
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
