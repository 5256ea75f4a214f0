"""Predict the costs of a run: disk, memory and minutes of each stage, and whether this machine has enough."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from .._check import check_choice
from .._files import as_path, bytes_in_words, seconds_in_words
from ..features import FeatureFolder
from ..scenes import Scene
from ..teachers import Teacher
from .config import FitConfig
from .estimate import DENSE, Dense, Sizes, StagePlan, add, gaussian_counts, plan_stages, training_bytes
from .fit import finished_stages
from .plan_maps import NamedTeacher, find_stored, run_teacher
from .train import training_device
from .trial import Timing, disk_free, memory_free, memory_now, time_color, time_fit

FEATURES = "features"  # the folder of maps in a scene folder, written by `kfgs features` and read by `kfgs fit`


@dataclass(frozen=True)
class Plan:
    """The predicted costs of a run; `str` gives a table."""

    title: str
    stages: tuple[StagePlan, ...]
    notes: tuple[str, ...]
    dense: Dense
    disk_free: int
    memory_free: int | None
    """Free memory in bytes; None if unknown."""
    disk_recomputed: int | None = None
    """Disk that the same run needs if maps are recomputed instead of stored."""

    @property
    def seconds(self) -> float | None:
        """Time of all stages."""
        return add([stage.seconds for stage in self.stages])

    @property
    def disk_bytes(self) -> int | None:
        """The largest use of disk at any time."""
        return add([stage.disk_bytes for stage in self.stages])

    @property
    def kept_bytes(self) -> int | None:
        """Bytes on disk at the end."""
        return add([stage.kept_bytes for stage in self.stages])

    @property
    def peak_bytes(self) -> int | None:
        """The most memory of any stage."""
        known = [stage.peak_bytes for stage in self.stages]
        return None if None in known else max(peak for peak in known if peak is not None)

    @property
    def fits(self) -> bool | None:
        """Whether the machine has the disk and the memory; None if that is not known."""
        return None if self._lacks is None else not self._lacks

    @property
    def verdict(self) -> str:
        """A sentence: whether it fits, and what to do if not."""
        if self._lacks is None:
            return (
                "unknown whether it fits: the maps' size is not known; name a teacher that can be loaded, or --features"
            )
        return "does not fit: " + "; ".join(self._lacks) if self._lacks else "fits"

    @property
    def _lacks(self) -> list[str] | None:
        """The resources of which the machine has too little; None if unknown."""
        found = []
        disk = sum(stage.disk_bytes or 0 for stage in self.stages)
        if disk > self.disk_free:
            less = f"needs {bytes_in_words(disk)} on disk, {bytes_in_words(self.disk_free)} free; {self._less_disk()}"
            found.append(less)
        largest = max(self.stages, key=lambda one: one.peak_bytes or 0)
        if self.memory_free is not None and (largest.peak_bytes or 0) > self.memory_free:
            have = f"{bytes_in_words(largest.peak_bytes)} of memory ({largest.name}), {bytes_in_words(self.memory_free)} free"
            found.append(f"needs {have}; ask for smaller maps (--size), or end other programs")
        unknown = self.disk_bytes is None or (self.peak_bytes is None and self.memory_free is not None)
        return None if unknown and not found else found

    def _less_disk(self) -> str:
        less = self.disk_recomputed
        if self.dense != "recompute" and less is not None and less <= self.disk_free:
            return (
                f"recompute instead of storing: {bytes_in_words(less)} on disk, twice the teacher's time "
                "(kfgs fit SCENE --teacher ...)"
            )
        return "ask for smaller maps (--size), or use a larger disk"

    def to_json(self) -> dict[str, Any]:
        """All numbers, with totals and verdict."""
        totals = {
            name: getattr(self, name)
            for name in ("seconds", "peak_bytes", "disk_bytes", "kept_bytes", "fits", "verdict")
        }
        return {**asdict(self), **totals}

    def __str__(self) -> str:
        rows = [("stage", "what", "time", "memory", "disk")]
        needs = [(one.name, one.what, one.seconds, one.peak_bytes, one.disk_bytes) for one in self.stages]
        for name, what, seconds, peak, disk in [*needs, ("in all", "", self.seconds, self.peak_bytes, self.disk_bytes)]:
            rows.append((name, what, seconds_in_words(seconds), bytes_in_words(peak), bytes_in_words(disk)))
        for row, stage in enumerate(self.stages, start=1):
            if stage.kept_bytes != stage.disk_bytes:
                rows[row] = (*rows[row][:4], f"{rows[row][4]} (for a while)")
        rows.append(("this machine", "free", "", bytes_in_words(self.memory_free), bytes_in_words(self.disk_free)))
        widths = [max(len(row[i]) for row in rows) for i in range(5)]
        lines = [
            f"{row[0]:<{widths[0]}}  {row[1]:<{widths[1]}}  {row[2]:>{widths[2]}}  {row[3]:>{widths[3]}}  {row[4]}".rstrip()
            for row in rows
        ]
        return "\n".join([self.title, "", *lines, "", *(f"note: {note}" for note in self.notes), self.verdict])


def plan_scene(
    scene: Scene,
    *,
    teacher: Teacher | Callable[[Tensor], Tensor] | NamedTeacher | str | None = None,
    config: FitConfig | None = None,
    dense: Dense = "keep",
    features: str | Path | None = None,
    run: str | Path | None = None,
) -> Plan:
    """Predict disk, memory and minutes of `extract_features` and `fit_scene` on this machine.

    Disk and memory follow from shapes. Times are measured: the teacher sees one picture, and each stage runs with a few
    views and twenty steps, with the planned number of Gaussians and size of maps; then times are scaled by counts. This
    takes seconds, or a minute with a slow teacher. Times are right within about a factor of two.

    Args:
        scene: whose views of `config.split` are learnt from.
        teacher: makes the maps that are missing: a teacher, a function from [3, H, W] to [D, h, w], or a name, see
            `NamedTeacher`. It runs on the device it is on, as in `extract_features`; one given by name, on that of `config`.
            None: whose maps exist, or else `lseg`.
        config: the method and its options, and the device; those of `fit_scene` when not given.
        dense: what becomes of the dense maps: `keep`, `discard` once the field is made of them, or `recompute` them
            instead of storing any.
        features: the folder of maps, in any layout that `FeatureFolder` reads; need not exist. Maps that are there are not
            made again, unless `dense` is `recompute`. None: `features` in the scene's folder.
        run: the folder of `fit_scene`; stages that are finished there count as done.

    Raises:
        ValueError: if there is no such teacher, split or device; if `dense` is not `keep` in mode `decouple`, which trains on
            the dense maps; or if the weights belong to another model.
        FileNotFoundError: if the weights or a picture are missing.
    """
    check_choice("dense", dense, DENSE)
    config = config or FitConfig()
    target = training_device(config.device)
    if config.needs_maps and dense != "keep":
        raise ValueError(
            f"dense: expected 'keep' with mode 'decouple', whose field learns from the dense maps, got {dense!r}; keep them"
        )
    folder = as_path(features) if features is not None else (scene.folder or Path()) / FEATURES
    teacher = NamedTeacher(teacher) if isinstance(teacher, str) else teacher
    stored = find_stored(scene, config.split, folder, teacher)
    views, straight = scene.views(config.split), scene.undistorted()
    done = set() if run is None else finished_stages(straight, stored.maps, run, config)
    notes = [] if stored.note is None else [stored.note]
    if config.method == "fuse" and scene.splat is not None:
        done = done | {"color"}
        notes.append(f"the scene has its splat ({scene.splat}), so no colours are trained")
    sizes = Sizes(
        config=config,
        dense=dense,
        points=len(scene.points),
        pictures=tuple(scene.cameras[i].size for i in views),
        shapes=tuple(stored.shape for _ in views),
        made=stored.there,
        done=frozenset(done),
    )
    if run is not None and not as_path(run).is_dir():
        notes.append(f"there is no folder {run} yet, so no stage is finished")
    if isinstance(teacher, NamedTeacher) and teacher.weights is not None and not sizes.missing:
        notes.append(f"no map is missing, so {teacher.name} and its weights were not looked at")
    with TemporaryDirectory(prefix="kfgs-plan-") as place:
        maps, name = stored.sample, stored.teacher
        if sizes.missing and not {"uplift", "index_maps"} & done:
            sizes, made, name, said = run_teacher(scene, sizes, teacher, target, Path(place))
            notes += said
            maps = maps if made is None else made
        sizes = _run_stages(straight, sizes, maps)
    plan = Plan(
        title=_title(sizes, name, target),
        stages=tuple(plan_stages(sizes)),
        notes=(*notes, *notes_on(sizes)),
        dense=dense,
        disk_free=disk_free(run if run is not None else folder),
        memory_free=memory_free(),
    )
    if config.needs_maps or dense == "recompute" or not sizes.missing:
        return plan
    again = plan_stages(replace(sizes, dense="recompute"))
    return replace(plan, disk_recomputed=add([stage.disk_bytes for stage in again]))


def _run_stages(scene: Scene, sizes: Sizes, maps: FeatureFolder | None) -> Sizes:
    """Time the stages that are not finished and fit into memory; returns the sizes with the timings."""
    config, free, now = sizes.config, memory_free(), memory_now() or 0
    sizes = replace(sizes, base=now)
    if sizes.points < 2 or (free is not None and training_bytes(sizes) > free):
        return sizes
    timings: dict[str, Timing] = {}
    fuse = config.method == "fuse"
    mean, last = gaussian_counts(config.color.field if fuse else config.field, sizes.points, full=fuse)
    if fuse and "color" not in sizes.done:
        timings |= time_color(scene, config, round(mean))
    if maps is not None and "uplift" not in sizes.done and "answers" not in sizes.done:
        timings |= time_fit(scene, maps, config, last if fuse else round(mean))
    return replace(sizes, timings=timings)


def _title(sizes: Sizes, teacher: str, device: torch.device) -> str:
    (height, width), config = sizes.pictures[0], sizes.config
    fuse = config.method == "fuse"
    steps, method = (config.color.field.steps, "fuse") if fuse else (config.field.steps, config.mode)
    maps = "maps of unknown size"
    if sizes.shape is not None:
        maps = f"{sizes.shape[2]} channels at {sizes.shape[0]}x{sizes.shape[1]}"
    stored = {"keep": "kept", "discard": "discarded", "recompute": "made again instead of stored"}[sizes.dense]
    return (
        f"{sizes.count} views of {width}x{height}, {teacher} ({maps}, {stored}), {method}, {steps} steps, on {device} "
        f"({torch.get_num_threads()} threads)"
    )


def notes_on(sizes: Sizes) -> list[str]:
    """Notes for the reader of the numbers."""
    found = [
        "times are those of small runs on this machine as busy as it is now, scaled up: within a factor of two or so"
    ]
    if any(sizes.made) and sizes.dense != "recompute":
        found.append(f"{sum(sizes.made)} of {sizes.count} maps exist and are not made again")
    if sizes.points < 2 and "color" not in sizes.done:
        found.append(
            f"the scene has {sizes.points} points; `kfgs fit` triangulates some from the poses before it trains, which is not "
            "counted; after `kfgs sfm SCENE --out NEW` the plan of NEW is complete"
        )
    if not sizes.missing or sizes.shape is None:
        return found
    whole = sizes.samples * sizes.count == sizes.pixels
    if sizes.dense == "recompute" and whole and sizes.config.method == "paper":
        found.append(
            "the codebook looks at every feature of these maps: keeping them takes no more disk, and half the time"
        )
    if sizes.dense == "keep" and not sizes.config.needs_maps:
        size = bytes_in_words(sizes.map_bytes(range(sizes.count)))
        found.append(f"the {size} of maps can be deleted once the field is made (kfgs fit --discard-features)")
    return found
