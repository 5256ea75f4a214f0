"""What failing machines cost a batch: a simulation of `kfgs batch` with measured seconds of its stages.

    python benchmarks/failures.py [--scenes 1000] [--workers 100] [--days 0.1 1 7] [--seed 0]
        [--seconds sfm=60 features=120 fit=300 segment=15 evaluate=5]

Workers fail at random (exponential, with a mean time between failures per worker), and come back after a while. What a stage
had done is lost, except that `features` keeps its pictures and `fit` its checkpoints, as the real ones do. A task is
submitted at most four times. Told are the hours until all scenes are done, the work that was lost, and the scenes that were
given up. The scheduler takes no time here: 1,000 scenes are 5,000 tasks, and Dask's costs some 1 ms a task.
"""

from __future__ import annotations

import argparse
import heapq
import random
from dataclasses import dataclass, field

STAGES = ("sfm", "features", "fit", "segment", "evaluate")
KEEPS = {"features": 0.98, "fit": 0.9}  # share of what was done that a killed one finds again
TRIES = 4
BACK = 300.0  # seconds until a failed worker is back


@dataclass(order=True)
class _Event:
    at: float
    number: int
    worker: int = field(compare=False)
    fails: bool = field(compare=False)


def simulate(
    scenes: int, workers: int, seconds: dict[str, float], between: float, spread: float, seed: int
) -> dict[str, float]:
    """Hours, share of lost work, and scenes that were given up.

    Args:
        scenes: how many.
        workers: that work at the same time.
        seconds: of each stage on one worker.
        between: mean seconds between failures of one worker; infinite: none fails.
        spread: scenes differ in size by so much (standard deviation of the logarithm).
        seed: of all random numbers.
    """
    rng = random.Random(seed)
    sizes = [rng.lognormvariate(-(spread**2) / 2, spread) for _ in range(scenes)]
    ready = [(0, scene, 0, seconds[STAGES[0]] * sizes[scene]) for scene in range(scenes)]  # tries, scene, stage, left
    ready.reverse()
    running: dict[int, tuple[int, int, int, float, float]] = {}
    free, events, number = list(range(workers)), [], 0
    now, useful, spent, given_up, done = 0.0, 0.0, 0.0, 0, 0
    while done + given_up < scenes:
        while free and ready:
            worker, (tries, scene, stage, left) = free.pop(), ready.pop()
            dies = rng.expovariate(1 / between) if between < float("inf") else float("inf")
            number += 1
            running[worker] = tries, scene, stage, left, now
            heapq.heappush(events, _Event(now + min(left, dies), number, worker, dies < left))
        event = heapq.heappop(events)
        now = event.at
        if event.worker not in running:  # is back
            free.append(event.worker)
            continue
        tries, scene, stage, left, began = running.pop(event.worker)
        spent += now - began
        if not event.fails:
            useful += left
            free.append(event.worker)
            if stage + 1 < len(STAGES):
                ready.append((0, scene, stage + 1, seconds[STAGES[stage + 1]] * sizes[scene]))
            else:
                done += 1
            continue
        kept = KEEPS.get(STAGES[stage], 0.0) * (now - began)
        useful += kept
        number += 1
        heapq.heappush(events, _Event(now + BACK, number, event.worker, False))
        if tries + 1 < TRIES:
            ready.append((tries + 1, scene, stage, left - kept))
        else:
            given_up += 1
    return {"hours": now / 3600, "lost": max(0.0, 1 - useful / spent), "given_up": float(given_up)}


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=100)
    parser.add_argument(
        "--seconds", nargs="*", default=["sfm=60", "features=120", "fit=300", "segment=15", "evaluate=5"]
    )
    parser.add_argument(
        "--days", type=float, nargs="*", default=[0.02, 0.1, 1, 7], help="mean time between failures of a worker"
    )
    parser.add_argument("--spread", type=float, default=0.5)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    seconds = {name: float(value) for name, _, value in (word.partition("=") for word in args.seconds)}
    missing = set(STAGES) ^ set(seconds)
    if missing:
        raise SystemExit(f"--seconds: expected {', '.join(STAGES)}, each once; check {', '.join(sorted(missing))}")
    print(f"{args.scenes} scenes of {sum(seconds.values()) / 60:.1f} min on {args.workers} workers\n")
    print("| a worker fails every | hours | lost work | scenes given up |\n|---|---|---|---|")
    for days in [float("inf"), *sorted(args.days, reverse=True)]:
        rows = [
            simulate(args.scenes, args.workers, seconds, days * 86400, args.spread, args.seed + i) for i in range(3)
        ]
        hours, lost, given_up = (sum(row[name] for row in rows) / len(rows) for name in ("hours", "lost", "given_up"))
        name = "never" if days == float("inf") else f"{days:g} days" if days >= 1 else f"{days * 24 * 60:.0f} min"
        print(f"| {name} | {hours:.2f} | {lost:.1%} | {given_up:.1f} |")


if __name__ == "__main__":
    main()
