"""The leaderboard page: every row that was run, with its command, seeds, machine and spread, from the JSON of the runs.

    python benchmarks/leaderboard.py docs/runs docs/leaderboard.md            # write the page again
    python benchmarks/leaderboard.py docs/runs docs/leaderboard.md --check    # fails if the page says something else
    python benchmarks/leaderboard.py docs/runs docs/leaderboard.md --add OUT [OUT2 ...] --name room_0-quick --about "..."

--add keeps what `benchmarks/table1.py SCENE FEATURES OUT` wrote, without losses, matrices and paths, as RUNS/NAME.json. Rows of
several OUTs are joined; of a row and seed that occur twice, the last counts.
"""

from __future__ import annotations

import argparse
import difflib
import re
import sys
from pathlib import Path
from statistics import mean, median
from typing import Any

from table1_rows import ROWS, fitting_seconds

from kfgs._files import atomic_path, read_json, write_json

MIB = 2**20
KEPT = (
    "dim", "gaussians", "storage", "disk", "packed", "stages", "miou", "miou_nearest", "miou_votes", "accuracy",
    "teacher_accuracy", "teacher_iou7", "codec_cosine", "codec_same", "fps_maps", "fps_labels", "peak_fit", "views", "threads",
    "wall_seconds",
)  # fmt: skip
PROTOCOL = "kfgs-pooled/1"
HEAD = (
    "",
    "method",
    "mIoU, %",
    "nearest text / votes, %",
    "accuracy, %",
    "IoU7 with teacher, %",
    "minutes",
    "MiB",
    "labels, FPS",
    "row",
)
UNITS = (
    "MiB: every number of the result in float32, with decoder and codebook. Labels, FPS: views a second that get a class for "
    "each pixel (rendering included)."
)
INTRO = f"""# Leaderboard

Every row was run with kfgs's own implementation of the method (`benchmarks/baselines/`), on the same scene and teacher. mIoU and
accuracy are `{PROTOCOL}`; IoU7 is `feature3dgs-teacher/1` with the scene's classes ([protocols](protocols.md)).
"Nearest text / votes" is the mIoU if pixels take the text nearest to their rendered feature, and if Gaussians vote with the
softmax of 100 cosines, as kfgs's default does; the mIoU before it is by the method's own rule. Minutes are those of training,
without the teacher and the Gaussians that methods share. [Results](results.md#other-methods) says what is not as published.
The paper's rows (decouple, ADC, SC) were measured before its codebook grew as Eq. 8 is printed, and before labels by Sec. 3.4.

To run a row again, make what all rows share, once; then type the command below the table, with the name of the row as ROW. OUT is
any folder of yours:

```bash
pip install -c constraints.txt torch==2.13.0 -e ".[test]" onnx                    # in a clone of this repository
python -c "from kfgs import make_toy_room; make_toy_room('TOY')"  # the toy room
kfgs color TOY --out COLOR

python benchmarks/real_teacher.py fetch WEIGHTS                                   # room_0, if you have it
python benchmarks/real_teacher.py head ROOM_0 WEIGHTS WEIGHTS/head.safetensors
python benchmarks/real_teacher.py maps ROOM_0 WEIGHTS WEIGHTS/head.safetensors MAPS
kfgs color ROOM_0 --out COLOR
```

Anybody can make the toy room. ROOM_0 is Replica's room_0 as the authors of DF-3DGS publish it (180 of its frames, 639x479, COLMAP
model, `split.json`), with `classes.json`, the classes' CLIP embeddings in `text.npy`, and labels. These were made from the data
set's true object boxes, estimated depth and a vote over views; `labels_scored` leaves out unreliable pixels (checked against true
depth: 96.5 % of pixels right). Replica's licence does not allow it to be passed on, and these labels are not published. The JSON
of the runs has a SHA-256 of the scene, the maps and the shared Gaussians, so that two runs can be known to be of the same data.

This page is made by `python benchmarks/leaderboard.py docs/runs docs/leaderboard.md`; with `--check` the command fails if a
number in the page is not in the runs.
"""


