"""Time small runs for a plan: one picture, a few views, twenty steps."""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from .._files import real_path
from ..features import FeatureFolder, Picture, extract_features
from ..fields import FieldConfig, GaussianParams
from ..scenes import Scene
from ..teachers import CallableTeacher, LSeg, LSegOptions, Teacher, as_teacher
from .color import Photos, fit_color, training_cameras
from .config import FitConfig
from .fit import fit_scene
from .maps import ChosenMaps
from .stages import Stage

STEPS = 20  # steps of the longer of two runs
VIEWS = 4  # views of the longer run
DENSER = 8  # factor on the samples of a map
SHORT = 2  # steps and views of the shorter run
PATIENCE = 5.0  # seconds: slower runs are not repeated, and have fewer steps
NOISE = 0.1  # one more step or view costs at least this share of the mean time


@dataclass(frozen=True)
class Timing:
    """The time of a stage as a straight line: constant seconds, plus seconds for each view or step."""

    fixed: float
    each: float
    peak: int | None = None
    """Peak memory of the process, bytes; None if unknown."""

    def seconds(self, count: int) -> float:
        """The time of `count` views or steps."""
        return self.fixed + self.each * count


@dataclass(frozen=True)
class EncodedPicture:
    """Costs of running a teacher on one picture."""

    shape: tuple[int, int, int]
    """(h, w, D) of its map."""
    seconds: float
    """For one picture, from its file to the file of its map."""
    peak: int | None
    """Peak memory of the process, bytes."""


def time_picture(teacher: Teacher | Callable[[Tensor], Tensor], picture: Picture, folder: Path) -> EncodedPicture:
    """Run a teacher on one picture, and write its map to a folder like `extract_features`.

    LSeg's network runs once, not for every scale and window; its time is multiplied.
    """
    teacher, runs = _one_run(as_teacher(teacher), picture)
    spent: list[float] = []

    def encode(image: Tensor) -> Tensor:
        start = time.perf_counter()
        features = teacher.encode_image(image).cpu()
        spent.append(time.perf_counter() - start)
        return features

    seconds = 0.0
    with PeakMemory() as memory:
        while len(spent) < 2 and seconds < PATIENCE:  # twice, because the first run reads weights and compiles
            shutil.rmtree(folder, ignore_errors=True)
            start = time.perf_counter()
            made = extract_features(CallableTeacher(encode, name=teacher.name, identity={}), [picture], folder)
            seconds = time.perf_counter() - start
    return EncodedPicture(made.maps[picture.stem].shape, seconds + (runs - 1) * spent[-1], memory.bytes)


def _one_run(teacher: Teacher, picture: Picture) -> tuple[Teacher, int]:
    """The teacher, or LSeg with one window at one scale, and the number of such runs per picture."""
    if not isinstance(teacher, LSeg):
        return teacher, 1
    height, width = map(int, picture.read().shape[:2])
    runs = teacher.options.forwards(height, width, window=teacher.network.config.window)
    once = replace(LSegOptions.fast(), size=teacher.options.size, precision=teacher.options.precision)
    return LSeg(teacher.network, once), runs


def time_color(scene: Scene, config: FitConfig, gaussians: int) -> dict[str, Timing]:
    """Time the stage `color`, with this number of Gaussians from the start.

    Each picture is read once, at its first step. A trial of few steps would count that for every step, so it is timed alone.
    """
    chosen = scene.views(config.split)
    read = _time_reading(scene, chosen[:1], config)

    def make(views: int, steps: int, folder: Path, report: Callable[[str], None]) -> list[Stage]:
        few = few_views(scene, config.split, views, gaussians)
        color = replace(config.color, split=config.split, max_points=None, field=_shortened(config.color.field, steps))
        [stage] = fit_color(few, folder, color, device=config.device, report=report).stages
        return [replace(stage, seconds=max(stage.seconds - read * min(views, steps), NOISE * stage.seconds))]

    found = _time_twice(make, len(chosen), {"color"})
    return {name: replace(one, fixed=one.fixed + read * len(chosen)) for name, one in found.items()}


def _time_reading(scene: Scene, views: list[int], config: FitConfig) -> float:
    """Seconds to read the first of these pictures at its training size, when the code has run before."""
    cameras = training_cameras(scene, views, config.color.picture_scale)
    for _ in range(2):
        start = time.perf_counter()
        Photos(scene, views, cameras)[0]
    return time.perf_counter() - start


