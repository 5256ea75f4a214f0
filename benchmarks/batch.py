"""Many scenes on one and on two workers: the speed-up, and whether killed workers change a byte.

    python benchmarks/batch.py OUT [--rooms 6] [--room-0 FOLDER --weights FOLDER] [--kills 3] [--steps N]

Toy rooms (48 views of 192x256; 24 of half the size with --small) go through features, fit, segment and evaluate by `run_batch`:
with one worker, with two, and with two of which --kills are killed at random moments (SIGKILL). Each worker has one thread. The
rooms' own teacher is looked up by the pictures, so its time is that of reading and writing maps. --room-0 adds a real scene,
whose pictures the network of benchmarks/real_teacher.py encodes; --weights is the folder that its `fetch` and `head` wrote.

Start it with OMP_NUM_THREADS=1, or numpy's threads differ from those of Dask's workers in the last bits.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import os
import random
import signal
import sys
import threading
import time
from pathlib import Path

import torch

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from small_batch import results

from kfgs._files import digest_file, write_json
from kfgs.batch import BatchOptions, open_client, run_batch
from kfgs.batch.run import describe_batch
from kfgs.pipeline import ColorConfig, Uplift
from kfgs.teachers import Teacher
from kfgs.toy.room_folder import ToyConfig, make_toy_room


class LookedUp:
    """The simulated teacher of toy rooms finds a picture among theirs by its values; a real network encodes all others."""

    def __init__(self, rooms: str, real: str | None = None) -> None:
        self.name, self.identity = "looked-up", {"name": "looked-up", "real": real is not None}
        self.maps: dict[str, Path] = {}
        self.real = real
        self.network: Teacher | None = None
        from kfgs.scenes import read_image

        for file in sorted(Path(rooms).glob("room_*/images/*.png")):
            maps = file.parents[1] / "features" / f"{file.stem}_fmap_CxHxW.pt"
            self.maps[self._digest(read_image(file).permute(2, 0, 1))] = maps

    @staticmethod
    def _digest(image: torch.Tensor) -> str:
        return hashlib.sha256((image * 255).round().byte().numpy().tobytes()).hexdigest()

    def encode_image(self, image: torch.Tensor) -> torch.Tensor:
        """The map that was made with the picture, or the network's."""
        digest = self._digest(image)
        if digest in self.maps or self.real is None:
            return torch.load(self.maps[digest], weights_only=True).float()
        if self.network is None:
            from real_teacher import RealTeacher

            self.network = RealTeacher(self.real)
        return self.network.encode_image(image)

    def encode_text(self, prompts: list[str]) -> torch.Tensor:
        """The rooms have their texts."""
        raise NotImplementedError


def kill_some(client, kills: int, seed: int, stop: threading.Event, log: list[str]) -> None:
    """Kill a worker process that has a task, `kills` times, some seconds after each other."""
    chance = random.Random(seed)
    while len(log) < kills and not stop.wait(chance.uniform(2, 12)):
        busy = sorted(address for address, tasks in client.processing().items() if tasks)
        if not busy:
            continue
        address = chance.choice(busy)
        pid = client.run(os.getpid, workers=[address])[address]
        os.kill(pid, signal.SIGKILL)
        log.append(f"process {pid}")
        print(f"  killed process {pid}", flush=True)


def measure(scenes: dict[str, str], out: Path, options: BatchOptions, workers: int, kills: int = 0) -> float:
    """Seconds of a batch without the start of its workers."""
    with open_client(workers) as client:
        client.run(_warm)
        stop, killed = threading.Event(), list[str]()
        killer = threading.Thread(target=kill_some, args=(client, kills, 0, stop, killed))
        start = time.perf_counter()
        killer.start()
        run_batch(scenes, out, options, client=client, report=lambda line: print(f"  {line}", flush=True))
        seconds = time.perf_counter() - start
        stop.set()
        killer.join()
    print(describe_batch(out))
    return seconds


def _warm() -> None:
    """Import what a worker imports for its first task."""
    import kfgs.batch  # noqa: F401


def main() -> None:
    """Print the table of docs/results.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--rooms", type=int, default=6)
    parser.add_argument("--small", action="store_true", help="pictures of 96x128, maps of 36x48x64, 24 views")
    parser.add_argument("--steps", type=int, default=400, help="of the geometry of each room")
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--room-0", type=Path)
    parser.add_argument("--weights", type=Path, help="of the network that encodes --room-0")
    given = parser.parse_args()
    size = {"train_views": 24, "test_views": 6, "size": (96, 128), "feature_size": (36, 48), "feature_dim": 64}
    rooms = [ToyConfig(seed=seed, **(size if given.small else {})) for seed in range(given.rooms)]
    base = given.out.absolute()
    folders = [make_toy_room(base / f"room_{room.seed}", room) for room in rooms]
    scenes = {folder.name: str(folder) for folder in folders}
    if given.room_0 is not None:
        scenes["real"] = str(given.room_0.absolute())
    color = dataclasses.replace(ColorConfig.quick(), training=ColorConfig.quick().training.with_steps(given.steps))
    os.environ["PYTHONPATH"] = os.pathsep.join(
        [str(Path(__file__).parent), *sys.path[:1], os.environ.get("PYTHONPATH", "")]
    )
    network = None if given.weights is None else str(given.weights.absolute())
    teacher = {"teacher": "batch:LookedUp", "teacher_options": {"rooms": str(base), "real": network}}
    options = BatchOptions(method=Uplift(color=color), pictures=1, **teacher)
    found = {}
    for name, workers, kills in (("one worker", 1, 0), ("two workers", 2, 0), ("two workers, killed", 2, given.kills)):
        print(f"{name}:", flush=True)
        seconds = measure(scenes, base / name.replace(",", "").replace(" ", "_"), options, workers, kills)
        found[name] = {"seconds": round(seconds, 1)}
    runs = {name: base / name.replace(",", "").replace(" ", "_") for name in found}
    first = {scene.name: results(runs["one worker"] / scene.name) for scene in scenes}
    for name, run in runs.items():
        found[name]["speed-up"] = round(found["one worker"]["seconds"] / found[name]["seconds"], 2)
        found[name]["byte-equal"] = sum(results(run / scene.name) == first[scene.name] for scene in scenes)
    write_json(base / "batch.json", {"scenes": len(scenes), **found})
    print(json.dumps(found, indent=2))
    print(f"| {len(scenes)} scenes | seconds | speed-up | scenes byte-equal |\n|---|---|---|---|")
    for name, row in found.items():
        print(f"| {name} | {row['seconds']} | {row['speed-up']} | {row['byte-equal']} |")
    field = runs["one worker"] / scenes[0].name / "field.kfgs"
    print(f"{field.name} of {scenes[0].name}: {digest_file(field)[:12]}")


if __name__ == "__main__":
    main()
