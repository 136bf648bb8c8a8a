"""Run files and the file system: one writer at a time, synced to disk, moved into place atomically."""

import contextlib
import errno
import os
import re
import shutil
import stat
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from dragrig.config import NO_TEXT, OutputError, is_text
from dragrig.rig.runfile.schema import PART_SUFFIX, lock_path, part_path

MAX_SHARING_WAIT_S = 5.0
"""How long a file that somebody reads may keep Windows from replacing it."""
_SHARING_RETRY_S = 0.05
_UNSHARED = "close the program that has it open"
_TEMPORARY = re.compile(rf"\..+\.\d+{re.escape(PART_SUFFIX)}")
_ABANDONED_S = 600.0
"""A temporary file that nobody has written to for so long is left over. No writer pauses for minutes, and a process's
number alone tells nothing of a program on another computer that shares the folder."""
_WITHOUT_LOCKS = {errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS}
"""Errors of network shares without file locks: a lock guards nothing there, and the run is recorded all the same."""


class BusyError(OutputError):
    """Another living process is writing."""


def lock_run(run: Path) -> contextlib.AbstractContextManager[None]:
    """Be the only writer of a run, as `file_lock`."""
    path = lock_path(run)
    return file_lock(path, f"{path.with_suffix('')}: another process is writing this run; let it finish")


@contextlib.contextmanager
def file_lock(path: Path, busy_message: str, timeout_s: float = 0.0) -> Iterator[None]:
    """Hold the lock of a small file, of all processes, until the block ends or the process dies; remove it at the end.

    Raises
    ------
    BusyError
        With this message, when another process, or this one elsewhere, still holds it after `timeout_s`.
    OutputError
        When the folder cannot be written to.
    """
    from filelock import FileLock, Timeout

    lock = FileLock(path, timeout=timeout_s, thread_local=False, fallback_to_soft=False)
    try:
        # filelock would make a missing folder.
        path.parent.stat()
        lock.acquire()
    except Timeout:
        raise BusyError(busy_message) from None
    except OSError as error:
        if error.errno not in _WITHOUT_LOCKS:
            raise OutputError(
                f"{path.parent}: cannot be written to ({error.strerror}); choose another folder"
            ) from None
    try:
        yield
    finally:
        if sys.platform != "win32":
            # Removed while it is held: whoever opened it before and locks it afterwards sees that it is gone, and makes
            # another. Windows removes no open file; there, filelock removes it after the release.
            path.unlink(missing_ok=True)
        lock.release()


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
    except OSError as error:
        # Network shares refuse this for folders; the file itself is synced.
        if error.errno not in {errno.EINVAL, errno.ENOTSUP}:
            raise
    finally:
        os.close(descriptor)


def move_into_place(part: Path, target: Path) -> None:
    """Sync a file and give it its name atomically: readers see either the old file or the new one, whole.

    Raises `OutputError` when Windows keeps the old file open for too long, or the folder refuses.
    """
    sync_file(part)
    rename_into_place(part, target)
    sync_folder(target.parent)


@contextlib.contextmanager
def written_atomically(target: Path, *, synced: bool = True) -> Iterator[Path]:
    """Yield the path of a temporary file beside the target, which gets the target's name once it is complete.

    Whatever ends the block removes it. The remains of a killed program go here too, once it is old enough to
    belong to nobody. Raises as `move_into_place`.
    """
    _remove_abandoned(target.parent)
    part = target.with_name(f".{target.name}.{os.getpid()}{PART_SUFFIX}")
    try:
        yield part
        if synced:
            move_into_place(part, target)
        else:
            rename_into_place(part, target)
    finally:
        remove_quietly(part)


def _remove_abandoned(folder: Path) -> None:
    for part in folder.glob(f".*{PART_SUFFIX}"):
        with contextlib.suppress(OSError):
            if _TEMPORARY.fullmatch(part.name) and time.time() - part.stat().st_mtime > _ABANDONED_S:
                part.unlink()


def rename_into_place(part: Path, target: Path) -> None:
    """Give a file its name atomically, unsynced; raises as `move_into_place`."""
    _retry_while_shared(lambda: part.replace(target), target)


def replace_text(path: Path, text: str) -> None:
    """Write a small text file, atomically in place of an earlier one; raises `OutputError`."""
    if not is_text(text):
        raise OutputError(f"{path}: cannot be written, as the text {NO_TEXT}")
    part = part_path(path)
    try:
        part.write_text(text, "utf-8", newline="\n")
        move_into_place(part, path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); ask for permission") from error
    finally:
        remove_quietly(part)


def remove_quietly(part: Path) -> None:
    """Remove a file that never got its name; an error here must not hide the one before."""
    with contextlib.suppress(OSError):
        part.unlink(missing_ok=True)


def remove_file(path: Path) -> None:
    """Remove a file; raises as `move_into_place`."""
    _retry_while_shared(lambda: path.unlink(missing_ok=True), path)
    sync_folder(path.parent)


def _retry_while_shared(action: Callable[[], object], path: Path) -> None:
    deadline_s = time.monotonic() + MAX_SHARING_WAIT_S
    while True:
        try:
            action()
        except PermissionError as error:
            remedy = refusal_remedy(path, os.name)
            if remedy != _UNSHARED or time.monotonic() > deadline_s:
                raise OutputError(f"{path}: cannot be replaced or removed ({error.strerror}); {remedy}") from error
            time.sleep(_SHARING_RETRY_S)
        else:
            return


def refusal_remedy(path: Path, system: str) -> str:
    """Return the ways out where a system (`os.name`) refuses to replace a file; the last may come by itself."""
    if os.access(path, os.F_OK) and not path.stat().st_mode & stat.S_IWRITE:
        return "it is read-only: make it writable"
    if path.is_dir():
        return "it is a folder: choose another name"
    return _UNSHARED if system == "nt" else "ask for permission to write in its folder"


def free_bytes(folder: Path) -> int:
    """Return the free space where `folder` is or will be; raises `OutputError` when it cannot be read."""
    existing = existing_folder(folder)
    try:
        return shutil.disk_usage(existing).free
    except OSError as error:
        raise OutputError(f"{existing}: its free space cannot be read ({error.strerror}).") from error


def existing_folder(folder: Path) -> Path:
    """Return the folder or the nearest one above it that exists; raises `OutputError` where there is none."""
    for existing in (folder.absolute(), *folder.absolute().parents):
        if existing.is_dir():
            return existing
    raise OutputError(f"{folder}: no part of this path exists; choose another folder.")


def brief_error(error: Exception) -> str:
    """Return the first line of an error, or the system's text for it; h5py's messages run over several lines."""
    if isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno)
    return (str(error).splitlines() or [type(error).__name__])[0]
