"""Write pictures as a film: GIF with Pillow, MP4 with imageio-ffmpeg."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from torch import Tensor

from .._check import check_range
from .._files import as_path, atomic_path
from .._typed import typed
from ..cameras import Camera
from ..gaussians import Gaussians
from .film_frames import Show, as_shows, draw_frame, legend_under
from .pictures import as_bytes, legend_strip

Array = np.ndarray[Any, Any]
Progress = Callable[[int, int], object]
"""Called after each frame with (frames done, frames in all)."""

GIF_FPS = 50.0  # browsers slow down films with shorter frames than 0.02 s
LEGEND_COLORS = 64  # of a GIF frame's 256 colours: 18 classes, ink, paper, and the greys between
MOST_LEGEND_COLORS = 192  # of more classes; the picture keeps 64 of its own, four steps per channel
FFMPEG = "imageio_ffmpeg"
SUFFIXES = (".gif", ".mp4")


@typed
def save_animation(
    path: str | Path,
    shows: Gaussians | Show | Mapping[str, Gaussians | Show],
    cameras: Sequence[Camera],
    *,
    fps: float = 15.0,
    names: Sequence[str] | None = None,
    listed: Tensor | Array | None = None,  # any shape, int
    progress: Progress | None = None,
) -> Path:
    """Draw a cloud, or several side by side, from each camera, and write the frames as a GIF or an MP4 video.

    Args:
        path: a name that ends in .gif or .mp4. The file appears whole or not at all.
        shows: Gaussians (coloured by their labels, else by their harmonics), a function camera -> [H, W, 3] (for instance
            from `show_cloud`), or several of these by title, shown side by side.
        cameras: one per frame, all of one size (`kfgs.cameras.orbit_cameras`, `path_cameras`).
        fps: frames per second, at least 0.01, and at most 50 in a GIF, which counts hundredths of a second.
        names: class names, for a legend of the labelled Gaussians below every frame, and their colours. Gaussians inside
            functions are not listed.
        listed: the labels in the legend; None: those of the labelled Gaussians.
        progress: called after each frame with (done, all).

    Returns:
        `path`.

    Raises:
        ValueError: if there is nothing to show or no camera, sizes differ, or the name ends otherwise.
        ImportError: for .mp4, if imageio-ffmpeg is not installed.
    """
    if not cameras:
        raise ValueError("cameras: expected at least one camera, got none; make some with kfgs.cameras.orbit_cameras")
    sizes = sorted({camera.size for camera in cameras})
    if len(sizes) > 1:
        raise ValueError(f"cameras: expected one size for all frames, got {sizes}; pass path_cameras(cameras, frames)")
    check_target(path, fps)
    drawn = as_shows(shows, names)
    strip = None
    if names is not None:
        width = draw_frame({title: _blank for title in drawn}, cameras[0]).shape[1]
        strip = legend_under(shows, names, width) if listed is None else legend_strip(listed, names, width)

    def frames() -> Iterator[Array]:
        for done, camera in enumerate(cameras, start=1):
            yield draw_frame(drawn, camera, strip)
            if progress is not None:
                progress(done, len(cameras))

    return _write(path, frames(), fps, strip)


def _blank(camera: Camera) -> Array:
    return np.zeros((camera.height, camera.width, 3), np.uint8)


def save_frames(
    path: str | Path,
    frames: Iterable[Tensor | Array],  # each [H, W, 3], uint8 or floats in [0, 1]
    *,
    fps: float = 15.0,
) -> Path:
    """Write pictures as a GIF (256 colours per frame, repeats for ever) or an MP4 (H.264; odd sizes get a white edge).

    Raises:
        ValueError: if there is no picture, sizes differ, or the name ends neither in .gif nor in .mp4.
        ImportError: for .mp4, if imageio-ffmpeg is not installed.
    """
    return _write(path, frames, fps, None)


def _write(path: str | Path, frames: Iterable[Tensor | Array], fps: float, strip: Array | None) -> Path:
    """Write a film. A GIF keeps the colours of `strip`, the legend below every frame, exactly."""
    target = check_target(path, fps)
    with atomic_path(target) as temporary:
        if target.suffix.lower() == ".gif":
            _write_gif(temporary, _checked(frames), fps, strip)
        else:
            _write_mp4(temporary, _checked(frames), fps)
    return target


def check_target(path: str | Path, fps: float) -> Path:
    """Check the target before the first frame is drawn."""
    target = as_path(path)
    suffix = target.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"path: expected a name that ends in .gif or .mp4, got {target.name!r}; rename it")
    check_range("fps", fps, 0.01, GIF_FPS if suffix == ".gif" else 240)  # a GIF counts to 655 seconds
    if suffix == ".mp4":
        _ffmpeg(target)
    return target


def _checked(frames: Iterable[Tensor | Array]) -> Iterator[Array]:
    shape: tuple[int, ...] | None = None
    for number, frame in enumerate(frames):
        picture = as_bytes(frame)
        wrong = picture.ndim != 3 or picture.shape[2] != 3 or 0 in picture.shape
        if wrong or picture.shape != (shape or picture.shape):
            wanted = "[H, W, 3]" if shape is None else f"{list(shape)} (from frames[0])"
            raise ValueError(f"frames[{number}]: expected {wanted}, got {picture.shape}; draw all of one size")
        shape = picture.shape
        yield picture
    if shape is None:
        raise ValueError("frames: expected at least one picture, got none; was there anything to draw?")


def _write_gif(path: Path, frames: Iterator[Array], fps: float, strip: Array | None) -> None:
    legend = None if strip is None else _few_colors(strip)
    indexed = [_indexed(frame, legend) for frame in frames]
    # one call for all frames, so that Pillow stores only what changes between two frames
    indexed[0].save(
        path,
        format="GIF",
        save_all=True,
        append_images=indexed[1:],
        duration=round(100 / fps) * 10,  # milliseconds; the file counts in hundredths of a second
        loop=0,
    )


def _few_colors(strip: Array) -> tuple[Array, Array]:  # [h, w, 3] -> [h, w] int64, [n, 3]
    """Reduce the legend to 64 colours, or more if its areas have more: those of areas, then the commonest edges of letters."""
    colors, inverse, counts = np.unique(strip.reshape(-1, 3), axis=0, return_inverse=True, return_counts=True)
    places = inverse.reshape(strip.shape[:2])
    windows = np.lib.stride_tricks.sliding_window_view(places, (3, 3))
    inside = (windows == places[1:-1, 1:-1, None, None]).all(axis=(2, 3))  # all neighbours have its colour: no edge
    areas = np.bincount(places[1:-1, 1:-1][inside], minlength=len(colors))
    kept = np.lexsort((-counts, -areas))[: np.clip(np.count_nonzero(areas), LEGEND_COLORS, MOST_LEGEND_COLORS)]
    distances = np.abs(colors[:, None].astype(np.int64) - colors[kept][None].astype(np.int64)).sum(-1)
    return distances.argmin(1)[places], colors[kept]


def _indexed(frame: Array, legend: tuple[Array, Array] | None) -> Image.Image:
    """A frame in 256 colours of its own, including the legend's. No dithering: its dots would flicker.

    An octree keeps the hue of small areas; a median cut, whose mean error is a little lower, paints them like their
    neighbours. With a legend, each pixel takes the nearest of all colours (Pillow looks that up in steps of 4 levels of 255),
    so that a small area has its colour in the legend.
    """
    index, colors = legend if legend is not None else (np.zeros((0, frame.shape[1]), np.int64), frame[:0, 0])
    picture = Image.fromarray(np.ascontiguousarray(frame[: len(frame) - len(index)]))
    free = 256 - len(colors)
    reduced = picture.quantize(free, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    if legend is None:
        return reduced
    table = [*(reduced.getpalette() or [])[: 3 * free]]
    table = [*table, *[0] * (3 * free - len(table)), *colors.ravel().tolist()]
    all_colors = Image.new("P", (1, 1))
    all_colors.putpalette(table)
    nearest = picture.quantize(palette=all_colors, dither=Image.Dither.NONE)
    whole = Image.fromarray(np.concatenate([np.asarray(nearest), index + free]).astype(np.uint8))
    whole.putpalette(table)
    return whole


def _write_mp4(path: Path, frames: Iterator[Array], fps: float) -> None:
    first = next(frames)
    height, width = (first.shape[0] + 1) // 2 * 2, (first.shape[1] + 1) // 2 * 2  # H.264 needs even sizes
    writer = _ffmpeg(path).write_frames(
        str(path), (width, height), fps=fps, codec="libx264", quality=8, macro_block_size=2, ffmpeg_log_level="error"
    )
    writer.send(None)
    try:
        for frame in chain([first], frames):
            paper = np.full((height, width, 3), 255, np.uint8)
            paper[: frame.shape[0], : frame.shape[1]] = frame
            writer.send(paper)
    finally:
        writer.close()


def _ffmpeg(path: Path) -> Any:
    try:
        return importlib.import_module(FFMPEG)
    except ImportError as error:
        raise ImportError(
            f"{path}: expected imageio-ffmpeg to write .mp4, but it is not installed; run: pip install imageio-ffmpeg "
            "(or write a .gif, which needs nothing)"
        ) from error
