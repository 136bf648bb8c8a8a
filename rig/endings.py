"""The error, with its exit code, that stands for an early end."""

from dragrig.config.errors import AbortedError, DeviceError, DragrigError, TrippedError
from dragrig.rig.acquiring import Outcome
from dragrig.rig.runfile.model import Status


def early_end(status: Status, reason: str) -> DragrigError:
    """Return the error that stands for an early end."""
    return {Status.ABORTED: AbortedError, Status.TRIPPED: TrippedError}.get(status, DeviceError)(reason)


def require_complete(outcome: Outcome) -> None:
    """Raise the error that stands for the early end of an acquisition, if it ended early."""
    if outcome.status is not Status.COMPLETE:
        raise early_end(outcome.status, outcome.reason)
