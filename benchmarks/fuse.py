"""The default method on one scene: quality, size and time, over several seeds.

    python benchmarks/fuse.py SCENE MAPS OUT [--splat FILE] [--seeds 0 1 2] [--words COCO.npy] [--truth labels_scored] [--uplift]
        [--device cuda]

SCENE holds classes.json, text.npy and label pictures; MAPS a teacher map for every training view (and for every test view if the
teacher is to be scored). Without --splat the geometry is trained from the pictures, its time counted. --words are text embeddings
of the teacher's space [C, D] with which open vocabulary is checked; --uplift adds rows that keep every Gaussian of the splat.

--device is where the rows of --uplift fuse. `kfgs.fit` takes a GPU if there is one (CUDA_VISIBLE_DEVICES= hides it), and all
fields are scored on the CPU. Name a new OUT for another device: finished stages are kept.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import numpy as np
import torch
from devices import add_device, device_name, wait

from kfgs import FeatureFolder, Gaussians, SemanticField, Uplift, fit, load_label_set, load_scene, read_splats
from kfgs._files import write_json
from kfgs.evaluation.label_pictures import load_label_map
from kfgs.fields import UpliftConfig, uplift_maps
from kfgs.pipeline import score_scene, score_teacher, true_labels
from kfgs.pipeline.maps import maps_of_views
from kfgs.splat import average_views, vote_labels


class Room:
    """The scene with its truth."""

    def __init__(self, folder: Path, maps: Path, truth: str) -> None:
        self.scene, self.folder = load_scene(folder).undistorted(), folder
        self.classes = load_label_set(folder / "classes.json", folder / "text.npy")
        self.maps = FeatureFolder(maps).of(self.scene, "train")
        self.truth = true_labels(self.scene, folder / truth, "test")
        self.labels = folder / truth

    def score(self, field: SemanticField) -> tuple[float, float]:
        """(mIoU, accuracy) in percent on the unseen views."""
        by_stem = {self.scene.stem(i): self.scene.cameras[i] for i in self.scene.views("test")}
        found = {stem: field.segment(by_stem[stem], self.classes) for stem in self.truth}
        scores = score_scene(found, self.truth, self.classes)
        return 100 * scores.miou.value, 100 * scores.accuracy.value

    def queries(self, field: SemanticField) -> float:
        """Mean IoU of one query per class with the labels that 30 views vote for, over the Gaussians that they agree on."""
        views = []
        for i in self.scene.views("train")[::3]:
            labels = load_label_map(self.labels / f"{self.scene.stem(i)}.png")
            views.append((self.scene.cameras[i], torch.where(labels == 255, -1, labels).long()))
        voted = vote_labels(field.gaussians, views, len(self.classes)).labels
        sure, ious = voted >= 0, []
        for label, name in enumerate(self.classes.names):
            found, true = field.query(name, self.classes).mask & sure, (voted == label) & sure
            if bool(true.any()):
                ious.append(float((found & true).sum() / (found | true).sum()))
        return statistics.mean(ious)


def uplifted(room: Room, splat: Gaussians, corrections: int) -> tuple[SemanticField, float]:
    """The field of `kfgs.fit`, on the CPU, and the seconds that fusing took on the splat's device."""
    scene = room.scene
    cameras = [scene.cameras[i] for i in scene.views("train")]
    maps = maps_of_views(scene, scene.views("train"), room.maps)
    wait()
    start = time.perf_counter()
    field = uplift_maps(splat, cameras, maps, UpliftConfig(corrections=corrections))
    wait()
    seconds = time.perf_counter() - start
    return field.to("cpu"), seconds


def open_vocabulary(room: Room, field: SemanticField, words: Path) -> dict[str, float]:
    """The latents of a packed field against the average of all channels on its Gaussians, weighted by the pixels they fill."""
    rows = torch.nn.functional.normalize(torch.from_numpy(np.load(words)).float(), dim=1)
    exact = _average_all(room, field)
    own = field.features_of(torch.arange(len(field)))
    cosine = torch.nn.functional.cosine_similarity(own, exact, dim=1)
    same = (own @ rows.T).argmax(1) == (exact @ rows.T).argmax(1)
    ones = ((camera, torch.ones(*camera.size, 1)) for camera in field.cameras)
    weights = average_views(field.gaussians, ones).weights
    weights /= weights.sum()
    return {"cosine": float((cosine * weights).sum()), f"best of {len(rows)} words": float((same * weights).sum())}


