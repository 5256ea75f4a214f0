"""The maps in a plan: find those that are stored, and run the teacher on one picture."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from .._files import as_path
from .._typed import typed
from ..features import FeatureFolder, pictures_of, read_manifest, write_npy_map
from ..scenes import Scene
from ..teachers import TRANSFORMERS, LSeg, LSegConfig, LSegOptions, Teacher, as_teacher, load_teacher, teacher_names
from ..teachers.load import check_teacher_name
from ..teachers.lseg.network import LSegNetwork
from .estimate import Sizes
from .trial import EncodedPicture, memory_now, time_picture

MOST_SIZES = 3  # sizes of pictures that the teacher is run on
RANK = 8  # directions of the noise that replaces the maps of a network with random weights


@typed
@dataclass(frozen=True)
class NamedTeacher:
    """A teacher by its name, loaded only if the plan must run it. Nothing is downloaded.

    Args:
        name: as in `load_teacher`.
        weights: as in `load_teacher`. Without weights, `lseg` is timed with random weights.
        options: as in `load_teacher`.
    """

    name: str
    weights: str | Path | None = None
    options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_teacher_name(self.name)

    def load(self) -> tuple[Teacher | None, str | None]:
        """The teacher, or None if its weights are not on this machine, with a note; raises as `load_teacher`."""
        if self.without_weights:
            return _lseg_without_weights(
                self.options
            ), "lseg is timed with meaningless weights, since no --weights are named"
        why, options = f"{self.name} was not run, so no size or time of its maps is known:", dict(self.options)
        if self.weights is None and self.name in teacher_names():
            return None, f"{why} no weights are named; pass --weights PATH"
        on_hub = self.name in TRANSFORMERS and not as_path(str(self.weights)).exists()
        try:
            return load_teacher(self.name, self.weights, **options | ({"local_only": True} if on_hub else {})), None
        except ValueError as error:
            if not on_hub:
                raise
            return None, f"{why} {error}"

    @property
    def without_weights(self) -> bool:
        """Whether it is LSeg without weights; its time and the size of its maps do not depend on them."""
        return self.name == "lseg" and self.weights is None


@dataclass(frozen=True)
class StoredMaps:
    """The maps that a folder has."""

    there: tuple[bool, ...]
    """For each view, whether its map can be read."""
    shape: tuple[int, int, int] | None = None
    maps: FeatureFolder | None = None
    """Of all views, if all are known; they may have been discarded."""
    sample: FeatureFolder | None = None
    """Of a view whose map is there."""
    teacher: str = "maps"
    note: str | None = None


def find_stored(scene: Scene, split: str, folder: Path, teacher: Any) -> StoredMaps:
    """Find the views' maps: a complete set of any program, or some made by kfgs with this teacher."""
    views = scene.views(split)
    stems, sizes = [scene.stem(i) for i in views], [scene.cameras[i].size for i in views]
    nothing = StoredMaps(tuple(False for _ in views))
    if not folder.is_dir():
        return nothing
    try:
        manifest = read_manifest(folder)
        made_by = {} if manifest is None else manifest.teacher
        name = None if teacher is None else teacher.name if hasattr(teacher, "name") else as_teacher(teacher).name
        if manifest is not None and name is not None and name not in (made_by.get("name"), made_by.get("source")):
            other = f"{folder} holds maps by {made_by.get('name')!r}"
            return replace(nothing, note=f"{other}; `kfgs features` asks for --out with another folder, or --overwrite")
        try:
            maps: FeatureFolder | None = FeatureFolder(folder, stems, sizes=sizes)
            there = tuple(file.is_file() for file in maps.files)  # type: ignore[union-attr]
        except FileNotFoundError as error:
            records = {} if manifest is None else manifest.maps
            maps, there = None, tuple(s in records and (folder / records[s].file).is_file() for s in stems)
            if manifest is None and any(folder.iterdir()):
                return replace(nothing, note=f"maps that exist are not counted: {error}")
        kept = [i for i, yes in enumerate(there) if yes]
        if not kept:
            note = f"no maps of these views in {folder}" if maps is None else None
            return replace(nothing, maps=maps, shape=None if maps is None else maps.shape, note=note)
        sample = FeatureFolder(folder, [stems[i] for i in kept], sizes=[sizes[i] for i in kept])
        for i in range(len(kept)):
            sample.grid(i, sample.shape[:2], 1)  # reads one feature: checks existence, size and finite values
    except (ValueError, TypeError, OSError) as error:
        return replace(nothing, note=f"maps that exist are not counted: {error}")
    return StoredMaps(there, sample.shape, maps, sample, str(made_by.get("name", "maps of another program")))


