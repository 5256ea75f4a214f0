"""The command batch: many scenes through all stages, on the processes of this machine or a cluster."""

from __future__ import annotations

import dataclasses
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from .features import teacher_options
from .files import check_alone
from .options import FieldMethod, Flag, Given, MapTeacher, Name, Positional, Training, fit_method
from .output import say

# Heavy imports happen inside the command, so that `kfgs --help` answers at once.


@dataclass(frozen=True)
class Workers:
    """Where the work is done: processes of this machine, if nothing else is said."""

    scheduler: Name = None
    """Address of a running Dask scheduler, tcp://HOST:8786. Its workers need --nthreads 1, kfgs, and the same paths."""
    workers: Given[int] = None
    """Processes on this machine (by default one for each --threads processors), or jobs of Slurm (by default 1)."""
    slurm: Annotated[str | None, tyro.conf.arg(metavar="PARTITION", help_behavior_hint="")] = None
    """Start the workers as Slurm jobs in this partition (dask-jobqueue)."""
    memory: str = "16GB"
    """Of each Slurm job."""
    threads: int = 1
    """Threads of each worker. Results are equal bit for bit for equal numbers of threads."""


def batch(
    scenes: Positional[Path],
    out: str,
    *,
    retry_failed: Flag = False,
    text: Given[Path] = None,
    share: int = 8,
    pictures: int = 4,
    discard_features: Flag = False,
    workers: Workers,
    teacher: MapTeacher,
    method: FieldMethod,
    training: Training,
) -> None:
    """Take many scenes through sfm, features, fit, segment and evaluate, on many machines.

    SCENES is a text file with a scene in each line: a folder with a COLMAP model or a transforms.json, a folder of photos whose
    cameras are found first, or a URL (s3://bucket/scene). `name = scene` gives a run another name than its folder. Running
    again repeats nothing that is done. Needs pip install 'kfgs[scale]'. The project's docs/scale has files for clusters.

    Examples:
        kfgs batch scenes.txt --out runs/ --teacher lseg --weights demo_e200.ckpt --workers 2
        kfgs batch scenes.txt --out s3://bucket/runs --scheduler tcp://10.0.0.5:8786 --retry-failed

    Args:
        scenes: The list of scenes; relative folders begin at that of the list.
        out: Folder or URL of the runs; OUT/NAME receives field, segmented views, scores.json, state.json and log.txt.
        retry_failed: Also try scenes again that failed before.
        text: Text table of `kfgs text` for all scenes; each scene's classes.json and text.* when not given.
        share: Pictures that a worker encodes in one task.
        pictures: How many views of a scene get a sheet, an overlay and a picture of features.
        discard_features: Delete a scene's feature maps when its field is made.
    """
    from ..scale import BatchOptions, open_client, read_scenes, run_batch
    from ..scale.batch import check_runs
    from ..scale.clients import check_workers
    from ..teachers.load import check_teacher_name

    check_workers(workers.scheduler, workers.workers, workers.slurm, workers.threads)
    entries = read_scenes(scenes)
    given: dict[str, Any] = {}
    if teacher.teacher is None:
        teacher.check_weights()
        for name, value in (
            ("size", teacher.size or None),
            ("fast", teacher.fast),
            ("discard_features", discard_features),
        ):
            check_alone(name, value, "without --teacher, whose option it is")
    else:
        check_teacher_name(teacher.teacher)
        given = teacher_options(teacher.teacher, teacher.fast, teacher.size)
    options = BatchOptions(
        teacher=teacher.teacher,
        weights=teacher.weights,
        teacher_options=given,
        method=fit_method(method, training=training),
        seed=training.seed,
        device=training.device,
        text=None if text is None else str(text),
        share=share,
        pictures=pictures,
        threads=workers.threads,
        discard_features=discard_features,
    )
    folder, screen = check_runs(entries, out), _Screen()
    with open_client(**dataclasses.asdict(workers)) as client:
        say(
            f"{len(entries)} scene{'s' if len(entries) != 1 else ''}; workers: {client.cluster or client.scheduler.address}"
        )
        if folder is None:
            say(
                f"note: {out} has no lock: start no other batch with this --out before this one ends; scenes might fail"
            )
        results = run_batch(
            entries,
            out,
            options,
            client=client,
            retry_failed=retry_failed,
            report=screen.show,
            at_once=lambda: 2 * len(client.nthreads()) + 2,  # enough to keep workers busy; more would need more disk
        )
    screen.end()
    failed = [one.name for one in results if one.failure is not None]
    if failed:
        some = ", ".join(failed[:3]) + (", ..." if len(failed) > 3 else "")
        raise ValueError(
            f"scenes: expected all {len(results)} to succeed, but {len(failed)} failed ({some}); see log.txt in their folders "
            f"of {out}, mend the cause, and pass --retry-failed"
        )


class _Screen:
    """The table of all scenes: drawn again at each event on a terminal, else a line for each finished stage."""

    def __init__(self) -> None:
        self.terminal = sys.stdout.isatty()
        self.drawn = 0
        self.rows: Any = ()

    def show(self, event: Any, rows: Any) -> None:
        """Show what happened."""
        from ..scale.board import event_line, table

        self.rows = rows
        if not self.terminal:
            line = event_line(event, rows)
            if line is not None:
                say(line)
            return
        size = shutil.get_terminal_size()
        lines = [line[: size.columns - 1] for line in table(rows, max(size.lines // 2 - 2, 1)).split("\n")]
        self._clear()
        say("\n".join(lines))
        self.drawn = len(lines)

    def end(self) -> None:
        """The whole table."""
        from ..scale.board import table

        self._clear()
        if self.rows:
            say(table(self.rows))

    def _clear(self) -> None:
        if self.drawn:
            sys.stdout.write(f"\x1b[{self.drawn}F\x1b[J")
