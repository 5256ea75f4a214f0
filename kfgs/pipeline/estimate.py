"""Estimate disk, memory and time of each stage of a run: bytes from shapes, seconds from small runs (`trial`)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Literal

from .._files import seconds_in_words
from ..fields import FieldConfig
from ..fields.answers import MOST
from ..fields.working_maps import WORKING
from ..quant.sampling import choose_grid_step
from .config import FitConfig
from .trial import Timing

Dense = Literal["keep", "discard", "recompute"]
DENSE: tuple[Dense, ...] = ("keep", "discard", "recompute")
HALF, FLOAT = 2, 4  # bytes
GROWTH = {"low": 6.0, "high": 1.15}
"""Assumed ratio of Gaussians at the end of training to points, by the densification threshold: below 4e-4 as in the paper
(110.5k in Table 2, of the 18.5k points of room_0), above it as room_0 and the toy room with the CPU preset. The true ratio
depends on the scene; `max_gaussians` is never exceeded."""
MARGIN = 1.25
"""Factor on the memory of a small run: a long run fragments memory (toy room, 100,000 Gaussians: 1.11 GB, small runs
1.00)."""
TRAINING = 8
"""Copies of the Gaussians in memory during training: values, gradients, Adam's two moments, and temporaries of a step."""


@dataclass(frozen=True)
class StagePlan:
    """The estimate for one stage. None: unknown."""

    name: str
    what: str
    """A description with sizes."""
    seconds: float | None
    peak_bytes: int | None
    """Memory of the whole process while it runs."""
    disk_bytes: int | None
    """Bytes that it writes to disk."""
    kept_bytes: int | None
    """Bytes on disk that stay at the end."""