def run_teacher(
    scene: Scene, sizes: Sizes, teacher: Any, device: torch.device, folder: Path
) -> tuple[Sizes, FeatureFolder | None, str, list[str]]:
    """Let the teacher see a picture of each size: sizes with what that tells, its map, its name, and notes.

    A teacher that is loaded here by its name is moved to `device`. One that the caller made is left on its own device, where
    `extract_features` runs it, too.
    """
    teacher = NamedTeacher("lseg") if teacher is None else teacher
    notes, name = list[str](), getattr(teacher, "name", None) or as_teacher(teacher).name
    before, loaded = memory_now(), teacher
    if isinstance(teacher, NamedTeacher):
        loaded, note = teacher.load()
        notes += [] if note is None else [note]
        if loaded is None:
            return sizes, None, name, notes
        loaded = loaded.to(device) if hasattr(loaded, "to") else loaded
    views, found = scene.views(sizes.config.split), dict[tuple[int, int], EncodedPicture]()
    counts = Counter(sizes.pictures[i] for i in sizes.missing)
    for size, _ in counts.most_common(MOST_SIZES):
        picture = pictures_of(scene, [views[sizes.pictures.index(size)]])[0]
        found[size] = time_picture(loaded, picture, folder / f"{size[0]}x{size[1]}")
    if len(counts) > MOST_SIZES:
        notes.append(
            f"pictures have {len(counts)} sizes, of which {MOST_SIZES} were tried; maps of the others are estimates"
        )
    nearest = {size: min(found, key=lambda one: abs(one[0] * one[1] - size[0] * size[1])) for size in sizes.pictures}
    shapes = tuple(found[nearest[size]].shape for size in sizes.pictures)
    seconds = sum(count * found[nearest[size]].seconds for size, count in counts.items())
    kept, largest = sizes.shapes[0], max(found, key=lambda one: counts[one])
    if any(sizes.made) and kept is not None and kept not in shapes:
        notes.append(f"maps that exist are not counted: they have the shape {kept}, and those of {name} {shapes[0]}")
        every = sum(found[nearest[size]].seconds for size in sizes.pictures)
        sizes, seconds = replace(sizes, made=tuple(False for _ in sizes.made)), every
    peaks = [one.peak for one in found.values()]
    peak = None if None in peaks else max(one for one in peaks if one is not None)
    extra = 0 if peak is None or before is None else max(0, peak - before)
    sizes = replace(sizes, shapes=shapes, picture_seconds=seconds, teacher_peak=peak, teacher_bytes=extra)
    place = folder / f"{largest[0]}x{largest[1]}"
    if isinstance(teacher, NamedTeacher) and teacher.without_weights:
        h, w, D = found[largest].shape
        place, generator = folder / "noise", torch.Generator().manual_seed(0)
        noise = torch.randn(h, w, RANK, generator=generator) @ torch.randn(RANK, D, generator=generator)
        write_npy_map(place / "noise.npy", noise.half())
    return sizes, FeatureFolder(place), name, notes


def _lseg_without_weights(options: dict[str, Any]) -> LSeg:
    """LSeg with random weights, to measure its time; it exists in one size only."""
    given = dict(options)
    chosen = LSegOptions.fast() if given.pop("fast", False) else LSegOptions()
    with torch.device("meta"):
        network = LSegNetwork(LSegConfig())
    network.to_empty(device="cpu")
    generator = torch.Generator().manual_seed(0)
    for value in network.state_dict().values():
        reach = (3 * len(value) / value.numel()) ** 0.5 if value.ndim > 1 else 0.0  # outputs about as large as inputs
        value.uniform_(-reach, reach, generator=generator) if reach else value.fill_(1)
    return LSeg(network, replace(chosen, **given))
