"""Pictures of clouds from any camera, drawn by kfgs's rasteriser, and films of them: GIF with Pillow, MP4 with imageio-ffmpeg.

Unlike pyvista it needs no display and no OpenGL, and scores are computed from the same pictures. A *show* is a function from
a camera to a picture [H, W, 3] of the camera's size (uint8, or floats in [0, 1]).
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from .._check import as_array, check_range, check_shapes
from .._files import atomic_path
from ..cameras import Camera, Orbit, as_cameras, orbit_cameras
from ..gaussians import Gaussians
from ..labels import Part
from ..labels.color import parse_color
from ..labels.selection import class_names
from ..labels.transfer import as_cloud
from ..scenes import Scene
from ..splat import rasterize
from .colors import Array, ColorBy, FeatureColors, cloud_colors
from .linked import upwards
from .pictures import as_bytes, check_suffix, draw_legend, picture_grid, picture_sheet, resize_photo, save_picture
from .transfer import enclosing

if TYPE_CHECKING:
    from ..fields import SemanticField

Show = Callable[[Camera], Any]
OUTLINE = (213, 94, 0)  # vermilion of Okabe and Ito
FADED = 0.7  # share of white in what is not selected
MOST, WIDTH = 12, 360  # parts in a sheet, and pixels of the picture of each


def show_cloud(
    gaussians: Gaussians | SemanticField,
    *,
    color_by: ColorBy = None,
    feature_colors: FeatureColors | None = None,
    background: str | Sequence[float] = "white",
) -> Show:
    """Make a function camera -> picture [H, W, 3] uint8 that draws a cloud, or a field, with `rasterize`.

    Labels and features become one colour per Gaussian, and the colours are composited (Eq. 3 with three channels), so they
    blend at borders. `rgb` is the colour of the harmonics, which depends on the direction. `background` is a colour by name
    or three numbers in [0, 1]; other arguments as in `add_cloud`.
    """
    gaussians = as_cloud(gaussians)
    if len(gaussians) == 0:
        raise ValueError("gaussians: expected at least one Gaussian to draw, got none; widen the selection")
    painted = gaussians.detach().replace(features=None)
    colors = cloud_colors(gaussians, color_by, feature_colors)
    if colors.name != "sh":
        painted = painted.replace(features=torch.from_numpy(colors.rgb).to(gaussians.means) / 255, sh=None)
    paper = torch.tensor(parse_color(background, "background")).to(gaussians.means)

    def show(camera: Camera) -> Array:
        with torch.no_grad():
            return as_bytes(rasterize(painted, camera.to(painted.means), background=paper).map)

    return show


def show_selection(gaussians: Gaussians, mask: Tensor, under: Show | None = None) -> Show:  # mask: [N] bool
    """Make a function camera -> picture in which a selection keeps its colours, with an outline, and the rest fades.

    `under` draws the picture, for instance `show_cloud(colors)`; None: the selection is dark on white paper.
    """
    check_shapes(("gaussians.opacities", gaussians.opacities, "N"), ("mask", mask, "N"))
    marked = gaussians.detach().replace(features=mask[:, None].to(gaussians.means), sh=None, labels=None)

    def show(camera: Camera) -> Array:
        from skimage.segmentation import find_boundaries

        with torch.no_grad():
            inside = rasterize(marked, camera.to(marked.means)).map[..., 0].cpu().numpy() > 0.5
        photo = np.where(inside, 60, 255)[..., None].repeat(3, -1) if under is None else as_bytes(under(camera))
        gray = photo.mean(-1, keepdims=True)
        picture = np.where(inside[..., None], photo, FADED * 255 + (1 - FADED) * gray)
        picture[find_boundaries(inside, mode="thick")] = OUTLINE
        return np.rint(picture).astype(np.uint8)

    return show


def write_parts(
    path: Path, gaussians: Gaussians, parts: Sequence[Part], cameras: Sequence[Camera], under: Show | None, name: str
) -> None:
    """Draw the largest parts, each in its best view with an outline, while the rest fades; nothing if no view shows one.

    `parts` are from `connected_parts`, with these cameras. They are titled name/1, name/2.
    """
    drawn: dict[str, Array] = {}
    for number, part in enumerate(parts[:MOST], start=1):
        if part.best_view is not None:
            camera = cameras[part.best_view.index]
            camera = camera.resized(max(1, round(WIDTH * camera.height / camera.width)), WIDTH)
            mask = torch.zeros(len(gaussians), dtype=torch.bool).index_fill_(0, part.indices.cpu(), True)
            title = f"{name}/{number}" + (f" in {camera.name}" if camera.name else "")
            drawn[title] = show_selection(gaussians, mask, under)(camera)
    if drawn:
        save_picture(path, picture_sheet([*drawn.values()], [*drawn], 3))


def show_photos(scene: Scene) -> Show:
    """Make a function camera -> photograph of an undistorted scene, found by the view's name; grey where there is none."""
    places = {camera.name: i for i, camera in enumerate(scene.cameras) if scene.image_paths[i].is_file()}

    def show(camera: Camera) -> Array:
        if camera.name not in places:
            return np.full((*camera.size, 3), 200, np.uint8)
        return as_bytes(resize_photo(scene.image(places[camera.name]), camera.size))

    return show


