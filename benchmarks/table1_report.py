"""Table 1 as text and as pictures, from the results of its rows; and several tables as one.

python benchmarks/table1_report.py OUT1 OUT2 ...      # of table1.py, one per room: mIoU by room, mean and range over rooms
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, median
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from table1_rows import ROWS, fitting_seconds

from kfgs._files import atomic_path, read_json, write_json
from kfgs.evaluation.label_pictures import load_label_map
from kfgs.labels import load_label_set
from kfgs.metrics import MIB
from kfgs.scenes import load_scene
from kfgs.viz import overlay_labels
from kfgs.viz.pictures import draw_legend, picture_sheet, save_picture
from kfgs.viz.plots import INK, LINES, finish, new_figure

COLUMNS = 5  # of the picture of labels
HEAD = (
    "row", "dim", "mIoU", "by nearest text / by votes", "accuracy", "agrees with teacher: accuracy, IoU7",
    "codec: cosine, class kept", "minutes (stages, s)", "Gaussians",
    "storage, MiB", "on disk, MiB", "FPS maps", "FPS labels", "peak of the fit, GB", "paper: mIoU, min, Gaussians, MB, FPS",
)  # fmt: skip
PRESETS = {
    "quick": "baselines by their `short()`, few steps of the paper's rows",
    "cpu": "baselines by their `medium()`, fields of the paper's rows by `Training.cpu()`",
    "paper": "`published()` of every baseline, the paper's schedule",
}


def save_report(path: Path, about: dict[str, Any], results: list[dict[str, Any]]) -> None:
    """Write everything as JSON."""
    write_json(path, {**about, "rows": results})


def print_table(path: Path, about: dict[str, Any], results: list[dict[str, Any]]) -> None:
    """Print the table, and write it as Markdown."""
    text = table_text(about, results)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    print(text)


def table_text(about: dict[str, Any], results: list[dict[str, Any]]) -> str:
    """The table with what has to be said about it."""
    lines = [f"{about['command']}", "", f"Preset {about['preset']}: {PRESETS[about['preset']]}."]
    if about.get("device", "cpu") != "cpu":
        lines.append(
            f"On {about['device']}: the shared Gaussians, the fields of the paper's rows, frames per second. On the CPU: the "
            "fits of the baselines, the fusion of kfgs's default, and the scores."
        )
    lines.append(f"{about['machine']}; {about['seconds'] / 60:.1f} minutes in all (rows read back take none).")
    if about["geometry_seconds"] is not None:
        lines.append(
            f"The shared coloured Gaussians took {about['geometry_seconds'] / 60:.1f} minutes, not counted below."
        )
    if about["teacher"] is not None:
        teacher = about["teacher"]
        lines.append(
            f"Teacher: mIoU {100 * teacher['miou']:.1f}, accuracy {100 * teacher['accuracy']:.1f} over {teacher['views']} "
            "views (kfgs-pooled/1)."
        )
    lines += ["", f"| {' | '.join(HEAD)} |", "|" + "---|" * len(HEAD)]
    for key, row in ROWS.items():
        found = [result for result in results if result["request"]["row"] == key]
        if found:
            lines.append(f"| {' | '.join(cells(row.title, row.paper, found))} |")
    return "\n".join(lines) + "\n"


def cells(title: str, paper: dict[str, Any] | None, found: list[dict[str, Any]]) -> list[str]:
    """One row over its seeds: means, and the range of mIoU."""

    def average(name: str) -> float:
        return mean(one[name] for one in found)

    spread = "" if len(found) == 1 else " ({:.1f} to {:.1f})".format(*_range([100 * one["miou"] for one in found]))
    stages = ", ".join(f"{name} {mean(one['stages'][name] for one in found):.0f}" for name in found[0]["stages"])
    minutes = median(fitting_seconds(one["stages"]) for one in found) / 60
    agrees = "-"
    if "teacher_accuracy" in found[0]:
        agrees = f"{100 * average('teacher_accuracy'):.1f}, {100 * average('teacher_iou7'):.1f}"
    rules, codec = "-", "-"
    if "miou_votes" in found[0]:
        rules = f"{100 * average('miou_nearest'):.1f} / {100 * average('miou_votes'):.1f}"
    if "codec_cosine" in found[0]:
        codec = f"{average('codec_cosine'):.3f}, {100 * average('codec_same'):.1f}"
    packed = "" if "packed" not in found[0] else f" (packed {average('packed') / MIB:.2f})"
    published = "-"
    if paper is not None:
        published = f"{paper['miou']}, {paper['minutes']}, {paper['gaussians'] / 1_000:.1f}k, {paper['mib']}, {paper['fps']:.1f}"
    return [
        title, found[0]["dim"], f"{100 * average('miou'):.1f}{spread}", rules, f"{100 * average('accuracy'):.1f}", agrees,
        codec, f"{minutes:.2f} ({stages})", f"{average('gaussians') / 1_000:.1f}k",
        f"{average('storage') / MIB:.2f}", f"{average('disk') / MIB:.2f}{packed}", f"{average('fps_maps'):.1f}",
        f"{average('fps_labels'):.1f}", f"{average('peak_fit') / 1e9:.2f}", published,
    ]  # fmt: skip


def rooms_text(folders: Sequence[Path]) -> str:
    """Each row's mIoU by room, as the mean over seeds, and the mean and range over rooms if every room has the row."""
    reports = [read_json(folder / "table1.json") for folder in folders]
    names = [Path(report["rows"][0]["request"]["scene"]).name for report in reports]
    lines = [f"| row | {' | '.join(names)} | mean over rooms |", "|" + "---|" * (len(names) + 2)]
    for key, title in {"": "the teacher", **{key: row.title for key, row in ROWS.items()}}.items():
        scores: list[float | None] = []
        for report in reports:
            results = [result["miou"] for result in report["rows"] if result["request"]["row"] == key]
            results += [report["teacher"]["miou"]] if key == "" and report["teacher"] else []
            scores.append(100 * mean(results) if results else None)
        known = [score for score in scores if score is not None]
        whole = f"{mean(known):.1f} ({min(known):.1f} to {max(known):.1f})" if len(known) == len(scores) else "-"
        if known:
            cells = ["-" if score is None else f"{score:.1f}" for score in scores]
            lines.append(f"| {title} | {' | '.join(cells)} | {whole} |")
    return "\n".join(lines)


