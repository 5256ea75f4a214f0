"""How well a few clicks find one thing: the fox of instant-ngp's photos, by the features of any teacher.

    python benchmarks/clicks.py FIELD [FIELD ...] [--clicks FILE.json]    # writes clicks for `kfgs features --examples`

For each field (docs/howto/labels.md makes them; photos of 540x960, `--images` of 270x480): the classes by CLICKS, and the fox in
the unseen photo 0027 against OUTLINE, which was drawn by hand. All numbers are pixels of 270x480.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw

from kfgs import SemanticField, label_set_from_examples, load_scene
from kfgs.fields import Clicks
from kfgs.fields.store import recall_scene

SIZE = (480, 270)  # height, width of the numbers below
VIEW, THING = "0027", "fox"
CLICKS = {  # an entry for each part that looks different
    "fox": [
        ("0018.jpg", [(132, 144), (105, 177), (171, 177)]),
        ("0031.jpg", [(104, 205), (131, 122), (181, 299), (76, 188)]),
        ("0018.jpg", [(132, 271), (110, 255)]),
        ("0031.jpg", [(131, 299), (104, 288)]),
        ("0074.jpg", [(90, 224), (60, 235)]),
    ],
    "board": [
        ("0018.jpg", [(83, 276), (190, 265), (132, 332)]),
        ("0031.jpg", [(203, 321), (153, 376)]),
        ("0039.jpg", [(133, 249), (78, 293)]),
    ],
    "wall": [
        ("0018.jpg", [(225, 250)]),
        ("0031.jpg", [(241, 111)]),
        ("0039.jpg", [(45, 359)]),
        ("0002.jpg", [(93, 407)]),
    ],
    "flower": [
        ("0018.jpg", [(176, 447), (138, 62)]),
        ("0031.jpg", [(109, 365), (170, 84)]),
        ("0002.jpg", [(139, 431), (34, 310)]),
    ],
    "frame": [
        ("0018.jpg", [(94, 12)]),
        ("0031.jpg", [(110, 20)]),
        ("0074.jpg", [(80, 60)]),
    ],
    "picture": [
        ("0018.jpg", [(39, 45)]),
        ("0025.jpg", [(45, 75)]),
    ],
    "mirror": [
        ("0031.jpg", [(15, 299)]),
    ],
}
OUTLINE = [
    (51, 106), (58, 118), (64, 137), (68, 150), (70, 160), (68, 169), (69, 181), (72, 197), (74, 217),
    (79, 221), (71, 234), (65, 241), (70, 247), (77, 251), (82, 256), (94, 262), (104, 264), (106, 271),
    (108, 285), (112, 299), (112, 319), (125, 334), (139, 343), (159, 347), (173, 352), (187, 346), (201, 334),
    (206, 325), (204, 316), (217, 299), (218, 279), (218, 256), (213, 240), (203, 225), (198, 217), (196, 203),
    (190, 188), (184, 177), (183, 160), (184, 140), (182, 112), (179, 92), (170, 81), (164, 79), (153, 91),
    (145, 106), (139, 122), (136, 132), (122, 133), (108, 139), (96, 135), (82, 129), (71, 118), (58, 108),
]  # fmt: skip


def main() -> None:
    """Print a line for each field."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fields", type=Path, nargs="+")
    parser.add_argument("--clicks", type=Path)
    given = parser.parse_args()
    if given.clicks is not None:
        listed = {name: [{"view": view, "points": points} for view, points in shown] for name, shown in CLICKS.items()}
        given.clicks.write_text(json.dumps(listed, indent=1))
    for path in given.fields:
        field = SemanticField.load(path)
        height = field.cameras[0].height
        examples = {
            name: [Clicks(view, [[x * height / SIZE[0] for x in point] for point in points]) for view, points in shown]
            for name, shown in CLICKS.items()
        }
        classes = label_set_from_examples(field, examples)
        scene = load_scene(recall_scene(field.info)).undistorted()
        [camera] = [one for one in scene.cameras if one.name.startswith(VIEW)]
        found = field.segment(camera, classes) == classes.index(THING)
        true = outline(*camera.size)
        both = float((found & true).sum())
        print(
            f"{path}: IoU {both / float((found | true).sum()):.3f}, found {both / float(true.sum()):.3f} of the {THING}, "
            f"{both / float(found.sum()):.3f} of what was found is {THING}"
        )


def outline(height: int, width: int) -> torch.Tensor:  # [H, W] bool
    """The pixels inside OUTLINE in a picture of this size."""
    picture = Image.new("1", (width, height))
    scale = height / SIZE[0]
    ImageDraw.Draw(picture).polygon([(x * scale, y * scale) for x, y in OUTLINE], fill=1)
    return torch.from_numpy(np.array(picture))


if __name__ == "__main__":
    main()
