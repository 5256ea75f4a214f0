"""The paper's Table 1 on one scene: fit each row, score it on unseen views, and print the table.

    python benchmarks/table1.py SCENE FEATURES OUT [--modes decouple adc adc+sc] [--preset cpu] [--truth labels_scored]

FEATURES holds a teacher map for every training view, and for every test view too if the teacher is to be scored. Times
are of this machine; a run folder that is already there is used again and keeps the times it was made with.
"""

from __future__ import annotations

import argparse
import dataclasses
import platform
import time
from functools import partial
from pathlib import Path

import torch

from kfgs._files import write_json
from kfgs.evaluation import load_label_set
from kfgs.features import FeatureFolder
from kfgs.pipeline import FitConfig, fit_scene, score_scene, score_teacher, segment_scene, true_labels
from kfgs.scenes import load_scene

NAMES = {"decouple": "just decouple", "adc": "decouple + ADC", "adc+sc": "decouple + ADC + SC"}


def frames_per_second(work, cameras) -> float:
    """Median over the cameras of 1 / seconds, after one warm-up."""
    work(cameras[0])
    times = []
    for camera in cameras:
        start = time.perf_counter()
        work(camera)
        times.append(time.perf_counter() - start)
    return 1 / sorted(times)[len(times) // 2]


def segment(field, embeddings, rule, camera) -> None:
    """One frame of labels."""
    field.segment(camera, embeddings, rule=rule)


def main() -> None:
    """Fit, score and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("features", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--modes", nargs="+", choices=NAMES, default=list(NAMES))
    parser.add_argument("--preset", choices=("cpu", "paper"), default="cpu")
    parser.add_argument("--steps", type=int)
    parser.add_argument("--truth", default="labels_scored")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()

    scene = load_scene(args.scene).undistorted()
    classes = load_label_set(args.scene / "classes.json", args.scene / "text.npy")
    test = scene.views("test")
    maps = FeatureFolder(args.features).of(scene, "train")
    stems = [scene.stem(i) for i in test]
    truth = true_labels(scene, args.scene / args.truth, "test")
    report: dict[str, object] = {"machine": f"{platform.processor()}, {torch.get_num_threads()} threads"}
    rows = []

    test_maps = FeatureFolder(args.features).of(scene, "test")
    teacher = score_teacher(lambda stem: test_maps[stems.index(stem)], truth, classes, scene.cameras[test[0]].size)
    print(f"teacher on the same views: {teacher.miou}\n{teacher.accuracy}")
    report["teacher"] = teacher.to_json()

    for mode in args.modes:
        config = FitConfig.cpu() if args.preset == "cpu" else FitConfig.paper()
        config = dataclasses.replace(config, method="paper", mode=mode, seed=args.seed)
        if args.steps:
            config = dataclasses.replace(config, field=config.field.with_steps(args.steps))
        result = fit_scene(scene, maps, args.out / mode, config, report=print, progress=True)
        field = result.field
        found = segment_scene(field, scene, classes, args.out / mode / "segmentation", progress=True)
        scores = score_scene(found, truth, classes)
        cameras = [scene.cameras[i] for i in test[:12]]
        with torch.no_grad():
            fps = frames_per_second(field.render, cameras)
            rules = ("paper", "fused")
            label_fps = {
                rule: frames_per_second(partial(segment, field, classes.embeddings, rule), cameras[:5])
                for rule in rules
            }
        storage = field.storage() / 2**20
        print(f"{mode}: {scores}")
        rows.append(
            f"| {NAMES[mode]} | {field.gaussians.features.shape[1]} | {100 * scores.miou.value:.1f} | "
            f"{result.seconds / 60:.1f} | {len(field.gaussians) / 1000:.1f}k | {storage:.1f} | {fps:.1f} | "
            f"{', '.join(f'{name} {value:.1f}' for name, value in label_fps.items())} |"
        )
        report[mode] = {
            "scores": scores.to_json(),
            "seconds": {stage.name: stage.seconds for stage in result.stages},
            "gaussians": len(field.gaussians),
            "storage_mib": storage,
            "fps_features": fps,
            "fps_labels": label_fps,
        }
        write_json(args.out / "table1.json", report)
    print("| row | dim | mIoU | training min | Gaussians | storage MiB | FPS features | FPS labels |")
    print("|---|---|---|---|---|---|---|---|")
    print("\n".join(rows))


if __name__ == "__main__":
    main()
