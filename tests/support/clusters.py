"""Dask clusters over loopback, and workers of theirs that are killed at work."""

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from ending import kill
from places import SUPPORT

POLL_INTERVAL_S = 0.05
PATIENCE_S = 600


@contextmanager
def dask_cluster(workers: int = 2) -> Iterator[str]:
    """Yield the address of a scheduler over loopback; its workers are processes that nobody starts again."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(SUPPORT),
        "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    }
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment}
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        port_file = Path(folder) / "scheduler.json"
        dask = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
        alone = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(port_file)]
        started = [subprocess.Popen([*dask, *alone], **quiet)]  # type: ignore[call-overload]
        try:
            worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(port_file)]
            few = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1"]
            local = ["--local-directory", folder]
            commands = [[*worker, *few, *local]] * workers
            started += [subprocess.Popen(command, **quiet) for command in commands]  # type: ignore[call-overload]
            yield _address_in(port_file)
        finally:
            for process in reversed(started):
                process.kill()
                process.wait()


def _address_in(port_file: Path) -> str:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        if port_file.exists() and (text := port_file.read_text("utf-8")):
            return str(json.loads(text)["address"])
        time.sleep(0.02)
    raise AssertionError("the scheduler did not start")


def wait_for_workers(address: str, workers: int) -> None:
    """Wait until a cluster has so many."""
    from distributed import Client

    with Client(address, timeout=PATIENCE_S, set_as_default=False) as client:  # type: ignore[no-untyped-call]
        client.wait_for_workers(workers, timeout=PATIENCE_S)


@contextmanager
def tasks_finished(address: str) -> Iterator[list[str]]:
    """Yield a list that holds the key of each task that a cluster finished meanwhile, once that is over."""
    from distributed import Client, get_task_stream

    keys: list[str] = []
    with Client(address, timeout=PATIENCE_S, set_as_default=False) as client:  # type: ignore[no-untyped-call]
        with get_task_stream(client) as stream:
            yield keys
        keys += [str(row["key"]) for row in stream.data]


@dataclass(slots=True)
class Watched:
    """What a cluster was seen to do.

    Attributes
    ----------
    killed
        Address of the worker that was killed, empty when none was.
    kept
        How many results had been kept by then.
    finished
        The key of each piece as often as it was finished, once the watch is over.
    """

    killed: str = ""
    kept: int = 0
    finished: list[str] = field(default_factory=list)


@contextmanager
def worker_killed_at_its_second(
    function: Callable[..., object], address: str, stored: Callable[[], int]
) -> Iterator[Watched]:
    """Watch a cluster, and kill the first worker that is seen in a function for the second time.

    The workers' own stacks say who is in it. The worker is killed once it holds no result that was not fetched and a
    result was kept, so that nothing that was finished may be done again.

    Parameters
    ----------
    stored
        Returns how many results of the function have been stored.
    """
    from distributed import Client, get_task_stream

    watched, over = Watched(), threading.Event()

    with Client(address, timeout=PATIENCE_S, set_as_default=False) as client:  # type: ignore[no-untyped-call]
        pids = client.run(os.getpid)

        def wait_and_kill() -> None:
            seen: dict[str, set[str]] = {worker: set() for worker in pids}
            deadline = time.monotonic() + PATIENCE_S
            while time.monotonic() < deadline and not over.wait(POLL_INTERVAL_S):
                now = {
                    worker: key
                    for worker, stacks in client.call_stack().items()
                    for key, frames in stacks.items()
                    if any(f", in {function.__name__}\n" in frame for frame in frames)
                }
                for worker, key in now.items():
                    seen[worker].add(key)
                finished = set().union(*seen.values()) - set(now.values())
                at = next((worker for worker in now if len(seen[worker]) == 2), "")
                if at and stored() >= len(finished) and not client.has_what([at])[at]:
                    watched.killed, watched.kept = at, stored()
                    kill(pids[at])
                    return

        with get_task_stream(client) as stream:  # type: ignore[no-untyped-call]
            killer = threading.Thread(target=wait_and_kill)
            killer.start()
            try:
                yield watched
            finally:
                over.set()
                killer.join()
        watched.finished = [str(row["key"]) for row in stream.data]
