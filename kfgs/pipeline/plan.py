"""What a run will cost, before it starts: disk, memory and minutes of each stage, and whether this machine has them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from .._check import check_choice
from .._files import bytes_in_words, seconds_in_words
from ..scenes import Scene
from ..teachers.costs import TeacherCost
from .device import training_device
from .fit import FitConfig
from .machine import Speed, disk_free, memory_free
from .plan_stages import DENSE, Dense, Sizes, StagePlan, add

FEATURES = "features"  # the folder of maps, as `kfgs features` and `kfgs fit` take it


@dataclass(frozen=True)
class Plan:
    """What a run will take; `str` gives a table."""

    title: str
    stages: tuple[StagePlan, ...]
    notes: tuple[str, ...]
    dense: Dense
    speed: Speed
    disk_free: int
    memory_free: int | None
    """Bytes that processes can still have; None where the system does not say."""
    disk_recomputed: int | None = None
    """Disk that the same run needs if maps are made anew instead of stored."""
    forwards: int = 1
    """How often the teacher's network runs for a picture."""

    @property
    def seconds(self) -> float | None:
        """Of all stages."""
        return add([stage.seconds for stage in self.stages])

    @property
    def disk_bytes(self) -> int | None:
        """The most that lies on the disk at a time."""
        return add([stage.disk_bytes for stage in self.stages])

    @property
    def kept_bytes(self) -> int | None:
        """What lies on the disk in the end."""
        return add([stage.kept_bytes for stage in self.stages])

    @property
    def peak_bytes(self) -> int | None:
        """The most memory of any stage."""
        known = [stage.peak_bytes for stage in self.stages]
        return None if None in known else max(peak for peak in known if peak is not None)

    @property
    def fits(self) -> bool | None:
        """Whether the machine has the disk and the memory; None if either need is not known."""
        if self.disk_bytes is None or self.peak_bytes is None:
            return None
        return self.disk_bytes <= self.disk_free and (self.memory_free is None or self.peak_bytes <= self.memory_free)

    @property
    def verdict(self) -> str:
        """Whether it fits, in a sentence, and what to do if not."""
        if self.disk_bytes is None or self.peak_bytes is None:
            return (
                "unknown whether it fits: nothing is known about this teacher; encode one picture and look at its map"
            )
        wants = []
        if self.disk_bytes > self.disk_free:
            text = f"needs {bytes_in_words(self.disk_bytes)} on disk, {bytes_in_words(self.disk_free)} free"
            wants.append(f"{text}; {self._less_disk()}")
        if self.memory_free is not None and self.peak_bytes > self.memory_free:
            stage = max(self.stages, key=lambda one: one.peak_bytes or 0).name
            text = (
                f"needs {bytes_in_words(self.peak_bytes)} of memory ({stage}), {bytes_in_words(self.memory_free)} free"
            )
            wants.append(f"{text}; ask for smaller maps (--size), or end other programs")
        return "does not fit: " + "; ".join(wants) if wants else "fits"

    def _less_disk(self) -> str:
        less = self.disk_recomputed
        if self.dense != "recompute" and less is not None and less <= self.disk_free:
            fast = "--fast does not change that; " if self.forwards > 1 else ""
            return (
                f"{fast}recompute instead of storing: {bytes_in_words(less)} on disk, twice the teacher's time "
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
    teacher: str | TeacherCost = "lseg",
    weights: str | Path | None = None,
    options: dict[str, Any] | None = None,
    config: FitConfig | None = None,
    dense: Dense = "keep",
    device: str | torch.device = "auto",
    folder: str | Path = ".",
) -> Plan:
    """Predict disk, memory and minutes of `extract_features` and `fit_scene`, from sizes, measured constants (`work`) and a
    third of a second of matrix products that tell how fast this machine is now.

    Times are orders of magnitude: within about a factor of two where the constants were measured, further off elsewhere.

    Args:
        scene: its views of `config.split`, their sizes and the number of points count; no picture is read.
        teacher: a name as `load_teacher` takes it, or what is known about one (`TeacherCost.of_maps` for maps on disk).
        weights: tells the teacher's size, see `teacher_cost`; not loaded, but refused where `load_teacher` would at first
            sight (`check_weights`).
        options: the teacher's.
        config: the method and its options; those of `fit_scene` when not given.
        dense: what becomes of the dense maps: `keep`, `discard` once index maps are made of them, or `recompute` them
            instead of storing any.
        device: where teacher and field run, see `training_device`.
        folder: where the run and the maps will be written; need not be there yet. Maps of this teacher that lie in its
            `features` already are not made again, unless `dense` is `recompute`.

    Raises:
        ValueError: if there is no such teacher, split or device, or `dense` is not `keep` although the field learns from the
            dense maps themselves (mode `decouple`), or the weights are another model's.
        FileNotFoundError: if the weights are not there.
    """
    check_choice("dense", dense, DENSE)
    config = config or FitConfig()
    if config.needs_maps and dense != "keep":
        raise ValueError(
            f"dense: expected 'keep' with mode 'decouple', whose field learns from the dense maps, got {dense!r}; keep them"
        )
    target = training_device(device)
    sizes = Sizes.of(scene, teacher, weights, options or {}, config, dense, Path(folder) / FEATURES)
    plan = Plan(
        title=sizes.title(target),
        stages=tuple(sizes.stages(target)),
        notes=tuple(sizes.notes(target)),
        dense=dense,
        speed=sizes.speed,
        disk_free=disk_free(folder),
        memory_free=memory_free(),
        forwards=sizes.cost.forwards,
    )
    if config.needs_maps or dense == "recompute" or sizes.existing:
        return plan
    anew = replace(sizes, dense="recompute", made=(0,) * len(sizes.made))
    return replace(plan, disk_recomputed=add([one.disk_bytes for one in anew.stages(target)]))
