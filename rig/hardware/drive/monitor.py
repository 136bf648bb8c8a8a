"""The monitor: polls drive and switches, and keeps drive and heartbeat relay alive while the program is well.

A drive that receives nothing for `hardware.drive.silence_s` stops by itself, and so does one whose heartbeat relay sees
no edge. Both signals come from the monitor's threads, so that neither outlives the program; and both end when the
program no longer reads its data (`Watchdog`), or when its samples are stale, so that neither a hung program nor a
blind guard keeps the stage moving.

A drive that answers nothing for `silence_s` may have a silence timeout or not: then the heartbeat ends and the enable
line is cleared. A thread of its own decides that, because the one that polls waits for the serial line; it also
looks at the switches while the other waits.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass

from dragrig.config import DeviceError, RigSettings, reason_of
from dragrig.rig import Clock, Trip, TripCause
from dragrig.rig.hardware import CardLines, MotionSamplingSync
from dragrig.rig.hardware.drive.link import DriveLink

_FAST_POLL_S = 0.005
_MAX_POWER_CHECK_S = 0.01
_UNHEARD_GRACE_S = 0.03
"""After a computer stood still, the thread that polls has so long to take the replies that came meanwhile."""
_POLLS_PER_SILENCE = 4
_LATE_POLLS = 2
"""A poll that is so many times later than it should be waits for the serial line."""
_RELAY_BEATS = 2.5
"""A relay opens when it sees no edge for three beats. A beat that comes so late would close it again, and give power
back to a drive that may still be told to move: by the voltage that the card holds, or by a target of its own."""
_STALE_GRACE_S = 0.05
"""How much later than the sampler the monitor says that samples are stale: the sampler's reason is the better one."""


class Watchdog:
    """Time since the program last showed that it reads its data: it feeds the watchdog, the monitor looks at it.

    The time is wall time, also where the rig has another clock: a hung program is a matter of this computer.
    """

    def __init__(self) -> None:
        self._fed_s = time.monotonic()

    def feed(self) -> None:
        """Restart the time. Never blocks."""
        self._fed_s = time.monotonic()

    @property
    def unfed_s(self) -> float:
        """Seconds since it was fed."""
        return time.monotonic() - self._fed_s


@dataclass(frozen=True, slots=True)
class StageDevices:
    """The parts that a stage works with."""

    settings: RigSettings
    link: DriveLink
    lines: CardLines
    sync: MotionSamplingSync
    clock: Clock
    """The rig's time, in which motions are."""
    watchdog: Watchdog
    """Fed by the sampler."""


