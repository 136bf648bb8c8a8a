"""Independent tasks in this process, in worker processes that may be killed, or on a Dask cluster."""

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from itertools import count
from multiprocessing import get_context, parent_process
from os import _exit
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from dragrig.analysis.computation import Progress
from dragrig.config.errors import SettingsError, WorkerError

if TYPE_CHECKING:
    from distributed import Client


P = ParamSpec("P")
R = TypeVar("R")


class SerialExecutor(Executor):
    """An executor that does each piece when it is handed in."""

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        """Do a piece; return it done."""
        future: Future[R] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # noqa: BLE001  # a future carries whatever its piece raised
            future.set_exception(error)
        return future


MAX_ATTEMPTS = 3
"""So many processes a piece may take with it before it is given up."""


@dataclass(slots=True, eq=False)
class _Task:
    future: Future[Any]
    call: Callable[[], object]
    lives: int = MAX_ATTEMPTS
    begun: bool = False


class ProcessExecutor(Executor):
    """An executor of processes, each with a pool of its own.

    A pool whose process dies is broken for good, with all that it holds. Each process here has its own pool, which
    holds one piece at a time, so that a death costs one attempt at one piece: it is begun again in a fresh process.
    Processes are started when there is work for them, by `spawn` on every system.
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
        """Hand in a piece, which must pickle.

        The future raises `WorkerError` where the piece takes three processes with it.
        """
        future: Future[R] = Future()
        with self._changed:
            if self._closed:
                raise RuntimeError("cannot schedule new futures after shutdown")
            self._waiting.append(_Task(future, partial(fn, *args, **kwargs)))
        self._deal()
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for the work that was handed in, `wait` or not, and end the processes.

        What has not begun may be cancelled in place of being waited for.
        """
        del wait
        with self._changed:
            self._closed = True
            dropped = []
            if cancel_futures:
                self._abandoned = True
                dropped = [one for one in self._waiting if not one.begun]
                self._waiting.clear()
        for one in dropped:
            one.future.cancel()
        with self._changed:
            self._changed.wait_for(lambda: len(self._idle) == self._workers and not self._waiting)
        for lane in (*self._idle, *self._dead):
            lane.shutdown()

    def _deal(self) -> None:
        """Give waiting pieces to idle processes."""
        with self._changed:
            while self._idle and self._waiting:
                piece = self._waiting.popleft()
                if not piece.begun and not piece.future.set_running_or_notify_cancel():
                    continue
                piece.begun = True
                lane = self._idle.pop()
                try:
                    inner = lane.submit(piece.call)
                except BrokenProcessPool:  # its process died while it had nothing to do
                    self._dead.append(lane)
                    lane = _new_worker()
                    inner = lane.submit(piece.call)
                inner.add_done_callback(partial(self._ended, piece, lane))

    def _ended(self, piece: _Task, lane: ProcessPoolExecutor, inner: Future[object]) -> None:
        error = inner.exception()
        died = isinstance(error, BrokenProcessPool)
        with self._changed:
            if died:
                # From Python 3.12 on a broken pool calls this with its lock held: shutting it down here, or letting go
                # of it, would wait for that lock for ever.
                self._dead.append(lane)
                lane = _new_worker()
                piece.lives -= 1
            again = died and piece.lives > 0 and not self._abandoned
            if again:
                self._waiting.appendleft(piece)
        if not again:
            _set_outcome(piece, inner, error, died=died)
        with self._changed:
            self._idle.append(lane)
        self._deal()
        with self._changed:
            self._changed.notify_all()


def _set_outcome(piece: _Task, inner: Future[object], error: BaseException | None, *, died: bool) -> None:
    if died:
        piece.future.set_exception(
            WorkerError(
                f"a process ended {MAX_ATTEMPTS - piece.lives} times while it worked on the same piece: see that there "
                "is memory for it, take fewer workers, and in a script of your own call this below "
                "`if __name__ == '__main__':`."
            )
        )
    elif error is not None:
        piece.future.set_exception(error)
    else:
        piece.future.set_result(inner.result())


def _new_worker() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_init_worker)


