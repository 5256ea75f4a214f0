"""Figure 7: decoded features as pictures: the teacher's, after quantisation, and rendered by fields.

    python benchmarks/figure7.py SCENE FEATURES OUT.png FIELD [FIELD ...] [--views STEM ...] [--names NAME ...]

A FIELD is what `kfgs fit` wrote, for instance OUT/rows/adc-quick-0/run/field.kfgs of `table1.py`. All pictures share three
colour axes, the principal ones of the teacher's unit features in these views; FEATURES must hold maps of them. The column
"quantised" shows the teacher's map through the codebook of the first field that has one.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from baselines.common import within
from torch import Tensor

from kfgs._rows import unit_rows
from kfgs.fields import SemanticField
from kfgs.scenes import FeatureFolder, load_scene
from kfgs.viz import FeatureColors
from kfgs.viz.pictures import picture_grid, save_picture

PIXELS = 20_000  # of a rendered map: 512 channels of it take 40 MB


def main() -> None:
    """Render and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("features", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("fields", type=Path, nargs="+")
    parser.add_argument("--views", nargs="+", help="stems; three test views if not given")
    parser.add_argument("--names", nargs="+", help="of the fields, for the titles")
    args = parser.parse_args()
    scene = load_scene(args.scene).undistorted()
    test = scene.views("test")
    chosen = [i for i in test if scene.stem(i) in args.views] if args.views else test[:: max(1, len(test) // 3)][:3]
    maps = FeatureFolder(args.features, [scene.stem(i) for i in chosen])
    fields = [SemanticField.load(path) for path in args.fields]
    book = next((field.decoder.codebook for field in fields if hasattr(field.decoder, "codebook")), None)
    colors = FeatureColors.fit(torch.cat([unit_rows(maps[i].flatten(0, 1)) for i in range(len(chosen))]))

    def shown(features: Tensor) -> object:  # [h, w, D]
        return colors(unit_rows(features))

    rows = []
    for i, view in enumerate(chosen):
        camera = within(scene.cameras[view], PIXELS)
        row: list[object] = [scene.image(view), shown(maps[i])]
        if book is not None:
            row.append(shown(book.codewords[book.quantize(maps[i])]))
        rows.append(row + [shown(field.feature_map(camera)) for field in fields])
    names = args.names or [field.decoder.name for field in fields]
    titles = ["photo", "teacher", *(["quantised"] if book is not None else []), *names]
    save_picture(args.out, picture_grid(rows, titles, width=260))
    print(args.out)


if __name__ == "__main__":
    main()
