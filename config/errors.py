"""Every error that a person can cause or meet, one class per kind, each with its exit code."""

from typing import ClassVar


class DragrigError(Exception):
    """Base of all errors for the operator; the message is one sentence: the fault, its place, and the remedy."""

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


NO_TEXT = "holds bytes that are no UTF-8; type it anew in a terminal set to UTF-8, and rename a file of such a name"
"""Said of a text for which `is_text` is false."""


def is_text(text: str) -> bool:
    """Whether UTF-8 can hold a text; words typed or named in bytes that are no UTF-8 reach Python as no text."""
    return text.isascii() or not any("\ud800" <= letter <= "\udfff" for letter in text)


def require_text(**texts: str) -> None:
    """Raise `SettingsError` for a text that no file could hold, by the name of its parameter."""
    for name, text in texts.items():
        if not is_text(text):
            raise SettingsError(f"{name} {text!r:.60}: {NO_TEXT}.")
