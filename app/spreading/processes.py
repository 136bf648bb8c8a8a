"""Processes of this machine, any of which may be killed without a piece being lost or done twice."""

import signal
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context, parent_process
from os import _exit
from typing import Any, ParamSpec, TypeVar

from dragrig.config.errors import WorkerError

P = ParamSpec("P")
R = TypeVar("R")
LIVES = 3
"""So many processes a piece may take with it before it is given up."""


@dataclass(slots=True, eq=False)
class _Piece:
    future: Future[Any]
    call: Callable[[], object]
    lives: int = LIVES
    begun: bool = False


class Processes(Executor):
    """An executor of processes, each with a pool of its own.

    A pool whose process dies is broken for good, with all that it holds. Each process here has its own pool, which
    holds one piece at a time, so that a death costs one attempt at one piece: it is begun again in a fresh process.
    Processes are started when there is work for them, by `spawn` on every system.
    """

    def __init__(self, workers: int) -> None:
        self._idle = [_lane() for _ in range(workers)]
        self._dead: list[ProcessPoolExecutor] = []
        self._workers = workers
        self._waiting: deque[_Piece] = deque()
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
            self._waiting.append(_Piece(future, partial(fn, *args, **kwargs)))
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
                    lane = _lane()
                    inner = lane.submit(piece.call)
                inner.add_done_callback(partial(self._ended, piece, lane))

    def _ended(self, piece: _Piece, lane: ProcessPoolExecutor, inner: Future[object]) -> None:
        error = inner.exception()
        died = isinstance(error, BrokenProcessPool)
        with self._changed:
            if died:
                # From Python 3.12 on a broken pool calls this with its lock held: shutting it down here, or letting go
                # of it, would wait for that lock for ever.
                self._dead.append(lane)
                lane = _lane()
                piece.lives -= 1
            again = died and piece.lives > 0 and not self._abandoned
            if again:
                self._waiting.appendleft(piece)
        if not again:
            _resolve(piece, inner, error, died=died)
        with self._changed:
            self._idle.append(lane)
        self._deal()
        with self._changed:
            self._changed.notify_all()


def _resolve(piece: _Piece, inner: Future[object], error: BaseException | None, *, died: bool) -> None:
    if died:
        piece.future.set_exception(
            WorkerError(
                f"a process ended {LIVES - piece.lives} times while it worked on the same piece: see that there is "
                "memory for it, take fewer workers, and in a script of your own call this below "
                "`if __name__ == '__main__':`."
            )
        )
    elif error is not None:
        piece.future.set_exception(error)
    else:
        piece.future.set_result(inner.result())


def _lane() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_begin)


def _begin() -> None:
    """Let a process end at once when it is interrupted, or when whoever started it is no more."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        _exit(1)
