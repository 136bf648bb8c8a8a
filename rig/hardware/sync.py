"""The state that stage and sampler share: time of the first sample, and whether the stage moves.

The sampler sets the first sample's time, the stage sets the motion state. Every method may be called from any thread
and from a signal handler, and none blocks except `await_first_sample`.
"""

import threading
from dataclasses import dataclass, replace
from threading import Event as Signal


@dataclass(frozen=True, slots=True)
class FirstSample:
    """When an acquisition's first sample was taken.

    Attributes
    ----------
    at_s
        Reading of the rig's monotonic clock.
    uncertainty_s
        How far the first sample may be off that reading.
    """

    at_s: float
    uncertainty_s: float


@dataclass(frozen=True, slots=True)
class _SyncState:
    armed: bool = False
    first: FirstSample | None = None
    moving: bool = False
    stopped: bool = False


class MotionSamplingSync:
    """The few facts that stage and sampler share."""

    def __init__(self) -> None:
        # Re-entrant, for a signal handler that stops the stage may interrupt the very thread that holds it.
        self._changed = threading.Condition(threading.RLock())
        self._facts = _SyncState()

    @property
    def armed(self) -> bool:
        """Whether the next motion has to wait for a first sample."""
        return self._facts.armed

    @property
    def first_sample(self) -> FirstSample | None:
        """The first sample of the acquisition under way; None before it."""
        return self._facts.first

    @property
    def moving(self) -> bool:
        """Whether a motion is under way, waits for its first sample, or is braking."""
        return self._facts.moving

    @property
    def stopped(self) -> bool:
        """Whether the stage was told to stop since the sampler was armed."""
        return self._facts.stopped

    def arm(self) -> None:
        """Let the next motion wait for the first sample. The sampler's."""
        with self._changed:
            self._become(replace(self._facts, armed=True, first=None, stopped=False))

    def begin(self, first: FirstSample) -> None:
        """Tell when the first sample was. The sampler's."""
        with self._changed:
            self._become(replace(self._facts, first=first))

    def disarm(self) -> None:
        """Forget the acquisition; a motion that still waits for its first sample is dropped. The sampler's."""
        with self._changed:
            self._become(replace(self._facts, armed=False, first=None))

    def set_moving(self, moving: bool) -> None:
        """Tell whether anything moves. The stage's."""
        with self._changed:
            self._become(replace(self._facts, moving=moving))

    def set_stopped(self) -> None:
        """Tell that the stage was told to stop. The stage's."""
        with self._changed:
            self._become(replace(self._facts, stopped=True))

    def await_first_sample(self, cancel: Signal, wake_s: float = 0.05) -> FirstSample | None:
        """Wait for the first sample; None when the acquisition is forgotten, the stage stopped or `cancel` set."""
        with self._changed:
            while self._facts.armed and self._facts.first is None and not self._facts.stopped and not cancel.is_set():
                self._changed.wait(wake_s)
            return None if self._facts.stopped or cancel.is_set() else self._facts.first

    def _become(self, facts: _SyncState) -> None:
        self._facts = facts
        self._changed.notify_all()
