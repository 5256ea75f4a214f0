"""Table 1, side by side: every row fitted on one scene with one teacher, scored on unseen views, beside the paper's figures.

    python benchmarks/table1.py SCENE FEATURES OUT [--splat PLY] [--rows ROW ...] [--quick] [--seeds 0 1 2] [--preset cpu|paper]
        [--device cuda]

FEATURES holds a teacher map for every training view, and for every test view too if the teacher is to be scored. All methods
that put features on coloured Gaussians share one cloud, which no semantic loss moves: --splat, or that of `kfgs color`, trained
first. Each row runs in a process of its own; a row that is finished is read back, so a killed run goes on where it stopped.

--quick: `short()` of every baseline, few steps of the paper's rows, and every third test view: under 20 minutes for room_0 on two
idle cores. Without it `medium()` of every baseline, and all test views: an hour or two. --preset paper: the published schedules.

--device cuda: the shared cloud and the fields of the paper's rows are trained on the GPU, and frames per second are measured
there. Baselines are fitted on the CPU, kfgs's default fuses there, and all rows are scored there.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from devices import add_device, device_name
from table1_report import draw_plots, print_table, save_report
from table1_rows import REQUEST, RESULT, ROWS, config_of

import kfgs
from kfgs._files import digest_file, digest_value, read_json, write_json
from kfgs.labels import load_label_set
from kfgs.pipeline import ColorConfig, fit_color, score_teacher, true_labels
from kfgs.pipeline.evaluate import this_machine
from kfgs.pipeline.stages import Run
from kfgs.scenes import FeatureFolder, load_scene

HERE = Path(__file__).resolve().parent


def main() -> None:
    """Fit, score, print and draw."""
    args = parse_arguments()
    start = time.perf_counter()
    args.out.mkdir(parents=True, exist_ok=True)
    splat, geometry_seconds = find_splat(args)
    teacher, data = read_teacher(args), data_digests(args, splat)
    results: list[dict[str, Any]] = []
    failed = []
    for key in args.rows:
        for seed in args.seeds:
            found = row_result(args, key, seed, splat, data)
            if found is None:
                failed.append(f"{key}, seed {seed}")
                continue
            results.append(found)
            print(
                f"{ROWS[key].title}, seed {seed}: mIoU {100 * found['miou']:.1f}, {found['wall_seconds']:.0f} s",
                flush=True,
            )
    about = {
        "machine": this_machine(), "device": device_name(args.device),
        "command": "python benchmarks/table1.py " + " ".join(sys.argv[1:]), "preset": preset_of(args),
        "geometry_seconds": geometry_seconds, "seconds": time.perf_counter() - start, "teacher": teacher,
    }  # fmt: skip
    save_report(args.out / "table1.json", about, results)
    print_table(args.out / "table1.md", about, results)
    draw_plots(args.out, args.scene, args.truth, results)
    if failed:
        sys.exit(f"failed: {'; '.join(failed)}; see the log beside each request.json")


def preset_of(args: argparse.Namespace) -> str:
    """`quick`, `cpu` or `paper`."""
    return "quick" if args.quick else str(args.preset)


def find_splat(args: argparse.Namespace) -> tuple[Path, float | None]:
    """The shared cloud, and the seconds that it took if it was trained here."""
    if args.splat is not None:
        return args.splat, None
    if all(ROWS[key].mode for key in args.rows):  # the paper's own rows need none
        return args.out / "none", None
    config = ColorConfig.geometry() if args.quick else ColorConfig() if args.preset == "paper" else ColorConfig.cpu()
    fit_color(load_scene(args.scene).undistorted(), args.out / "color", config, report=print)
    return args.out / "color" / "color.ply", sum(stage.seconds for stage in Run(args.out / "color").finished("color"))


def read_teacher(args: argparse.Namespace) -> dict[str, Any] | None:
    """The teacher's own score on the views that are scored; None if it has no maps of them."""
    scene = load_scene(args.scene).undistorted()
    classes = load_label_set(args.scene / "classes.json", args.scene / "text.npy")
    stems = [scene.stem(i) for i in scene.views("test")]
    truth = true_labels(scene, args.scene / args.truth, "test")
    chosen = {stem: truth[stem] for stem in stems[:: every(args)] if stem in truth}
    try:
        maps = FeatureFolder(args.features).of(scene, "test")
    except FileNotFoundError:
        return None
    size = scene.cameras[scene.views("test")[0]].size
    report = score_teacher(lambda stem: maps[stems.index(stem)], chosen, classes, size)
    print(f"teacher on the same views: {report.miou}\n{report.accuracy}", flush=True)
    return {"miou": report.miou.value, "accuracy": report.accuracy.value, "views": len(chosen)}


