"""Every error that a person can cause or meet, one class per kind, each with its exit code."""

from typing import ClassVar


class DragrigError(Exception):
    """Base of all errors whose message is written for the person at the rig.

    The message is one sentence that says what is wrong, where, and what to do.
    """

    exit_code: ClassVar[int] = 2


class SettingsError(DragrigError):
    """A settings file or a `--set` value that cannot be used."""


class PlanError(DragrigError):
    """A plan that the rig cannot or must not carry out."""


class RunFileError(DragrigError):
    """A run file that is missing, foreign, damaged, or of a newer format."""


class ImportDataError(DragrigError):
    """A foreign measurement that cannot be turned into a run file."""


class OutputError(DragrigError):
    """A place that cannot be written to, or that already holds something."""


class AnalysisError(DragrigError):
    """A request that the data at hand cannot answer."""


class WorkerError(DragrigError):
    """Processes that share a work end before it is done."""


class RecordingError(DragrigError):
    """The disk refused data while a run was being recorded."""

    exit_code = 5


class AbortedError(DragrigError):
    """A person or a signal ended the session."""

    exit_code = 3


class TrippedError(DragrigError):
    """The guard stopped the stage and stays latched until it is reset."""

    exit_code = 4


class DeviceError(DragrigError):
    """A device did not do what it was told."""

    exit_code = 5


class StaleDataError(DeviceError):
    """The sampler delivered nothing for longer than the guard allows."""


def reason_of(error: DragrigError) -> str:
    """Return an error's sentence as a part of another one."""
    return str(error).rstrip(".")
