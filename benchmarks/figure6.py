"""Figure 6: the number of codewords over training, for one scene or several, by the paper's rule and by the default one.

    python benchmarks/figure6.py OUT SCENE FEATURES [SCENE FEATURES ...] [--epochs 28] [--device cuda]

Writes OUT/figure6.png and OUT/figure6.json. The paper's rule starts from 8 codewords, lets badly represented features join
(alpha = 0.9) and drops those that became too similar (beta = 0.99); the default splits cells as long as that pays.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch
from devices import MapsOn, add_device

from kfgs._files import write_json
from kfgs.quant import GrownCodebook, PaperCodebook, fit_codebook
from kfgs.scenes import FeatureFolder, load_scene
from kfgs.viz.plots import finish, new_figure


def history_of(scene: Path, features: Path, epochs: int | None, device: torch.device) -> dict[str, Any]:
    """Codewords after each epoch of the paper's rule, and after each round of the default one."""
    maps = MapsOn(FeatureFolder(features).of(load_scene(scene).undistorted(), "train"), device)
    paper = PaperCodebook() if epochs is None else PaperCodebook(epochs=epochs)
    found = {}
    for name, config in (("paper", paper), ("default", GrownCodebook())):
        book = fit_codebook(maps, config, generator=torch.Generator().manual_seed(0))
        found[name] = [row["size"] for row in book.report.history]
        print(f"{scene.name}, {name}: {book.size} codewords", flush=True)
    return {"scene": scene.name, "limit": {"paper": paper.maximum, "default": GrownCodebook().maximum}, **found}


def draw(path: Path, scenes: list[dict[str, Any]]) -> None:
    """A panel for each rule, a line for each scene."""
    figure = new_figure(10, 4)
    for panel, (rule, across) in enumerate((("paper", "epoch"), ("default", "round of growth"))):
        axes = figure.add_subplot(1, 2, panel + 1)
        for one in scenes:
            sizes = one[rule]
            axes.plot(range(1, len(sizes) + 1), sizes, "o-", markersize=3, label=f"{one['scene']}: {sizes[-1]}")
        axes.axhline(scenes[0]["limit"][rule], color="0.6", linestyle=":", label="most")
        axes.set(xlabel=across, ylabel="codewords", title=f"{rule} rule", ylim=(0, 1.35 * scenes[0]["limit"][rule]))
        axes.grid(alpha=0.3)
        axes.legend(loc="upper center", ncols=3)
    finish(figure, path)


def main() -> None:
    """Fit and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("pairs", type=Path, nargs="+", metavar="SCENE FEATURES")
    parser.add_argument("--epochs", type=int, help="of the paper's rule; 28 if not given")
    add_device(parser)
    args = parser.parse_args()
    if len(args.pairs) % 2:
        parser.error("expected a folder of features after each scene")
    args.out.mkdir(parents=True, exist_ok=True)
    pairs = zip(args.pairs[::2], args.pairs[1::2], strict=True)
    scenes = [history_of(scene, features, args.epochs, args.device) for scene, features in pairs]
    write_json(args.out / "figure6.json", scenes)
    draw(args.out / "figure6.png", scenes)


if __name__ == "__main__":
    main()