@dataclass(frozen=True)
class Sizes:
    """The sizes from which disk and memory of the stages follow."""

    config: FitConfig
    dense: Dense
    """Whether maps are kept, discarded or recomputed."""
    points: int
    pictures: tuple[tuple[int, int], ...]
    """(height, width) of each view."""
    shapes: tuple[tuple[int, int, int] | None, ...]
    """(h, w, D) of each view's map; None if unknown."""
    made: tuple[bool, ...]
    """For each view, whether its map exists."""
    done: frozenset[str] = frozenset()
    """Finished stages in the run folder."""
    picture_seconds: float | None = None
    """The teacher's, of all pictures; None if it was not run."""
    teacher_peak: int | None = None
    """Memory of a process that runs the teacher."""
    teacher_bytes: int = 0
    """Memory that the teacher takes."""
    timings: dict[str, Timing] = field(default_factory=dict)
    """Times of the small runs, by stage."""
    base: int = 0
    """Memory of this process before any stage."""

    @property
    def count(self) -> int:
        """Views."""
        return len(self.pictures)

    @property
    def shape(self) -> tuple[int, int, int] | None:
        """(h, w, D) of a map; None if that of a map is unknown."""
        return None if None in self.shapes else self.shapes[0]

    @property
    def pixels(self) -> int:
        """Pixels of all maps."""
        return sum(shape[0] * shape[1] for shape in self.shapes if shape)

    @property
    def render(self) -> int:
        """Pixels of the largest picture."""
        return max(height * width for height, width in self.pictures)

    @property
    def samples(self) -> int:
        """Features of one map that the codebook samples."""
        if self.shape is None:
            return 0
        (h, w, _), options = self.shape, self.config.codebook
        most = options.samples_of(self.count)
        rows, columns = options.grid_step or choose_grid_step(h, w, most)
        found = max(1, -(-(h - rows // 2) // rows)) * max(1, -(-(w - columns // 2) // columns))
        return min(found, most) if options.adaptive else found

    def map_bytes(self, views: Iterable[int]) -> int | None:
        """Bytes of some views' maps on disk, in half precision; None if a shape is unknown."""
        shapes = [self.shapes[i] for i in views]
        return None if None in shapes else sum(HALF * h * w * D for h, w, D in filter(None, shapes))

    @property
    def missing(self) -> list[int]:
        """Views without a map, which the teacher must make."""
        return [i for i, made in enumerate(self.made) if self.dense == "recompute" or not made]


def plan_stages(sizes: Sizes) -> list[StagePlan]:
    """All stages of a run in their order."""
    found = [_features(sizes)] if sizes.missing and not {"uplift", "index_maps"} & sizes.done else []
    if sizes.config.method == "fuse":
        return [*found, _color(sizes), _uplift(sizes)]
    if sizes.config.mode != "decouple":
        found += [_codebook(sizes), _index_maps(sizes)]
    if sizes.config.mode == "adc+sc":
        found.append(_autoencoder(sizes))
    return [*found, _field(sizes), _answers(sizes)]


def _stage(sizes: Sizes, name: str, what: str, count: int, disk: tuple[int, int] | None, *, more: int = 0) -> StagePlan:
    """A stage by its name in the run folder.

    Args:
        sizes: of the run.
        name: of the stage.
        what: its description.
        count: views or steps.
        disk: bytes that it writes, and those that stay; None if the shape of the maps is unknown.
        more: bytes of memory in addition to a small run, which has fewer views or Gaussians.
    """
    title = name.replace("_", " ")
    if name in sizes.done:
        return StagePlan(title, "done already", 0.0, 0, 0, 0)
    if disk is None:
        return StagePlan(title, what, None, None, None, None)
    timing = sizes.timings.get(name)
    if timing is None:  # too large to try
        return StagePlan(title, what, None, sizes.base + more, *disk)
    peak = None if timing.peak is None else round(MARGIN * timing.peak) + more
    return StagePlan(title, what, timing.seconds(count), peak, *disk)


def _features(sizes: Sizes) -> StagePlan:
    """The teacher on all pictures without a map; its maps, or the samples for the codebook, on disk."""
    missing, seconds = sizes.missing, sizes.picture_seconds
    peak = None if sizes.teacher_peak is None else round(MARGIN * sizes.teacher_peak)
    what = f"{len(missing)} pictures"
    if seconds is not None:
        what += f", {seconds_in_words(seconds / max(1, len(missing)))} each"
    if sizes.dense == "recompute":
        disk = None if sizes.shape is None else HALF * sizes.count * sizes.samples * sizes.shape[2]
        return StagePlan("features", f"{what}, samples stored", seconds, peak, disk, disk and 0)
    disk = sizes.map_bytes(missing)
    kept = 0 if disk is not None and sizes.dense == "discard" else disk
    return StagePlan("features", what, seconds, peak, disk, kept)


def _again(sizes: Sizes, stage: StagePlan) -> StagePlan:
    """A stage that reads every map once; if maps are not stored, the teacher runs again in it."""
    if sizes.dense != "recompute" or stage.what == "done already":
        return stage
    peak = None if stage.peak_bytes is None else stage.peak_bytes + sizes.teacher_bytes
    seconds = add([stage.seconds, sizes.picture_seconds])
    return replace(stage, what=f"{stage.what}, each made again", seconds=seconds, peak_bytes=peak)


def _codebook(sizes: Sizes) -> StagePlan:
    """Adaptive Data Compression, Sec. 3.3.1."""
    options = sizes.config.codebook
    passes = f"{options.passes} pass{'es' if options.passes > 1 else ''}"
    if sizes.shape is None:
        return _stage(sizes, "codebook", f"{passes} over unknown maps", sizes.count, None)
    size, D = FLOAT * options.maximum * sizes.shape[2], sizes.shape[2]
    # The adaptive one holds the samples of all maps: four arrays of them, and three of their similarities.
    pool = FLOAT * sizes.count * sizes.samples * (4 * D + 3 * options.maximum) if options.adaptive else 0
    what = f"{passes} over {sizes.samples:,} features a map"
    return _stage(sizes, "codebook", what, sizes.count, (size, size), more=pool)


def _index_maps(sizes: Sizes) -> StagePlan:
    """Quantisation of every pixel, Eq. 5."""
    size = sizes.pixels * (1 if sizes.config.codebook.maximum <= 255 else 2)
    disk = None if sizes.shape is None else (size, size)
    return _again(
        sizes, _stage(sizes, "index_maps", f"{sizes.count} maps of {_say(sizes)}", sizes.count, disk, more=size)
    )


def _autoencoder(sizes: Sizes) -> StagePlan:
    """Semantic Compression, Sec. 3.3.2."""
    options, K = sizes.config.autoencoder, sizes.config.codebook.maximum
    size = _autoencoder_bytes(sizes)
    disk = None if sizes.shape is None else (size, size)
    return _stage(sizes, "autoencoder", f"{options.steps:,} steps on {K} codewords", options.steps, disk)


def _autoencoder_bytes(sizes: Sizes) -> int:
    """Bytes of the weights of encoder and decoder; 0 without an autoencoder."""
    if sizes.shape is None or sizes.config.method != "paper" or sizes.config.mode != "adc+sc":
        return 0
    options, D = sizes.config.autoencoder, sizes.shape[2]
    widths = ((D, *options.encoder, options.latent), (options.latent, *options.decoder, D))
    return FLOAT * sum((a + 1) * b for row in widths for a, b in pairwise(row))


def _channels(sizes: Sizes) -> int:
    """Channels per Gaussian of the paper's field."""
    compressed = sizes.config.mode == "adc+sc"
    return sizes.config.autoencoder.latent if compressed else sizes.shape[2] if sizes.shape else 0


def _field(sizes: Sizes) -> StagePlan:
    """Training; the stage and the finished field stay on disk, the checkpoint does not."""
    options, channels = sizes.config.field, _channels(sizes)
    mean, last = gaussian_counts(options, sizes.points)
    what = f"{options.steps:,} steps, {sizes.points:,} points, perhaps {last:,} Gaussians"
    if sizes.shape is None:
        return _stage(sizes, "field", what, options.steps, None)
    book = 0 if sizes.config.mode == "decouple" else FLOAT * sizes.config.codebook.maximum * sizes.shape[2]
    kept = 2 * gaussian_bytes(last, channels) + book + _autoencoder_bytes(sizes)
    more = sizes.pixels + TRAINING * gaussian_bytes(last - round(mean), channels)
    if "field" not in sizes.timings:
        more = sizes.pixels + training_bytes(sizes)
    disk = (kept + 3 * gaussian_bytes(last, channels), kept)
    return _stage(sizes, "field", what, options.steps, disk, more=more)


def _color(sizes: Sizes) -> StagePlan:
    """Training of Gaussians on the pictures, to fuse onto; not needed with the user's splat."""
    options, colors = sizes.config.color.field, color_channels(sizes.config)
    mean, last = gaussian_counts(options, sizes.points, full=True)
    what = f"{options.steps:,} steps on the pictures, at most {last:,} Gaussians; not needed if you have a splat"
    size, table = gaussian_bytes(last, colors), FLOAT * last * (14 + colors)  # color.ply has normals, too
    photos = round(sum(4 * height * width for height, width in sizes.pictures) * sizes.config.color.picture_scale**2)
    more = photos + TRAINING * gaussian_bytes(last - round(mean), colors)
    if "color" not in sizes.timings:
        more = photos + training_bytes(sizes)
    return _stage(sizes, "color", what, options.steps, (size + table + 3 * size, size + table), more=more)


def _uplift(sizes: Sizes) -> StagePlan:
    """Averaging maps onto the Gaussians, and correction."""
    options = sizes.config.uplift
    kept = "all are kept" if options.max_gaussians is None else f"at most {options.max_gaussians:,} are kept"
    what = f"{sizes.count} maps onto the Gaussians, of which {kept}"
    if sizes.shape is None:
        return _stage(sizes, "uplift", what, sizes.count, None)
    h, w, D = sizes.shape
    _, last = gaussian_counts(sizes.config.color.field, sizes.points, full=True)
    left, latents = min(last, options.max_gaussians or last), min(options.max_latents, D)
    size = 2 * FLOAT * (left * (13 + latents) + latents * D)  # in the stage and in the finished field
    if not sizes.config.discard_sums and options.corrections < 2:
        size += FLOAT * (last * (4 * latents + 4) + latents * D)  # `UpliftSums`
    working = HALF * sizes.count * min(WORKING, D) * min(options.pixels, h * w)  # files of the working maps
    more = 0
    if "uplift" not in sizes.timings:
        more = 2 * FLOAT * h * w * D + 4 * FLOAT * last * (min(WORKING, D) + 1)
    return _again(sizes, _stage(sizes, "uplift", what, sizes.count, (size + working, size), more=more))


def _answers(sizes: Sizes) -> StagePlan:
    """Fused features of a trained field: every view is rendered once and averaged onto the Gaussians."""
    what = f"{sizes.count} views averaged onto the Gaussians"
    if sizes.shape is None:
        return _stage(sizes, "answers", what, sizes.count, None)
    D, (mean, last) = sizes.shape[2], gaussian_counts(sizes.config.field, sizes.points)
    latents = min(MOST, D if sizes.config.mode == "decouple" else min(D, sizes.config.codebook.maximum))
    size = 2 * FLOAT * (last * (latents + 2) + latents * D)  # in the stage and in the finished field
    more = TRAINING * gaussian_bytes(last - round(mean), max(latents, _channels(sizes)))
    return _stage(sizes, "answers", what, sizes.count, (size, size), more=more)


def color_channels(config: FitConfig) -> int:
    """Number of colour coefficients per Gaussian."""
    return 3 * (config.color.sh_degree + 1) ** 2


def gaussian_counts(config: FieldConfig, points: int, *, full: bool = False) -> tuple[float, int]:
    """Guess the mean and the final number of Gaussians (`GROWTH`), with even growth while it densifies.

    With `full`, the final number is `config.max_gaussians`, if there is a limit.
    """
    until = min(config.densify_until, config.steps)
    if until <= config.densify_from:
        return float(points), points
    last = round(points * GROWTH["low" if config.densify_gradient < 4e-4 else "high"])
    if config.max_gaussians is not None:
        last = max(points, config.max_gaussians if full else min(last, config.max_gaussians))
    after, during = config.steps - until, until - config.densify_from
    return (config.densify_from * points + during * (points + last) / 2 + after * last) / config.steps, last


def gaussian_bytes(gaussians: int, channels: int) -> int:
    """Bytes of mean, rotation, scale, opacity and features of some Gaussians, in float32."""
    return FLOAT * gaussians * (11 + channels)


def training_bytes(sizes: Sizes) -> int:
    """The least memory of training, in addition to the process: Gaussians, and three maps of the rendered size."""
    fuse = sizes.config.method == "fuse"
    config, channels = sizes.config, color_channels(sizes.config) if fuse else _channels(sizes)
    _, last = gaussian_counts(config.color.field if fuse else config.field, sizes.points, full=fuse)
    return TRAINING * gaussian_bytes(last, channels) + 3 * FLOAT * sizes.render * ((3 if fuse else channels) + 2)


def _say(sizes: Sizes) -> str:
    return "unknown size" if sizes.shape is None else f"{sizes.shape[0]}x{sizes.shape[1]}"


def add(values: list[Any]) -> Any:
    """The sum, or None if a value is unknown."""
    return None if any(value is None for value in values) else sum(values)
