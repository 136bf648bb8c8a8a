"""A second copy of each finished run file, on another disk, compared after it has been read back.

Copying has its own thread, and no run waits for it. What the mirror refuses is reported and tried again with the next
file and at the end; the measurement goes on.
"""

import contextlib
import hashlib
import os
import queue
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from threading import Thread

from dragrig.config.errors import OutputError
from dragrig.rig.runfile import filesystem as files
from dragrig.rig.runfile import schema as naming

COPY_BYTES = 1 << 20
MAX_STALL_S = 120.0
"""How long the end of a session waits for a mirror that gets nothing done."""


@dataclass(frozen=True, slots=True)
class MirrorReport:
    """What is in the mirror and what is not.

    Attributes
    ----------
    folder
        Where the copies are.
    copied
        Names of files whose copy was read back and found equal.
    missing
        Names of files without such a copy, each with why.
    """

    folder: Path
    copied: tuple[str, ...] = ()
    missing: Mapping[str, str] = field(default_factory=dict)

    @property
    def whole(self) -> bool:
        """Whether nothing is missing."""
        return not self.missing


class Mirror:
    """Copies files into a folder of the mirror, one after the other, on a thread of its own.

    Parameters
    ----------
    root
        The mirror, a folder that is there; none is made, because a disk that is not mounted leaves an empty place that
        anything could be written to.
    name
        Of the folder in it.
    told
        Called, on the mirror's thread, with a sentence about each file that could not be copied.
    """

    def __init__(self, root: Path, name: str, told: Callable[[str], None]) -> None:
        self.folder = root / name
        self._root, self._told = root, told
        self._device: int | None = None
        self._jobs: queue.SimpleQueue[Path | None] = queue.SimpleQueue()
        self._asked: dict[str, Path] = {}
        self._copied: dict[str, None] = {}
        self._missing: dict[str, str] = {}
        self._steps = 0
        self._thread = Thread(target=self._work, name="mirror", daemon=True)
        self._thread.start()

    def submit(self, file: Path) -> None:
        """Have a file copied; returns at once."""
        self._asked[file.name] = file
        self._jobs.put(file)

    def close(self, patience_s: float = MAX_STALL_S) -> MirrorReport:
        """Try once more what failed, and say what is in the mirror; a mirror that hangs is given up."""
        self._jobs.put(None)
        seen = -1
        while self._thread.is_alive() and seen != self._steps:
            seen = self._steps
            self._thread.join(patience_s)
        hung = dict.fromkeys(
            self._asked.keys() - self._copied.keys() - self._missing.keys(), "the mirror does not answer"
        )
        return MirrorReport(self.folder, tuple(self._copied), {**self._missing, **hung})

    def _work(self) -> None:
        try:
            self._require_mirror()
        except (OSError, OutputError) as error:
            self._told(f"NOT MIRRORED: {self.folder}: {_reason(error)}; the runs are made all the same.")
        while (file := self._jobs.get()) is not None:
            if self._try(file):
                self._try_again()
        self._try_again()

    def _try_again(self) -> None:
        for name in tuple(self._missing):
            self._try(self._asked[name])

    def _try(self, file: Path) -> bool:
        try:
            self._require_mirror()
            copy_verified(file, self.folder / file.name, self._step)
        except (OSError, OutputError) as error:
            why = _reason(error)
            if self._missing.get(file.name) != why:
                self._missing[file.name] = why
                self._told(f"NOT MIRRORED: {file.name} is not in {self.folder}: {why}; it stays where it was made.")
            return False
        self._missing.pop(file.name, None)
        self._copied[file.name] = None
        return True

    def _require_mirror(self) -> None:
        if not self._root.is_dir():
            raise OutputError("there is no such folder; make it, or mount the disk")
        device = self._root.stat().st_dev
        if self._device is None:
            self._device = device
        elif device != self._device:
            raise OutputError("another disk is there than at the beginning; mount the right one")
        self.folder.mkdir(exist_ok=True)

    def _step(self) -> None:
        self._steps += 1


def _reason(error: Exception) -> str:
    return files.error_text(error) if isinstance(error, OSError) else str(error)


def copy_verified(source: Path, target: Path, step: Callable[[], None] = lambda: None) -> None:
    """Copy a file, read the copy back from its disk, compare, and give it its name at once.

    A copy that is there already and equal is left; one that differs is never replaced.

    Parameters
    ----------
    step
        Called after each piece, to tell that something is done.

    Raises
    ------
    OutputError
        When another file of this name is there, or the copy reads back otherwise than it was written.
    OSError
        When a disk refuses.
    """
    if target.exists():
        if _file_sha256(target, step) == _file_sha256(source, step):
            return
        raise OutputError("a file of this name is there and differs; it is left as it is")
    part = naming.part_path(target)
    try:
        wanted = hashlib.sha256()
        with source.open("rb") as from_, part.open("wb") as to:
            while piece := from_.read(COPY_BYTES):
                wanted.update(piece)
                to.write(piece)
                step()
            to.flush()
            os.fsync(to.fileno())
        if _file_sha256(part, step) != wanted.digest():
            raise OutputError("the copy reads back otherwise than it was written; replace that disk")
        files.move_into_place(part, target)
    finally:
        files.remove_quietly(part)


def _file_sha256(path: Path, step: Callable[[], None]) -> bytes:
    found = hashlib.sha256()
    with path.open("rb") as file:
        _drop_page_cache(file.fileno())
        while piece := file.read(COPY_BYTES):
            found.update(piece)
            step()
    return found.digest()


def _drop_page_cache(descriptor: int) -> None:
    """Have a file read from its disk, as far as the system does as it is told."""
    advise = getattr(os, "posix_fadvise", None)
    if advise is not None:
        with contextlib.suppress(OSError):
            advise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