def _range(values: list[float]) -> tuple[float, float]:
    return min(values), max(values)


def draw_plots(out: Path, scene: Path, truth: str, results: list[dict[str, Any]]) -> None:
    """Quality against storage and against time, and the labels of one view by every row."""
    if not results:
        return
    sizes: dict[str, tuple[float, float]] = {}
    times: dict[str, tuple[float, float]] = {}
    for key, row in ROWS.items():
        found = [result for result in results if result["request"]["row"] == key]
        if found:
            title, miou = row.title.strip("*"), mean(one["miou"] for one in found)
            sizes[title] = mean(one["storage"] for one in found) / MIB, miou
            times[title] = max(median(fitting_seconds(one["stages"]) for one in found) / 60, 1e-3), miou
    paper = {f"{row.title.split(' (')[0]} (paper)": row.paper for row in ROWS.values() if row.paper is not None}
    reference = {name: (p["mib"], p["miou"] / 100) for name, p in paper.items()}
    figure = plot_quality_storage(sizes, reference=reference)
    figure.set_size_inches(12, 8)  # large enough for the names of both kinds of points
    finish(figure, out / "quality_storage.png")
    figure = plot_quality_storage(times)
    (axes,) = figure.axes
    axes.set(xlabel="minutes beyond the shared coloured Gaussians, on this machine", title="Quality against time")
    finish(figure, out / "quality_time.png")
    draw_labels(out, scene, truth, results)


def draw_labels(out: Path, folder: Path, truth: str, results: list[dict[str, Any]]) -> None:
    """The photograph, the truth, and what each row makes of one view."""
    scene, names = (
        load_scene(folder).undistorted(),
        list(load_label_set(folder / "classes.json", folder / "text.npy").names),
    )
    stem, seed = results[0]["picture"], results[0]["request"]["seed"]
    (view,) = [i for i in scene.views("test") if scene.stem(i) == stem]
    photo = scene.image(view)
    maps = {}
    if (folder / truth / f"{stem}.png").is_file():
        maps["truth"] = load_label_map(folder / truth / f"{stem}.png")
    for result in results:
        request = result["request"]
        labels = out / "rows" / result["folder"] / "labels.png"
        if result["picture"] == stem and request["seed"] == seed and labels.is_file():
            maps[ROWS[request["row"]].title.strip("*")] = load_label_map(labels)
    pictures = [photo, *(overlay_labels(photo, labels, names, legend=False) for labels in maps.values())]
    titles = [f"photo {stem}", *maps]
    sheet = picture_sheet(pictures, titles, COLUMNS, width=320)
    present = np.concatenate([labels.numpy().ravel() for labels in maps.values()])
    save_picture(out / "labels.png", np.concatenate([sheet, draw_legend(present, names, width=sheet.shape[1])]))


def plot_quality_storage(
    points: Mapping[str, tuple[float, float]],
    *,
    reference: Mapping[str, tuple[float, float]] | None = None,
) -> Figure:
    """Draw segmentation quality against size: mIoU in per cent over MiB (logarithmic), with the name of each point.

    Args:
        points: name to (storage in MiB, mIoU in [0, 1]).
        reference: published points, drawn hollow: for instance rows of Table 1, whose "MB" are MiB.

    Raises:
        ValueError: if there is no point, a size is not positive, or an mIoU lies outside [0, 1].
    """
    rows = [*points.items(), *(reference or {}).items()]
    if not rows or not all(mib > 0 and 0 <= miou <= 1 for _, (mib, miou) in rows):
        raise ValueError(f"points: expected names with (MiB above 0, mIoU in [0, 1]), got {dict(rows)}; correct them")
    figure = new_figure(7.6, 5.2)
    axes = figure.add_subplot()
    for group, color, marker, label in ((points, LINES[0], "o", "measured"), (reference, "none", "s", "reference")):
        if group:
            x, y = zip(*group.values(), strict=True)
            axes.scatter(x, 100 * np.array(y), s=55, color=color, edgecolor=INK, marker=marker, label=label, zorder=3)
    axes.set_xscale("log")
    axes.margins(x=0.3, y=0.12)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set(xlabel="storage in MiB", ylabel="mIoU in %", title="Quality against storage")
    axes.grid(alpha=0.3, which="both")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    for name, (mib, miou) in rows:  # to the left of its point if the next one to the right is close
        close = any(0 < np.log10(x / mib) < 0.5 and abs(y - miou) < 0.03 for _, (x, y) in rows)
        shift, side = (-8, "right") if close else (8, "left")
        axes.annotate(name, (mib, 100 * miou), (shift, 0), textcoords="offset points", ha=side, va="center", fontsize=9)
    return figure


if __name__ == "__main__":
    print(rooms_text([Path(folder) for folder in sys.argv[1:]]))
