"""The moving picture of the README: a real room flown through, labelled, asked, and edited.

    python docs/pictures/film.py FIELD COLORS.ply SCENE OUT.webp [--ask chair] [--remove chair ...] [--paint "sofa:#3f7f5f"]

(README: --views 24 28 36 28 --ask sofa --remove table bottle "drinking glass" --paint "sofa:#3f7f5f", of the Grey & White Room.)
The camera follows training views of the scene. Four parts: colours as trained, classes, the answer to a word, and the scene
after the edits.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from classes import show_classes
from PIL import Image, ImageDraw, ImageFont

from kfgs import EditList, Recolor, Remove, SemanticField, attach, load_scene, read_splats
from kfgs.cameras import path_cameras
from kfgs.labels import OfClass
from kfgs.viz import show_cloud
from kfgs.viz.films import show_selection

SIZE = (480, 640)  # height and width of the film
FRAMES, BLEND = 96, 5  # in all; of the change from one part to the next
MILLISECONDS = 90


def main() -> None:
    """Draw the film and say its size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("field", "colors", "scene", "out"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--views", type=int, nargs="+", help="keys of the path, among the training views")
    parser.add_argument("--ask", default="chair")
    parser.add_argument("--remove", nargs="+", default=["chair"])
    parser.add_argument("--paint", default="sofa:#3f7f5f")
    given = parser.parse_args()
    field, scene = SemanticField.load(given.field), load_scene(given.scene).undistorted()
    labelled = attach(field, read_splats(given.colors)).gaussians
    thing, paint = given.paint.split(":")
    edited = EditList().then(Remove(given.remove, fill=True)).then(Recolor(thing, paint)).apply(labelled)
    train = scene.views("train")
    keys = [scene.cameras[train[i]] for i in given.views or range(0, len(train), max(len(train) // 6, 1))]
    cloud, names = labelled, labelled.names
    colors = show_cloud(cloud, background="black", color_by="rgb")
    parts = [
        ("an ordinary colour scene", colors),
        ("its classes", show_classes(cloud, names, colors)),
        (f'asked for "{given.ask}"', show_selection(cloud, OfClass(given.ask).select(labelled).mask, colors)),
        (
            f"edited: no {given.remove[0]}, another {thing}",
            show_cloud(edited, background="black", color_by="rgb"),
        ),
    ]
    font, frames, each = ImageFont.load_default(20), [], FRAMES // len(parts)
    for number, camera in enumerate(path_cameras([*keys, keys[0]], FRAMES + 1, size=SIZE)[:-1]):
        part, at = divmod(number, each)
        picture = parts[part][1](camera).astype(float)
        if (left := each - at) <= BLEND:  # fade to the next part
            share = 1 - left / (BLEND + 1)
            picture += share * (parts[(part + 1) % len(parts)][1](camera) - picture)
        frame = Image.fromarray(np.rint(picture).astype(np.uint8))
        ImageDraw.Draw(frame).text(
            (12, SIZE[0] - 34), parts[part][0], "white", font, stroke_width=2, stroke_fill="black"
        )
        frames.append(frame)
    frames[0].save(
        given.out, save_all=True, append_images=frames[1:], duration=MILLISECONDS, loop=0, quality=60, method=6
    )
    print(f"{given.out}: {given.out.stat().st_size / 1e6:.2f} MB, {len(frames)} pictures")


if __name__ == "__main__":
    main()
