"""Pieces of work through an executor."""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from itertools import count
from typing import TypeVar

from dragrig.analysis.progress import Progress

R = TypeVar("R")
PieceT = TypeVar("PieceT")
AHEAD = 64
"""So many pieces are handed in at a time; the others wait here, where they cost nothing."""


def spread(
    executor: Executor,
    function: Callable[[PieceT], R],
    pieces: Iterable[PieceT],
    finished: Callable[[PieceT, R], None] | None = None,
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
    running: dict[Future[R], tuple[int, PieceT]] = {}
    results: dict[int, R] = {}
    while waiting or running:
        while waiting and len(running) < AHEAD:
            number, piece = waiting.popleft()
            running[executor.submit(alone, function, piece)] = number, piece
            if any(one.done() for one in running):
                break
        for number, piece, result in _ended(running):
            results[number] = result
            if finished is not None:
                finished(piece, result)
    return [results[number] for number in range(len(results))]


def spread_counted(
    executor: Executor, function: Callable[[PieceT], R], pieces: Sequence[PieceT], progress: Progress
) -> list[R]:
    """Do the same, and tell how many pieces are done of how many."""
    done = count(1)
    progress(0, len(pieces))
    return spread(executor, function, pieces, lambda _piece, _result: progress(next(done), len(pieces)))


def _ended(running: dict[Future[R], tuple[int, PieceT]]) -> list[tuple[int, PieceT, R]]:
    """Wait for some to end and take them out.

    No future is kept: a cluster does again what its workers lose as long as anybody holds on to it.
    """
    done = wait(running, return_when=FIRST_COMPLETED).done
    return [(*running.pop(one), one.result()) for one in sorted(done, key=lambda one: running[one][0])]


def alone(function: Callable[[PieceT], R], piece: PieceT) -> R:
    """Do a piece with one thread for linear algebra."""
    from dragrig.analysis.identification.threads import one_thread

    with one_thread():
        return function(piece)