def every(args: argparse.Namespace) -> int:
    """Every how many test views one is scored."""
    return args.every or (3 if args.quick else 1)


def data_digests(args: argparse.Namespace, splat: Path) -> dict[str, str]:
    """SHA-256 of what a row depends on beside its configuration, so that a row of other data or other code is made again."""
    sources = [*Path(kfgs.__file__).parent.rglob("*.py"), *HERE.glob("baselines/*.py"), HERE / "table1_rows.py"]
    parts = {
        "code": sources,
        "maps": [file for file in args.features.iterdir() if file.is_file() and not file.name.startswith(".")],
        "scene": [
            file
            for folder in (args.scene / "sparse", args.scene / args.truth)
            for file in folder.rglob("*") if file.is_file()
        ] + [file for file in args.scene.iterdir() if file.is_file()],
    }  # fmt: skip
    digests = {name: digest_value(sorted(digest_file(file) for file in files)) for name, files in parts.items()}
    return digests | {"splat": digest_file(splat) if splat.is_file() else ""}


def row_result(
    args: argparse.Namespace, key: str, seed: int, splat: Path, digests: dict[str, str]
) -> dict[str, Any] | None:
    """A row's result: read back if it is there and was asked for in the same way, else made in a process of its own."""
    preset, mode = preset_of(args), ROWS[key].mode
    facts = {
        "row": key, "seed": seed, "preset": preset, "steps": args.steps, "truth": args.truth, "every": every(args),
        "config": config_of(key, preset, args.steps, seed, str(args.device)), "device": str(args.device),
        "digests": digests | ({} if mode is None else {"splat": ""}),
        "given": args.splat is not None and mode is None,
    }  # fmt: skip
    paths = {"scene": str(args.scene), "features": str(args.features), "splat": str(splat) if mode is None else None}
    request = facts | paths
    folder = args.out / "rows" / f"{key}-{preset}-{seed}-{digest_value(facts)[:8]}"
    if (folder / RESULT).is_file():
        return dict(read_json(folder / RESULT))
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / REQUEST, request)
    command = [sys.executable, str(HERE / "table1_rows.py"), str(folder)]
    with (folder / "log.txt").open("w") as log:
        code = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, check=False).returncode
    if code:
        print(f"{key}, seed {seed}: failed with {code}:\n" + (folder / "log.txt").read_text()[-1_500:], file=sys.stderr)
        return None
    return dict(read_json(folder / RESULT))


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("features", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--splat", type=Path, help="the coloured Gaussians that methods share")
    parser.add_argument("--rows", "--modes", nargs="+", choices=ROWS, default=list(ROWS))
    parser.add_argument("--quick", action="store_true", help="few steps, every third test view")
    parser.add_argument("--preset", choices=("cpu", "paper"), default="cpu")
    parser.add_argument("--steps", type=int, help="of the fields of the paper's rows")
    parser.add_argument("--every", type=int, help="score every so many test views")
    parser.add_argument("--truth", default="labels_scored")
    parser.add_argument("--seeds", "--seed", type=int, nargs="+", default=[0])
    add_device(parser)
    args = parser.parse_args()
    if args.splat is not None and not args.splat.is_file():
        parser.error(f"--splat: expected a file, got {args.splat}, which does not exist")
    if not (args.scene / args.truth).is_dir():
        found = ", ".join(sorted(entry.name for entry in args.scene.glob("labels*"))) or "none"
        parser.error(
            f"--truth: expected a folder of label pictures in {args.scene}, got {args.truth!r}; there: {found}"
        )
    return args


if __name__ == "__main__":
    main()
