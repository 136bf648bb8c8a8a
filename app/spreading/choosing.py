"""From what was asked for to an executor."""

import os
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from dragrig.config.errors import SettingsError
from dragrig.spreading.cluster import cluster
from dragrig.spreading.processes import Processes
from dragrig.spreading.serial import Serial


def cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def executor(
    workers: int | None = None, scheduler: str | None = None, *, most: int | None = None, apart: bool = False
) -> Iterator[Executor]:
    """Yield what pieces of work are handed to; when it is left by an error, what has not begun is dropped.

    Parameters
    ----------
    workers
        Processes of this machine; as many as there are cores unless given. One is this process.
    scheduler
        Address of a Dask cluster's scheduler, which does the work in their place.
    most
        So many pieces there are; more processes would have nothing to do.
    apart
        Whether even one worker is to be a process of its own.

    Raises
    ------
    SettingsError
        When both are given, there is to be less than one worker, or the cluster cannot be used.
    """
    processes = require_workers(workers, scheduler)
    if scheduler is not None:
        with cluster(scheduler) as found:
            yield found
        return
    processes = processes if most is None else max(min(processes, most), 1)
    here: Executor = Processes(processes) if processes > 1 or apart else Serial()
    try:
        yield here
    except BaseException:
        here.shutdown(wait=True, cancel_futures=True)
        raise
    here.shutdown(wait=True)


def require_workers(workers: int | None, scheduler: str | None) -> int:
    """Return how many processes are meant; raises `SettingsError` for none, or for a cluster beside them."""
    if workers is not None and scheduler is not None:
        raise SettingsError("--workers and --scheduler: are for processes here and for a cluster elsewhere; give one.")
    if workers is None:
        return cores()
    if workers < 1:
        raise SettingsError(f"--workers {workers}: it takes one worker at least.")
    return workers
