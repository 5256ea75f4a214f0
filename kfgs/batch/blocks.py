"""A large scene in blocks: cut it, fit each block as a scene of its own, join the cores of their fields.

Latents are fitted once, on features from all over the scene, so that those of all blocks mean the same. A block's views and
Gaussians are all that can say something about its core (`scenes.blocks.Block`), so the core of its field is nearly that of
the whole scene's, and blocks join without a seam.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._card import error_line
from .._check import as_array
from .._files import Names, as_path, check_output, digest_file, digest_value, locked, read_json, real_path, write_json
from .._origin import to_world
from ..fields import SemanticField, store, uplift, working_maps
from ..formats import read_splats, write_splats
from ..formats.table import splat_file_of
from ..gaussians import Gaussians
from ..pipeline import Uplift, fit
from ..pipeline.maps import maps_of_views
from ..quant import LinearLatents
from ..scenes import FeatureFolder, Scene, SceneError, load_scene
from ..scenes.blocks import Block, partition, write_part
from ..scenes.colmap_model import read_model
from ..scenes.files import picture_folder
from ..scenes.load import find_model
from .run import run_tasks

BLOCKS, BLOCK, CORE, FACTS, LATENTS, SPLAT = (
    "blocks.json", "block.json", "core.kfgs", "core.json", "latents.safetensors", "splat.ply",
)  # fmt: skip
RUN = ".run"  # hidden: its field has the Gaussians of the reach, too
BESIDE = ("classes.json", "text.npy", "text.safetensors", "labels", "labels_scored", "masks")
"""Files and folders of a scene that belong to each of its blocks, too."""
REACH = 3.0  # standard deviations: farther out, a Gaussian is below 1/255 of any pixel


def fit_blocks(
    scene: str | Path,
    out: str | Path,
    count: int,
    method: Uplift | None = None,
    *,
    splat: str | Path | None = None,
    latents: int = 32,
    client: Any = None,
    report: Callable[[str], None] | None = None,
) -> dict[str, dict[str, Any]]:
    """Cut a scene into blocks and make the field of each, here or as tasks of Dask. `join_blocks` joins them.

    Each block is a scene folder of its own, `out/<block>`: links to the pictures, masks, maps and labels, a COLMAP model of
    the images that see its core, and the core's field in `core.kfgs`. The same call again repeats nothing that is finished.

    Args:
        scene: a folder with feature maps in `features/` and a COLMAP model, whose tracks say which image sees which point.
        out: the folder of the blocks.
        count: how many blocks.
        method: how; its `max_gaussians` is per block.
        splat: Gaussians of the whole scene; each block gets those that it needs. None: each block trains its own.
        latents: numbers per Gaussian, the same in all blocks.
        client: a `distributed.Client` (`open_client`); None: one block after the other in this process.
        report: called with a line per block.

    Returns:
        For each block the number of `gaussians` in its core, the `box` around them (None if there are none), the `seconds`,
        and a digest of the `options`.

    Raises:
        SceneError: if the model has no tracks, or fewer points than blocks, or no training view sees a block.
        FileNotFoundError: if views have no maps.
        ValueError: if `out` has other blocks, or if a block failed: the others are finished then.
    """
    root, say = check_output("out", out, "a folder").absolute(), report or (lambda text: None)
    with locked(root, ".blocks.lock"):
        folders = {name: root / name for name in _cut(as_path(scene), root, count, splat, latents)}
        tasks = {name: (folder, method or Uplift()) for name, folder in folders.items()}
        results, failed = dict[str, dict[str, Any]](), list[str]()
        for name, result in run_tasks(_fit_block, tasks, client, say):
            if isinstance(result, Exception):
                failed.append(f"{folders[name]}: {str(result) or error_line(result)}")
                say(failed[-1])
            else:
                results[name] = result
                say(f"{name}: {result['gaussians']:,} Gaussians in {result['seconds']} s")
    if failed:
        raise ValueError(failed[0] + (f" (and {len(failed) - 1} more blocks failed)" if len(failed) > 1 else ""))
    return results


def _cut(source: Path, out: Path, count: int, splat: str | Path | None, latents: int) -> list[str]:
    """Write the scene folder of each block, unless an earlier call has; their names."""
    model, whole = find_model(source), load_scene(source)
    if model is None:
        raise SceneError(f"scene: expected a folder with a COLMAP model, got {source}; make one with `kfgs sfm`")
    maps = maps_of_views(whole, whole.views("train"), FeatureFolder(source / "features").of(whole, "train"))
    content, training = read_model(model), set(whole.views("train"))
    blocks = partition(content, count)
    unseen = next((block.name for block in blocks if not training & _views_of(whole, block)), None)
    if unseen is not None:
        raise SceneError(f"{unseen}: expected training views that see it, got none; ask for fewer blocks than {count}")
    todo = [block for block in blocks if not (out / block.name / BLOCK).is_file()]
    cloud = read_splats(splat) if todo and splat is not None else None
    facts = {
        "format": "kfgs.blocks/3",
        "scene": os.path.relpath(real_path(source), real_path(out)),
        "splat": None if splat is None else digest_file(splat_file_of(splat)),
        "latents": latents,
        "blocks": [asdict(block) for block in blocks],
    }
    if not (out / BLOCKS).is_file():
        write_json(out / BLOCKS, facts)  # first, so that another cut is refused even if this one is killed
    elif read_json(out / BLOCKS) != facts:
        raise ValueError(f"out: expected a new folder, or one with these blocks, got {out} with others; choose another")
    if not (out / LATENTS).is_file():
        working_maps.sample_latents(maps, latents, most=256).save(out / LATENTS)
    for block in todo:
        write_part(out / block.name / "sparse/0", content, block.views)
        _write_block(out / block.name, block, whole, cloud)
    return [block.name for block in blocks]


def _write_block(folder: Path, block: Block, whole: Scene, cloud: Gaussians | None) -> None:
    """Make the scene folder of a block, which has its model already."""
    assert whole.folder is not None
    own = _views_of(whole, block)
    splits = {name: [whole.stem(i) for i in views if i in own] for name, views in whole.splits.items()}
    write_json(folder / "split.json", splits)
    targets = {name: whole.folder / name for name in ("features", *BESIDE) if (whole.folder / name).exists()}
    targets["images"] = picture_folder(whole.cameras[0].name, whole.image_paths[0])
    for name, target in targets.items():  # relative links, so that both folders can move together
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(os.path.relpath(real_path(target), real_path(folder)), target.is_dir())
    if cloud is not None:
        means, radii = _places(cloud), REACH * as_array(cloud.scales).max(1)
        write_splats(cloud.select(block.needs(means, radii)), folder / SPLAT)
    write_json(folder / BLOCK, asdict(block))  # last: the folder is complete


def _fit_block(folder: Path, method: Uplift) -> dict[str, Any]:
    """Fit the field of one block, and keep its core; the facts about it, as `core.json` has them."""
    block, scene = Block(**read_json(folder / BLOCK)), load_scene(folder)
    splat = read_splats(folder / SPLAT) if (folder / SPLAT).is_file() else None
    facts: dict[str, Any] = {"gaussians": 0, "box": None, "seconds": 0.0, "options": digest_value(method.options())}
    (folder / FACTS).unlink(missing_ok=True)  # a fit that is killed leaves a block that is not fitted
    if splat is None or block.holds(_places(splat)).any():
        maps = FeatureFolder(folder / "features").of(scene)
        method = replace(method, splat=splat, latents=LinearLatents.load(folder.parent / LATENTS))
        made = fit(scene.undistorted(), maps, method, folder=folder / RUN)
        own = block.holds(_places(made.gaussians))
        facts |= {"gaussians": int(own.sum()), "seconds": round(sum(made.info["seconds"].values()), 1)}
        if own.any():
            core = made.select(own)
            means, radii = _places(core.gaussians), REACH * as_array(core.gaussians.scales).max(1)[:, None]
            facts["box"] = [(means - radii).min(0).tolist(), (means + radii).max(0).tolist()]
            core.save(folder / CORE)
    write_json(folder / FACTS, facts)
    return facts


def join_blocks(
    out: str | Path, low: Sequence[float] = (-np.inf,) * 3, high: Sequence[float] = (np.inf,) * 3
) -> SemanticField:
    """The fitted blocks of a scene as one field, or the Gaussians whose centres lie in a box.

    Only blocks that touch the box are read. Each block's own field is in `out/<block>/core.kfgs`.

    Args:
        out: the folder of the blocks.
        low: [3] corner of the box, world units; -inf: no limit on this side.
        high: [3] corner; inf: no limit.

    Raises:
        FileNotFoundError: if a block was not fitted.
        ValueError: if the blocks were fitted with different options, or no Gaussian lies in the box.
    """
    root, box = as_path(out), np.array([low, high], np.float64)
    if box.shape != (2, 3) or not (box[0] <= box[1]).all():
        raise ValueError(f"low, high: expected a low corner and then a high one, got {list(low)} and {list(high)}")
    described = read_json(root / BLOCKS, "the blocks of a scene, which fit_blocks makes,")
    names = [block["name"] for block in described["blocks"]]
    facts = {name: read_json(root / name / FACTS, "a fitted block: run fit_blocks again;") for name in names}
    if len({fact["options"] for fact in facts.values()}) > 1:
        raise ValueError(f"{root}: expected blocks that were fitted with the same options; fit all of them again")
    boxes = {name: np.array(fact["box"]) for name, fact in facts.items() if fact["box"] is not None}
    parts = []
    for name, corners in boxes.items():
        if (box[0] <= corners[1]).all() and (box[1] >= corners[0]).all():
            part = SemanticField.load(root / name / CORE)
            means = _places(part.gaussians)
            inside = ((means >= box[0]) & (means <= box[1])).all(1)
            parts += [part.select(inside)] if inside.any() else []
    if not parts:
        where = {name: corners.round(3).tolist() for name, corners in boxes.items()}
        raise ValueError(f"low, high: expected a box with Gaussians, got none in it; all of them lie in {where}")
    field, scene = uplift.join_fields(parts), real_path(root / described["scene"])
    return replace(field, info=field.info | {"scene": str(scene)}, classes=store.scene_classes(scene, field.dim))


def _places(gaussians: Gaussians) -> Any:  # [N, 3]
    """Where Gaussians are in the world, as the boxes of blocks are."""
    return as_array(to_world(gaussians.means, gaussians.origin))


def _views_of(scene: Scene, block: Block) -> set[int]:
    """The scene's views in a block, whose names are those of the model."""
    place = {camera.name: i for i, camera in enumerate(scene.cameras)}
    names = Names(place)
    return {place[name] for view in block.views if (name := names.find(view)) is not None}
