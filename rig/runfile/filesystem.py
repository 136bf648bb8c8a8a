"""What run files need of the file system: one writer at a time, synced to disk, moved into place atomically."""

import contextlib
import errno
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py

from dragrig.config.errors import OutputError
from dragrig.rig.runfile.schema import lock_path

MAX_SHARING_WAIT_S = 5.0
"""How long Windows may keep a file from being replaced because somebody reads it."""
_SHARING_PAUSE_S = 0.05


class BusyError(OutputError):
    """Another process, alive, is at work on this."""


@contextlib.contextmanager
def lock_run(run: Path) -> Iterator[None]:
    """Be the only writer of a run, of all processes, until the block ends or the process dies.

    Raises
    ------
    BusyError
        When another process, or this one elsewhere, is writing the run.
    """
    path = lock_path(run)
    with file_lock(path, f"{path.with_suffix('')}: another process is writing this run; let it finish"):
        yield


@contextlib.contextmanager
def file_lock(path: Path, busy: str) -> Iterator[None]:
    """Be the only one of all processes to hold the lock of a small file, until the block ends or the process dies.

    The operating system holds the lock, so that it ends with its process; the file is made and removed. A file system
    or a Python without file locks guards nothing.

    Raises
    ------
    BusyError
        With this sentence, when another process, or this one elsewhere, holds it.
    """
    descriptor = _locked_descriptor(path, busy)
    try:
        yield
    finally:
        if sys.platform == "win32":
            os.close(descriptor)
            with contextlib.suppress(PermissionError):  # the next one has it open already
                path.unlink(missing_ok=True)
        else:
            path.unlink(missing_ok=True)
            os.close(descriptor)


def _locked_descriptor(path: Path, busy: str) -> int:
    while True:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as fault:
            raise OutputError(
                f"{path.parent}: cannot be written to ({fault.strerror}); choose another folder"
            ) from None
        if not _try_lock(descriptor):
            os.close(descriptor)
            raise BusyError(busy)
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), path.stat()):
                return descriptor
        os.close(descriptor)  # its last owner removed the file meanwhile: lock the new one


def _try_lock(descriptor: int) -> bool:
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except ImportError:
        return True
    except OSError as fault:
        if fault.errno in {errno.EACCES, errno.EAGAIN, errno.EDEADLK}:
            return False
        if fault.errno in {errno.ENOLCK, errno.ENOTSUP}:
            return True
        raise
    return True


def sync_file(path: Path) -> None:
    """Have a file's content reach the disk."""
    descriptor = os.open(path, os.O_RDWR | getattr(os, "O_BINARY", 0))
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """Have a folder's names reach the disk, where the system can."""
    if sys.platform == "win32":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as fault:
        # Network shares refuse this for folders; the file itself is synced.
        if fault.errno not in {errno.EINVAL, errno.ENOTSUP}:
            raise
    finally:
        os.close(descriptor)


def move_into_place(part: Path, target: Path) -> None:
    """Sync a file and give it its name at once; readers see the old one or the new one whole.

    Raises
    ------
    OutputError
        When Windows keeps the old one open for too long, or the folder refuses.
    """
    sync_file(part)
    rename_into_place(part, target)
    sync_folder(target.parent)


def rename_into_place(part: Path, target: Path) -> None:
    """Give a file its name at once, unsynced; raises as `move_into_place`."""
    _retry_while_shared(lambda: part.replace(target), target)


def remove_quietly(part: Path) -> None:
    """Remove what never got its place; a folder that refuses this too must not hide why."""
    with contextlib.suppress(OSError):
        part.unlink(missing_ok=True)


def remove_file(path: Path) -> None:
    """Remove a file, as patiently as `move_into_place`."""
    _retry_while_shared(lambda: path.unlink(missing_ok=True), path)
    sync_folder(path.parent)


def _retry_while_shared(action: Callable[[], object], path: Path) -> None:
    deadline = time.monotonic() + MAX_SHARING_WAIT_S
    while True:
        try:
            action()
        except PermissionError as fault:
            if os.name != "nt" or time.monotonic() > deadline:
                raise OutputError(
                    f"{path}: cannot be replaced or removed ({fault.strerror}); close what has it open"
                ) from fault
            time.sleep(_SHARING_PAUSE_S)
        else:
            return


def free_bytes(folder: Path) -> int:
    """Return how much room a folder's disk has for us."""
    return shutil.disk_usage(folder).free


def error_text(fault: Exception) -> str:
    """Return the few words of an exception that a person needs; h5py's say much more."""
    if isinstance(fault, OSError) and fault.errno:
        return os.strerror(fault.errno)
    return (str(fault).splitlines() or [type(fault).__name__])[0]


def abandon_hdf5_file(file: h5py.File) -> None:
    """Let go of an HDF5 file whose disk refuses data, leaving it on disk as it is.

    HDF5 flushes on closing and, refused, crashes the interpreter at its end. So its descriptor is pointed
    at memory (or a temporary file) first, where the last flush may go.
    """
    descriptor = file.id.get_vfd_handle()
    with _discarding_descriptor() as sink:
        os.dup2(sink, descriptor, inheritable=False)
    with contextlib.suppress(OSError, RuntimeError, ValueError):
        file.close()


@contextlib.contextmanager
def _discarding_descriptor() -> Iterator[int]:
    in_memory = getattr(os, "memfd_create", None)
    if in_memory is not None:
        descriptor = in_memory("dragrig")
        try:
            yield descriptor
        finally:
            os.close(descriptor)
    else:
        with tempfile.TemporaryFile() as file:
            yield file.fileno()
