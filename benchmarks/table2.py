"""Table 2: the paper's method with latents of 3, 6, 9, 12 and 15 numbers, and without compression of channels (512).

    python benchmarks/table2.py SCENE FEATURES OUT [--dims 3 6 9 12 15 512] [--quick] [--steps N] [--preset cpu|paper]
        [--device cuda]

All rows share the codebook and the index maps, which are made once and counted in each. A row that is finished is read back.
--quick: 800 steps (512 channels: 350), and every third test view is scored. --device is where frames per second are measured;
`kfgs.fit` takes a GPU if there is one. Name a new OUT for another device: finished stages are kept.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from devices import add_device
from table1 import data_digests
from table1_rows import FPS_VIEWS, QUICK_STEPS, Room, field_codec, fitting_seconds, frames_per_second, views_on

from kfgs._files import atomic_path, digest_value, read_json, write_json
from kfgs.evaluation import FieldMethod
from kfgs.metrics import MIB
from kfgs.pipeline import Paper, fit
from kfgs.viz.plots import finish, new_figure

FULL = 512
PAPER = {  # mIoU, minutes, thousand Gaussians, MB, FPS
    3: (73.6, 6, 131.5, 12.0, 39.58), 6: (75.7, 7, 123.5, 12.8, 36.91), 9: (76.6, 8, 110.5, 13.0, 36.08),
    12: (76.0, 9, 90.1, 12.3, 38.53), 15: (76.3, 10, 106.7, 15.3, 33.26), FULL: (77.9, 220, 28.7, 57.6, 9.37),
}  # fmt: skip


def config_of(dim: int, args: argparse.Namespace) -> Paper:
    """Of one row: `adc+sc` with so many latents, or `adc`."""
    method = Paper.paper() if args.preset == "paper" else Paper()
    latents = None if dim == FULL else replace(method.autoencoder, latent=dim)
    steps = args.steps or (QUICK_STEPS["adc" if dim == FULL else "adc+sc"] if args.quick else None)
    training = method.training if steps is None else method.training.with_steps(steps)
    return replace(method, autoencoder=latents, training=training)


def run(dim: int, room: Room, args: argparse.Namespace) -> dict[str, Any]:
    """One row, fitted and scored, or read back."""
    method = config_of(dim, args)
    field = fit(room.scene, room.maps, method, folder=args.out / "run", seed=args.seed, report=print)
    asked = {
        "stages": field.info["stages"],
        "views": [view.stem for view in room.views],
        "truth": args.truth,
        "device": str(args.device),
        "digests": data_digests(args, args.out / "none"),
    }
    file = args.out / "rows" / f"{dim}-{digest_value(asked)[:12]}.json"
    if file.is_file():
        return dict(read_json(file))
    scored, nearest = FieldMethod(field, rule="paper"), FieldMethod(field, rule="nearest")
    seconds = field.info["seconds"]
    moved, shown = field.to(args.device), views_on(room.views[:FPS_VIEWS], args.device)
    row = {
        "dim": dim, **room.score(scored, nearest), **room.codec_scores(field_codec(field), args.seed), "stages": seconds,
        "gaussians": len(field), "storage": field.storage(),
        "fps_maps": frames_per_second(lambda view: moved.render(view.camera), shown),
        "device": str(args.device), "steps": method.training.steps,
    }  # fmt: skip
    write_json(file, row)
    return row


def table_text(rows: list[dict[str, Any]], command: str) -> str:
    """The table as Markdown."""
    lines = [
        command,
        "",
        "| d | mIoU | accuracy | minutes | Gaussians | storage, MiB | FPS maps | steps | paper: mIoU, min, ",
    ]
    lines[-1] += "Gaussians, MB, FPS |"
    lines.append("|" + "---|" * 9)
    for row in rows:
        paper = PAPER.get(row["dim"])
        published = "-" if paper is None else "{}, {}, {}k, {}, {:.1f}".format(*paper)
        minutes, count = fitting_seconds(row["stages"]) / 60, row["gaussians"] / 1_000
        lines.append(
            f"| {row['dim']} | {100 * row['miou']:.1f} | {100 * row['accuracy']:.1f} | {minutes:.2f} | {count:.1f}k | "
            f"{row['storage'] / MIB:.2f} | {row['fps_maps']:.1f} | {row['steps']} | {published} |"
        )
    return "\n".join(lines) + "\n"


def draw(path: Path, rows: list[dict[str, Any]]) -> None:
    """MIoU and storage against the number of latents, beside the paper's."""
    figure = new_figure(10, 4)
    panels = [figure.add_subplot(1, 2, i + 1) for i in (0, 1)]
    for axes, label in zip(panels, ("mIoU in %", "storage in MiB"), strict=True):
        known = [row for row in rows if row["dim"] in PAPER]
        ours = [100 * row["miou"] if axes is panels[0] else row["storage"] / MIB for row in rows]
        theirs = [PAPER[row["dim"]][0 if axes is panels[0] else 3] for row in known]
        axes.plot([str(row["dim"]) for row in rows], ours, "o-", label="here")
        axes.plot([str(row["dim"]) for row in known], theirs, "s--", color="0.5", label="paper, mean of five rooms")
        axes.set(xlabel="numbers of a latent (512: no autoencoder)", ylabel=label)
        axes.grid(alpha=0.3)
        axes.legend()
    finish(figure, path)


def main() -> None:
    """Fit, score, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("features", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--dims", type=int, nargs="+", default=list(PAPER))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--preset", choices=("cpu", "paper"), default="cpu")
    parser.add_argument("--steps", type=int, help="of the field")
    parser.add_argument("--every", type=int, help="score every so many test views")
    parser.add_argument("--truth", default="labels_scored")
    parser.add_argument("--seed", type=int, default=0)
    add_device(parser)
    args = parser.parse_args()
    room = Room(args.scene, args.features, args.truth, args.every or (3 if args.quick else 1))
    rows = []
    for dim in args.dims:
        rows.append(run(dim, room, args))
        print(f"d = {dim}: mIoU {100 * rows[-1]['miou']:.1f}", flush=True)
    write_json(args.out / "table2.json", rows)
    text = table_text(rows, "python benchmarks/table2.py " + " ".join(sys.argv[1:]))
    with atomic_path(args.out / "table2.md") as temporary:
        temporary.write_text(text, encoding="utf-8")
    print(text)
    draw(args.out / "table2.png", rows)


if __name__ == "__main__":
    main()