def save_animation(
    path: str | Path,
    shows: Any,
    cameras: Sequence[Camera] | None = None,
    *,
    fps: float = 15.0,
    legend: Gaussians | SemanticField | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Path:
    """Draw a cloud, or several side by side, from each camera, and write the frames as a GIF or an MP4 video.

    Args:
        path: a name that ends in .gif or .mp4. The file appears whole or not at all.
        shows: a cloud, a field, a function camera -> picture (`show_cloud`), or several of these by title, side by side.
        cameras: one per frame (`kfgs.cameras.orbit_cameras`, `path_cameras`); all frames have the size of the first, in which
            those of other shapes are seen whole. None: once around the first cloud; of a room, what is in front is cut away.
        fps: frames per second; at most 50 in a GIF, because browsers slow down films with shorter frames.
        legend: the labelled cloud, or the field, whose classes are listed below every frame; None: no legend.
        progress: called after each frame with (done, all).
    """
    named = shows if isinstance(shows, Mapping) else {"": shows}
    first: Any = next(iter(named.values()), print)
    if cameras is None and not callable(first):
        cloud, own = as_cloud(first, "shows"), getattr(first, "cameras", ())
        up = upwards(own)
        orbit = Orbit(zoom=1.3, cut=0.6) if enclosing(cloud, own, np.asarray(up)).any() else Orbit()  # walls hide rooms
        cameras = orbit_cameras(cloud.means, orbit, up=up, origin=cloud.origin)
    if not named or not (cameras := as_cameras(cameras or ())):
        advice = "kfgs.cameras.orbit_cameras makes some"
        raise ValueError(f"shows, cameras: expected at least one of each, got none; {advice}")
    target = check_target(path, fps)
    drawn = {title: show if callable(show) else show_cloud(show) for title, show in named.items()}
    labelled = None if legend is None else as_cloud(legend, "legend", labelled=True)

    def frames() -> Iterator[Array]:
        for done, camera in enumerate(cameras, start=1):
            pictures = [as_bytes(show(camera.letterboxed(*cameras[0].size))) for show in drawn.values()]
            frame = pictures[0] if list(drawn) == [""] else picture_grid([pictures], list(drawn))
            if labelled is not None:
                below = draw_legend(as_array(labelled.labels), class_names(labelled), width=frame.shape[1])
                frame = np.concatenate([frame, below])
            yield frame
            if progress is not None:
                progress(done, len(cameras))

    with atomic_path(target) as temporary:
        (_write_gif if target.suffix.lower() == ".gif" else _write_mp4)(temporary, frames(), fps)
    return target


def check_target(path: str | Path, fps: float, name: str = "path") -> Path:
    """Check the target before the first frame is drawn."""
    target = check_suffix(path, ".gif", ".mp4", name=name)
    suffix = target.suffix.lower()
    check_range("fps", fps, 0.01, 50 if suffix == ".gif" else 240)  # a GIF counts to 655 seconds
    if suffix == ".mp4":
        _ffmpeg()
    return target


def _write_gif(path: Path, frames: Iterator[Array], fps: float) -> None:
    # an octree keeps the hue of small areas, as in a legend; dots of dithering would flicker
    indexed = [
        Image.fromarray(frame).quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        for frame in frames
    ]
    # one call for all frames, so that Pillow stores only what changes between two frames
    duration = round(100 / fps) * 10  # milliseconds; the file counts in hundredths of a second
    indexed[0].save(path, format="GIF", save_all=True, append_images=indexed[1:], duration=duration, loop=0)


def _write_mp4(path: Path, frames: Iterator[Array], fps: float) -> None:
    writer = None
    for frame in frames:
        odd = [(0, side % 2) for side in frame.shape[:2]]  # H.264 needs even sizes
        paper = np.pad(frame, [*odd, (0, 0)], constant_values=255)
        if writer is None:
            options = {"fps": fps, "codec": "libx264", "quality": 8, "macro_block_size": 2, "ffmpeg_log_level": "error"}
            writer = _ffmpeg().write_frames(str(path), paper.shape[1::-1], **options)
            writer.send(None)
        writer.send(paper)
    assert writer is not None
    writer.close()


def _ffmpeg() -> Any:
    try:
        return importlib.import_module("imageio_ffmpeg")
    except ImportError as error:
        install = "pip install imageio-ffmpeg (or write a .gif, which needs nothing)"
        wanted = "imageio-ffmpeg to write .mp4, but it is not installed"
        raise ImportError(f"path: expected {wanted}; run: {install}") from error