def _average_all(room: Room, field: SemanticField) -> torch.Tensor:
    """Every channel fused by the same passes onto the field's own Gaussians: 64 channels at a time, so no basis is lost."""

    class Part:
        def __init__(self, start: int) -> None:
            self.start = start

        def __len__(self) -> int:
            return len(room.maps)

        def __getitem__(self, i: int) -> torch.Tensor:
            features = torch.nn.functional.normalize(room.maps[i].float(), dim=-1)
            part = features[..., self.start : self.start + 63]
            rest = (1 - part.square().sum(-1, keepdim=True)).clamp_min(0).sqrt()  # keeps each row's length at 1
            return torch.cat([part, rest], dim=-1)

    parts = []
    for start in range(0, room.maps[0].shape[-1], 63):
        found = uplift_maps(field.gaussians, field.cameras, Part(start), UpliftConfig(keep=1.0, max_latents=64))
        parts.append(found.decode(found.latents)[:, :-1])
    return torch.cat(parts, dim=1)


def main() -> None:
    """Fit, score and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("maps", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--splat", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--words", type=Path)
    parser.add_argument("--truth", default="labels_scored")
    parser.add_argument("--uplift", action="store_true")
    add_device(parser)
    args = parser.parse_args()
    room, rows = Room(args.scene, args.maps, args.truth), []
    print(f"{device_name(args.device)}, {torch.get_num_threads()} threads")
    stems = list(room.truth)
    try:
        test_maps = FeatureFolder(args.maps, stems)
        size = room.scene.cameras[room.scene.views("test")[0]].size
        teacher = score_teacher(lambda stem: test_maps[stems.index(stem)], room.truth, room.classes, size)
        print(f"teacher: mIoU {100 * teacher.miou.value:.1f}, accuracy {100 * teacher.accuracy.value:.1f}")
    except (FileNotFoundError, ValueError) as error:
        print(f"teacher: not scored ({str(error).splitlines()[0][:80]})")
    if args.uplift and args.splat is not None:
        splat = read_splats(args.splat).to(args.device)
        for corrections in (0, 1):
            field, seconds = uplifted(room, splat, corrections)
            miou, accuracy = room.score(field)
            print(
                f"uplift, {corrections} corrections: {len(field)} Gaussians, {field.decoder.latent} latents, {seconds:.1f} s, "
                f"mIoU {miou:.2f}, accuracy {accuracy:.2f}, queries {room.queries(field):.3f}"
            )
    for seed in args.seeds:
        field = fit(room.scene, room.maps, Uplift(args.splat), folder=args.out / str(seed), seed=seed, report=print)
        small = args.out / f"{seed}.kfgs"
        field.save(small, "small")
        packed = SemanticField.load(small)
        miou, accuracy = room.score(field)
        row = {
            "seed": seed,
            "miou": miou,
            "accuracy": accuracy,
            "queries": room.queries(field),
            "gaussians": len(field),
            "latents": field.decoder.latent,
            "packed_mib": small.stat().st_size / 2**20,
            "miou_packed": room.score(packed)[0],
            "seconds": field.info["seconds"],
            **({} if args.words is None or seed != args.seeds[0] else open_vocabulary(room, packed, args.words)),
        }
        rows.append(row)
        print(row, flush=True)
        write_json(args.out / "fuse.json", rows)
    scores = [row["miou"] for row in rows]
    spread = f" (from {min(scores):.2f} to {max(scores):.2f})" if len(scores) > 1 else ""
    print(f"mIoU {statistics.mean(scores):.2f}{spread} over {len(scores)} seeds")


if __name__ == "__main__":
    main()
