"""Independent tasks in this process, in worker processes that may be killed, or on a Dask cluster."""

import asyncio
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from itertools import count
from os import _exit
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from dragrig.analysis import Progress
from dragrig.config import SettingsError, WorkerError

if TYPE_CHECKING:
    from distributed import Client


P = ParamSpec("P")
R = TypeVar("R")
TaskT = TypeVar("TaskT")
MAX_ATTEMPTS = 3
"""A task is given up once it has taken this many processes with it."""
MAX_SUBMITTED = 64
"""Tasks submitted at a time; a cluster holds the arguments of every task that is submitted."""
CLUSTER_TIMEOUT_S = 10


def map_tasks(
    function: Callable[[TaskT], R],
    tasks: Sequence[TaskT],
    workers: int | None,
    scheduler: str | None,
    progress: Progress,
) -> tuple[R, ...]:
    """Apply a function to tasks on an executor of their own; return the results in the order of the tasks."""
    with open_executor(workers, scheduler, tasks=len(tasks)) as executor:
        return tuple(parallel_map_with_progress(executor, function, tasks, progress))


def parallel_map_with_progress(
    executor: Executor, function: Callable[[TaskT], R], tasks: Sequence[TaskT], progress: Progress
) -> list[R]:
    """Do the same as `parallel_map`, and report how many tasks of how many are done."""
    done = count(1)
    progress(0, len(tasks))
    return parallel_map(executor, function, tasks, lambda _task, _result: progress(next(done), len(tasks)))


def parallel_map(
    executor: Executor,
    function: Callable[[TaskT], R],
    tasks: Iterable[TaskT],
    finished: Callable[[TaskT, R], None] | None = None,
) -> list[R]:
    """Apply a function to tasks in parallel; return the results in the order of the tasks.

    Every task runs with a single BLAS thread, so that results are identical bit for bit for any number of workers.

    Parameters
    ----------
    finished
        Called in this process with each task and its result as soon as it is there, in order of completion.

    Raises
    ------
    WorkerError
        When a task ends several processes.
    Exception
        The error of the first failing task; tasks not yet started are dropped.
    """
    waiting = deque(enumerate(tasks))
    running: dict[Future[R], tuple[int, TaskT]] = {}
    results: dict[int, R] = {}
    while waiting or running:
        while waiting and len(running) < MAX_SUBMITTED:
            number, task = waiting.popleft()
            running[executor.submit(_call_single_threaded, function, task)] = number, task
            if any(future.done() for future in running):
                break
        # No name refers to a future while the next ones are awaited: a cluster repeats what a lost worker had finished
        # for as long as something does.
        for future in sorted(wait(running, return_when=FIRST_COMPLETED).done, key=lambda future: running[future][0]):
            number, task = running.pop(future)
            results[number] = future.result()
            if finished is not None:
                finished(task, results[number])
        del future
    return [results[number] for number in range(len(results))]


def _call_single_threaded(function: Callable[[TaskT], R], task: TaskT) -> R:
    from dragrig.analysis import single_blas_thread

    with single_blas_thread():
        return function(task)


@contextmanager
def open_executor(
    workers: int | None = None, scheduler: str | None = None, *, tasks: int | None = None, own_process: bool = False
) -> Iterator[Executor]:
    """Yield an executor; when the block ends with an error, tasks not yet started are dropped.

    Parameters
    ----------
    workers
        Processes on this machine (default: as many as there are cores). A single worker is this process.
    scheduler
        Address of a Dask cluster's scheduler to use in their place.
    tasks
        Number of tasks; more processes are not started.
    own_process
        Whether even a single worker is a separate process.

    Raises
    ------
    SettingsError
        When both are named, `workers` is below 1, or the cluster cannot be used.
    """
    processes = worker_count(workers, scheduler)
    if scheduler is not None:
        with dask_executor(scheduler) as cluster:
            yield cluster
        return
    processes = processes if tasks is None else max(min(processes, tasks), 1)
    local: Executor = ProcessExecutor(processes) if processes > 1 or own_process else SerialExecutor()
    try:
        yield local
    except BaseException:
        local.shutdown(wait=True, cancel_futures=True)
        raise
    local.shutdown(wait=True)


def worker_count(workers: int | None, scheduler: str | None) -> int:
    """Return the number of processes; raises `SettingsError` below 1, or where a cluster is named too."""
    if workers is not None and scheduler is not None:
        raise SettingsError("--workers and --scheduler: are for processes here and for a cluster elsewhere; give one.")
    if workers is None:
        return available_cores()
    if workers < 1:
        raise SettingsError(f"--workers {workers}: at least one worker is needed.")
    return workers


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class SerialExecutor(Executor):
    """Runs each task in this process when it is submitted."""

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        """Run a task; return its completed future."""
        future: Future[R] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # noqa: BLE001  # a future carries whatever its task raised
            future.set_exception(error)
        return future


@dataclass(slots=True, eq=False)
class _Task:
    future: Future[Any]
    call: Callable[[], object]
    attempts_left: int = MAX_ATTEMPTS
    started: bool = False


