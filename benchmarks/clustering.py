"""When does quantising help? The paper's claim about its codebook, with teachers that know less and less.

    python benchmarks/clustering.py ROOM TOKENS WORDS.npy OUT [--heads 2 5 15 90] [--books paper-0 ...] [--flat]

ROOM has labels/ and labels_scored/ (room_0); TOKENS are DINOv2's maps of all views (`unseen.py maps` writes OUT/tokens/NAME);
WORDS.npy has a text row per class. A head is fitted on the labels of a few training views, evenly spread. Then, with each book
(the paper's codebook, seeds 0 to 3; kfgs's own): "flat", the teacher's maps of the test views, quantised or not, by the nearest
text, also with texts to which noise is added (three draws, sigma times the length of a unit row); and "field", Gaussians
trained on the maps for 1,000 steps of `Training.cpu()` in 24 principal channels, labelled by Sec. 3.4. All classes, and in
brackets the ten with the most pixels. Finished cells are read back.
"""

from __future__ import annotations

import argparse
from functools import cache
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
import torch
from full_schedule import frequent, principal
from real_teacher import fit_head, labelled_tokens
from torch import Tensor
from torch.nn.functional import linear, normalize

from kfgs import FeatureFolder, Paper, fit, fit_codebook, load_scene
from kfgs._files import read_json, write_json
from kfgs.cameras import resize_map
from kfgs.evaluation import evaluate_segmentation
from kfgs.fields import Training
from kfgs.labels import LabelSet
from kfgs.pipeline import true_labels
from kfgs.quant import Codebook, GrownCodebook, PaperCodebook

SIGMAS, DRAWS, STEPS = (0.5, 1.1), 3, 1_000
BOOKS = {"none": None, **{f"paper-{seed}": PaperCodebook() for seed in range(4)}, "own-0": GrownCodebook()}
IN_3D = ("none", "paper-0", "paper-1", "own-0")


class Task:
    """A room, its tokens and its texts."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args, self.scene = args, load_scene(args.room).undistorted()
        self.names = read_json(args.room / "classes.json")
        self.text = normalize(torch.from_numpy(np.load(args.words)).float(), dim=1)
        self.tokens = FeatureFolder(args.tokens).of(self.scene, "all")
        self.truth = true_labels(self.scene, args.room / "labels_scored", "test")
        self.counts = torch.bincount(torch.cat([labels[labels >= 0] for labels in self.truth.values()])).tolist()
        self.index = {self.scene.stem(i): i for i in self.scene.views("test")}

    @cache  # noqa: B019
    def maps(self, count: int) -> list[Tensor]:  # [h, w, D] of each view, unit rows
        """The maps of the head of some training views."""
        views = self.scene.views("train")
        chosen = [views[round(k)] for k in np.linspace(0, len(views) - 1, count)]
        some = self.scene.select(chosen)
        tokens = [self.tokens[i] for i in chosen]
        inputs, labels = labelled_tokens(tokens.__getitem__, some, self.args.room / "labels")
        weight, bias = fit_head(inputs, labels, self.text, generator=torch.Generator().manual_seed(0))
        return [normalize(linear(self.tokens[i], weight, bias), dim=-1) for i in self.scene.views("all")]

    @cache  # noqa: B019
    def book(self, count: int, name: str) -> Codebook | None:
        """A codebook of a head's maps of the training views."""
        options = BOOKS[name]
        maps = [self.maps(count)[i] for i in self.scene.views("train")]
        seed = torch.Generator().manual_seed(int(name[-1])) if options else None
        return None if options is None else fit_codebook(maps, options, generator=seed)

    def score(self, label: Any) -> dict[str, Any]:
        """Scores of label maps by view."""
        report = evaluate_segmentation(lambda stem: label(self.index[stem]), self.truth, self.names)
        iou = dict(zip(self.names, map(float, report.iou), strict=True))
        return {"miou": report.miou.value, "accuracy": report.accuracy.value, "iou": iou, "pixels": self.counts}

    def flat(self, count: int, name: str) -> dict[str, Any]:
        """The teacher's own maps, quantised and enlarged."""
        book = self.book(count, name)

        def label(i: int, text: Tensor) -> Tensor:
            features = self.maps(count)[i]
            features = features if book is None else normalize(book.codewords, dim=1)[book.quantize(features)]
            return resize_map(features @ text.T, self.scene.cameras[i].size).argmax(-1)

        result = self.score(lambda i: label(i, self.text))
        for sigma in SIGMAS:
            noisy = []
            for draw in range(DRAWS):
                noise = torch.randn(self.text.shape, generator=torch.Generator().manual_seed(draw))
                text = normalize(self.text + sigma * noise / self.text.shape[1] ** 0.5, dim=1)
                noisy.append(self.score(lambda i, text=text: label(i, text))["miou"])
            result[f"sigma {sigma}"] = noisy
        return result

    def field(self, count: int, name: str) -> dict[str, Any]:
        """Gaussians trained on the maps."""
        maps, book = [self.maps(count)[i] for i in self.scene.views("train")], self.book(count, name)
        basis = principal(maps)
        if book is not None:  # of the whole features; then targets are fixed and no codebook is fitted
            maps = [normalize(book.codewords, dim=1)[book.quantize(part)] for part in maps]
        method = Paper(codebook=None, autoencoder=None, training=Training.cpu().with_steps(STEPS))
        field = fit(self.scene, [part @ basis for part in maps], method, seed=0)
        if book is None:
            classes = LabelSet(tuple(self.names), self.text @ basis)
            return self.score(lambda i: field.paper.segment(self.scene.cameras[i], classes))
        rows = normalize(normalize(book.codewords, dim=1) @ basis, dim=1)
        classes = LabelSet(tuple(map(str, range(len(rows)))), rows)
        labels = (book.codewords @ self.text.T).argmax(1)
        return self.score(lambda i: labels[field.paper.segment(self.scene.cameras[i], classes)])

    def cell(self, kind: str, count: int, name: str) -> dict[str, Any]:
        """A result, read back if it is there."""
        file = self.args.out / f"{kind}-{count}-{name}.json"
        if not file.is_file():
            write_json(file, getattr(self, kind)(count, name))
            print(file.stem, f"{100 * read_json(file)['miou']:.1f}", flush=True)
        return dict(read_json(file))


def main() -> None:
    """Score, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("room", "tokens", "words", "out"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--heads", type=int, nargs="+", default=[2, 5, 15, 90])
    parser.add_argument("--books", nargs="+", choices=BOOKS, default=list(BOOKS))
    parser.add_argument("--flat", action="store_true", help="no fields, which take minutes each")
    args = parser.parse_args()
    task = Task(args)
    print(
        "| head of | book | flat | texts with noise "
        + ", ".join(map(str, SIGMAS))
        + " | field |\n|---|---|---|---|---|"
    )
    for count in args.heads:
        for name in args.books:
            flat = task.cell("flat", count, name)
            noisy = ", ".join(f"{100 * mean(flat[f'sigma {sigma}']):.1f}" for sigma in SIGMAS)
            cells = [f"{100 * flat['miou']:.1f} ({100 * frequent(flat):.1f})", noisy, "-"]
            if name in IN_3D and not args.flat:
                field = task.cell("field", count, name)
                cells[2] = f"{100 * field['miou']:.1f} ({100 * frequent(field):.1f})"
            print(f"| {count} views | {name} | {' | '.join(cells)} |", flush=True)
        task.maps.cache_clear()
        task.book.cache_clear()


if __name__ == "__main__":
    main()
