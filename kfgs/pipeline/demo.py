"""The demo: every step on the toy room, with colours and edits, scored against exact ground truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from .._files import check_output, write_json
from ..evaluation import find_points, score_views
from ..evaluation.surface import score_surface
from ..fields import SemanticField
from ..fields.store import NAME
from ..formats import write_splats
from ..formats.ply import write_ply
from ..gaussians import Gaussians
from ..labels import EditList, OfClass, Recolor, Remove, connected_parts
from ..scenes import FeatureFolder, Scene, load_scene
from ..toy.room_folder import ToyConfig, make_toy_room
from ..viz.compare import views_of_change, write_comparison
from .attach import attach, label_cloud, save_labelled
from .color import ColorConfig, fit_color
from .fit import fit
from .methods import Uplift
from .run_report import write_run_report
from .segment import score_scene, score_teacher, segment_scene, true_labels

REMOVED, PAINTED, PAINT = "chair", "plant", "#c04040"  # the edits of the paper's Figures 5 and 4


def run(
    out: str | Path,
    *,
    seed: int = 0,
    room: ToyConfig | None = None,
    report: Callable[[str], None] | None = None,
    progress: bool = False,
) -> list[Path]:
    """Make the room, fit it, segment its unseen views, label its surface, edit its colours; return the files written.

    Args:
        out: the folder for `scene/`, `run/`, `segmentation/`, labelled and edited clouds, pictures and `scores.json`.
        seed: every random choice follows from it.
        room: the room to build; None: the default room.
        report: called with one line per step.
        progress: show progress bars.
    """
    out, say = check_output("out", out, "a folder"), report or (lambda text: None)
    say(
        "1. A room. The demo makes a small furnished room, so that the truth is known exactly: photos, cameras, and for each "
        "photo what a 2-D network would say about its pixels, with the errors of such networks."
    )
    folder = make_toy_room(out / "scene", room or ToyConfig())
    scene, maps = load_scene(folder), FeatureFolder(folder / "features")
    say(
        "2. Colours. An ordinary Gaussian splat is trained on the photos. It knows nothing of chairs. If you have a splat of "
        "your own, kfgs takes that."
    )
    colors = fit_color(scene, out / "run", ColorConfig.quick(), seed=seed, report=say, progress=progress)
    quality = score_views(colors, scene)
    say(f"colours of unseen views: {quality}")
    say(
        "3. Meaning. Each Gaussian gets the mean of what the network says about the pixels that show it; errors of single photos "
        "cancel. Then the features are compressed: a few numbers instead of 512, and neighbours that mean the same become one."
    )
    method = Uplift(colors)
    field = fit(scene, maps.of(scene, "train"), method, folder=out / "run", seed=seed, report=say, progress=progress)
    say(field.summary())
    say(
        "4. Segmentation. Views that no photo shows are drawn from the field, a class for each pixel, and compared with the "
        "truth. mIoU is the mean over classes of overlap divided by union; 1 is perfect."
    )
    assert field.classes is not None
    classes, truth = field.classes, true_labels(scene, folder / "labels", "test")
    unseen = segment_scene(field, scene, classes, out / "segmentation", truth=truth, progress=progress)
    scores = score_scene(unseen, truth, classes)
    seen = dict(zip(unseen, maps.of(scene, "test"), strict=True))
    teacher = score_teacher(seen.__getitem__, truth, classes, scene.cameras[scene.views("test")[0]].size)
    say(f"unseen views: {scores}")
    say(f"the 2-D network alone, on the same views: {teacher.miou}")
    gaussians = field.label(classes)
    written = save_labelled(out / "gaussians.ply", gaussians, rule="fused features; score = cosine")
    known = find_points(folder)
    write_ply(out / "surface.ply", {name: known.points[:, i].float().numpy() for i, name in enumerate("xyz")})
    label_cloud(gaussians, out / "surface.ply", out / "surface.ply")
    assert gaussians.labels is not None
    surface = score_surface(gaussians.means, gaussians.labels, known.points.float(), known.labels)
    say(f"surface points: {surface}")
    edited = _edit(out, field, colors, scene, say)
    reports: dict[str, Any] = {"unseen_views": scores, "teacher": teacher, "surface": surface, "color": quality}
    write_json(out / "scores.json", {name: value.to_json() for name, value in reports.items()})
    pages = write_run_report(out / "run", field, scene, method, command="kfgs demo")
    segmented = [out / "segmentation" / name for name in ("predicted", "colored", "sheets")]
    return [out / "run" / NAME, *segmented, *written, out / "surface.ply", *pages, *edited, out / "scores.json"]


def _edit(out: Path, field: SemanticField, colors: Gaussians, scene: Scene, say: Callable[[str], None]) -> list[Path]:
    """Remove one class from the colours, paint another; the files of clouds and edits, and pictures of the changes."""
    say(
        f'5. Edits. The classes are carried over to the splat with the colours, and then "{REMOVED}" is a name for Gaussians: '
        f"the {REMOVED}s are removed, and the {PAINTED}s are painted red. What nobody saw behind a {REMOVED} is invented: the "
        "floor around it continues (fill). Pictures show the views that change most."
    )
    before = attach(field, colors).gaussians
    written = list(write_splats(before, out / "color.ply").paths)
    for part in connected_parts(before, OfClass(REMOVED).select(before), field.cameras):
        say(f"  {REMOVED}: {part!r}")
    for name, edit in {"removed": Remove(REMOVED, fill=True), "recolored": Recolor(PAINTED, PAINT)}.items():
        after, file = edit.apply(before), out / f"{name}.ply"
        written += [*write_splats(after, file).paths, EditList((edit,)).save(out / f"{name}.ply.edits.json")]
        views = [scene.cameras[i] for i in views_of_change(before, after, scene.cameras)]
        written.append(write_comparison(out / f"{name}.png", before, after, views))
    return written
