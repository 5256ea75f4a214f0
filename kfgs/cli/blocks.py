"""The commands blocks (cut and fit a large scene) and join (blocks as one field)."""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import tyro

from .._files import check_output, real_path
from .files import inputs_of
from .options import FieldMethod, Given, Maps, Positional, SceneFolder, Training, fit_config
from .output import say, wrote

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.


def blocks(
    scene: SceneFolder,
    out: Path,
    count: int,
    *,
    splat: Given[Path] = None,
    latents: int = 32,
    workers: Given[int] = None,
    maps: Maps,
    training: Training,
) -> None:
    """Make the field of a large scene in blocks, one after the other, so that memory does not grow with the scene.

    Each block is a scene folder of its own (OUT/block00, ...), which any machine can fit.

    Examples:
        kfgs blocks town/ --out city/ --count 16
        kfgs blocks town/ --out city/ --count 16 --splat town.ply

    Args:
        out: Receives the blocks. Running again continues where it stopped.
        count: Number of blocks.
        splat: Gaussians of the whole scene; without it each block trains its own.
        latents: Numbers per Gaussian, the same in all blocks.
        workers: Fit so many blocks at once, in processes of this machine (Dask).
    """
    from ..scale import fit_blocks, open_client, split_scene

    check_output("out", out, "a folder", apart=inputs_of(scene), other=[maps.features])
    config = fit_config(
        FieldMethod(),
        seed=training.seed,
        steps=training.steps,
        max_gaussians=training.max_gaussians,
        views_per_step=training.views_per_step,
    )
    config = dataclasses.replace(config, undistorted_features=maps.undistorted_features, device=training.device)
    split_scene(scene, out, count, features=maps.folder(scene), splat=splat, latents=latents, report=say)
    with nullcontext() if workers is None else open_client(workers=workers) as client:
        done = fit_blocks(out, config, client=client, report=say)
    say(f"{len(done):,} Gaussians in {len(done.blocks)} blocks")
    say(f"next: kfgs join {out} --out field")
    wrote([out / "blocks.json", *(out / block.name / "core" for block in done.blocks)])


def join(
    city: Positional[Path], out: Path, *, box: Annotated[Given[str], tyro.conf.arg(metavar="NUMBERS")] = None
) -> None:
    """Write the blocks of a scene, or those in a box, as one field.

    Examples:
        kfgs join city/ --out field/
        kfgs join city/ --out street/ --box 0,0,-2,40,10,8

    Args:
        city: What `kfgs blocks` made.
        out: The field folder to write.
        box: x, y, z of the low corner, then of the high one, world units; only blocks that touch it are read.
    """
    from ..fields.store import check_place
    from ..scale import FieldInBlocks

    corners = _corners(box)
    check_output("out", out, "a folder")
    found = FieldInBlocks.open(city)
    if real_path(out).is_relative_to(real_path(city)):
        raise ValueError(f"out: expected a place outside {city}, which is read, got {out}; give another")
    check_place(out)
    field = found.joined() if corners is None else found.within(corners[:3], corners[3:])
    field.save(out)
    say(field.summary())
    wrote([out])


def _corners(box: str | None) -> list[float] | None:
    """The numbers of --box."""
    if box is None:
        return None
    words = box.replace(",", " ").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != 6 or not all(low <= high for low, high in zip(numbers[:3], numbers[3:], strict=True)):
        raise ValueError(f"box: expected six numbers, low corner and high corner, as in 0,0,-2,40,10,8, got {box!r}")
    return numbers
