"""A large scene in blocks: cut it, fit each block as a scene of its own, keep the core of each field.

Latents are fitted once, on features from all over the scene, so that those of all blocks mean the same. A block's views and
Gaussians are all that can say something about its core (`scenes.Block`), so the core of its field is nearly that of the
whole scene's, and blocks join without a seam.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from .._check import as_array, check_whole
from .._files import (
    Names,
    as_path,
    atomic_folder,
    check_output,
    digest_file,
    digest_value,
    locked,
    read_json,
    real_path,
    write_json,
)
from .._origin import to_world
from .._rows import unit_rows
from ..features import FeatureFolder
from ..fields import SemanticField, sample_latents
from ..fields.store import NAME
from ..formats import read_splats, write_splats
from ..formats.folders import splat_file_of
from ..gaussians import Gaussians
from ..pipeline import Uplift, fit
from ..pipeline.maps import maps_of_views
from ..pipeline.stages import digest_tensors
from ..quant import FeatureMaps, LinearLatents
from ..scenes import Scene, SceneError, load_scene
from ..scenes.blocks import Block, partition, write_parts
from ..scenes.colmap_model import read_whole_model
from ..scenes.masks import picture_folder
from ..scenes.sub_models import find_model
from .batch import map_scenes
from .in_blocks import BLOCKS, CORE, FACTS, FORMAT, FieldInBlocks, read_blocks

LATENTS, SPLAT = "latents.safetensors", "splat.ply"
RUN = ".run"  # hidden: its field has the Gaussians of the reach, too
BESIDE = ("classes.json", "text.npy", "text.safetensors", "labels", "labels_scored", "masks")
"""Files and folders of a scene that belong to each of its blocks, too."""
"""Options of a fit that do not change what its field means."""
LOOKED_AT = 8  # maps, to say how well given latents fit
REACH = 3.0  # standard deviations: farther out, a Gaussian is below 1/255 of any pixel


def split_scene(
    scene: str | Path,
    out: str | Path,
    count: int,
    *,
    features: str | Path | None = None,
    splat: str | Path | None = None,
    latents: int | str | Path | LinearLatents = 32,
    report: Callable[[str], None] | None = None,
) -> list[Block]:
    """Cut a scene into blocks, each a scene folder of its own that `fit_block` or any command takes.

    Pictures, masks, maps and labels are links into the scene. A block's COLMAP model has the images that see its core.

    Args:
        scene: a folder with a COLMAP model, whose tracks say which image sees which point.
        out: receives a folder for each block, `blocks.json`, and `latents.safetensors`.
        count: of blocks.
        features: folder of feature maps; None: SCENE/features.
        splat: Gaussians of the whole scene; each block gets those that it needs. None: each block trains its own.
        latents: numbers per Gaussian, in all blocks; or latents that exist, or their file (`latents.safetensors` of other
            blocks): then the fields of both scenes mean the same, and can be joined. The teacher must be the same.
        report: called with a line per block.
        options: others of `fit_block`.

    Returns:
        The blocks.

    Raises:
        SceneError: if the model has no tracks, or fewer points than blocks, or no image sees a block.
        FileNotFoundError: if views have no maps.
        ValueError: if OUT holds another scene's blocks, or was cut from other maps, another splat or in another way; if another
            process cuts there; if OUT is the scene, or lies among its maps; if given latents do not fit to the maps.
        FileExistsError: if OUT has files of these names, but no blocks: somebody else made them.
    """
    source, say = as_path(scene), report or (lambda text: None)
    maps_folder = source / "features" if features is None else as_path(features)
    out = check_output("out", out, "a folder")
    if isinstance(latents, str | Path):
        latents = LinearLatents.load(latents)
    elif not isinstance(latents, LinearLatents):
        check_whole("latents", latents, 1)
    whole = load_scene(source)
    cloud = None if splat is None else read_splats(splat)
    maps = maps_of_views(whole, whole.views("train"), FeatureFolder(maps_folder).of(whole, "train"))
    if isinstance(latents, LinearLatents):
        say(_fit_of(latents, maps))
    model = find_model(source)
    if model is None:
        raise SceneError(f"scene: expected a folder with a COLMAP model, got {source}; make one with `kfgs sfm`")
    blocks = partition(read_whole_model(model), count)
    facts = {
        "format": FORMAT,
        "version": 1,
        "scene": os.path.relpath(real_path(source), real_path(out)),
        "features": os.path.relpath(real_path(maps_folder), real_path(out)),
        "splat": None if splat is None else digest_file(splat_file_of(splat)),
        "latents": digest_tensors(latents.basis) if isinstance(latents, LinearLatents) else latents,
        "blocks": [b.to_json() for b in blocks],
    }
    _check_same(out, facts)
    training = set(whole.views("train"))
    for block in blocks:
        if not training & set(_views_of(whole, block)):
            raise SceneError(
                f"{block.name}: expected training views that see it, got none; ask for fewer blocks than {count}"
            )
    with locked(out, ".blocks.lock"):
        _check_same(out, facts)
        write_json(out / BLOCKS, facts)  # first, so that another cut is refused even if this one is killed
        known = latents if isinstance(latents, LinearLatents) else sample_latents(maps, count=latents)
        known.save(out / LATENTS)
        write_parts(model, {out / block.name / "sparse/0": block.views for block in blocks})
        for block in blocks:
            _write_block(out / block.name, block, whole, maps_folder, cloud)
            say(f"{block.name}: {len(block.views)} views")
    return blocks


def _fit_of(latents: LinearLatents, maps: FeatureMaps) -> str:
    """A line about how well given latents fit to the features of some maps; a ValueError if they have other channels."""
    views = range(0, len(maps), max(1, len(maps) // LOOKED_AT))
    own = sample_latents([maps[i] for i in views], count=latents.latent)
    if own.dim != latents.dim:
        raise ValueError(
            f"latents: expected those of features with {own.dim} channels, as the maps have, got {latents.dim} channels; "
            "give latents of the same teacher"
        )
    given, best = (_held(one, [maps[i] for i in views]) for one in (latents, own))
    return f"the given latents hold {given:.1%} of the features here; {latents.latent} of this scene's own would hold {best:.1%}"


def _held(latents: LinearLatents, maps: list[torch.Tensor]) -> float:
    """The share of unit features, by squared length, that latents hold; pixels without a feature do not count."""
    rows = unit_rows(torch.cat([one.flatten(0, 1).float() for one in maps]))
    known = rows[rows.any(1)]
    return float(latents.encode(known).square().sum() / len(known))


def _write_block(folder: Path, block: Block, whole: Scene, maps_folder: Path, cloud: Gaussians | None) -> None:
    """Make the scene folder of a block, which has its model already."""
    assert whole.folder is not None
    _link(folder / "images", picture_folder(whole.cameras[0].name, whole.image_paths[0]))
    _link(folder / "features", maps_folder)
    for name in BESIDE:
        if (whole.folder / name).exists():
            _link(folder / name, whole.folder / name)
    write_json(folder / "split.json", _splits(whole, block))
    if cloud is not None:
        means, radii = _places(cloud), REACH * as_array(cloud.scales).max(1)
        write_splats(cloud.select(torch.from_numpy(block.needs(means, radii))), folder / SPLAT)
    write_json(folder / "block.json", block.to_json())


def fit_block(
    folder: str | Path,
    method: Uplift | None = None,
    *,
    split: str = "train",
    report: Callable[[str], None] | None = None,
    **options: Any,
) -> dict[str, Any]:
    """Fit the field of one block, and keep its core in `folder/core`. Finished stages in `folder/.run` are reused.

    An older core stays until the new one, with the facts about it in `core.json`, replaces it in one step.

    Args:
        folder: what `split_scene` made.
        method: how.
        split: the training views.
        report: called with a line per stage.
        options: others of `fit`: seed, device, undistorted_features, progress.

    Returns:
        Counts, the box of the core's Gaussians (None if there is none), seconds, and a digest of the options, as JSON.

    Raises:
        ValueError: as `fit`.
    """
    folder, method = as_path(folder), method or Uplift()
    block = Block.from_json(read_json(folder / "block.json"))
    as_taken = load_scene(folder)
    maps = FeatureFolder(folder / "features").of(as_taken, split)
    splat = read_splats(folder / SPLAT) if (folder / SPLAT).is_file() else None
    decides = [method.options(), split, options.get("seed", 0), options.get("undistorted_features", False)]
    facts: dict[str, Any] = {"gaussians": 0, "of": 0, "box": None, "seconds": 0.0, "options": digest_value(decides)}
    core = None
    if splat is None or block.holds(_places(splat)).any():
        latents = LinearLatents.load(folder.parent / LATENTS)
        method = replace(method, splat=splat, latents=latents)
        field = fit(as_taken.undistorted(), maps, method, folder=folder / RUN, split=split, report=report, **options)
        own = torch.from_numpy(block.holds(_places(field.gaussians)))
        seconds = round(sum(field.info["seconds"].values()), 1)
        facts |= {"gaussians": int(own.sum()), "of": len(own), "seconds": seconds}
        if bool(own.any()):
            core = field.select(own)
            facts["box"] = _box(core)
    _put(folder / CORE, core, facts)
    return facts


def _put(place: Path, core: SemanticField | None, facts: dict[str, Any]) -> None:
    """Write the core of a block, if it has Gaussians, and the facts about it, in one step."""
    with atomic_folder(place) as new:
        if core is not None:
            core.save(new / NAME)
        write_json(new / FACTS, facts)
    if core is None:  # what is left of an older one
        (place / NAME).unlink(missing_ok=True)


def fit_blocks(
    out: str | Path,
    method: Uplift | None = None,
    *,
    client: Any = None,
    report: Callable[[str], None] | None = None,
    **options: Any,
) -> FieldInBlocks:
    """Fit all blocks of `split_scene`, one after the other or on the workers of a client.

    Args:
        out: the folder of the blocks.
        method: how; `max_gaussians` is per block.
        client: where blocks are fitted, as in `map_scenes`; None: here.
        report: called with a line per block.
        options: others of `fit_block`.

    Raises:
        ValueError: if a block failed; the others are finished then.
    """
    out, say = as_path(out), report or (lambda text: None)
    folders = {block.name: out / block.name for block in read_blocks(out)}
    facts, failed = dict[str, Any](), list[str]()
    if client is None:
        for name, folder in folders.items():
            try:
                facts[name] = fit_block(folder, method, **options)
            except (ValueError, OSError) as error:
                failed.append(f"{folder}: {error}")
    else:
        for result in map_scenes(
            functools.partial(fit_block, method=method, **options), folders.values(), client=client
        ):
            if result.failure is None:
                facts[result.name] = result.value
            else:
                failed.append(f"{out / result.name}: {result.failure.message}")
    for name, found in facts.items():
        say(f"{name}: {found['gaussians']:,} Gaussians of {found['of']:,} in {found['seconds']} s")
    if failed:
        more = f" (and {len(failed) - 1} more blocks failed)" if len(failed) > 1 else ""
        raise ValueError(failed[0] + more)
    return FieldInBlocks.open(out)


def _check_same(out: Path, facts: dict[str, Any]) -> None:
    """Raise a ValueError if the folder holds other blocks."""
    if (out / BLOCKS).is_file() and read_json(out / BLOCKS) != facts:
        raise ValueError(
            f"out: expected a new folder, or one with these blocks, got {out} with others (of another scene, splat, maps, ...); "
            "choose another, or delete it"
        )


def _box(field: SemanticField) -> tuple[list[float], list[float]]:
    """The box around a field's Gaussians, spread included."""
    means, radii = _places(field.gaussians), REACH * as_array(field.gaussians.scales).max(1)[:, None]
    return (means - radii).min(0).tolist(), (means + radii).max(0).tolist()


def _places(gaussians: Gaussians) -> Any:  # [N, 3]
    """Where Gaussians are in the world, as the boxes of blocks are."""
    return as_array(to_world(gaussians.means, gaussians.origin))


def _splits(scene: Scene, block: Block) -> dict[str, list[str]]:
    """The block's views in each split."""
    own = _views_of(scene, block)
    return {name: [scene.stem(i) for i in views if i in own] for name, views in scene.splits.items()}


def _views_of(scene: Scene, block: Block) -> set[int]:
    """The scene's views in a block, whose names are those of the model."""
    place = {camera.name: i for i, camera in enumerate(scene.cameras)}
    names = Names(place)
    return {place[name] for view in block.views if (name := names.find(view)) is not None}


def _link(place: Path, target: Path) -> None:
    """A link to a file or folder, relative, so that both can move together."""
    if not place.is_symlink():
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(
            os.path.relpath(real_path(target), real_path(place.parent)), target_is_directory=target.is_dir()
        )
