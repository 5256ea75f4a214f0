"""How long does the explorer take to open, to turn and to answer a slider, and what draws it?

    python benchmarks/viewing.py OUT [--sizes 20000,100000,600000] [--turns 5]

Synthetic rooms as in benchmarks/transfer.py: 20,000 semantic Gaussians on the left, as many colour Gaussians as the row says
on the right, 1200 x 600 pixels without a display. Each size is opened by a process of its own, so that imports count.
Writes OUT/viewing.md, a table, and a picture of each row.

There is no --device: VTK draws with the machine's OpenGL, on a GPU if its driver offers that without a display, else in software
(Mesa's llvmpipe). The table says which. Labels are carried and colours made on the CPU.
"""

from __future__ import annotations

import time

BEGAN = time.perf_counter()  # before the imports that "open from nothing" counts

import argparse  # noqa: E402
import json  # noqa: E402
import os  # noqa: E402
import subprocess  # noqa: E402
import sys  # noqa: E402
from collections.abc import Callable  # noqa: E402
from pathlib import Path  # noqa: E402

import torch  # noqa: E402
from transfer import room  # noqa: E402

from kfgs.viewer import Exploration, Explorer, SplatMeaning  # noqa: E402

SEMANTIC = 20_000
MOVING, STILL = 15.0, 0.0001  # frames per second that VTK asks for while the mouse moves the camera, and when it rests
NAMES = ("wall", "chair", "table")
HEAD = "| colour Gaussians | drawn as | open | from nothing | frames/s turning | every frame whole | lambda | gamma |"


def main() -> None:
    """Measure each size in a process of its own, or (with --one) one size in this."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--sizes", default="20000,100000,600000")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--one", type=int)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.one is not None:
        print(json.dumps(measure(args.one, args.turns, args.out)))
        return
    lines = [HEAD, "|---" * HEAD.count(" | ") + "|---|"]
    for size in args.sizes.split(","):
        command = [sys.executable, __file__, str(args.out), "--one", size, "--turns", str(args.turns)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        rows, drawn_by = json.loads(done.stdout.splitlines()[-1])
        lines += rows
    lines += [
        "",
        f"OpenGL: {drawn_by}; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} of others and this at the end",
    ]
    (args.out / "viewing.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


def renderer(explorer: Explorer) -> str:
    """What draws, in OpenGL's words."""
    said = explorer.plotter.render_window.ReportCapabilities()
    return next((line.split(":", 1)[1].strip() for line in said.splitlines() if "renderer string" in line), "unknown")


def measure(size: int, turns: int, out: Path) -> tuple[list[str], str]:
    """The table's rows of one size, and what drew them."""
    loaded = time.perf_counter() - BEGAN
    semantic, color = room(SEMANTIC, 0.04, 0), room(size, 0.08 * (SEMANTIC / size) ** 0.5, 1)
    patches = ((semantic.means + 0.25) * 2).floor().long() @ torch.tensor([1, 5, 7])
    semantic = semantic.replace(labels=patches % len(NAMES))
    scores = torch.rand(SEMANTIC, generator=torch.Generator().manual_seed(2)).numpy()
    began = time.perf_counter()
    state = Exploration(SplatMeaning(semantic.replace(scores=scores, names=NAMES)), color)
    explorer = Explorer(state, out=out, off_screen=True)
    explorer.screenshot()
    opened = time.perf_counter() - began
    style, rows = explorer.style, []
    explorer.ask(None)
    explorer.screenshot(out / f"viewing_{size}_{style}.png")
    quick, whole = turning(explorer, MOVING, turns), turning(explorer, STILL, turns)
    explorer.ask("chair")
    explorer.screenshot(out / f"viewing_{size}_{style}_asked.png")
    far, sure = state.distance, iter([0.3 + 0.05 * i for i in range(turns + 1)])
    distance = least(turns, lambda far=far: moved(explorer, lambda: explorer.set_distance(0.9 * far)))
    gamma = least(turns, lambda sure=sure: moved(explorer, lambda: explorer.set_gamma(next(sure))))
    rows.append(
        f"| {size:,} | {style} | {opened:.1f} s | {loaded + opened:.1f} s | {quick:.1f} | {whole:.1f} "
        f"| {distance:.2f} s | {gamma:.2f} s |"
    )
    drawn_by = renderer(explorer)
    explorer.close()
    return rows, drawn_by


def turning(explorer: Explorer, rate: float, turns: int) -> float:
    """Frames per second of the quickest of some turns by 4 degrees."""
    window = explorer.plotter.render_window
    window.SetDesiredUpdateRate(rate)
    explorer.screenshot()

    def turn() -> None:
        explorer.plotter.camera.azimuth += 4
        explorer.screenshot()

    seconds = least(turns, turn)
    window.SetDesiredUpdateRate(STILL)
    explorer.screenshot()
    return 1 / seconds


def moved(explorer: Explorer, move: Callable[[], None]) -> None:
    """A slider's move, with the picture that follows."""
    move()
    explorer.screenshot()


def least(repeats: int, call: Callable[[], object]) -> float:
    """Seconds of the quickest of some calls."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return min(times)


if __name__ == "__main__":
    main()
