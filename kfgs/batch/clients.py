"""Start or find the workers of a batch by Dask: processes of this machine, a running scheduler, or jobs of Slurm."""

from __future__ import annotations

import logging
import os
import shutil
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm


@contextmanager
def open_client(workers: int | str = 1) -> Iterator[Any]:
    """A `distributed.Client` whose workers run one task at a time; what was started is ended again.

    Args:
        workers: how many processes to start on this machine; or the address of a running Dask scheduler,
            `tcp://host:8786`, whose workers have one thread each (`dask worker --nthreads 1`); or `slurm:PARTITION:N`: N jobs
            of dask-jobqueue, which are submitted again if they end early. Memory, time and other options of the jobs are
            read from its configuration (`~/.config/dask/jobqueue.yaml`).

    Raises:
        ImportError: if Dask, or for Slurm dask-jobqueue, is missing.
        ValueError: if `workers` is something else.
        OSError: if the scheduler does not answer, or there is no Slurm.
    """
    address = str(workers)
    partition, _, jobs = address.removeprefix("slurm:").partition(":")
    number = jobs if address.startswith("slurm:") else address
    if "://" not in address and not (number.isdecimal() and int(number) > 0):
        raise ValueError(f"workers: expected a number, tcp://HOST:8786 or slurm:PARTITION:NUMBER, got {address!r}")
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise ImportError(f"workers: expected Dask, got {error}; pip install 'kfgs[batch]'") from error
    if "://" in address:
        try:
            client = Client(address, timeout="60s", set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            got = f"{error}; start `dask scheduler` there"
            raise OSError(f"workers: expected a scheduler that answers at {address}, got {got}") from error
        with client:
            yield client
        return
    # Dask sets these for its workers in this process too, whose other children would then count with one thread
    names = ("PYTHONHASHSEED", *dask.config.get("distributed.nanny.pre-spawn-environ"))
    before = {name: os.environ.get(name) for name in names}
    if address.startswith("slurm:"):
        before_import = signal.getsignal(signal.SIGINT)
        from dask_jobqueue import SLURMCluster

        signal.signal(signal.SIGINT, before_import)  # else Ctrl-C would end the process with code 0
        if shutil.which("sbatch") is None:
            raise OSError(
                "workers: expected Slurm's sbatch on this machine, got none; start it where jobs are submitted"
            )
        cluster: Any = SLURMCluster(queue=partition, cores=1, processes=1)
        cluster.adapt(minimum=int(number), maximum=int(number))  # also replaces jobs that ended
    else:
        cluster = LocalCluster(
            n_workers=int(number),
            threads_per_worker=1,
            memory_limit=0,
            dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
            preload=[__name__],  # each worker calls dask_setup
        )
    patience = {"distributed.deploy.lost-worker-timeout": "10 minutes"}  # a new worker imports for longer than 15 s
    try:
        with dask.config.set(patience), cluster, Client(cluster, set_as_default=False) as client:
            yield client
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})


def dask_setup(_: Any) -> None:
    """Called in each worker of this machine. Ctrl-C in a terminal reaches all processes: the driver alone acts on it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    tqdm.set_lock(threading.RLock())  # its own is a semaphore of the system, which a killed worker would leave behind
