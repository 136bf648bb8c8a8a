"""The state that stage and sampler share: time of the first sample, and whether the stage moves.

The sampler sets the first sample's time, the stage sets the motion state. Every method may be called from any thread
and from a signal handler, and none blocks except `await_first_sample`.
"""

import threading
from dataclasses import dataclass, replace
from threading import Event as Signal

_WAKE_S = 0.05
"""How late a wait may notice that its caller cancelled it: an `Event` cannot wake a `Condition`."""


@dataclass(frozen=True, slots=True)
class FirstSample:
    """When an acquisition's first sample was taken."""

    at_s: float
    """Reading of the rig's monotonic clock."""
    uncertainty_s: float
    """Half-width of the interval around `at_s` in which the first sample was taken."""


@dataclass(frozen=True, slots=True)
class _SyncState:
    armed: bool = False
    first_sample: FirstSample | None = None
    moving: bool = False
    stop_requested: bool = False


class MotionSamplingSync:
    """Motion state, set by the stage, and sampling state, set by the sampler."""

    def __init__(self) -> None:
        # Re-entrant, because a signal handler that stops the stage may interrupt the very thread that holds it.
        self._changed = threading.Condition(threading.RLock())
        self._state = _SyncState()
        self.newest_seen_s = 0.0
        """When the newest sample that the guard gets was taken, by `time.monotonic` of this computer (set by the
        sampler)."""

    @property
    def armed(self) -> bool:
        """Whether the sampler is armed: the next motion has to wait for the first sample."""
        return self._state.armed

    @property
    def first_sample(self) -> FirstSample | None:
        """The first sample of the current acquisition; None before it."""
        return self._state.first_sample

    @property
    def moving(self) -> bool:
        """Whether a motion is in progress, waits for its first sample, or is braking."""
        return self._state.moving

    @property
    def stop_requested(self) -> bool:
        """Whether a stop was requested since the sampler was armed."""
        return self._state.stop_requested

    def arm(self) -> None:
        """Make the next motion wait for the first sample (called by the sampler)."""
        self._update(armed=True, first_sample=None, stop_requested=False)

    def set_first_sample(self, first_sample: FirstSample) -> None:
        """Set when the first sample was taken (called by the sampler)."""
        self._update(first_sample=first_sample)

    def disarm(self) -> None:
        """End the acquisition; a motion that still waits for its first sample is dropped (called by the sampler)."""
        self._update(armed=False, first_sample=None)

    def set_moving(self, moving: bool) -> None:
        """Set whether the stage moves (called by the stage)."""
        self._update(moving=moving)

    def set_stop_requested(self) -> None:
        """Record that a stop was requested (called by the stage)."""
        self._update(stop_requested=True)

    def await_first_sample(self, cancel: Signal) -> FirstSample | None:
        """Wait for the first sample; None when the sampler is disarmed, a stop is requested or `cancel` is set."""
        with self._changed:
            while self._state.armed and self._state.first_sample is None:
                if self._state.stop_requested or cancel.is_set():
                    break
                self._changed.wait(_WAKE_S)
            return None if self._state.stop_requested or cancel.is_set() else self._state.first_sample

    def _update(self, **changes: FirstSample | bool | None) -> None:
        with self._changed:
            self._state = replace(self._state, **changes)  # type: ignore[arg-type]
            self._changed.notify_all()