def main() -> None:
    """Add runs, then write or check the page."""
    args = parse_arguments()
    if args.add:
        if args.name is None:
            sys.exit("--name: expected the name of the runs with --add, for instance room_0-quick")
        write_json(
            args.runs / f"{args.name}.json", join([read_json(out / "table1.json") for out in args.add], args.about)
        )
    text = page(args.runs)
    if args.check:
        differences = compare(args.page.read_text(encoding="utf-8") if args.page.is_file() else "", text)
        if differences:
            sys.exit("\n".join([f"{args.page}: differs from the runs in {args.runs}:", *differences[:20]]))
        print(f"{args.page}: every number is in the runs")
        return
    with atomic_path(args.page) as temporary:
        temporary.write_text(text, encoding="utf-8")
    print(f"wrote {args.page}")


def join(tables: list[dict[str, Any]], about: str = "") -> dict[str, Any]:
    """What is kept of some tables: small rows without paths, in their order."""
    rows: dict[tuple[str, int], dict[str, Any]] = {}
    configs: dict[tuple[str, int], dict[str, Any]] = {}
    for table in tables:
        for row in table["rows"]:
            request = row["request"]
            configs[request["row"], request["seed"]] = {**request.get("config", {}), "seed": None}
            rows[request["row"], request["seed"]] = {
                "row": request["row"], "seed": request["seed"], "machine": table["machine"], "command": command(request),
                **{name: row[name] for name in KEPT if name in row},
            }  # fmt: skip
    for key, seed in configs:
        if any(other[0] == key and config != configs[key, seed] for other, config in configs.items()):
            sys.exit(f"--add: expected one configuration of {key}, got several; run its seeds again")
    for part in ("maps", "scene", "splat"):  # not the code, which may change where it does not matter
        found = {row["request"]["digests"][part] for table in tables for row in table["rows"]} - {""}
        if len(found) > 1:
            sys.exit(f"--add: expected runs of one {part}, got {len(found)} different ones; add them under other names")
    for part in ("truth", "every"):
        found = {str(row["request"][part]) for table in tables for row in table["rows"]}
        if len(found) > 1:
            sys.exit(
                f"--add: expected runs of one --{part}, got {', '.join(sorted(found))}; add them under other names"
            )
    if any(table["teacher"] != tables[0]["teacher"] for table in tables):
        sys.exit(
            "--add: expected runs with the same scores of the teacher, got different ones; are their views the same?"
        )
    presets = {table["preset"] for table in tables}
    if len(presets) != 1:
        sys.exit(f"--add: expected runs of one preset, got {', '.join(sorted(presets))}; add them under two names")
    first, requests = tables[0], [row["request"] for table in tables for row in table["rows"]]
    if not requests:
        sys.exit("--add: expected finished rows, got none; run table1.py again, its log says why they failed")
    scene = Path(requests[0]["scene"]).name
    digests = {part: max(one["digests"][part] for one in requests) for part in ("maps", "scene", "splat")}
    listed = sorted(rows.values(), key=lambda row: (row["row"], row["seed"]))
    return {
        "scene": scene,
        "preset": first["preset"],
        "about": about,
        "teacher": first["teacher"],
        "digests": digests,
        "rows": listed,
    }


def command(request: dict[str, Any]) -> str:
    """The command that makes one row again. Folders are named by what they hold, not by where they were."""
    scene, features = Path(request["scene"]), Path(request["features"])
    maps = f"{scene.name.upper()}/{features.name}" if features.parent == scene else "MAPS"
    words = ["python benchmarks/table1.py", scene.name.upper(), maps, "OUT"]
    words += ["--splat COLOR/color.ply"] if request["given"] else []
    words += ["--quick"] if request["preset"] == "quick" else [f"--preset {request['preset']}"]
    words += [f"--steps {request['steps']}"] if request.get("steps") is not None else []
    words += [f"--device {request['device']}"] if request.get("device", "cpu") != "cpu" else []
    usual = 3 if request["preset"] == "quick" else 1
    words += [f"--every {request['every']}"] if request.get("every", usual) != usual else []
    words += [f"--truth {request['truth']}"] if request.get("truth", "labels_scored") != "labels_scored" else []
    return " ".join([*words, f"--rows {request['row']} --seeds {request['seed']}"])


