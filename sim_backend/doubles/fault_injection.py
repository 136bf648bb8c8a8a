"""Faults of the simulated bench and its devices: a value that tests change while everything runs."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class ActiveFaults:
    """Everything that is wrong at present; by default nothing.

    Attributes
    ----------
    card_unplugged
        The card was pulled: every call that touches it fails with −201003.
    card_gone
        The driver no longer knows the card: −88705.
    card_absent
        The card is in no list of devices; its channels are not found: −200220.
    card_reserved
        Another program holds the card: starting or reserving a task fails with −50103.
    card_stalled
        Samples are taken, but none reaches the program before this ends; reads time out with what there was.
    overwritten_samples
        How many samples in all the card's buffer lost before they were read: with every increase, each running task
        loses that many that it had not read, and its next relative read fails with −200279.
    short_reads
        How many buffered reads in all of each task time out (−200284) with half of what they asked for.
    drive_alarm
        Text or code of an alarm that the drive raises; empty for none.
    drive_reply_late_s
        How much later than usual, in the wall's seconds, the drive replies.
    drive_garbled
        The drive's replies arrive with wrong bytes.
    drive_silent
        The drive hears, and acts, but says nothing.
    drive_unplugged
        The serial cable was pulled.
    force_added_mN
        Force on the sensor beside the gut's.
    sensor_open
        The force sensor's wire is broken: its amplifier is at the rail.
    encoder_stuck
        The encoder repeats one count.
    e_stop_pressed, limit_low_pressed, limit_high_pressed
        A hand is on the button; a switch is actuated or its wire broken.
    """

    card_unplugged: bool = False
    card_gone: bool = False
    card_absent: bool = False
    card_reserved: bool = False
    card_stalled: bool = False
    overwritten_samples: int = 0
    short_reads: int = 0
    drive_alarm: str = ""
    drive_reply_late_s: float = 0.0
    drive_garbled: bool = False
    drive_silent: bool = False
    drive_unplugged: bool = False
    force_added_mN: float = 0.0
    sensor_open: bool = False
    encoder_stuck: bool = False
    e_stop_pressed: bool = False
    limit_low_pressed: bool = False
    limit_high_pressed: bool = False


class FaultInjector:
    """The one holder of a `ActiveFaults`, which any thread may swap and look at."""

    def __init__(self, now: ActiveFaults | None = None) -> None:
        self._lock = threading.Lock()
        self._now = now or ActiveFaults()
        self._listeners: list[Callable[[], None]] = []

    @property
    def now(self) -> ActiveFaults:
        """What is wrong at present."""
        return self._now

    def become(self, now: ActiveFaults) -> None:
        """Let exactly this be wrong from here on, and tell the listeners."""
        with self._lock:
            self._now = now
            listeners = tuple(self._listeners)
        for listener in listeners:
            listener()

    def strike(self, **changes: float | str) -> None:
        """Change the named attributes of `ActiveFaults`, leave the others."""
        with self._lock:
            changed = replace(self._now, **changes)  # type: ignore[arg-type]
        self.become(changed)

    def repair(self) -> None:
        """Let nothing be wrong."""
        self.become(ActiveFaults())

    def listen(self, listener: Callable[[], None]) -> None:
        """Call `listener` after every change, in the thread that made it."""
        with self._lock:
            self._listeners.append(listener)