class Monitor:
    """The one owner of the reason that forbids motion. `fault` may be read by any thread and never blocks.

    Parameters
    ----------
    poll_drive
        Requests the drive's status, which feeds its silence timeout; returns the reason that forbids motion, or None.
        May raise `DeviceError`.
    stop
        Stops the stage; must return at once.
    may_beat
        Whether the heartbeat goes on; without it the relay opens.
    ending
        Held while a movement and the tolerance of a switch end, which are one step for the thread that holds it.
    """

    def __init__(
        self,
        devices: StageDevices,
        poll_drive: Callable[[], Trip | None],
        stop: Callable[[], None],
        may_beat: Callable[[], bool],
        ending: AbstractContextManager[object],
    ) -> None:
        self._poll_drive_status, self._stop, self._may_beat, self._ending = poll_drive, stop, may_beat, ending
        self._link, self._lines = devices.link, devices.lines
        self._sync, self._watchdog = devices.sync, devices.watchdog
        self._silence_s = devices.settings.hardware.drive.silence_s
        # A poll may first wait for another thread's request, which is repeated for nearly as long.
        self._unpolled_s = 2 * self._silence_s
        self._beat_s = devices.settings.hardware.card.lines.heartbeat_s
        self._relay_s = _RELAY_BEATS * self._beat_s
        # How long the watchdog may go unfed while a sampled motion is in progress.
        self._hang_s = devices.settings.hardware.hang_s
        self._stale_s = devices.settings.guard.stale_data_s + _STALE_GRACE_S
        # Half a block's, so that a poll with its requests over the link is done within a block; less where the silence
        # timeout is shorter.
        self._interval_s = min(devices.settings.sampling.block_s / 2, self._silence_s / _POLLS_PER_SILENCE)
        # One poll at a time; it need not be re-entrant, because no poll leads to another.
        self._polling = threading.Lock()
        self._sampled_motion_since_s: float | None = None
        self._tolerated: TripCause | None = None
        self._latched: Trip | None = None
        self._fault: Trip | None = None
        self._stop_sent = False
        self._drive_on = False
        self._guard_is_blind = self._power_released = False
        self._polled_s = self._beaten_s = self._late_beat_s = float("-inf")
        self._moved_at_beat = False
        self._unheard_seen_s: float | None = None
        self._withholds_polls = self._withholds_beats = False
        self._ended = threading.Event()
        self._fast = threading.Event()
        self._threads = (
            threading.Thread(target=self._run, args=(self.watch_drive,), name="drive monitor", daemon=True),
            threading.Thread(target=self._run, args=(self.watch_power,), name="drive power", daemon=True),
        )

    @property
    def fault(self) -> Trip | None:
        """The fault at the last poll; a fault that has stopped a motion is latched until `clear`."""
        return self._fault

    def start(self) -> None:
        """Poll once, then go on polling from the monitor's own threads."""
        self.poll()
        self._polled_s = time.monotonic()
        for thread in self._threads:
            thread.start()

    def poll(self) -> Trip | None:
        """Read switches and drive now, and return the fault that forbids motion."""
        with self._polling:
            # Read before the drive answers, which may have stopped by itself already: the program's own stop follows.
            moved, tolerated = self._moving_and_tolerated()
            by_switches = self._look_at_switches(tolerated, moved=moved)
            by_drive = self._poll_drive()
            if by_drive is not None and by_switches is None:
                # A switch that was pressed in between explains the stop better than the drive, which has stopped by it.
                by_switches = self._poll_switches(tolerated)
            self._report(self._latched or by_switches or by_drive, moved=moved)
            return self._fault

    def poll_fast(self) -> None:
        """Poll every few milliseconds until nothing moves any more."""
        self._fast.set()

    def set_drive_on(self, on: bool) -> None:
        """Set whether the drive is meant to be on: then an emergency stop is latched even at a standstill."""
        self._drive_on = on

    def latch(self, trip: Trip) -> None:
        """Latch a fault until `clear`, and stop the motion; the first one is kept.

        An emergency stop is named as such, also where the thread that saw its effects first took it for something else.
        """
        first, self._latched = self._latched is None, self._latched or trip
        self._report(self._latched, moved=self._sync.moving)
        if first and (pressed := self._poll_switches(self._tolerated)) and pressed.cause is TripCause.EMERGENCY_STOP:
            self._fault = self._latched = pressed

    def clear(self) -> None:
        """Drop the latched fault; a fault that persists comes back at the next poll."""
        self._latched = None
        self._power_released = False

    def tolerate(self, cause: TripCause | None) -> None:
        """Let one limit switch forbid nothing, and drop it if latched; None ends that."""
        self._tolerated = cause
        if self._latched is not None and self._latched.cause is cause:
            self._latched = None

    @property
    def last_beat_s(self) -> float:
        """When the heartbeat last changed its line, as of `time.monotonic`."""
        return self._beaten_s

    def beat_late_since(self, from_s: float) -> bool:
        """Return whether a relay may have opened since a `time.monotonic`: a beat came late, or is late now."""
        return self._late_beat_s >= from_s or time.monotonic() - self._beaten_s > self._relay_s

    @contextmanager
    def withholding(self, *, polls: bool = False, beats: bool = False) -> Iterator[None]:
        """Neither poll nor beat by itself for a while, as chosen: whether the drive goes off then is being tried."""
        with self._polling:
            self._withholds_polls, self._withholds_beats = polls, beats
        try:
            yield
        finally:
            # A beat that comes now is late by intention.
            self._moved_at_beat = False
            self._withholds_polls = self._withholds_beats = False

    def close(self) -> None:
        """End the threads. Safe to call twice."""
        self._ended.set()
        self._fast.set()
        for thread in self._threads:
            if thread.is_alive():
                thread.join()

    def watch_drive(self) -> None:
        """Poll once, and wait for the next poll: a step of the first of the monitor's threads."""
        self._polled_s = time.monotonic()
        if self._guard_is_blind or self._withholds_polls:
            self._ended.wait(self._interval_s)
            return
        self.poll()
        if self._fast.is_set() and self._sync.moving:
            self._ended.wait(_FAST_POLL_S)
        else:
            self._fast.clear()
            self._fast.wait(self._interval_s)

    def watch_power(self) -> None:
        """Beat while the guard sees, the drive is heard and is polled; else release its power: a step of the second."""
        blind = self._guard_blind()
        self._guard_is_blind = blind is not None
        if blind is not None:
            self.latch(blind)
        now_s = time.monotonic()
        if now_s - self._polled_s > _LATE_POLLS * self._interval_s:
            moved, tolerated = self._moving_and_tolerated()
            self._look_at_switches(tolerated, moved=moved)
        self._release_power_if_late(now_s)
        unheard = self._link.unheard_s > self._silence_s or now_s - self._polled_s > self._unpolled_s
        if not unheard:
            self._unheard_seen_s = None
            self._power_released = self._power_released and self._drive_on
        elif self._unheard_seen_s is None:
            self._unheard_seen_s = now_s
        elif now_s - self._unheard_seen_s >= _UNHEARD_GRACE_S:
            silence = f"the drive on {self._link.port} was not heard for {self._silence_s:g} s"
            released = f"{silence}, so that its enable and the heartbeat were taken away"
            self._release_power(Trip(TripCause.DRIVE_FAULT, released))
        if not (blind or unheard or self._power_released or self._withholds_beats):
            self._beat(now_s)
        self._ended.wait(min(_MAX_POWER_CHECK_S, self._beat_s / 2))

    def _run(self, cycle: Callable[[], None]) -> None:
        try:
            while not self._ended.is_set():
                cycle()
        except Exception as error:
            # Nothing is monitored any more: stop, and let the drive's own silence timeout end the rest.
            self.latch(Trip(TripCause.WATCHDOG, f"the drive's monitor failed ({type(error).__name__}: {error})"))
            raise

    def _look_at_switches(self, tolerated: TripCause | None, *, moved: bool) -> Trip | None:
        if (pressed := self._poll_switches(tolerated)) is not None:
            self._report(self._latched or pressed, moved=moved)
        return pressed

    def _moving_and_tolerated(self) -> tuple[bool, TripCause | None]:
        # Taken apart, the end of a motion off a switch would look like a motion onto it.
        with self._ending:
            return self._sync.moving, self._tolerated

    def _release_power_if_late(self, now_s: float) -> None:
        late_s = now_s - self._beaten_s
        watched = self._lines.has_heartbeat and self._drive_on and not self._withholds_beats
        if not (watched and self._moved_at_beat) or late_s < self._relay_s:
            return
        self._moved_at_beat = False
        beat = f"the heartbeat came {late_s:.2f} s late while the stage moved, because this computer stood still"
        self._release_power(Trip(TripCause.WATCHDOG, f"{beat}: end other programs, then reset"))

    def _release_power(self, why: Trip) -> None:
        if self._power_released:
            return
        self._power_released = True
        # With a card that does not answer there is no heartbeat either.
        with suppress(DeviceError):
            self._lines.set_enable(False)
        if self._drive_on:
            self.latch(why)

    def _beat(self, now_s: float) -> None:
        if now_s - self._beaten_s < self._beat_s / 2 or not self._may_beat():
            return
        self._late_beat_s = now_s if now_s - self._beaten_s > self._relay_s else self._late_beat_s
        self._beaten_s = now_s
        self._moved_at_beat = self._sync.moving
        try:
            self._lines.toggle_heartbeat()
        except DeviceError as error:
            self.latch(Trip(TripCause.CARD_FAULT, reason_of(error)))

    def _guard_blind(self) -> Trip | None:
        """Return why the guard does not see the motion: the program hangs, or the samples that it has are stale."""
        if not (self._sync.moving and self._sync.armed and self._sync.first_sample is not None):
            self._sampled_motion_since_s = None
            return None
        now_s = time.monotonic()
        if self._sampled_motion_since_s is None:
            self._sampled_motion_since_s = now_s
        moved_s = now_s - self._sampled_motion_since_s
        if min(self._watchdog.unfed_s, moved_s) > self._hang_s:
            return Trip(TripCause.WATCHDOG, f"the program did not read its data for {self._hang_s:g} s while it moved")
        unseen_s = min(now_s - self._sync.newest_seen_s, moved_s)
        if unseen_s > self._stale_s:
            return Trip(
                TripCause.STALE_DATA,
                f"no fresh sample reached the guard for {unseen_s:.2f} s while the stage moved (guard.stale_data_s)",
            )
        return None

    def _report(self, trip: Trip | None, *, moved: bool) -> None:
        self._fault = trip
        if not moved or trip is None:
            self._stop_sent = self._stop_sent and moved
            if self._drive_on and trip is not None and trip.cause is TripCause.EMERGENCY_STOP:
                # Pressed and released between two motions: whoever pressed it may still have a hand at the rig.
                self._latched = self._latched or trip
            return
        # The engine may ask why the stage stopped after the cause is gone.
        self._latched = self._latched or trip
        if not self._stop_sent:
            # Once a motion, because a stop feeds the drive's silence timeout too.
            self._stop_sent = True
            self._stop()

    def _poll_switches(self, tolerated: TripCause | None) -> Trip | None:
        try:
            return self._lines.read_switches().trip(ignoring=tolerated)
        except DeviceError as error:
            # Switches that cannot be read count as pressed.
            return Trip(TripCause.CARD_FAULT, reason_of(error))

    def _poll_drive(self) -> Trip | None:
        try:
            return self._poll_drive_status()
        except DeviceError as error:
            return Trip(TripCause.DRIVE_FAULT, reason_of(error))
