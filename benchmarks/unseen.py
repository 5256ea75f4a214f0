"""Rooms that nobody tuned on: teachers that have not seen a room, their maps and scores, and the default field on them.

    python benchmarks/real_teacher.py fetch WEIGHTS
    python benchmarks/unseen.py maps OUT ROOM... --weights WEIGHTS --words WORDS.safetensors --logits LOGITS
    python benchmarks/unseen.py table OUT ROOM... --colors COLORS        # COLORS/<name>/color.ply, by `kfgs color`

ROOM is a scene with classes.json and labels/ (of benchmarks/rooms.py; or labels_scored/, which is scored if it is there); its
folder's name is the room's. `maps` writes OUT/TEACHER/<name>/<stem>.npy of all views, the teacher's own score on the test
views to OUT/scores/, and OUT/scenes/TEACHER/<name>: links to ROOM, and text.npy with this teacher's rows of the classes, for
other programs (`python benchmarks/table1.py OUT/scenes/ade/<name> OUT/ade/<name> TABLE`). The teachers:

ade     A network for ADE20K's 150 classes. LOGITS/<name>/<stem>.npy has its logits [h, w, 150], of which 0 is the background and
        1 the wall; any network will do. A class of the room is the largest of some logits (`ADE_WORDS`), and so the map is [h, w,
        C] with one channel per class, and the rows are the identity: the best cosine is the largest score. A field of these maps
        fuses scores by their direction, without their length, and answers only these classes.
loo     DINOv2 with a linear head, fitted as in real_teacher.py on the labelled training views of all *other* rooms.
own     The same with a head that is fitted on the room's own training views.

The rows of loo and own come from WORDS, a label set with the text embeddings of any words (`LabelSet.save`; here COCO-Stuff's
171 names by CLIP ViT-B/16). A class that has no word there (`SYNONYMS`) gets a made-up row, which scatters as the others do.

A class is *known* if ade has a word for it, or if another room has it, for loo. Every class of the room is asked and scored;
what is not known costs points. The second score is the mean IoU over the known classes, of the same label maps.

Both commands continue what was begun. Name a new OUT for other rooms: every head of loo depends on all of them. Remove
OUT/fields to fuse again with another version of kfgs.
"""

from __future__ import annotations

import argparse
import json
import statistics
import zlib
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from real_teacher import SIZE, fit_head, labelled_tokens
from torch import Tensor
from torch.nn.functional import linear, normalize

from kfgs import FeatureFolder, Uplift, fit, load_label_set, load_scene
from kfgs._files import write_json
from kfgs.evaluation import TeacherMethod, View
from kfgs.evaluation.segmentation import SegmentationReport, evaluate_segmentation
from kfgs.labels import LabelSet
from kfgs.pipeline import true_labels
from kfgs.pipeline.maps import maps_of_views
from kfgs.scenes import extract_features, save_feature_map
from kfgs.teachers import load_teacher

ADE20K = Path(__file__).parents[1] / "kfgs/evaluation/data/ade20k.json"
KEYS = ("miou", "known", "accuracy")
TEACHERS = {"ade": "ADE20K network", "loo": "DINOv2, head of the other rooms", "own": "DINOv2, the room's own head"}

# ADE20K's words for a class, the closest first. A word that several classes of a room name is the one's that names it earliest.
ADE_WORDS: dict[str, list[str]] = {
    "wall": ["wall"],
    "ceiling": ["ceiling"],
    "floor": ["floor"],
    "rug": ["rug"],
    "window": ["windowpane"],
    "window blind": ["blind", "windowpane", "curtain"],
    "sofa": ["sofa", "armchair"],
    "armchair": ["armchair"],
    "cushion": ["cushion", "pillow"],
    "blanket": ["blanket"],
    "table": ["table", "coffee table", "desk"],
    "chair": ["chair", "swivel chair", "seat"],
    "stool": ["stool", "ottoman"],
    "cabinet": ["cabinet", "chest of drawers", "wardrobe", "shelf"],
    "bookcase": ["bookcase", "shelf"],
    "lamp": ["lamp", "light", "sconce", "chandelier"],
    "picture": ["painting", "poster"],
    "mirror": ["mirror"],
    "door": ["door"],
    "plant": ["plant", "flower", "tree"],
    "vase": ["vase", "pot"],
    "book": ["book"],
    "fireplace": ["fireplace"],
    "television": ["television", "crt screen", "monitor", "projection screen"],
    "radiator": ["radiator"],
    "sculpture": ["sculpture"],
    "bottle": ["bottle"],
    "drinking glass": ["glass"],
    "cup": ["glass"],
    "teapot": ["pot"],
    "jug": ["vase"],
    "bowl": ["plate"],
    "apple": ["food"],
}  # none: magazine, radio, candle holder, socket

