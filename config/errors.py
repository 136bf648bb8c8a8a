"""Every error that a person can cause or meet, one class per kind, each with its exit code."""

from typing import ClassVar


class DragrigError(Exception):
    """Base of all errors for the operator; the message is one sentence on what is wrong, where, and what to do."""

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
    """An output file or folder that cannot be written, or exists already."""


class AnalysisError(DragrigError):
    """A request that the available data cannot answer."""


class WorkerError(DragrigError):
    """Worker processes ended before their work was done."""


class RecordingError(DragrigError):
    """The disk refused data while a run was being recorded."""

    exit_code = 5


class AbortedError(DragrigError):
    """A person or a signal ended the session."""

    exit_code = 3


class TrippedError(DragrigError):
    """The guard stopped the stage and stays tripped until it is reset."""

    exit_code = 4


class DeviceError(DragrigError):
    """A device failed or refused a command."""

    exit_code = 5


class StaleDataError(DeviceError):
    """The sampler delivered nothing for longer than the guard allows."""


class OverrunError(StaleDataError):
    """The sampler delivered nothing, because samples were lost before they were read."""


def reason_of(error: DragrigError) -> str:
    """Return an error's message without its full stop, for use in another sentence."""
    return str(error).rstrip(".")