def time_fit(scene: Scene, maps: FeatureFolder, config: FitConfig, gaussians: int) -> dict[str, Timing]:
    """Time the stages that read maps.

    Args:
        scene: as for `fit_scene`.
        maps: of some views, used for all.
        config: as for `fit_scene`.
        gaussians: their number from the start (method `paper`), or to fuse onto (`fuse`).
    """
    count = len(scene.views(config.split))
    # The adaptive codebook grows with all samples together; four views have too few to show it.
    denser = max(1, min(DENSER, count // VIEWS)) if config.codebook.adaptive else 1
    codebook = replace(config.codebook, samples=denser * config.codebook.samples_of(count))

    def make(views: int, steps: int, folder: Path, report: Callable[[str], None]) -> list[Stage]:
        few = few_views(scene, config.split, views, gaussians)
        short = replace(
            config,
            codebook=codebook,
            autoencoder=replace(config.autoencoder, steps=steps),
            field=_shortened(config.field, steps),
        )
        splat = GaussianParams.from_points(few.points, 1).activated().detach() if config.method == "fuse" else None
        return fit_scene(few, _few_maps(maps, views), folder, short, splat=splat, report=report).stages

    found = _time_twice(make, count, {"autoencoder", "field"})
    return {name: replace(one, each=one.each / denser) if name == "codebook" else one for name, one in found.items()}


def few_views(scene: Scene, split: str, count: int, points: int) -> Scene:
    """Some evenly spread views of a split, with the scene's points repeated to a given number."""
    views = scene.views(split)
    chosen = scene.select([views[i * len(views) // count] for i in range(count)])
    generator = torch.Generator().manual_seed(0)
    rows = torch.arange(points) % len(scene.points)
    moved = 0.005 * scene.extent * torch.randn(points, 3, generator=generator)
    return replace(
        chosen, points=scene.points[rows] + moved, colors=scene.colors[rows], splits={split: [*range(count)]}
    )


def _shortened(config: FieldConfig, steps: int) -> FieldConfig:
    """The same mixture of sizes in fewer steps, with as many Gaussians at the end as at the start."""
    return replace(config.with_steps(steps), densify_until=0, reset_every=0)


def _time_twice(
    make: Callable[[int, int, Path, Callable[[str], None]], list[Stage]], views: int, stepwise: set[str]
) -> dict[str, Timing]:
    """Time two runs of different length, and put a straight line through both.

    Args:
        make: makes the stages with a number of views and steps in a folder, and reports them.
        views: the most views available.
        stepwise: stages whose time depends on the steps; the others depend on the views.
    """
    short, long = min(SHORT, views), min(VIEWS, views)
    with TemporaryDirectory(prefix="kfgs-plan-") as place:
        folder = Path(place)
        make(short, SHORT, folder / "first", lambda line: None)  # which compiles, and fills caches
        less = {stage.name: stage for stage in make(short, SHORT, folder / "short", lambda line: None)}
        slowest = max([less[name].seconds for name in stepwise & less.keys()], default=0.0) / SHORT
        steps = max(SHORT + 1, min(STEPS, int(PATIENCE / max(slowest, 1e-9))))
        peaks = _Peaks()
        more = make(long, steps, folder / "long", peaks.report)
        found = {}
        for stage in more:
            few, many = (SHORT, steps) if stage.name in stepwise else (short, long)
            mean = stage.seconds / many
            slope = (stage.seconds - less[stage.name].seconds) / (many - few) if many > few else mean
            each = min(mean, max(slope, NOISE * mean))
            found[stage.name] = Timing(stage.seconds - each * many, each, peaks.found.get(stage.name))
        return found


class _Peaks:
    """The peak memory of each stage, from the lines that a run reports."""

    def __init__(self) -> None:
        self.found: dict[str, int | None] = {}
        self._memory = PeakMemory()

    def report(self, line: str) -> None:
        name, _, words = line.partition(": ")
        if words == "working":
            self._memory.__enter__()
        elif words.startswith("done in "):
            self._memory.__exit__()
            self.found[name] = self._memory.bytes


def _few_maps(maps: FeatureFolder, count: int) -> ChosenMaps:
    """The maps of a number of views, evenly spread over the stored ones; repeated if there are too few."""
    return ChosenMaps(maps, [i * len(maps) // count for i in range(count)], [[str(i), ""] for i in range(count)])


class PeakMemory:
    """A context: `bytes` is the peak memory of the process inside it; None if unknown.

    On systems other than Linux an earlier peak cannot be reset, so it is the peak since the start.
    """

    bytes: int | None = None

    def __enter__(self) -> PeakMemory:
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")  # proc(5): the peak starts again
        return self

    def __exit__(self, *_: Any) -> None:
        try:
            status = Path("/proc/self/status").read_text()
            self.bytes = int(status.partition("VmHWM:")[2].split()[0]) * 1024
        except (OSError, IndexError, ValueError):
            self.bytes = _largest_so_far()


def memory_now() -> int | None:
    """Bytes of this process; if unknown, its peak so far."""
    with PeakMemory() as memory:
        pass
    return memory.bytes


def _largest_so_far() -> int | None:
    try:
        import resource
    except ImportError:  # Windows
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def disk_free(folder: str | Path) -> int:
    """Free bytes on the disk of a folder, which may not exist yet."""
    path = real_path(folder)
    while not path.exists():
        path = path.parent
    return shutil.disk_usage(path).free


def memory_free() -> int | None:
    """Free memory in bytes, within a container's limit; None if unknown."""
    found: list[int] = []
    meminfo, limit, used = (
        Path(name) for name in ("/proc/meminfo", "/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current")
    )
    try:
        lines = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
        found.append(int(lines["MemAvailable"].split()[0]) * 1024)
    except (OSError, KeyError, ValueError):
        with contextlib.suppress(AttributeError, OSError, ValueError):  # Windows, macOS
            found.append(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    with contextlib.suppress(OSError, ValueError):  # no container, or its limit is "max"
        found.append(int(limit.read_text()) - int(used.read_text()))
    return min(found) if found else None