# Words of COCO-Stuff for a class; the others have a word of their own name, or none.
SYNONYMS = {
    "wall": "wall-concrete", "ceiling": "ceiling-tile", "floor": "floor-other", "window": "window-other",
    "window blind": "window-blind", "sofa": "couch", "cushion": "pillow", "stool": "bench", "lamp": "light",
    "picture": "banner", "door": "door-stuff", "plant": "potted plant", "television": "tv", "bookcase": "shelf",
    "mirror": "mirror-stuff", "drinking glass": "wine glass", "magazine": "paper",
}  # fmt: skip


class Room:
    """A labelled scene."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.scene = folder.resolve(), load_scene(folder).undistorted()
        self.name = self.folder.name
        self.labels = folder / "labels"
        self.names: list[str] = json.loads((folder / "classes.json").read_text(encoding="utf-8"))
        scored = folder / "labels_scored"
        self._scored = scored if scored.is_dir() else self.labels

    @cached_property
    def truth(self) -> dict[str, Tensor]:
        """The scored labels [H, W] of the test views."""
        return true_labels(self.scene, self._scored, "test")

    def score(self, segment: Callable[[int], Tensor], known: Sequence[str]) -> dict[str, Any]:
        """Scores of the test views in percent, `segment` giving the label map of the scene's view i."""
        index = {self.scene.stem(i): i for i in self.scene.views("test")}
        report: SegmentationReport = evaluate_segmentation(lambda stem: segment(index[stem]), self.truth, self.names)
        iou = {name: float(value) for name, value in zip(self.names, report.iou, strict=True) if value == value}
        return {
            "miou": 100 * report.miou.value,
            "known": 100 * statistics.mean(value for name, value in iou.items() if name in known),
            "accuracy": 100 * report.accuracy.value,
            "iou": iou,
        }


def ade_channels(names: Sequence[str]) -> list[list[int]]:
    """The logits of each class of a room: indices of ADE20K's classes from 1, as `ADE_WORDS` names them."""
    words = json.loads(ADE20K.read_text(encoding="utf-8"))["full"]
    groups = [ADE_WORDS.get(name, []) for name in names]

    def owner(word: str) -> int:
        return min((group.index(word), k) for k, group in enumerate(groups) if word in group)[1]

    return [[1 + words.index(word) for word in group if owner(word) == k] for k, group in enumerate(groups)]


def group_scores(logits: Tensor, channels: Sequence[Sequence[int]]) -> Tensor:  # [h, w, L] -> [h, w, C]
    """The largest logit of each class; a class without any gets the pixel's lowest score, so that it never wins."""
    known = torch.stack([logits[..., rows].amax(-1) for rows in channels if rows], -1)
    scores = known.amin(-1, keepdim=True).repeat(1, 1, len(channels))
    scores[..., [k for k, rows in enumerate(channels) if rows]] = known
    return scores


def text_rows(names: Sequence[str], words: LabelSet) -> Tensor:  # [C, D], unit rows
    """The embedding of each class's word, or a made-up one with the words' mean and covariance, the same in every room."""
    rows = normalize(words.embeddings.float(), dim=1)
    made = []
    for name in names:
        word = SYNONYMS.get(name, name)
        if words.knows(word):
            made.append(rows[words.index(word)])
        else:
            generator = torch.Generator().manual_seed(zlib.crc32(name.encode()))
            shares = torch.randn(len(rows), generator=generator) / len(rows) ** 0.5
            made.append(rows.mean(0) + shares @ (rows - rows.mean(0)))
    return normalize(torch.stack(made), dim=1)


