"""Ground truth of a class in a scene: the pixels that show it in each view, and its surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from .._card import short_repr
from .._files import as_path, read_json
from ..cameras.camera import Camera
from ..scenes.load import load_scene
from ..scenes.scene import Scene
from .datasets.surface_points import load_surface_points
from .segmentation import load_label_map

BORDER = 2  # pixels around the class whose light is mixed: pictures are sampled, Gaussians have soft edges


class TrueView(NamedTuple):
    """A view, and the pixels that show the class."""

    camera: Camera
    inside: Tensor  # [H, W] bool: the class is seen here, and the pixel is neither masked nor transparent
    far: Tensor  # [H, W] bool: neither here nor within BORDER pixels, and not masked or transparent either

    def __repr__(self) -> str:
        return short_repr(self)


@dataclass(frozen=True, eq=False)
class SceneTruth:
    """A class of a scene with ground truth, as `make_toy_room` writes it."""

    folder: Path
    scene: Scene
    label: int
    indices: tuple[int, ...]
    """The views of the split."""
    pixels: int
    """Number of their pixels that show the class."""

    __repr__ = short_repr

    @staticmethod
    def open(folder: str | Path, name: str, split: str) -> SceneTruth:
        """Look the class up, and count its pixels in the views of a split.

        Raises:
            FileNotFoundError: if there is no such scene, or it lacks labels.
            ValueError: if it has no such class or split, or no view shows the class.
        """
        folder = as_path(folder)
        names = read_json(folder / "classes.json")
        if name not in names:
            raise ValueError(f"name: expected one of {', '.join(names)} (classes of {folder}), got {name!r}")
        scene, label = load_scene(folder), names.index(name)
        indices = tuple(scene.views(split))
        maps = (load_label_map(folder / "labels" / f"{scene.stem(i)}.png") for i in indices)
        pixels = sum(int((labels == label).sum()) for labels in maps)
        if pixels == 0:
            raise ValueError(
                f"name: expected a class that is seen in some of the {len(indices)} views of {split!r}, got {name!r}, "
                "which none shows; choose another class or split"
            )
        return SceneTruth(folder, scene, label, indices, pixels)

    def views(self) -> Iterator[TrueView]:
        """The views one by one.

        Raises:
            FileNotFoundError: if a picture of labels is missing.
            ValueError: if one is damaged or of another size than its camera's.
        """
        for i in self.indices:
            camera, path = self.scene.cameras[i], self.folder / "labels" / f"{self.scene.stem(i)}.png"
            inside = load_label_map(path) == self.label
            _check_size(path, inside.shape, camera)
            grown = torch.nn.functional.max_pool2d(inside[None].float(), 2 * BORDER + 1, 1, BORDER)[0] > 0
            counted = self.scene.counted(i, camera.size)
            yield (
                TrueView(camera, inside, ~grown)
                if counted is None
                else TrueView(camera, inside & counted, ~grown & counted)
            )

    def surface(self) -> tuple[Tensor, Tensor]:  # [P, 3] float32, [P] bool
        """Points of all surfaces, and which of them are the class's.

        Raises:
            FileNotFoundError: if the scene lacks `surface.npz`.
            ValueError: if it is damaged.
        """
        truth = load_surface_points(self.folder)
        return truth.points, truth.labels == self.label


def _check_size(path: Path, shape: tuple[int, ...], camera: Camera) -> None:
    if tuple(shape) != camera.size:
        raise ValueError(
            f"{path}: expected {camera.height}x{camera.width} values (rows x columns, as its camera says), got "
            f"{'x'.join(map(str, shape))}; make the room again"
        )
