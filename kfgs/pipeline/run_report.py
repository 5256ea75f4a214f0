"""What a run leaves to look at: a preview of three views, and one page with what was fitted, its numbers and its times."""

from __future__ import annotations

import base64
import html
import json
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch

from .._files import as_path, atomic_path, bytes_in_words, real_path, seconds_in_words
from ..fields import SemanticField
from ..fields.store import NAME
from ..scenes import Scene
from ..viz import FeatureColors, overlay_labels, plot_history, save_picture
from ..viz.pictures import as_bytes, legend_strip, picture_grid, resize_photo
from .methods import Paper, Uplift
from .stages import read_stage

WIDTH = 400  # pixels of a picture
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 1240px; margin: 2em auto; padding: 0 1em; color: #1b1b1b }
img { max-width: 100%; height: auto } h2 { margin-top: 2em } code, pre { background: #f3f3f5; border-radius: 4px }
pre { padding: .8em; overflow-x: auto; white-space: pre-wrap } table { border-collapse: collapse }
th, td { text-align: left; padding: .2em 1.2em .2em 0; border-bottom: 1px solid #ddd; vertical-align: top }
td.number { text-align: right; font-variant-numeric: tabular-nums }
"""


def write_preview(
    path: Path, field: SemanticField, scene: Scene, split: str = "train", *, count: int = 3
) -> Path | None:
    """Draw some views, evenly spread: photograph, features as colours, and labels if the field has classes.

    Views held out (split `test`) are preferred to those of `split`. Without any photograph nothing is drawn.
    """
    views = [i for i in scene.views("test" if scene.splits.get("test") else split) if scene.image_paths[i].is_file()]
    if not views:
        return None
    count = min(count, len(views))
    chosen = [
        views[(2 * i + 1) * len(views) // (2 * count)] for i in range(count)
    ]  # not the ends, which often are alike
    classes, colors = field.classes, FeatureColors.fit(field.features)
    titles = ["photograph", "features as colours"] + ([] if classes is None else ["labels"])
    rows, seen = [], []
    for view in chosen:
        camera = scene.cameras[view]
        camera = camera.resized(max(1, round(WIDTH * camera.height / camera.width)), WIDTH)
        photo = resize_photo(scene.image(view), camera.size)
        with torch.no_grad():
            row = [as_bytes(photo), colors(field.render(camera).map)]
        if classes is not None:
            labels = field.segment(camera, classes).cpu()
            row.append(overlay_labels(photo, labels, classes.names, legend=False))
            seen.append(labels.unique())
        rows.append(row)
    sheet = picture_grid(rows, titles, width=WIDTH)
    if classes is not None:
        sheet = np.concatenate([sheet, legend_strip(torch.cat(seen), classes.names, sheet.shape[1])])
    save_picture(path, sheet)
    return path


def write_run_report(
    folder: Path,
    field: SemanticField,
    scene: Scene,
    method: Uplift | Paper,
    *,
    split: str = "train",
    command: str | None = None,
) -> list[Path]:
    """Write pictures of a fit and `report.html` into its run folder: one file without scripts, which loads nothing.

    Args:
        folder: the run folder.
        field: what `fit` returned.
        scene: its scene.
        method: its method.
        split: its training views.
        command: the command that made it; None: the page shows the call of `fit`.

    Returns:
        The pictures (`preview.png`, and of trained stages `<stage>.png`) and the page.
    """
    folder, info = as_path(folder), field.info
    title = real_path(folder).name
    preview = write_preview(folder / "preview.png", field, scene, split)
    training = _training_pictures(folder, info["stages"])
    facts = {
        "scene": f"{scene.folder or 'in memory'}: {len(scene)} views, {len(info['views'])} of them used",
        "teacher": (info.get("teacher") or {}).get("name", "not known"),
        "teacher's maps": " x ".join(map(str, info["teacher_map"])),
        "method": info["method"],
        "geometry": info.get("geometry", "trained with the field"),
        "Gaussians": f"{len(field):,}",
        "numbers for each Gaussian's meaning": f"{field.features.shape[1]}, for {field.dim} channels of the teacher",
        "size on disk": bytes_in_words((folder / NAME).stat().st_size),
        "size as the paper's Table 1 counts it": bytes_in_words(field.storage()),
        "seed": info["seed"],
        "kfgs, torch": f"{info['kfgs']}, {torch.__version__}",
    }
    seconds = info["seconds"] | {"all": sum(info["seconds"].values())}
    repeat = command or f"kfgs.fit(scene, maps, method, folder={str(folder)!r})"
    options = json.dumps(method.options(), indent=1)
    parts = [
        f"<h1>kfgs: {_text(title)}</h1>",
        *([] if preview is None else [_image(preview, "three views of the field")]),
        "<h2>What was fitted</h2>",
        _table(facts.items()),
        "<h2>Time of each stage</h2>",
        _table(((name, seconds_in_words(value)) for name, value in seconds.items()), numbers=1),
        *(f"<h2>Training: {_text(file.stem)}</h2>\n{_image(file, file.stem)}" for file in training),
        "<h2>How to repeat it</h2>",
        f"<pre>{_text(repeat)}</pre>",
        f"<details><summary>All options</summary><pre>{_text(options)}</pre></details>",
        "<h2>What to do next</h2>",
        f"<pre>{_text(_next(folder / NAME, field))}</pre>",
    ]
    head = f'<meta charset="utf-8"><title>kfgs: {_text(title)}</title><style>{STYLE}</style>'
    page = f'<!doctype html>\n<html lang="en"><head>{head}</head><body>\n' + "\n".join(parts) + "\n</body></html>\n"
    with atomic_path(folder / "report.html") as temporary:
        temporary.write_text(page, encoding="utf-8")
    return [*([] if preview is None else [preview]), *training, folder / "report.html"]


def _training_pictures(folder: Path, stages: Sequence[str]) -> list[Path]:
    """Plot the histories of a run's codebook and field; return the pictures."""
    written = []
    for stage in (read_stage(folder / "stages" / name) for name in stages):
        if stage.name in ("codebook", "field"):
            written.append(folder / f"{stage.name}.png")
            plot_history(stage.history, written[-1])
    return written


def _next(path: Path, field: SemanticField) -> str:
    classes = field.classes
    select = "" if classes is None else shlex.join(["kfgs", "select", classes.names[-1], str(path)]) + "\n"
    return f"kfgs view {path}\n{select}kfgs segment {path} --out segmented/"


def _text(value: object) -> str:
    return html.escape(str(value))


def _table(rows: Iterable[Sequence[object]], numbers: int | None = None) -> str:
    lines = []
    for row in rows:
        cells = [
            f'<td class="number">{_text(v)}</td>' if i == numbers else f"<td>{_text(v)}</td>" for i, v in enumerate(row)
        ]
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return "<table>\n" + "\n".join(lines) + "\n</table>"


def _image(file: Path, name: str) -> str:
    data = base64.b64encode(file.read_bytes()).decode("ascii")
    return f'<img alt="{_text(name)}" src="data:image/png;base64,{data}">'
