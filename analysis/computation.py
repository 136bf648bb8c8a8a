"""Long computations: the progress callback, and linear algebra held to one thread."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeAlias

Progress: TypeAlias = Callable[[int, int], None]
"""Called with the numbers of pieces of work that are done, and in all."""


def no_progress(_done: int, _of: int) -> None:
    """Report nothing."""


@contextmanager
def single_blas_thread() -> Iterator[None]:
    """Let BLAS work in the caller's thread alone.

    Fits are made of many small matrices. Two threads that take turns at them are no faster on an idle machine, and
    four times slower where anything else runs.
    """
    # SciPy brings a BLAS of its own, which can only be limited once it is loaded.
    import scipy.linalg
    from threadpoolctl import threadpool_limits

    del scipy
    with threadpool_limits(limits=1, user_api="blas"):
        yield
