"""The stages of a run as a plan foretells them, from the sizes of pictures, maps and cloud."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from .._files import bytes_in_words
from ..features.manifest import read_manifest
from ..fields.answers import MOST, PIXELS
from ..fields.working_maps import WORKING
from ..quant.sampling import choose_grid_step
from ..scenes import Scene
from ..teachers.costs import TeacherCost, check_weights, teacher_cost
from . import work
from .fit import FitConfig
from .machine import Speed, measure_speed

Dense = Literal["keep", "discard", "recompute"]
DENSE: tuple[Dense, ...] = ("keep", "discard", "recompute")
_HALF, _FLOAT = 2, 4  # bytes
COLOR_CHANNELS = (
    12  # a step of colours with harmonics of degree 1 and SSIM costs about as much as one of so many features
)


@dataclass(frozen=True)
class StagePlan:
    """One stage. None: not known."""

    name: str
    what: str
    """What it does, in words with its sizes."""
    seconds: float | None
    peak_bytes: int | None
    """Memory of the whole process while it runs."""
    disk_bytes: int | None
    """What it writes, and lies on the disk together with what the other stages write."""
    kept_bytes: int | None
    """What of it is left in the end."""


@dataclass(frozen=True)
class Sizes:
    """Everything that the stages' costs follow from."""

    views: tuple[tuple[int, tuple[int, int], TeacherCost], ...]  # so many pictures of that size, and what each costs
    made: tuple[int, ...]  # of how many of them the maps exist, for each of `views`
    others: str | None  # whose maps lie where the teacher's will be written, if they are none of its
    points: int
    config: FitConfig
    dense: Dense
    speed: Speed

    @classmethod
    def of(
        cls,
        scene: Scene,
        teacher: str | TeacherCost,
        weights: str | Path | None,
        options: dict[str, Any],
        config: FitConfig,
        dense: Dense,
        folder: Path,
    ) -> Sizes:
        """What a scene and options say, and how fast the machine is now; the arguments are those of `plan_scene`."""
        chosen = scene.views(config.split)
        if isinstance(teacher, str):
            check_weights(teacher, weights)
            if ":" in teacher and dense != "recompute":
                teacher = _own_maps(teacher, folder, [scene.stem(i) for i in chosen]) or teacher

        def cost(size: tuple[int, int]) -> TeacherCost:
            return teacher_cost(teacher, size, weights=weights, **options) if isinstance(teacher, str) else teacher

        counts = Counter(scene.cameras[i].size for i in chosen)
        views = tuple((count, size, cost(size)) for size, count in counts.items())
        made, others = Counter[tuple[int, int]](), None
        if dense != "recompute" and views[0][2].forwards != 0:
            pictures = [(scene.stem(i), scene.cameras[i].size) for i in chosen]
            made, others = _existing(folder, pictures, {size: one for _, size, one in views})
        counted = tuple(made[size] for _, size, _ in views)
        return cls(views, counted, others, len(scene.points), config, dense, measure_speed())

    @property
    def cost(self) -> TeacherCost:
        """Of the first picture, which stands for the others where there is one number for all."""
        return self.views[0][2]

    @property
    def count(self) -> int:
        """Pictures."""
        return sum(count for count, _, _ in self.views)

    @property
    def missing(self) -> tuple[tuple[int, tuple[int, int], TeacherCost], ...]:
        """The pictures that the teacher has not seen yet, as `views`."""
        both = zip(self.views, self.made, strict=True)
        return tuple((count - made, size, cost) for (count, size, cost), made in both)

    @property
    def known(self) -> bool:
        """Whether it is known what maps the teacher makes."""
        return self.cost.map_size is not None and self.cost.channels is not None

    @property
    def existing(self) -> bool:
        """Whether the maps are there, so that no teacher runs."""
        return self.cost.forwards == 0

    @property
    def channels(self) -> int:
        """D of a map, 0 if it is not known."""
        return self.cost.channels or 0

    @property
    def pixels(self) -> int:
        """Of all maps."""
        return sum(count * cost.map_size[0] * cost.map_size[1] for count, _, cost in self.views if cost.map_size)

    @property
    def samples(self) -> int:
        """Of all maps that the codebook looks at."""
        return sum(count * self._grid(cost) for count, _, cost in self.views)

    @property
    def largest(self) -> int:
        """Bytes of the largest map in float32."""
        return max(_FLOAT * h * w * self.channels for h, w in (cost.map_size or (0, 0) for _, _, cost in self.views))

    @property
    def dense_bytes(self) -> int:
        """Of all maps on disk."""
        return _HALF * self.pixels * self.channels

    @property
    def missing_bytes(self) -> int:
        """Of those maps that are not there yet."""
        maps = ((count, cost.map_size) for count, _, cost in self.missing if cost.map_size)
        return sum(_HALF * count * h * w * self.channels for count, (h, w) in maps)

    def _grid(self, cost: TeacherCost) -> int:
        h, w = cost.map_size or (0, 0)
        options = self.config.codebook
        most = options.samples_of(self.count)
        rows, columns = options.grid_step or choose_grid_step(h, w, most)
        found = max(1, -(-(h - rows // 2) // rows)) * max(1, -(-(w - columns // 2) // columns))
        return min(found, most) if options.adaptive else found

    def title(self, device: torch.device) -> str:
        """What is planned, in a line."""
        (height, width), fuse = self.views[0][1], self.config.method == "fuse"
        steps, method = (self.config.color.field.steps, "fuse") if fuse else (self.config.field.steps, self.config.mode)
        maps = f"{self.channels} channels at {say_size(self.cost.map_size)}" if self.known else "maps of unknown size"
        stored = {"keep": "kept", "discard": "discarded", "recompute": "made anew instead of stored"}[self.dense]
        return (
            f"{self.count} views of {width}x{height}, {self.cost.name} ({maps}, {stored}), {method}, "
            f"{steps} steps, on {device} ({self.speed.threads} threads, {self.speed.flops / 1e9:.0f} GFLOP/s)"
        )

    def stages(self, device: torch.device) -> list[StagePlan]:
        """All stages in their order."""
        found = [] if self.existing or sum(self.made) == self.count else [self.features(device)]
        if self.config.method == "fuse":
            return [*found, self.geometry(device), self.uplift()]
        if self.config.mode != "decouple":
            found += [self.codebook(), self.index_maps(device)]
        if self.config.mode == "adc+sc":
            found.append(self.autoencoder())
        found.append(self.field(device))
        return [*found, self.answers()]

    def _teacher_seconds(self, device: torch.device) -> float | None:
        """One run over the pictures that lack a map, what is written not counted."""
        total = add([None if cost.flops is None else count * cost.flops for count, _, cost in self.missing])
        if total is None:
            return None
        pictures = self.count - sum(self.made)
        if device.type == "cuda":
            speed = measure_speed(device).flops * work.GPU_FEATURES_EFFICIENCY
            return total / speed + pictures * work.PICTURE_WORK / self.speed.flops
        return work.features_work(total, pictures, 0) / self.speed.flops

    def features(self, device: torch.device) -> StagePlan:
        """The teacher over all pictures without a map, and its maps (or the codebook's samples of them) on disk."""
        flops, forwards, left = self.cost.flops, self.cost.forwards, self.count - sum(self.made)
        if flops is None:
            disk = self.missing_bytes if self.known and self.dense != "recompute" else None
            return StagePlan("features", f"{left} pictures, cost unknown", None, None, disk, disk)
        network = f"{forwards} x {flops / forwards / 1e12:.2f} TFLOP" if forwards > 1 else f"{flops / 1e12:.2f} TFLOP"
        peak = work.BASE_BYTES + max(cost.peak_bytes or 0 for _, _, cost in self.views)
        seconds = self._teacher_seconds(device)
        if self.dense == "recompute":
            disk, kept = _HALF * self.samples * self.channels, 0
            what = f"{left} pictures of {network}, samples stored"
        else:
            disk, kept = self.missing_bytes, self.missing_bytes if self.dense == "keep" else 0
            what = f"{left} pictures of {network}"
        assert seconds is not None
        seconds += disk / _HALF * work.WRITE_WORK / self.speed.flops
        return StagePlan("features", what, seconds, peak, disk, kept)

    def codebook(self) -> StagePlan:
        """Adaptive Data Compression, Sec. 3.3.1."""
        options, first = self.config.codebook, self._grid(self.cost)
        passes = f"{options.passes} pass{'es' if options.passes > 1 else ''}"
        if not self.known:
            return StagePlan("codebook", f"{passes} over unknown maps", None, None, None, None)
        size = _FLOAT * options.maximum * self.channels
        amount = work.codebook_work(options, self.samples, first, self.channels)
        together = self.samples if options.adaptive else first
        peak = work.codebook_peak(together, self.channels, options.maximum, adaptive=options.adaptive)
        what = f"{passes} over {first:,} features a map"
        return StagePlan("codebook", what, amount / self.speed.flops, work.BASE_BYTES + peak, size, size)

    def index_maps(self, device: torch.device) -> StagePlan:
        """Quantisation of every pixel, Eq. 5."""
        if not self.known:
            return StagePlan("index maps", f"{self.count} maps of unknown size", None, None, None, None)
        K = self.config.codebook.maximum
        seconds: float | None = work.quantize_work(self.pixels, self.channels, K) / self.speed.flops
        peak, what = work.BASE_BYTES + 2 * self.largest, f"{self.count} maps of {say_size(self.cost.map_size)}"
        if self.dense == "recompute" and not self.existing:
            seconds, what = add([seconds, self._teacher_seconds(device)]), f"{what}, each made anew"
            peak += max(cost.peak_bytes or 0 for _, _, cost in self.views)
        size = self.pixels * (1 if K <= 255 else 2)
        return StagePlan("index maps", what, seconds, peak, size, size)

    def autoencoder(self) -> StagePlan:
        """Semantic Compression, Sec. 3.3.2."""
        options, K = self.config.autoencoder, self.config.codebook.maximum
        what = f"{options.steps:,} steps on {K} codewords"
        if not self.known:
            return StagePlan("autoencoder", what, None, None, None, None)
        size = _FLOAT * work.autoencoder_weights(options, self.channels)
        seconds = work.autoencoder_work(options, self.channels, K) / self.speed.flops
        return StagePlan("autoencoder", what, seconds, work.BASE_BYTES + 8 * size, size, size)

    def field(self, device: torch.device) -> StagePlan:
        """Training; parameters of the stage and of the finished field are kept, a checkpoint goes."""
        options = self.config.field
        mean, last = work.gaussian_counts(options, self.points)
        guessed = f"{options.steps:,} steps, {self.points / 1e3:.1f}k points, perhaps {last / 1e3:.1f}k Gaussians"
        if not self.known:
            return StagePlan("field", guessed, None, None, None, None)
        compressed = self.config.mode == "adc+sc"
        channels = self.config.autoencoder.latent if compressed else self.channels
        h, w = self.cost.map_size or (0, 0)
        pixels = work.render_pixels(options, self.views[0][1], (h, w))
        step = work.step_work(pixels, mean, channels, h * w) / self.speed.flops
        if device.type == "cuda":
            faster = measure_speed(device).flops / self.speed.flops
            step = max(work.GPU_STEP_SECONDS, step / faster)
        if self.config.mode == "decouple":  # every step reads a dense map
            step += h * w * channels * work.READ_WORK / self.speed.flops
        size = work.field_bytes(last, channels)
        shared = 0 if not compressed else _FLOAT * work.autoencoder_weights(self.config.autoencoder, channels)
        book = 0 if self.config.mode == "decouple" else _FLOAT * self.config.codebook.maximum * self.channels
        kept = 2 * size + shared + book
        targets = (_FLOAT * h * w * channels * 2, self.pixels)
        peak = work.BASE_BYTES + work.field_peak(pixels, last, channels, targets)
        return StagePlan("field", guessed, options.steps * step, peak, kept + 3 * size, kept)

    def geometry(self, device: torch.device) -> StagePlan:
        """Gaussians trained on the pictures, to fuse onto; a splat of the user's takes their place."""
        options, (height, width) = self.config.color.field, self.views[0][1]
        last = options.max_gaussians or work.gaussian_counts(options, self.points)[1]
        mean = (self.points + last) / 2
        pixels = [height * width // options.divisor(step) ** 2 for step in range(1, options.steps + 1)]
        step = work.step_work(sum(pixels) / len(pixels), mean, COLOR_CHANNELS, 0) / self.speed.flops
        if device.type == "cuda":
            step = max(work.GPU_STEP_SECONDS, step * self.speed.flops / measure_speed(device).flops)
        size = work.field_bytes(last, COLOR_CHANNELS)
        peak = work.BASE_BYTES + work.field_peak(
            height * width, last, COLOR_CHANNELS, (3 * height * width * self.count,)
        )
        what = f"{options.steps:,} steps on the pictures, perhaps {last / 1e3:.1f}k Gaussians; none with --splat"
        return StagePlan("color", what, options.steps * step, peak, 2 * size + 3 * size, 2 * size)

    def uplift(self) -> StagePlan:
        """Maps averaged onto the Gaussians and corrected: the views once in the working directions, and twice in few."""
        options, (height, width) = self.config.uplift, self.views[0][1]
        what = f"{self.count} maps onto the Gaussians, at most {options.max_gaussians or 'all'} left"
        if not self.known:
            return StagePlan("uplift", what, None, None, None, None)
        fields = self.config.color.field
        last = fields.max_gaussians or work.gaussian_counts(fields, self.points)[1]
        pixels, channels = min(options.pixels, height * width), min(WORKING, self.channels)
        passes = [channels] + [options.max_latents] * 2 * options.corrections
        amount: float = self.count * sum(work.step_work(pixels, last, one, 0) for one in passes) / 2  # no backward pass
        amount += self.pixels * self.channels * (work.READ_WORK + 2 * channels)
        seconds: float | None = amount / self.speed.flops
        peak = work.BASE_BYTES + 2 * self.largest + 2 * 2 * _FLOAT * last * (channels + 1)
        if self.dense == "recompute" and not self.existing:
            seconds = add([seconds, self._teacher_seconds(torch.device("cpu"))])
            peak += max(cost.peak_bytes or 0 for _, _, cost in self.views)
        size = 2 * _FLOAT * (min(last, options.max_gaussians or last) * (13 + options.max_latents))
        working = (
            _HALF * self.count * channels * min(options.pixels, self.pixels // max(1, self.count))
        )  # a temporary file
        return StagePlan("uplift", what, seconds, peak, size + working, size)

    def answers(self) -> StagePlan:
        """What each Gaussian of the trained field answers with: every view rendered once and averaged onto the Gaussians."""
        what = f"{self.count} views averaged onto the Gaussians"
        if not self.known:
            return StagePlan("answers", what, None, None, None, None)
        _, last = work.gaussian_counts(self.config.field, self.points)
        rank = self.channels if self.config.mode == "decouple" else min(self.channels, self.config.codebook.maximum)
        latents, (height, width) = min(MOST, rank), self.views[0][1]
        rendered = self.config.autoencoder.latent if self.config.mode == "adc+sc" else self.channels
        pixels = min(PIXELS, height * width)
        amount = self.count * sum(work.step_work(pixels, last, channels, 0) for channels in (rendered, latents))
        peak = work.BASE_BYTES + work.field_peak(pixels, last, max(rendered, latents), ())
        size = 2 * _FLOAT * (last * (latents + 2) + latents * self.channels)  # in the stage and in the finished field
        return StagePlan("answers", what, amount / self.speed.flops, peak, size, size)

    def notes(self, device: torch.device) -> list[str]:
        """What a reader should know besides the numbers."""
        found = ["times are rough, within a factor of two or so, at the speed that this machine has at the moment"]
        if self.cost.assumed is not None:
            found.append(f"{self.cost.name} is counted with {self.cost.assumed}; --weights tells its size")
        if sum(self.made):
            found.append(f"{sum(self.made)} of {self.count} maps exist and are not made again")
        if self.others is not None:
            found.append(self.others)
        if self.cost.flops is None:
            found.append(f"the cost of {self.cost.name!r} is unknown: no size, time or memory of its maps is foretold")
        if device.type == "cuda":
            found.append(
                "times of features and field on the GPU are estimates from operations and an assumed efficiency; none was "
                "measured"
            )
        if self.points < 2:
            found.append(f"the scene has {self.points} points; training needs some: estimate them with `kfgs sfm`")
        if self.existing or not self.known:
            return found
        if self.dense == "recompute" and self.samples == self.pixels and self.config.method == "paper":
            found.append(
                "the codebook looks at every feature of these maps: keeping them takes no more disk, and half the time"
            )
        if self.dense == "keep" and not self.config.needs_maps:
            left = f"the {bytes_in_words(self.dense_bytes)} of maps can be deleted once the field is made"
            found.append(f"{left} (kfgs fit --discard-features)")
        return found


def _existing(
    folder: Path, pictures: list[tuple[str, tuple[int, int]]], costs: dict[tuple[int, int], TeacherCost]
) -> tuple[Counter[tuple[int, int]], str | None]:
    """Of how many (stem, size) there is a map of the teacher in a folder, by size; and a note if they are another's.

    Only the teacher's name and the maps' shapes are compared: its weights are not read to plan.
    """
    made, manifest = Counter[tuple[int, int]](), read_manifest(folder)
    name = next(iter(costs.values())).name
    if manifest is None or not manifest.maps or ":" in name:  # what a teacher of one's own calls itself is not known
        return made, None
    whose = manifest.teacher.get("name")
    if whose != name:
        return made, _say_others(folder, f"by {whose!r}")
    for stem, size in pictures:
        record, cost = manifest.maps.get(stem), costs[size]
        if record is None or not (folder / record.file).is_file():
            continue
        if cost.map_size is not None and tuple(record.shape) != (*cost.map_size, cost.channels):
            return Counter(), _say_others(folder, f"of another shape, {tuple(record.shape)}")
        made[size] += 1
    return made, None


def _own_maps(teacher: str, folder: Path, stems: list[str]) -> TeacherCost | None:
    """The cost of a teacher of one's own (`package.module:name`) that has made every map already: none; else None."""
    manifest = read_manifest(folder)
    if manifest is None or manifest.teacher.get("source") != teacher:
        return None
    records = [manifest.maps.get(stem) for stem in stems]
    there = [record for record in records if record is not None and (folder / record.file).is_file()]
    return TeacherCost.of_maps(teacher, there[0].shape) if len(there) == len(stems) else None


def _say_others(folder: Path, which: str) -> str:
    return f"{folder} holds maps {which}; `kfgs features` asks for --out with another folder, or --overwrite"


def add(values: list[Any]) -> Any:
    """Their sum, or None if one is not known."""
    return None if any(value is None for value in values) else sum(values)


def say_size(size: tuple[int, int] | None) -> str:
    """(h, w) for people."""
    return "unknown size" if size is None else f"{size[0]}x{size[1]}"