def _init_worker() -> None:
    """Let a process end at once when it is interrupted, or when whoever started it is no more."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        _exit(1)


CLUSTER_TIMEOUT_S = 10


@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """Yield the executor of the cluster whose scheduler is at an address, such as `tcp://127.0.0.1:8786`.

    The scheduler gives the pieces of a worker that dies to others.

    Raises
    ------
    SettingsError
        When Dask is not installed, nobody answers there, or its workers have no dragrig of this version.
    WorkerError
        When a piece takes several workers with it, or the cluster goes away.
    """
    try:
        from distributed import Client, KilledWorker
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
            with client.get_executor(pure=False) as executor:  # type: ignore[no-untyped-call]
                yield executor
        except KilledWorker as error:
            raise WorkerError(
                f"--scheduler {address}: {error.allowed_failures + 1} workers ended while they worked on the same "
                "piece; see that there is memory for it."
            ) from error
        except CancelledError as error:
            raise WorkerError(
                f"--scheduler {address}: the cluster went away; what is done is kept, so give the command again "
                "once it is back."
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
    here, versions = dragrig_version(), client.run(dragrig_version, on_error="return")
    other = {where: one for where, one in versions.items() if one != here}
    if other:
        where, one = next(iter(other.items()))
        told = f"has dragrig {one}" if isinstance(one, str) else f"cannot load dragrig ({one})"
        raise SettingsError(
            f"--scheduler {address}: the worker at {where} {told}, and here is {here}; install the same there."
        )


def available_cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def open_executor(
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
    processes = worker_count(workers, scheduler)
    if scheduler is not None:
        with dask_executor(scheduler) as found:
            yield found
        return
    processes = processes if most is None else max(min(processes, most), 1)
    here: Executor = ProcessExecutor(processes) if processes > 1 or apart else SerialExecutor()
    try:
        yield here
    except BaseException:
        here.shutdown(wait=True, cancel_futures=True)
        raise
    here.shutdown(wait=True)


def worker_count(workers: int | None, scheduler: str | None) -> int:
    """Return how many processes are meant; raises `SettingsError` for none, or for a cluster beside them."""
    if workers is not None and scheduler is not None:
        raise SettingsError("--workers and --scheduler: are for processes here and for a cluster elsewhere; give one.")
    if workers is None:
        return available_cores()
    if workers < 1:
        raise SettingsError(f"--workers {workers}: it takes one worker at least.")
    return workers


TaskT = TypeVar("TaskT")
MAX_SUBMITTED = 64
"""So many pieces are handed in at a time; the others wait here, where they cost nothing."""


def parallel_map(
    executor: Executor,
    function: Callable[[TaskT], R],
    pieces: Iterable[TaskT],
    finished: Callable[[TaskT, R], None] | None = None,
) -> list[R]:
    """Do pieces of work side by side; return their results in the order of the pieces.

    Linear algebra has one thread in every piece, so that results are the same bit for bit however many workers there
    are and wherever they are.

    Parameters
    ----------
    finished
        Called here with each piece and its result as soon as it is there, in whatever order they end.

    Raises
    ------
    WorkerError
        When a piece takes several processes with it.
    Exception
        Whatever the first piece that fails raises; pieces that have not begun are left.
    """
    waiting = deque(enumerate(pieces))
    running: dict[Future[R], tuple[int, TaskT]] = {}
    results: dict[int, R] = {}
    while waiting or running:
        while waiting and len(running) < MAX_SUBMITTED:
            number, piece = waiting.popleft()
            running[executor.submit(call_single_threaded, function, piece)] = number, piece
            if any(one.done() for one in running):
                break
        for number, piece, result in _wait_for_any(running):
            results[number] = result
            if finished is not None:
                finished(piece, result)
    return [results[number] for number in range(len(results))]


def parallel_map_with_progress(
    executor: Executor, function: Callable[[TaskT], R], pieces: Sequence[TaskT], progress: Progress
) -> list[R]:
    """Do the same, and tell how many pieces are done of how many."""
    done = count(1)
    progress(0, len(pieces))
    return parallel_map(executor, function, pieces, lambda _piece, _result: progress(next(done), len(pieces)))


def _wait_for_any(running: dict[Future[R], tuple[int, TaskT]]) -> list[tuple[int, TaskT, R]]:
    """Wait for some to end and take them out.

    No future is kept: a cluster does again what its workers lose as long as anybody holds on to it.
    """
    done = wait(running, return_when=FIRST_COMPLETED).done
    return [(*running.pop(one), one.result()) for one in sorted(done, key=lambda one: running[one][0])]


def call_single_threaded(function: Callable[[TaskT], R], piece: TaskT) -> R:
    """Do a piece with one thread for linear algebra."""
    from dragrig.analysis.computation import single_blas_thread

    with single_blas_thread():
        return function(piece)
