"""Finishing the recordings that a crash left behind."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from dragrig.config.errors import DragrigError, OutputError, RunFileError
from dragrig.rig.runfile import files, schema
from dragrig.rig.runfile.naming import is_recording
from dragrig.rig.runfile.reader import read_info
from dragrig.rig.runfile.repack import finish


class Outcome(StrEnum):
    """What became of a recording that was found."""

    FINISHED = "finished"
    IN_USE = "in use"
    LEFT = "left"


@dataclass(frozen=True, slots=True)
class Recovered:
    """A recording that was found and what became of it.

    Attributes
    ----------
    path
        The run file, where the recording was finished.
    message
        Why it was not, otherwise.
    """

    recording: Path
    outcome: Outcome
    path: Path | None = None
    samples: int = 0
    message: str = ""


def left_recordings(place: Path) -> tuple[Path, ...]:
    """Return the recordings in a folder and those below it, in the order of their names; or the one given."""
    if is_recording(place):
        return (place,) if place.is_file() else ()
    return tuple(sorted(place.rglob(f"*{schema.RECORDING_SUFFIX}")))


def recover(place: Path, progress: Callable[[Path], object] = lambda _: None) -> list[Recovered]:
    """Finish every recording in a folder, or the one given, whose writer is not alive.

    A run that ended before its file was finished keeps its status; one that was cut off becomes
    `recovered`. Nothing is removed before its run file is whole, so that calling this again, or losing
    power meanwhile, does no harm. A recording that cannot be read stays as it is.

    Parameters
    ----------
    progress
        Called with each recording before it is finished.

    Raises
    ------
    RunFileError
        When there is no such folder or file.
    """
    if not place.exists():
        raise RunFileError(f"{place}: there is no such folder or recording; give the folder of a campaign")
    found: list[Recovered] = []
    for recording in left_recordings(place):
        progress(recording)
        found.append(_recovered(recording))
    if place.is_dir():
        _sweep(place)
    return found


def _recovered(recording: Path) -> Recovered:
    try:
        path = finish(recording)
        return Recovered(recording, Outcome.FINISHED, path, read_info(path).samples)
    except files.BusyError as fault:
        return Recovered(recording, Outcome.IN_USE, message=str(fault))
    except DragrigError as fault:
        return Recovered(recording, Outcome.LEFT, message=str(fault))


def _sweep(folder: Path) -> None:
    """Remove half-made copies and locks of writers that are not alive; neither ever holds the only copy."""
    for part in folder.rglob(f"*{schema.FINISHED_SUFFIX}{schema.PART_SUFFIX}"):
        with suppress(OutputError), files.writing(part.with_suffix("")):
            part.unlink(missing_ok=True)
    for lock in folder.rglob(f"*{schema.LOCK_SUFFIX}"):
        with suppress(OutputError), files.writing(lock.with_suffix(schema.FINISHED_SUFFIX)):
            pass  # a lock is removed by whoever lets go of it
