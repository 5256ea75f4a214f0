"""What a run leaves to look at: a preview of three views, and one page with what was fitted, its numbers and its times."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Sequence
from pathlib import Path

import torch

from .._files import as_path, atomic_path, read_json
from ..fields import SemanticField
from ..fields.store import NAME
from ..gaussians import Gaussians
from ..scenes import Scene
from ..splat.rasterize import render_color
from ..viz import FeatureColors, overlay_labels, plot_history
from ..viz.pictures import as_bytes, picture_grid, resize_photo, save_picture
from .methods import Paper, Uplift

WIDTH = 400  # pixels of a picture
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 1240px; margin: 2em auto; padding: 0 1em }
img { max-width: 100%; height: auto } pre { background: #f3f3f5; padding: .8em; overflow-x: auto }
td { padding: .2em 1.2em .2em 0; border-bottom: 1px solid #ddd; vertical-align: top }
"""


def write_preview(path: Path, field: SemanticField, scene: Scene, split: str) -> bool:
    """Draw 3 views, evenly spread: photograph, features as colours, and labels if the field has classes.

    Views held out (split `test`) are preferred to those of `split`. Without any photograph nothing is drawn (False).
    """
    views = [i for i in scene.views("test" if scene.splits.get("test") else split) if scene.image_paths[i].is_file()]
    count, colors, rows = min(3, len(views)), FeatureColors.fit(field.latents), []
    for view in (views[(2 * k + 1) * len(views) // (2 * count)] for k in range(count)):  # not the ends, often alike
        camera = scene.cameras[view]
        camera = camera.resized(max(1, round(WIDTH * camera.height / camera.width)), WIDTH)
        photo = resize_photo(scene.image(view), camera.size)
        with torch.no_grad():
            rows.append([as_bytes(photo), colors(field.render(camera).map)])
        if field.classes is not None:
            rows[-1].append(overlay_labels(photo, field.segment(camera).cpu(), field.classes.names))
    if rows:
        titles = ("photograph", "features as colours", "labels")[: len(rows[0])]
        save_picture(path, picture_grid(rows, titles, width=WIDTH))
    return bool(rows)


def draw_photos(gaussians: Gaussians, scene: Scene, views: Sequence[int], folder: Path) -> list[Path]:
    """Draw views of a colour field next to their photographs, into `folder/<stem>.png`; the files."""
    written = [folder / f"{scene.stem(i)}.png" for i in views]
    for i, path in zip(views, written, strict=True):
        pair = [scene.image(i), render_color(gaussians, scene.cameras[i])]
        save_picture(path, picture_grid([pair], ("photograph", "colour field")))
    return written


def write_run_report(
    folder: str | Path,
    field: SemanticField,
    scene: Scene,
    method: Uplift | Paper,
    *,
    split: str = "train",
    command: str | None = None,
) -> list[Path]:
    """Write pictures of a fit and `report.html` into its run folder: one file without scripts, which loads nothing.

    The arguments are those of `fit`, its result, and the command that called it. Returns the pictures (`preview.png`, and of
    trained stages `<stage>.png`) and the page.
    """
    folder, info = as_path(folder), field.info
    written = [folder / "preview.png"] if write_preview(folder / "preview.png", field, scene, split) else []
    for stage in info["stages"]:
        if (name := stage.rpartition("-")[0]) in ("codebook", "field"):
            written.append(folder / f"{name}.png")
            plot_history(read_json(folder / "stages" / stage / "history.json"), written[-1])
    facts = {
        "scene": f"{scene.folder or 'in memory'}: {len(scene)} views, {len(info['views'])} of them used",
        "teacher": (info.get("teacher") or {}).get("name", "not known"),
        "teacher's maps": " x ".join(map(str, info["teacher_map"])),
        "method": info["method"],
        "geometry": info.get("geometry", "trained with the field"),
        "Gaussians": f"{len(field):,}",
        "numbers for each Gaussian's meaning": f"{field.latents.shape[1]}, for {field.dim} channels of the teacher",
        "size on disk": f"{(folder / NAME).stat().st_size / 1e6:,.1f} MB",
        "size as the paper's Table 1 counts it": f"{field.storage() / 1e6:,.1f} MB",
        "seed": info["seed"],
        "kfgs, torch": f"{info['kfgs']}, {torch.__version__}",
    }
    if shares := info.get("explained"):
        said = "{:.0%} in the other half, {:.0%} in its own".format(*shares)
        facts["of the teacher's variation half of the views explains"] = said
    seconds = info["seconds"] | {"all stages": sum(info["seconds"].values())}
    facts |= {name: f"{value:,.0f} s" for name, value in seconds.items()}
    title = html.escape(folder.absolute().name)
    repeat = command or f"kfgs.fit(scene, maps, method, folder={str(folder)!r})"
    options = html.escape(json.dumps(method.options(), indent=1))
    pictures = {file.stem: base64.b64encode(file.read_bytes()).decode("ascii") for file in written}
    shown = {html.escape(name): html.escape(str(value)) for name, value in facts.items()}
    cells = (f"<tr><td>{name}</td><td>{value}</td></tr>" for name, value in shown.items())
    parts = [
        f"<h1>kfgs: {title}</h1>",
        *(f'<h2>{name}</h2>\n<img alt="{name}" src="data:image/png;base64,{data}">' for name, data in pictures.items()),
        "<h2>What was fitted, and the time of each stage</h2>\n<table>",
        *cells,
        f"</table>\n<h2>How to repeat it</h2>\n<pre>{html.escape(repeat)}</pre>",
        f"<details><summary>All options</summary><pre>{options}</pre></details>",
    ]
    head = f'<meta charset="utf-8"><title>kfgs: {title}</title><style>{STYLE}</style>'
    page = f'<!doctype html>\n<html lang="en"><head>{head}</head><body>\n' + "\n".join(parts) + "\n</body></html>\n"
    with atomic_path(folder / "report.html") as temporary:
        temporary.write_text(page, encoding="utf-8")
    return [*written, folder / "report.html"]