def head_of(rooms: Sequence[Room], tokens: Path, words: LabelSet) -> tuple[Tensor, Tensor]:  # [D, C], [D]
    """A linear head into the words' space, fitted on the labelled training views of some rooms."""
    union = list(dict.fromkeys(name for room in rooms for name in room.names))
    inputs, targets = [], []
    for room in rooms:
        maps = FeatureFolder(tokens / room.name).of(room.scene, "all")
        found, labels = labelled_tokens(maps.__getitem__, room.scene, room.labels)
        inputs.append(found)
        targets.append(torch.tensor([union.index(name) for name in room.names])[labels])
    generator = torch.Generator().manual_seed(0)
    return fit_head(torch.cat(inputs), torch.cat(targets), text_rows(union, words), generator=generator)


def known_classes(teacher: str, room: Room, rooms: Sequence[Room]) -> list[str]:
    """The classes of a room that a teacher can know."""
    if teacher == "ade":
        return [name for name, rows in zip(room.names, ade_channels(room.names), strict=True) if rows]
    others = {name for other in rooms if other is not room for name in other.names}
    return [name for name in room.names if teacher == "own" or name in others]


def make_maps(teacher: str, room: Room, rooms: Sequence[Room], args: argparse.Namespace) -> None:
    """Write a teacher's maps of a room, the rows of the classes, and the teacher's score."""
    out, linked = args.out / teacher / room.name, args.out / "scenes" / teacher / room.name
    if teacher == "ade":
        logits, channels = FeatureFolder(args.logits / room.name).of(room.scene, "all"), ade_channels(room.names)
        rows, encode = torch.eye(len(room.names)), lambda i: group_scores(logits[i], channels)
    else:
        tokens, words = FeatureFolder(args.out / "tokens" / room.name).of(room.scene, "all"), load_label_set(args.words)
        others = [other for other in rooms if other is not room]
        weight, bias = head_of([room] if teacher == "own" else others, args.out / "tokens", words)
        rows, encode = text_rows(room.names, words), lambda i: linear(tokens[i], weight, bias)
    for i in room.scene.views("all"):
        save_feature_map(out, room.scene.stem(i), encode(i))
    linked.mkdir(parents=True, exist_ok=True)
    for entry in room.folder.iterdir():
        if entry.name != "text.npy" and not (linked / entry.name).exists():
            (linked / entry.name).symlink_to(entry)
    np.save(linked / "text.npy", rows.numpy())
    test = room.scene.views("test")
    maps = maps_of_views(room.scene, test, FeatureFolder(out).of(room.scene, "test"))
    smooth = TeacherMethod({room.scene.stem(i): maps[k] for k, i in enumerate(test)})

    def segment(i: int) -> Tensor:
        return smooth.cosines(View(room.scene.stem(i), room.scene.cameras[i]), rows)[0].argmax(-1)

    known = known_classes(teacher, room, rooms)
    score = {"room": room.name, "teacher": teacher, "classes": room.names, "known": known}
    score |= {"others": [other.name for other in rooms if other is not room], "alone": room.score(segment, known)}
    write_json(score_file(args.out, teacher, room), score)
    alone = score["alone"]
    print(
        f"{room.name}, {teacher}: mIoU {alone['miou']:.1f}, known {alone['known']:.1f}, accuracy {alone['accuracy']:.1f}"
    )


def score_file(out: Path, teacher: str, room: Room) -> Path:
    """Where the scores of a teacher in a room are kept."""
    return out / "scores" / f"{teacher}-{room.name}.json"


