"""The command batch: many scenes through all steps, or one large scene in blocks."""

from __future__ import annotations

import os
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import tyro

from .options import Given, Name, Positional
from .output import say, wrote

# Heavy imports happen inside the command, so that `kfgs --help` answers at once.

Workers = Annotated[str | None, tyro.conf.arg(metavar="NUMBER|ADDRESS", help_behavior_hint="")]


def batch(
    scenes: Positional[Path],
    out: Path,
    *,
    teacher: Name = None,
    weights: Name = None,
    text: Given[Path] = None,
    workers: Workers = None,
    blocks: Given[int] = None,
    splat: Given[Path] = None,
) -> None:
    """Take many scenes through sfm, features, fit, segment and evaluate; or, with --blocks, one scene that is too large.

    SCENES is a text file with a scene in each line: a folder with a COLMAP model or a transforms.json, or a folder of photos
    whose cameras are found first. `name = scene` gives a run another name than its folder. Running again repeats nothing
    that is finished, and tries failed scenes again. With --blocks, SCENES is the folder of one scene with a COLMAP model
    and feature maps: it is cut into blocks, and their fields are joined. --workers needs pip install 'kfgs[batch]'.

    Examples:
        kfgs batch scenes.txt --out runs/ --teacher lseg --weights demo_e200.ckpt --workers 2
        kfgs batch scenes.txt --out /shared/runs --workers slurm:gpu:16
        kfgs batch town/ --out city/ --blocks 16 --splat town.ply

    Args:
        scenes: The list of scenes (relative folders begin at that of the list), or with --blocks the scene.
        out: Folder of the runs: OUT/NAME receives field, segmented views, scores.json, state.json and log.txt. Of blocks:
            OUT/field.kfgs is the joined field.
        teacher: Network that makes the feature maps; without it each scene has its maps in features/.
        weights: Its weights, a file or folder that all workers can read.
        text: Text table of `kfgs features --words` for all scenes; each scene's classes.json and text.* when not given.
        workers: Processes on this machine, or a Dask scheduler (tcp://HOST:8786), or slurm:PARTITION:NUMBER. One scene after
            the other in this process when not given.
        blocks: Cut the scene SCENES into this many blocks. With fewer than about 300 views in each, a block fits into the
            memory of most machines.
        splat: With --blocks: Gaussians of the whole scene, a splat file; without it each block trains its own.
    """
    from ..batch import BatchOptions, fit_blocks, join_blocks, open_client, read_scenes, run_batch
    from ..teachers.load import check_teacher_name

    if blocks is not None:
        if teacher is not None or weights is not None or text is not None:
            raise ValueError(
                "blocks: expected a scene with features/, got --teacher, --weights or --text; leave these out"
            )
        with nullcontext() if workers is None else open_client(workers) as client:
            fit_blocks(scenes, out, blocks, splat=splat, client=client, report=say)
        field = join_blocks(out)
        field.save(out / "field.kfgs")
        say(field.summary())
        wrote([out / "field.kfgs"])
        return
    entries = read_scenes(scenes)
    if weights is not None and teacher is None:
        raise ValueError("weights: expected none without --teacher, whose weights they are; name the teacher")
    if teacher is not None:
        check_teacher_name(teacher)
    local = int(workers) if workers is not None and workers.isdecimal() else 0
    threads = max(1, (os.cpu_count() or 1) // local) if local else 1
    words = None if text is None else str(text)
    options = BatchOptions(teacher=teacher, weights=weights, text=words, threads=threads)
    with nullcontext() if workers is None else open_client(workers) as client:
        results = run_batch(entries, out, options, client=client, report=say)
    failed = [result.name for result in results if result.failure is not None]
    say(f"{len(results) - len(failed)} of {len(results)} scenes are finished; kfgs convert {out} has a line for each")
    if failed:
        some = ", ".join(failed[:3]) + (", ..." if len(failed) > 3 else "")
        raise ValueError(
            f"scenes: expected all {len(results)} to succeed, but {len(failed)} failed ({some}); see log.txt in their folders "
            f"of {out}, correct the cause, and give the same command again"
        )
