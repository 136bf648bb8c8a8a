"""One program per rig: a lock of the operating system, released when its process ends for whatever reason."""

import contextlib
import os
import re
import stat
import sys
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Self

from filelock import FileLock, Timeout

from dragrig.config.errors import DeviceError
from dragrig.config.hardware import HardwareSettings

_LOCK_FOLDERS = (Path("/run/lock"), Path("/var/lock"))
_SHARED_FOLDER = 0o777
_SHARED_FILE = 0o666


class RigLock:
    """The lock of one program on one rig, from construction to `close`.

    Parameters
    ----------
    folder
        Folder of this machine's locks; default: one that all its users share.

    Raises
    ------
    DeviceError
        When another program, or this one elsewhere, holds the rig (with its process id), or no lock can be made.
    """

    def __init__(self, hardware: HardwareSettings, folder: Path | None = None) -> None:
        path = (folder or machine_lock_folder()) / f"{lock_name(hardware)}.lock"
        rig = f"{hardware.card.device} and {hardware.drive.port}"
        self._lock = FileLock(path, timeout=0, mode=_SHARED_FILE, thread_local=False)
        self._note = path.with_suffix(".pid")
        try:
            if not path.parent.is_dir():
                path.parent.mkdir(parents=True, exist_ok=True)
                path.parent.chmod(_SHARED_FOLDER)
            self._lock.acquire()
        except Timeout:
            raise DeviceError(
                f"{rig}: {_describe_holder(self._note)} is at this rig; end it, or wait until it is done."
            ) from None
        except OSError as error:
            raise DeviceError(
                f"{rig}: the lock {path} cannot be made ({error.strerror}): check who may write there."
            ) from error
        # The process id is information for a person only; the lock holds without it.
        with contextlib.suppress(OSError):
            self._note.write_text(str(os.getpid()), "ascii")
            self._note.chmod(_SHARED_FILE)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Release the rig. Safe to call twice."""
        if self._lock.is_locked:
            with contextlib.suppress(OSError):  # the next holder writes its own
                self._note.unlink(missing_ok=True)
            self._lock.release()


def lock_name(hardware: HardwareSettings) -> str:
    """Return the name of a rig's lock: card device and drive port, however the port is spelled."""
    port = hardware.drive.port
    if "://" not in port and Path(port).exists():
        port = str(Path(port).resolve())
    parts = (hardware.card.server, hardware.card.device, port)
    return "-".join(re.sub(r"[^a-z0-9.]+", "_", part.lower()).strip("_") for part in parts if part)


def machine_lock_folder() -> Path:
    """Return the folder that keeps the locks of this machine for all who use it."""
    if sys.platform == "win32":
        return Path(os.environ.get("PROGRAMDATA", tempfile.gettempdir())) / "dragrig"
    # Not whether this user may write there but whether every user may: all have to get the same folder.
    shared = (path for path in _LOCK_FOLDERS if path.is_dir() and path.stat().st_mode & stat.S_IWOTH)
    return next(shared, Path(tempfile.gettempdir())) / "dragrig"


def _describe_holder(note: Path) -> str:
    try:
        return f"process {int(note.read_text('ascii'))}"
    except (OSError, ValueError):
        return "another program"