def fuse_maps(teacher: str, room: Room, args: argparse.Namespace) -> dict[str, Any]:
    """The scores of a teacher and of the default field on its maps."""
    score = json.loads(score_file(args.out, teacher, room).read_text(encoding="utf-8"))
    run, linked = args.out / "fields" / f"{teacher}-{room.name}", args.out / "scenes" / teacher / room.name
    if not (run / "score.json").is_file():
        classes = load_label_set(linked / "classes.json", linked / "text.npy")
        maps = FeatureFolder(args.out / teacher / room.name).of(room.scene, "train")
        field = fit(room.scene, maps, Uplift(args.colors / room.name / "color.ply"), folder=run, seed=0)
        fused = room.score(lambda i: field.segment(room.scene.cameras[i], classes), score["known"])
        write_json(run / "score.json", fused)
    return {**score, "field": json.loads((run / "score.json").read_text(encoding="utf-8"))}


def table(scores: Sequence[dict[str, Any]]) -> str:
    """Markdown: a row for each teacher and room, and one for the mean over rooms with the range of the differences.

    A cell is the score of the teacher alone, that of the field, and the difference.
    """
    lines = ["| teacher | room | mIoU | mIoU, known classes | accuracy |", "|---|---|---|---|---|"]
    for teacher, title in TEACHERS.items():
        rows = [score for score in scores if score["teacher"] == teacher]
        pairs = np.array([[[row[what][key] for key in KEYS] for what in ("alone", "field")] for row in rows])
        part = "{}" if any(row["known"] != row["classes"] for row in rows) else "the same"
        for row, pair in zip(rows, pairs, strict=True):
            cells = [f"{alone:.1f} to {field:.1f}, {field - alone:+.1f}" for alone, field in pair.T]
            lines.append(f"| {title} | {row['room']} | {cells[0]} | {part.format(cells[1])} | {cells[2]} |")
        if len(rows) > 1:
            gains = pairs[:, 1] - pairs[:, 0]
            means = zip(*pairs.mean(0), *(f(gains, 0) for f in (np.mean, np.min, np.max)), strict=True)
            cells = [f"{a:.1f} to {b:.1f}, **{m:+.1f}** ({low:+.1f} to {high:+.1f})" for a, b, m, low, high in means]
            lines.append(f"| {title} | **mean** | {cells[0]} | {part.format(cells[1])} | {cells[2]} |")
    return "\n".join(lines)


def main() -> None:
    """Make maps, or fuse them and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("maps", "table"))
    parser.add_argument("out", type=Path)
    parser.add_argument("rooms", type=Path, nargs="+", metavar="ROOM")
    parser.add_argument("--teachers", nargs="+", choices=TEACHERS, default=list(TEACHERS))
    parser.add_argument("--weights", type=Path, help="maps: DINOv2, of real_teacher.py fetch")
    parser.add_argument("--words", type=Path, help="maps: a label set of words, for loo and own")
    parser.add_argument("--logits", type=Path, help="maps: a folder of logits per room, for ade")
    parser.add_argument("--colors", type=Path, help="table: a folder with <room>/color.ply")
    args = parser.parse_args()
    heads = set(args.teachers) - {"ade"}
    needed = ["weights", "words"] * bool(heads) + ["logits"] * ("ade" in args.teachers)
    needed = ["colors"] if args.command == "table" else needed
    if missing := [f"--{name}" for name in needed if getattr(args, name) is None]:
        parser.error(f"{args.command}: expected {', '.join(missing)}, got none; --help says what it is")
    rooms = [Room(folder) for folder in args.rooms]
    if len({room.name for room in rooms}) < len(rooms):
        parser.error("ROOM: expected folders of different names, got repeats; rename one")
    if args.command == "maps" and heads:
        backbone = load_teacher("dinov2", args.weights, size=SIZE)
        for room in rooms:
            extract_features(backbone, room.scene, args.out / "tokens" / room.name, "all")
    pairs = [(teacher, room) for teacher in args.teachers for room in rooms]
    if args.command == "table":
        print(table([fuse_maps(teacher, room, args) for teacher, room in pairs]))
    else:
        for teacher, room in pairs:
            if not score_file(args.out, teacher, room).is_file():
                make_maps(teacher, room, rooms, args)


if __name__ == "__main__":
    main()
