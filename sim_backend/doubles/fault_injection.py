"""Faults of the simulated bench and its devices: a value that tests change while everything runs."""

import dataclasses
import threading
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ActiveFaults:
    """Everything that is wrong at present; default: nothing.

    Attributes
    ----------
    card_unplugged
        The card was pulled: every call that touches it fails with −201003.
    card_gone
        The driver no longer knows the card: −88705.
    card_absent
        The driver lists no such card; its channels are not found: −200220.
    card_reserved
        Another program holds the card: starting or reserving a task fails with −50103.
    card_stalled
        Samples are taken, but none reaches the program before this ends; reads time out with what there was.
    overwritten_samples
        Total number of samples that the card's buffer lost before they were read: with every increase, each running
        task loses that many unread samples, and its next relative read fails with −200279.
    short_reads
        Total number of buffered reads of each task that time out (−200284) with half of what they requested.
    drive_alarm
        Text or code of an alarm that the drive raises; empty for none.
    drive_reply_late_s
        Delay of the drive's replies, in wall time.
    drive_garbled
        The drive's replies arrive with wrong bytes.
    drive_silent
        The drive carries out requests, but does not reply.
    drive_unplugged
        The serial cable was pulled.
    force_added_mN
        Force on the sensor in addition to the specimen's.
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
    """Holds the active faults; any thread may read or change them."""

    def __init__(self, active: ActiveFaults | None = None) -> None:
        self._lock = threading.Lock()
        self._active = active or ActiveFaults()
        self._listeners: list[Callable[[], None]] = []

    @property
    def active(self) -> ActiveFaults:
        """The faults that are active at present."""
        return self._active

    def replace(self, active: ActiveFaults) -> None:
        """Make exactly these faults active, and notify the listeners."""
        with self._lock:
            self._active = active
            listeners = tuple(self._listeners)
        for listener in listeners:
            listener()

    def inject(self, **changes: float | str) -> None:
        """Change the named attributes of `ActiveFaults`; the others stay."""
        with self._lock:
            changed = dataclasses.replace(self._active, **changes)  # type: ignore[arg-type]
        self.replace(changed)

    def clear(self) -> None:
        """End all faults."""
        self.replace(ActiveFaults())

    def subscribe(self, listener: Callable[[], None]) -> None:
        """Call `listener` after every change, in the thread that made it."""
        with self._lock:
            self._listeners.append(listener)
