"""Search over many fields: seconds of the index and of a query, and how far answers by words are from the fields' own.

    python benchmarks/search.py --out /tmp/search                      # 52 rooms of 20,000 Gaussians
    python benchmarks/search.py --out /tmp/search --compare RUNS       # disagreement on real fields below RUNS
    python benchmarks/search.py --out /tmp/search --fields 3 --copies 10000             # an archive, made of copied entries
    python benchmarks/search.py --out /tmp/search --fields 3 --copies 10000 --atoms 50  # entries as large as those of room_0

The rooms are toy rooms of different seeds: Gaussians on their surfaces with the features of their classes, noise, and blends
at borders. All share one teacher. Times are those of whole processes, with Python's start.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from itertools import cycle
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from kfgs import Gaussians, LabelSet
from kfgs.fields import SemanticField
from kfgs.quant import fit_linear_latents
from kfgs.scale import SearchIndex
from kfgs.scale.search_file import NAME, Contents, Entry, read_index, write_index
from kfgs.scale.search_words import label_set
from kfgs.toy.geometry import sample_surface
from kfgs.toy.render import walk_cameras
from kfgs.toy.room import CLASSES, build_room
from kfgs.toy.teacher import class_embeddings

NOISE = 0.02  # of each of 512 channels of a unit feature: a cosine of 0.91 with its class
LARGE = ("atoms", "links")  # rows of an entry that grow with its scene
BLEND = 0.06  # metres: features are means over neighbours, as those of uplifted pixels are


def make_field(seed: int, count: int) -> SemanticField:
    """A toy room as a field, without training."""
    rng = np.random.default_rng(seed)
    solids = build_room(seed)
    many = [sample_surface(solid, 2_000, rng) for solid in solids]
    areas = np.array([np.prod(np.sort(2 * np.array(solid.half))[1:]) for solid in solids])
    share = np.maximum(80, count * areas / areas.sum()).astype(int)
    drawn = [points[rng.integers(0, len(points), n)] for points, n in zip(many, share, strict=True)]
    points = np.concatenate(drawn) + rng.normal(0, 0.01, (int(share.sum()), 3))
    labels = np.repeat([CLASSES.index(solid.label) for solid in solids], share)
    kept = rng.permutation(len(points))[:count]
    points, labels = points[kept], labels[kept]
    words = class_embeddings(512, 0)
    features = words[labels] + rng.normal(0, NOISE, (len(points), 512)).astype(np.float32)
    near = cKDTree(points).query(points, k=6, distance_upper_bound=BLEND)[1]
    padded = np.concatenate([features, np.zeros((1, 512), np.float32)])
    features = torch.from_numpy(padded[near].sum(axis=1)).float()
    linear = fit_linear_latents(torch.nn.functional.normalize(features, dim=1), keep=0.995, maximum=32)
    N = len(points)
    cloud = Gaussians(
        torch.from_numpy(points).float(), torch.eye(4)[[0]].repeat(N, 1), torch.full((N, 3), 0.03), torch.full((N,), 0.9),
        features=linear.encode(features),
    )  # fmt: skip
    cameras, train = walk_cameras(24, 1, (192, 256))
    info = {"teacher": {"name": "toy"}, "method": "made"}
    table = LabelSet(CLASSES, torch.from_numpy(words), info={"teacher": {"name": "toy"}})
    views = tuple(camera for camera, used in zip(cameras, train, strict=True) if used)
    return SemanticField(cloud, linear=linear, info=info, words=table, cameras=views)


def time_command(*words: object, repeats: int = 5) -> dict[str, float]:
    """Median wall-clock and processor seconds of a command, in processes of their own."""
    walls, users = [], []
    for _ in range(repeats):
        code = "import resource, subprocess, sys; subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL); "
        code += "used = resource.getrusage(resource.RUSAGE_CHILDREN); print(used.ru_utime + used.ru_stime)"
        start = time.perf_counter()
        command = [sys.executable, "-c", code, sys.executable, "-m", "kfgs", *map(str, words)]
        users.append(float(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
        walls.append(time.perf_counter() - start)
    return {"wall_s": round(float(np.median(walls)), 2), "processor_s": round(float(np.median(users)), 2)}


def compare(folder: Path) -> list[dict[str, object]]:
    """For every class of every field: what words answer, beside what the field answers."""
    index, _ = SearchIndex.open(folder).update(progress=True)
    rows = []
    for path, entry in index.contents.entries.items():
        if entry.table is None:
            continue
        table = label_set(index.contents.tables[entry.table])
        field = SemanticField.load(folder / path)
        for name in table.names:
            exact = next((one for one in index.search(name).scenes if one.path == path), None)
            words = next((one for one in index.search(name, table).scenes if one.path == path), None)
            row: dict[str, object] = {"field": path, "class": name}
            row |= {"exact": 0 if exact is None else exact.count, "words": 0 if words is None else words.count}
            assert row["exact"] == len(field.query(name, table))
            if exact and words and exact.parts and words.parts:
                one, other = exact.parts[0], words.parts[0]
                off, size = np.subtract(one.center, other.center), np.subtract(one.high, one.low)
                row |= {"parts": [len(exact.parts), len(words.parts)], "same_view": one.view == other.view}
                row |= {"center_off": float(np.linalg.norm(off) / np.linalg.norm(size))}
            rows.append(row)
    return rows


def say_comparison(rows: list[dict[str, object]]) -> dict[str, object]:
    """Shares over the classes with at least 100 Gaussians."""
    large = [row for row in rows if int(row["exact"]) >= 100]
    both = [row for row in large if "parts" in row]
    error = [abs(int(row["words"]) / int(row["exact"]) - 1) for row in large]
    return {
        "classes": len(large),
        "count_off_median": round(float(np.median(error)), 4),
        "count_off_worst": round(float(np.max(error)), 4),
        "found_by_both": len(both),
        "same_number_of_parts": sum(row["parts"][0] == row["parts"][1] for row in both),
        "same_best_view": sum(bool(row["same_view"]) for row in both),
        "center_off_median_of_box": round(float(np.median([row["center_off"] for row in both])), 4),
    }


def archive(source: Path, folder: Path, copies: int, atoms: int) -> dict[str, object]:
    """Processor seconds of an index with many entries, copied from those of a small one, each with `atoms` times its atoms."""
    few = read_index(source / NAME)

    def grown(entry: Entry) -> Entry:
        large = {
            kind: {name: np.concatenate([rows] * atoms) for name, rows in entry.rows[kind].items()} for kind in LARGE
        }
        return dataclasses.replace(entry, rows={**entry.rows, **large})

    entries = {}
    for number, entry in zip(range(copies), cycle(map(grown, few.entries.values()))):
        name = f"{number:06d}/field"
        (folder / name).mkdir(parents=True, exist_ok=True)
        if not (folder / name / "field.json").exists():
            os.link(source / entry.path / "field.json", folder / name / "field.json")  # the same size and time
        entries[name] = dataclasses.replace(entry, path=name)
    many = Contents(few.spaces, few.tables, entries)
    report: dict[str, object] = {"write_s": seconds(partial(write_index, folder / NAME, many))}
    del many, entries
    report |= {"bytes": (folder / NAME).stat().st_size, "read_s": seconds(lambda: SearchIndex.open(folder))}
    index = SearchIndex.open(folder)
    report |= {"look_for_changes_s": seconds(index.is_current), "unchanged": index.is_current()}
    report["class_s"] = seconds(lambda: index.search("chair"))
    report["by_words_s"] = seconds(lambda: index.search("chair", threshold=0.7))
    return report


def seconds(work: Callable[[], object]) -> float:
    """Processor seconds of some work."""
    start = time.process_time()
    work()
    return round(time.process_time() - start, 2)


def main() -> None:
    """Make the fields (kept in --out), and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--fields", type=int, default=52)
    parser.add_argument("--gaussians", type=int, default=20_000)
    parser.add_argument("--compare", type=Path, help="only compare answers on the fields below this folder")
    parser.add_argument(
        "--copies", type=int, help="time an archive of so many entries, copied from those of the fields"
    )
    parser.add_argument("--atoms", type=int, default=1, help="make each of these entries so many times as large")
    given = parser.parse_args()
    if given.compare is not None:
        rows = compare(given.compare)
        for row in rows:
            print(json.dumps(row), file=sys.stderr)
        print(json.dumps(say_comparison(rows), indent=2))
        return
    for seed in range(given.fields):
        place = given.out / f"room_{seed:03d}" / "field"
        if not place.exists():
            make_field(seed, given.gaussians).save(place)
    start, used = time.perf_counter(), time.process_time()
    index, changes = SearchIndex.open(given.out).update(progress=True)
    report: dict[str, object] = {
        "fields": len(index),
        "added": len(changes.added),
        "index_s": round(time.perf_counter() - start, 1),
        "index_processor_s": round(time.process_time() - used, 1),
        "index_bytes": index.file.stat().st_size,
        "words": [len(space.words) for space in index.contents.spaces],
    }
    if given.copies is not None:
        report |= archive(given.out, given.out.with_name(f"{given.out.name}-{given.copies}"), given.copies, given.atoms)
        print(json.dumps(report, indent=2))
        return
    example = given.out / "room_000" / "field"
    report["class"] = time_command("search", "chair", given.out)
    report["threshold"] = time_command("search", "chair", given.out, "--threshold", 0.7)
    report["example"] = time_command("search", given.out, "--like", example, "--index", 17)
    report["exact_of_5"] = time_command("search", "chair", given.out, "--threshold", 0.7, "--exact", 5, repeats=3)
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