class ProcessExecutor(Executor):
    """Worker processes, any of which may be killed without a task being lost or done twice.

    A pool whose process dies is broken for good, with all that it holds. Each process here has its own pool, which
    holds one task at a time, so that a death costs one attempt at one task, which is then started again in a fresh
    process. Processes start when there is work for them, by `spawn` on every system.
    """

    def __init__(self, workers: int) -> None:
        self._idle = [_new_worker() for _ in range(workers)]
        self._dead: list[ProcessPoolExecutor] = []
        self._workers = workers
        self._waiting: deque[_Task] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._abandoned = False

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        """Submit a task, which must pickle; its future raises `WorkerError` after three dead processes."""
        future: Future[R] = Future()
        with self._changed:
            if self._closed:
                raise RuntimeError("cannot schedule new futures after shutdown")
            self._waiting.append(_Task(future, partial(fn, *args, **kwargs)))
        self._start_waiting()
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for submitted tasks, whatever `wait` is, and end the processes; tasks not started may be cancelled."""
        del wait
        with self._changed:
            self._closed = True
            dropped = []
            if cancel_futures:
                self._abandoned = True
                dropped = [task for task in self._waiting if not task.started]
                self._waiting.clear()
        for task in dropped:
            task.future.cancel()
        with self._changed:
            self._changed.wait_for(lambda: len(self._idle) == self._workers and not self._waiting)
        for worker in (*self._idle, *self._dead):
            worker.shutdown()

    def _start_waiting(self) -> None:
        """Hand waiting tasks to idle processes."""
        with self._changed:
            while self._idle and self._waiting:
                task = self._waiting.popleft()
                if not task.started and not task.future.set_running_or_notify_cancel():
                    continue
                task.started = True
                worker = self._idle.pop()
                try:
                    inner = worker.submit(task.call)
                except BrokenProcessPool:  # its process died while it was idle
                    self._dead.append(worker)
                    worker = _new_worker()
                    inner = worker.submit(task.call)
                inner.add_done_callback(partial(self._ended, task, worker))

    def _ended(self, task: _Task, worker: ProcessPoolExecutor, inner: Future[object]) -> None:
        error = inner.exception()
        died = isinstance(error, BrokenProcessPool)
        with self._changed:
            if died:
                # From Python 3.12 on a broken pool calls this with its lock held: shutting it down here, or dropping
                # the last reference to it, would wait for that lock for ever.
                self._dead.append(worker)
                worker = _new_worker()
                task.attempts_left -= 1
            retry = died and task.attempts_left > 0 and not self._abandoned
            if retry:
                self._waiting.appendleft(task)
        if died and not retry:
            error = WorkerError(
                f"a process ended {MAX_ATTEMPTS - task.attempts_left} times while it worked on the same task: check "
                "that there is memory for it, take fewer workers, and in a script of your own call this below "
                "`if __name__ == '__main__':`."
            )
        if error is None:
            task.future.set_result(inner.result())
        elif not retry:
            task.future.set_exception(error)
        with self._changed:
            self._idle.append(worker)
        self._start_waiting()
        with self._changed:
            self._changed.notify_all()


def _new_worker() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"), initializer=_init_worker)


def _init_worker() -> None:
    """Let the process end at once when it is interrupted, or when its parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        _exit(1)


class _ClusterExecutor(Executor):
    """Submits tasks to a Dask cluster; whatever is not done when its client closes is dropped.

    The executor of `Client.get_executor` reads the status of a task once its result is there, and fails where the
    worker that made it was lost in between.
    """

    def __init__(self, client: "Client") -> None:
        self._client = client

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        """Submit a task, which must pickle."""
        task = self._client.submit(fn, *args, pure=False, **kwargs)
        loop: asyncio.AbstractEventLoop = self._client.loop.asyncio_loop  # type: ignore[union-attr]
        return asyncio.run_coroutine_threadsafe(_result_of(task), loop)


async def _result_of(task: Awaitable[R]) -> R:
    return await task


@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """Yield the executor of the cluster whose scheduler is at an address, such as `tcp://127.0.0.1:8786`.

    The scheduler hands the tasks of a worker that dies to other workers.

    Raises
    ------
    SettingsError
        When Dask is not installed, no scheduler answers, or its workers have no dragrig of this version.
    WorkerError
        When a task ends several workers, or the cluster goes away.
    """
    try:
        from distributed import Client, KilledWorker
        from distributed.comm.core import CommClosedError
    except ImportError as error:
        raise SettingsError(
            f"--scheduler {address}: Dask is not installed here; install dragrig[dask], or leave --scheduler out."
        ) from error
    try:
        client = Client(address, timeout=CLUSTER_TIMEOUT_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TypeError) as error:
        raise SettingsError(
            f"--scheduler {address}: no Dask scheduler answers there; start one with `dask scheduler`, and workers "
            "with `dask worker ADDRESS --nthreads 1`."
        ) from error
    with client:
        _require_same_version(client, address)
        try:
            yield _ClusterExecutor(client)
        except KilledWorker as error:
            raise WorkerError(
                f"--scheduler {address}: {error.allowed_failures + 1} workers ended while they worked on the same "
                "task; check that there is memory for it."
            ) from error
        except (CancelledError, CommClosedError) as error:
            raise WorkerError(
                f"--scheduler {address}: the cluster went away; what is done is saved, so repeat the command once it "
                "is back."
            ) from error


def dragrig_version() -> str:
    """Return the version of dragrig where this is called."""
    return metadata.version("dragrig")


def _require_same_version(client: "Client", address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=CLUSTER_TIMEOUT_S)
    except TimeoutError as error:
        raise SettingsError(
            f"--scheduler {address}: it has no workers; start some with `dask worker {address} --nthreads 1`."
        ) from error
    local, versions = dragrig_version(), client.run(dragrig_version, on_error="return")
    for worker, version in versions.items():
        if version != local:
            problem = f"has dragrig {version}" if isinstance(version, str) else f"cannot load dragrig ({version})"
            raise SettingsError(
                f"--scheduler {address}: the worker at {worker} {problem}, and here is {local}; install the same there."
            )