def page(folder: Path) -> str:
    """The whole page, from all runs of a folder."""
    files = sorted(folder.glob("*.json"))
    if not files:
        sys.exit(f"{folder}: expected JSON files of runs, found none; add some with --add")
    return "\n".join([INTRO, *(section(file.stem, read_json(file)) for file in files)])


def section(name: str, runs: dict[str, Any]) -> str:
    """One scene and preset: what was run, and a table, the best mIoU first."""
    lines = [f"## {runs['scene']}, {runs['preset']}", ""]
    lines += [runs["about"], ""] if runs["about"] else []
    if runs["teacher"] is not None:
        teacher = runs["teacher"]
        lines += [
            f"The teacher itself, on the same {teacher['views']} views: mIoU {100 * teacher['miou']:.1f} %, accuracy "
            f"{100 * teacher['accuracy']:.1f} %.", "",
        ]  # fmt: skip
    lines += [f"| {' | '.join(HEAD)} |", "|" + "---|" * len(HEAD)]
    of_row: dict[str, list[dict[str, Any]]] = {}
    for row in runs["rows"]:
        of_row.setdefault(row["row"], []).append(row)
    ranked = sorted(of_row.items(), key=lambda one: -mean(row["miou"] for row in one[1]))
    lines += [f"| {' | '.join(cells(place, key, rows))} |" for place, (key, rows) in enumerate(ranked, 1)]
    machines = "; ".join(dict.fromkeys(row["machine"] for row in runs["rows"]))
    longest = max((row["command"].partition(" --rows ")[0] for row in runs["rows"]), key=len)
    lines += ["", f"`{longest} --rows ROW`; {machines}. {UNITS} Source: [runs/{name}.json](runs/{name}.json).", ""]
    return "\n".join(lines)


def cells(place: int, key: str, rows: list[dict[str, Any]]) -> list[str]:
    """A row of the table over its seeds."""

    def average(name: str, scale: float = 100.0, digits: int = 1) -> str:
        return f"{mean(row[name] for row in rows) * scale:.{digits}f}" if all(name in row for row in rows) else "-"

    rules = "-" if "miou_votes" not in rows[0] else f"{average('miou_nearest')} / {average('miou_votes')}"
    mious = [100 * row["miou"] for row in rows]
    spread = f" ({min(mious):.1f} to {max(mious):.1f})" if len(rows) > 1 else ""
    minutes = median(fitting_seconds(row["stages"]) for row in rows) / 60
    frames = f"{median(row['fps_labels'] for row in rows):.1f}"
    return [
        str(place), ROWS[key].title, average("miou") + spread, rules, average("accuracy"), average("teacher_iou7"),
        f"{minutes:.2f}", average("storage", 1 / MIB, 2), frames, f"`{key}`",
    ]  # fmt: skip


def compare(old: str, new: str) -> list[str]:
    """The lines in which a page differs from the runs, numbers that the runs lack first."""
    known = set(re.findall(r"\d+\.\d+|\d+", new))
    unknown = [number for number in re.findall(r"\d+\.\d+|\d+", old) if number not in known]
    found = [f"not in the runs: {', '.join(dict.fromkeys(unknown))}"] if unknown else []
    changed = difflib.unified_diff(old.splitlines(), new.splitlines(), "page", "runs", lineterm="", n=0)
    return found + [line for line in changed if line[:1] in "+-"]


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, help="folder of small JSON files of runs")
    parser.add_argument("page", type=Path, help="the Markdown file")
    parser.add_argument("--check", action="store_true", help="compare the page with the runs instead of writing it")
    parser.add_argument("--add", nargs="+", type=Path, default=[], help="OUT folders of table1.py")
    parser.add_argument("--name", help="of the runs that are added")
    parser.add_argument("--about", default="", help="what they are, a sentence")
    return parser.parse_args()


if __name__ == "__main__":
    main()
