"""The commands blocks (cut and fit a large scene) and join (blocks as one field)."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import tyro

from .._files import check_output, real_path
from .options import FieldMethod, Given, Maps, Positional, SceneFolder, Training, fit_method
from .output import say, wrote

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.

Latents = Annotated[int | Path, tyro.conf.arg(metavar="NUMBER|FILE")]


def blocks(
    scene: SceneFolder,
    out: Path,
    count: int,
    *,
    splat: Given[Path] = None,
    latents: Latents = 32,
    workers: Given[int] = None,
    maps: Maps,
    training: Training,
) -> None:
    """Make the field of a scene that is too large for one `kfgs fit`: cut it into blocks, and fit one after the other.

    A fit then needs the memory of one block. The scene needs a COLMAP model, and feature maps (`kfgs features`). Each block
    becomes a scene folder of its own (OUT/block00, ...) with its field in core/. `kfgs join`
    makes one field of all of them, or of a part, for all other commands.

    Examples:
        kfgs blocks town/ --out city/ --count 16
        kfgs blocks town/ --out city/ --count 16 --splat town.ply
        kfgs blocks harbour/ --out city2/ --count 8 --latents city/latents.safetensors

    Args:
        out: Folder that receives the blocks. The same command again continues where it stopped.
        count: Number of blocks. With fewer than about 300 views in each, a block fits into the memory of most machines.
        splat: Gaussians of the whole scene, a splat file; without it each block trains its own.
        latents: Numbers per Gaussian, the same in all blocks. Or a file of such latents that another city has
            (latents.safetensors): then both cities can be joined.
        workers: Number of blocks that are fitted at once, in processes of this machine (Dask); one when not given.
    """
    from ..scale import fit_blocks, open_client, split_scene
    from ..scale.in_blocks import in_numbers

    check_output("out", out, "a folder")
    method = fit_method(FieldMethod(), training=training)
    options = {
        "seed": training.seed,
        "device": training.device,
        "undistorted_features": maps.undistorted_features,
    }
    with nullcontext() if workers is None else open_client(workers=workers) as client:  # a wrong number is said at once
        split_scene(scene, out, count, features=maps.folder(scene), splat=splat, latents=latents, report=say)
        done = fit_blocks(out, method, **options, client=client, report=say)
    say(f"{len(done):,} Gaussians in {len(done.blocks)} blocks; all lie in the box {in_numbers(done.extent)}")
    say(f"next: kfgs join {out} --out field, or with --box a part of it")
    wrote([out / "blocks.json", *(out / block.name / "core" for block in done.blocks)])


def join(
    city: Positional[Path], out: Path, *, box: Annotated[Given[str], tyro.conf.arg(metavar="NUMBERS")] = None
) -> None:
    """Write the blocks of a scene as one field, or the Gaussians in a box of it. All commands take the result as a field.

    Examples:
        kfgs join city/ --out field/
        kfgs join city/ --out street/ --box=-5,0,-2,40,10,8

    Args:
        city: The folder that `kfgs blocks` made.
        out: File of the field to write (*.kfgs), outside of CITY.
        box: Six numbers: x, y, z of the low corner, then of the high one, in the scene's units; inf and -inf: no limit. Only
            blocks that touch the box are read. `kfgs blocks` prints the box around all.
    """
    from ..fields.store import check_place
    from ..scale import FieldInBlocks

    corners = _corners(box)
    check_output("out", out, "a file")
    found = FieldInBlocks.open(city)
    if real_path(out).is_relative_to(real_path(city)):
        raise ValueError(f"out: expected a place outside {city}, which is read, got {out}; give another")
    check_place(out)
    try:
        field = found.joined() if corners is None else found.within(corners[:3], corners[3:])
    except ValueError as error:
        raise ValueError(str(error).replace("low, high: ", "box: ", 1)) from error
    field.save(out)
    say(field.summary())
    say(f"next: kfgs view {out}")
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
    if len(numbers) != 6:
        raise ValueError(f"box: expected six numbers, low corner and high corner, as in -5,0,-2,40,10,8, got {box!r}")
    return numbers
