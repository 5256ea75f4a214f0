"""The command render: a film of a field or a labelled splat."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._files import check_output
from .options import Classes, Given, Positional, Teacher, Walk
from .output import say, wrote
from .view import open_colors, open_meaning

if TYPE_CHECKING:
    from ..cameras import Camera

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.

WORDS = "photo, labels, features or query=TEXT"
KEYS = 40  # cameras of a long walk that become keys: enough to follow it, few enough to smooth out a shaking hand
FPS = 15.0
FRAMES, WIDTH = 72, 480  # of a path without cameras of your own
MOST_FRAMES = 100_000  # more than an hour of film at 25 a second
LARGEST = 1 << 14  # pixels on a side: a square picture in floats takes 3 GB
OVERHEAD = "ceiling"  # left out of an orbit, which looks in from above


def render(
    source: Positional[Path],
    out: Path,
    *,
    path: Walk = "orbit",
    show: Given[str] = None,
    color: Given[Path] = None,
    frames: Given[int] = None,
    width: Given[int] = None,
    classes: Classes,
) -> None:
    """Make a film of a field or a labelled splat: an orbit, or a flight along its cameras or your own.

    Examples:
        kfgs render run/ --out tour.gif
        kfgs render run/ --path cameras --show photo,labels,query=chair --out tour.mp4
        kfgs render labelled.ply --path cameras --scene scene/ --out flight.gif
        kfgs render run/ --path my_cameras.json --out mine.mp4

    Args:
        source: A run folder, a field (RUN/field.kfgs), or a splat with classes.
        out: The film, .gif or .mp4 (which needs imageio-ffmpeg).
        path: orbit goes around the scene and looks in from above: what is in front is cut away, and a class "ceiling" is left
            out. cameras flies along the scene's cameras. A file or folder
            (transforms.json, COLMAP model, scene; without pictures, too) gives cameras of your own: exactly these, in the order
            of their names; or with --frames a smooth path through them.
        show: What stands side by side, with commas between: photo (the colours), labels, features, query=TEXT. By default
            photo,labels, or labels if there are no colours.
        color: Colour splat in the same frame; by default that of the run, or that which the field was made on.
        width: Width of each picture in pixels, by default 480; your own cameras keep theirs.
        frames: Number of pictures; by default 72, or one for each camera of your own.
    """
    from tqdm import tqdm

    from ..fields.store import find_field
    from ..viz import save_animation
    from ..viz.films import SUFFIXES, check_target

    check_output("out", out, "a file")
    if out.suffix.lower() not in SUFFIXES:
        raise ValueError(f"out: expected a name that ends in .gif or .mp4, got {out.name!r}; rename it")
    check_target(out, FPS)
    walked = read_walk(path, frames, film=True)
    field = find_field(source)
    meaning, cameras = open_meaning(field or source, classes, Teacher())
    if (scene := classes.load_scene()) is not None:
        cameras = scene.cameras
    colors = open_colors(field, color, meaning)
    semantic = meaning.gaussians
    colors = None if colors is None else colors.with_origin(semantic.origin)
    if path == "orbit":
        semantic, colors = _opened(meaning.names, semantic, colors)
    words = [word.strip() for word in (show or ("labels" if colors is None else "photo,labels")).split(",")]
    shows = {_title(word): _show(word, meaning, semantic, colors) for word in words}
    walk = walk_of(walked, semantic if colors is None else colors, cameras, frames, width or WIDTH)
    listed = semantic.labels.unique() if "labels" in words else None
    with tqdm(total=len(walk), desc="render", unit="frame") as bar:
        save_animation(
            out,
            shows,
            walk,
            fps=FPS,
            names=None if listed is None else meaning.names,
            listed=listed,
            progress=lambda *_: bar.update(),
        )
    wrote([out])


def _opened(names: Any, semantic: Any, colors: Any) -> tuple[Any, Any]:
    """Both clouds without the ceiling (of the colours, what is near it) and without what lies far outside."""
    from ..cameras.bounds import robust_bounds
    from ..labels import transfer_labels

    box = robust_bounds(semantic.means.double(), margin=0.02)
    label = names.index(OVERHEAD) if OVERHEAD in names else None

    def kept(cloud: Any) -> Any:
        inside = ((cloud.means >= box.low) & (cloud.means <= box.high)).all(dim=1)
        if label is None:
            return cloud.select(inside)
        own = cloud is semantic
        labels = semantic.labels if own else transfer_labels(semantic, cloud).labels
        return cloud.select(inside & (labels != label))

    shown = kept(semantic)
    return shown, None if colors is None else shown if colors is semantic else kept(colors)


def read_walk(path: Walk, frames: int | None, *, film: bool = False) -> Walk | list[Camera]:
    """Check what `walk_of` is asked for, before anything else is read; cameras of your own are read here.

    Args:
        path: the name of a path, or a file or folder with cameras of your own.
        frames: how many cameras; None: as many as there are.
        film: the cameras must be of one size.

    Returns:
        The name of the path, or the cameras.
    """
    from .._check import check_whole
    from ..scenes.load import is_scene

    if frames is not None:
        check_whole("frames", frames, 2, MOST_FRAMES)
    if not isinstance(path, Path):
        return path
    if not ((path.suffix == ".json" and path.exists()) or (path.is_dir() and is_scene(path))):
        raise ValueError(
            "path: expected orbit, cameras, a transforms.json (a name that ends in .json), or a folder with a COLMAP model, "
            f"got {path}; `--path cameras` flies along the cameras of the field"
        )
    return _own_walk(path, frames, film)


def _own_walk(path: Path, frames: int | None, film: bool) -> list[Camera]:
    """The cameras of a file or folder; with `frames`, those of a smooth path through them."""
    from ..cameras import path_cameras
    from ..cameras.paths import TooFewViewsError
    from ..scenes import load_cameras

    own = load_cameras(path)
    sizes = [(camera.width, camera.height) for camera in own]
    if frames is not None:
        sizes = sizes[:1]
    for w, h in sizes:
        if max(w, h) > LARGEST:
            raise ValueError(
                f"path: expected cameras of at most {LARGEST} x {LARGEST} pixels, got {w} x {h} in {path}; make them smaller"
            )
    if film and len(set(sizes)) > 1:
        listed = " and ".join(f"{w}x{h}" for w, h in sorted(set(sizes))[:3])
        raise ValueError(
            f"path: expected cameras of one size for a film, got {listed} in {path}; give --frames, which takes the size of the "
            "first"
        )
    if frames is None:
        return [camera.resized(h, w) for camera, (w, h) in zip(own, sizes, strict=True)]
    try:
        return path_cameras(own, frames, size=sizes[0][::-1])
    except TooFewViewsError as error:
        got = "1" if len(own) == 1 else f"{len(own)} that are all at one place and angle"
        raise ValueError(
            f"frames: expected two different cameras or more to go through, got {got} in {path}; leave it out"
        ) from error


def walk_of(
    path: Walk | list[Camera], cloud: Any, cameras: list[Camera], frames: int | None, width: int = WIDTH
) -> list[Camera]:
    """The cameras of a path that `read_walk` gave. Those of the scene are needed for a flight along them."""
    from ..cameras import Orbit, orbit_cameras, path_cameras
    from ..viz.linked import upwards

    if isinstance(path, list):
        # the size of the scene, not that of the path, says what is too near to be drawn
        near = min((camera.near for camera in cameras), default=path[0].near)
        return [replace(camera, near=near) for camera in path]
    frames = frames or FRAMES
    if path == "orbit":
        size = (round(width * 3 / 4), width)
        orbit = Orbit(frames=frames, size=size, elevation_degrees=45, zoom=1.5, cut=0.6)
        return orbit_cameras(cloud.means, orbit, up=upwards(cameras), origin=cloud.origin)
    if not cameras:
        raise ValueError(
            f"scene: expected --scene for --path {path}, whose cameras it needs, got none; or take an orbit"
        )
    cameras = [camera.with_origin(cloud.origin) for camera in cameras]
    size = (max(1, round(width * cameras[0].height / cameras[0].width)), width)
    return path_cameras(cameras, frames, every=max(1, round(len(cameras) / KEYS)), size=size)


def _title(word: str) -> str:
    return {"photo": "colours", "labels": "classes"}.get(word, word.removeprefix("query="))


def _show(word: str, meaning: Any, semantic: Any, colors: Any) -> Any:
    from ..viz import show_cloud
    from ..viz.films import show_selection

    under = None if colors is None else show_cloud(colors, color_by="rgb")
    if word == "photo":
        if under is None:
            raise ValueError("show: expected --color for photo, got none; name the colour splat of the scene")
        return under
    if word == "labels":
        return show_cloud(semantic, color_by="label", names=meaning.names)
    if word == "features":
        if semantic.features is None:
            raise ValueError("show: expected a field for features, got a splat without; leave it out")
        return show_cloud(semantic, color_by="feature")
    if word.startswith("query="):
        asked = meaning.ask(word.removeprefix("query="))
        say(f"{asked.words}: {len(asked.selection)} of {len(meaning.gaussians)} Gaussians, {asked.selection.summary}")
        return show_selection(meaning.gaussians, asked.selection.mask, under)
    raise ValueError(f"show: expected {WORDS}, got {word!r}; separate them with commas")
