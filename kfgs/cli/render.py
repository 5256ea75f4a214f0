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

KEYS = 40  # cameras of a long walk that become keys: enough to follow it, few enough to smooth out a shaking hand
FPS = 15.0
TITLES = {"photo": "colours", "labels": "classes"}
FRAMES, WIDTH = 72, 480  # of a path without cameras of your own
OVERHEAD = "ceiling"  # left out of an orbit, which looks in from above


def render(
    source: Positional[Path],
    out: Path,
    *,
    path: Walk = "orbit",
    show: Given[str] = None,
    color: Given[Path] = None,
    frames: Given[int] = None,
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
        frames: Number of pictures; by default 72, or one for each camera of your own.
    """
    from tqdm import tqdm

    from ..fields.store import find_field
    from ..viz import save_animation
    from ..viz.films import check_target

    check_output("out", out, "a file")
    check_target(out, FPS, "out")
    walked = read_walk(path, frames)
    field = find_field(source)
    meaning, cameras = open_meaning(field or source, classes, Teacher())
    if classes.loaded is not None:
        cameras = classes.loaded.cameras
    semantic, colors = meaning.gaussians, open_colors(field, color, meaning)
    colors = None if colors is None else colors.with_origin(semantic.origin)
    if path == "orbit":
        semantic, colors = _opened(meaning.names, semantic, colors)
    words = [word.strip() for word in (show or ("labels" if colors is None else "photo,labels")).split(",")]
    shows = {TITLES.get(word, word.removeprefix("query=")): _show(word, meaning, semantic, colors) for word in words}
    walk = walk_of(walked, semantic if colors is None else colors, cameras, frames)
    names, listed = (meaning.names, semantic.labels.unique()) if "labels" in words else (None, None)
    with tqdm(total=len(walk), desc="render", unit="frame") as bar:
        save_animation(out, shows, walk, fps=FPS, names=names, listed=listed, progress=lambda *_: bar.update())
    wrote([out])


def _opened(names: Any, semantic: Any, colors: Any) -> tuple[Any, Any]:
    """Both clouds without the ceiling (of the colours, what is near it) and without what lies far outside."""
    from ..cameras.bounds import robust_bounds
    from ..labels import transfer_labels

    box = robust_bounds(semantic.means.double(), margin=0.02)

    def kept(cloud: Any) -> Any:
        inside = ((cloud.means >= box.low) & (cloud.means <= box.high)).all(dim=1)
        if OVERHEAD in names:
            labels = (semantic if cloud is semantic else transfer_labels(semantic, cloud)).labels
            inside = inside & (labels != names.index(OVERHEAD))
        return cloud.select(inside)

    shown = kept(semantic)
    return shown, None if colors is None else shown if colors is semantic else kept(colors)


def read_walk(path: Walk, frames: int | None) -> Walk | list[Camera]:
    """The cameras of a file or folder, with `frames` those of a smooth path through them; the name of a path as it is.

    It is called before anything else is read.
    """
    from .._check import check_whole
    from ..cameras import path_cameras
    from ..scenes import load_cameras
    from ..scenes.load import is_scene

    if frames is not None:
        check_whole("frames", frames, 2)
    if not isinstance(path, Path):
        return path
    if not (path.is_file() and path.suffix == ".json") and not (path.is_dir() and is_scene(path)):
        raise ValueError(
            "path: expected orbit, cameras, a transforms.json (a name that ends in .json), or a folder with a COLMAP model, "
            f"got {path}; `--path cameras` flies along the cameras of the field"
        )
    own = load_cameras(path)
    return own if frames is None else path_cameras(own, frames, size=own[0].size)


def walk_of(path: Walk | list[Camera], cloud: Any, cameras: list[Camera], frames: int | None) -> list[Camera]:
    """The cameras of a path that `read_walk` gave; those of the scene are needed for a flight along them."""
    from ..cameras import Orbit, orbit_cameras, path_cameras
    from ..viz.linked import upwards

    if isinstance(path, list):
        # the size of the scene, not that of the path, says what is too near to be drawn
        near = min((camera.near for camera in cameras), default=path[0].near)
        return [replace(camera, near=near) for camera in path]
    frames = frames or FRAMES
    if path == "orbit":
        size = (round(WIDTH * 3 / 4), WIDTH)
        orbit = Orbit(frames=frames, size=size, elevation_degrees=45, zoom=1.5, cut=0.6)
        return orbit_cameras(cloud.means, orbit, up=upwards(cameras), origin=cloud.origin)
    if not cameras:
        raise ValueError(
            f"scene: expected --scene for --path {path}, whose cameras it needs, got none; or take an orbit"
        )
    cameras = [camera.with_origin(cloud.origin) for camera in cameras]
    size = (max(1, round(WIDTH * cameras[0].height / cameras[0].width)), WIDTH)
    return path_cameras(cameras, frames, every=max(1, round(len(cameras) / KEYS)), size=size)


def _show(word: str, meaning: Any, semantic: Any, colors: Any) -> Any:
    """The function camera -> picture of a word of --show."""
    from ..viz import show_cloud
    from ..viz.films import show_selection

    under = None if colors is None else show_cloud(colors, color_by="rgb")
    if word == "photo" and under is not None:
        return under
    if word == "labels":
        return show_cloud(semantic, color_by="label", names=meaning.names)
    if word == "features" and semantic.features is not None:
        return show_cloud(semantic, color_by="feature")
    if word.startswith("query="):
        asked = meaning.ask(word.removeprefix("query="))
        say(f"{asked.words}: {len(asked.selection)} of {len(meaning.gaussians)} Gaussians, {asked.selection.summary}")
        return show_selection(meaning.gaussians, asked.selection.mask, under)
    raise ValueError(
        "show: expected photo (which needs --color), labels, features (of a field) or query=TEXT, with commas between, "
        f"got {word!r}; leave it out"
    )
