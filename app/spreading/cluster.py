"""A Dask cluster as an executor."""

from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor
from contextlib import contextmanager
from importlib import metadata
from typing import TYPE_CHECKING

from dragrig.config.errors import SettingsError, WorkerError

if TYPE_CHECKING:
    from distributed import Client

ANSWERS_WITHIN_S = 10


@contextmanager
def cluster(address: str) -> Iterator[Executor]:
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
        client = Client(address, timeout=ANSWERS_WITHIN_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TypeError) as error:
        raise SettingsError(
            f"--scheduler {address}: no Dask scheduler answers there; start one with `dask scheduler`, and workers "
            "with `dask worker ADDRESS --nthreads 1`."
        ) from error
    with client:
        _require_workers(client, address)
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


def version() -> str:
    """Return the version of dragrig where this is called."""
    return metadata.version("dragrig")


def _require_workers(client: "Client", address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=ANSWERS_WITHIN_S)
    except TimeoutError as error:
        raise SettingsError(
            f"--scheduler {address}: it has no workers; start some with `dask worker {address} --nthreads 1`."
        ) from error
    here, versions = version(), client.run(version, on_error="return")
    other = {where: one for where, one in versions.items() if one != here}
    if other:
        where, one = next(iter(other.items()))
        told = f"has dragrig {one}" if isinstance(one, str) else f"cannot load dragrig ({one})"
        raise SettingsError(
            f"--scheduler {address}: the worker at {where} {told}, and here is {here}; install the same there."
        )
