"""How many threads linear algebra takes."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_thread() -> Iterator[None]:
    """Let BLAS work in the caller's thread alone.

    Fits are made of many small matrices. Two threads that take turns at them are no faster on an idle machine, and
    four times slower where anything else runs.
    """
    # SciPy brings a BLAS of its own, which can only be told once it is there.
    import scipy.linalg
    from threadpoolctl import threadpool_limits

    del scipy
    with threadpool_limits(limits=1, user_api="blas"):
        yield
