"""What each way to fit the codebook keeps of a teacher's classes, without training a field (about a minute a variant).

    python benchmarks/codebook.py SCENE MAPS [--splat SPLAT.ply] [--variants paper adaptive ...] [--seeds 0 1] [--device cuda]

MAPS holds one teacher map per view (test views too, for the scores in 2-D). For each variant: size K, alpha, coverage, mean
similarity, seconds to fit and to quantise; mIoU of the quantised test maps (2-D); and, with a colour splat of the scene,
mIoU of the splat's Gaussians that carry the average of the quantised training maps (`average_views`), each with the class
of its own average ("direct") and with that of the codeword nearest to it ("codeword", Sec. 3.4), rendered as one-hot labels.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import torch
from devices import MapsOn, add_device, device_name, wait
from torch import Tensor
from torch.nn.functional import one_hot

from kfgs.cameras import resize_map
from kfgs.formats import read_splats
from kfgs.labels import classify, load_label_set
from kfgs.pipeline import score_scene, score_teacher, true_labels
from kfgs.quant import Codebook, GrownCodebook, LatentMaps, PaperCodebook, fit_codebook, quantize_maps
from kfgs.scenes import FeatureFolder, load_scene
from kfgs.splat import average_views, rasterize

HEIGHT = 120  # of the maps that are averaged onto the splat
VARIANTS = {
    "paper": PaperCodebook(),
    "paper-10-epochs": PaperCodebook(epochs=10, step_every=2),
    "adaptive": GrownCodebook(),
    "adaptive-100": GrownCodebook(maximum=100),
    "adaptive-512": GrownCodebook(maximum=512),
    "adaptive-1024": GrownCodebook(maximum=1024),
}


def main() -> None:
    """Print one row per variant and seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("maps", type=Path)
    parser.add_argument("--splat", type=Path)
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=["paper-10-epochs", "adaptive"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--truth", default="labels_scored")
    add_device(parser)
    args = parser.parse_args()

    scene = load_scene(args.scene).undistorted()
    classes = load_label_set(args.scene / "classes.json", args.scene / "text.npy")
    rows = classes.embeddings.to(args.device)
    train, test = scene.views("train"), scene.views("test")
    cameras, stems = {scene.stem(i): scene.cameras[i] for i in test}, [scene.stem(i) for i in test]
    maps = MapsOn(FeatureFolder(args.maps).of(scene, "train"), args.device)
    truth = true_labels(scene, args.scene / args.truth, "test")
    splat = None if args.splat is None else read_splats(args.splat).to(args.device)
    seen_in_2d = all(any(args.maps.glob(f"{stem}[._]*")) for stem in stems)
    test_maps = MapsOn(FeatureFolder(args.maps).of(scene, "test"), args.device) if seen_in_2d else None

    def score_2d(change: Callable[[Tensor], Tensor]) -> float:
        assert test_maps is not None
        size = scene.cameras[test[0]].size
        return score_teacher(lambda stem: change(test_maps[stems.index(stem)]).cpu(), truth, classes, size).miou.value

    def average(features: Callable[[int], Tensor]) -> Tensor:  # [N, D]; 0 where no view shows the Gaussian
        def views() -> object:
            for k, i in enumerate(train):
                camera = scene.cameras[i]
                size = HEIGHT, round(HEIGHT * camera.width / camera.height)
                yield camera.resized(*size), resize_map(features(k), size)

        return average_views(splat, views()).values

    def score_3d(labels: Tensor) -> float:  # [N]
        each = dataclasses.replace(splat, sh=None, features=one_hot(labels.clamp_min(0), len(classes.names)).float())
        found = {stem: rasterize(each, camera).map.argmax(dim=-1).cpu() for stem, camera in cameras.items()}
        return score_scene(found, truth, classes).miou.value

    def say(*cells: object) -> None:
        print(
            "| " + " | ".join(f"{cell:.3f}" if isinstance(cell, float) else str(cell) for cell in cells) + " |",
            flush=True,
        )

    print(f"{device_name(args.device)}, {torch.get_num_threads()} threads\n")
    say("variant", "seed", "K", "alpha", "coverage", "similarity", "fit s", "quantise s", "2-D", "direct", "codeword")
    say(*["---"] * 11)
    raw_2d = score_2d(lambda features: features.float()) if test_maps is not None else "-"
    raw_3d = "-"
    if splat is not None:
        raw_3d = score_3d(classify(average(lambda k: maps[k].float()), rows).labels)
    say("not quantised", *["-"] * 7, raw_2d, raw_3d, "-")
    for name in args.variants:
        for seed in args.seeds:
            wait()
            start = time.perf_counter()
            book = fit_codebook(maps, VARIANTS[name], generator=torch.Generator().manual_seed(seed))
            wait()
            fitted = time.perf_counter()
            fit = book.report
            index_maps = quantize_maps(maps, book)  # on the CPU when it returns
            seconds = fitted - start, time.perf_counter() - fitted
            flat: float | str = "-"
            if test_maps is not None:
                flat = score_2d(lambda features, book=book: book.codewords[book.quantize(features)])
            direct: float | str = "-"
            coded: float | str = "-"
            if splat is not None:
                targets = LatentMaps(index_maps, book.codewords)
                carried = average(lambda k, targets=targets: targets[k].nan_to_num())
                direct = score_3d(classify(carried, rows).labels)
                coded = score_3d(_by_codeword(book, carried, rows))
            say(name, seed, book.size, fit.alpha, fit.coverage, fit.mean_similarity, *seconds, flat, direct, coded)
            if fit.note:
                print(f"  {fit.note}")


def _by_codeword(book: Codebook, features: Tensor, embeddings: Tensor) -> Tensor:  # [N]
    return classify(book.codewords, embeddings).labels[book.quantize(features)]


if __name__ == "__main__":
    main()
