"""Start or find workers by Dask: processes of this machine, a running scheduler, or jobs of Slurm."""

from __future__ import annotations

import logging
import os
import shutil
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from .._check import check_whole

START = "60s"  # to wait for a scheduler
WALLTIME = "24:00:00"  # of a Slurm job; a batch goes on after it ended


def check_workers(scheduler: str | None, workers: int | None, slurm: str | None, threads: int) -> None:
    """Check options of `open_client`, which starts nothing before.

    Raises:
        ValueError: if both a scheduler and workers or Slurm are given, or a number is less than 1.
    """
    if workers is not None:
        check_whole("workers", workers, 1)
    check_whole("threads", threads, 1)
    if scheduler is not None and (workers is not None or slurm is not None):
        raise ValueError(
            "scheduler: expected none with workers or slurm, which start their own, got both; leave one out"
        )


@contextmanager
def open_client(
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    slurm: str | None = None,
    threads: int = 1,
    memory: str = "16GB",
) -> Iterator[Any]:
    """A `dask.distributed.Client` whose workers run one task at a time; what was started is ended again.

    Args:
        scheduler: the address of a running Dask scheduler, `tcp://host:8786`. Its workers should have one thread each
            (`dask worker --nthreads 1`).
        workers: processes to start on this machine (by default one for each `threads` processors), or jobs of Slurm
            (by default 1).
        slurm: a partition: each worker is a job of dask-jobqueue, and is submitted again if it ends early. Other options of
            the jobs are read from dask-jobqueue's configuration (`~/.config/dask/jobqueue.yaml`).
        threads: processors of each worker.
        memory: of each Slurm job. Workers of this machine have no limit.

    Raises:
        ImportError: if Dask, or for Slurm dask-jobqueue, is missing.
        ValueError: see `check_workers`.
        OSError: if the scheduler does not answer, or there is no Slurm.
    """
    check_workers(scheduler, workers, slurm, threads)
    try:
        import dask
        from dask.utils import parse_bytes
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise ImportError(f"batch: expected Dask, got {error}; pip install 'kfgs[scale]'") from error
    try:
        parse_bytes(memory)
    except ValueError as error:
        raise ValueError(f"memory: expected a size such as 16GB, got {memory!r}; write it so") from error
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=START, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise OSError(
                f"scheduler: expected one that answers at {scheduler}, got {error}; start `dask scheduler`"
            ) from error
        with client:
            yield client
        return
    once = {"allowed_failures": 0}  # the driver submits again what dies
    # Dask sets these for its workers in this process, too, whose other children then count with one thread: other last bits
    names = ("PYTHONHASHSEED", *dask.config.get("distributed.nanny.pre-spawn-environ"))
    before = {name: os.environ.get(name) for name in names}
    if slurm is not None:
        cluster: Any = _slurm(slurm, threads, memory, once)
        cluster.adapt(minimum=workers or 1, maximum=workers or 1)  # also replaces jobs that ended
    else:
        count = workers or max(1, (os.cpu_count() or 1) // threads)
        cluster = LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            memory_limit=0,
            dashboard_address="127.0.0.1:0",
            scheduler_kwargs=once,
            silence_logs=logging.CRITICAL,
            preload=[__name__],  # each worker calls dask_setup
        )
    try:
        with cluster, Client(cluster, set_as_default=False) as client:
            yield client
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})


def dask_setup(_: Any) -> None:
    """Called in each worker of this machine: Ctrl-C ends the driver, which ends its workers.

    In a terminal, it reaches all processes, and workers would print tracebacks. pycolmap is imported here, in the main thread:
    only there can the import undo that its log library prints a stack at SIGTERM. tqdm's own lock is a semaphore of the system,
    which a killed worker leaves behind: Python then warns in the driver.
    """
    from tqdm import tqdm

    from ..scenes.pycolmap_import import import_pycolmap

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    tqdm.set_lock(threading.RLock())
    with suppress(ImportError):
        import_pycolmap()


def _slurm(partition: str, threads: int, memory: str, scheduler: dict[str, Any]) -> Any:
    before = signal.getsignal(signal.SIGINT)
    try:
        from dask_jobqueue import SLURMCluster
    except ImportError as error:
        raise ImportError(f"slurm: expected dask-jobqueue, got {error}; pip install 'kfgs[scale]'") from error
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, before)  # the package replaces it: Ctrl-C would be an exit with code 0
    if shutil.which("sbatch") is None:
        raise OSError("slurm: expected Slurm's sbatch on this machine, got none; start it where jobs are submitted")
    return SLURMCluster(
        queue=partition,
        cores=1,  # Dask's threads: one task at a time
        job_cpu=threads,
        processes=1,
        memory=memory,
        walltime=WALLTIME,
        scheduler_options={"dashboard_address": ":0", **scheduler},
    )
