"""The monitor thread: polls drive and switches, and keeps drive and heartbeat relay alive while the program is well.

A drive that receives nothing for `hardware.drive.silence_s` stops by itself, and so does one whose heartbeat relay sees
no edge. Both signals come from this thread, so that neither outlives the program; and both end when the program no
longer reads its data (`Watchdog`), so that a hung program does not keep the stage moving.
"""

import threading
import time
from collections.abc import Callable

from dragrig.config.errors import DeviceError, reason_of
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import Trip, TripCause
from dragrig.rig.hardware.lines import DigitalLines, SwitchStates
from dragrig.rig.hardware.sync import MotionSamplingSync


class Watchdog:
    """Remembers when it was fed last; whoever reads the data feeds it, the monitor's thread looks.

    Its time is the wall's, whatever clock the rig lives by: a hung program is a matter of this computer.
    """

    def __init__(self) -> None:
        self._fed_s = time.monotonic()

    def feed(self) -> None:
        """Say that the program is well. Costs nothing and waits for nobody."""
        self._fed_s = time.monotonic()

    @property
    def unfed_s(self) -> float:
        """Seconds since it was fed."""
        return time.monotonic() - self._fed_s


_FAST_POLL_S = 0.005
_POLLS_PER_SILENCE = 4


def poll_interval_s(settings: RigSettings) -> float:
    """Return the time between two looks: half a block's, or less where silence timeout or heartbeat are shorter."""
    # Half, so that a look with its questions over the link is done within a block.
    look_s = settings.sampling.block_s / 2
    wired = settings.hardware.card.lines
    heartbeat_s = wired.heartbeat_s if wired.heartbeat else look_s
    return min(look_s, settings.hardware.drive.silence_s / _POLLS_PER_SILENCE, heartbeat_s)


class Monitor:
    """The one owner of what forbids motion. `fault` may be asked for by anybody and waits for nobody.

    Parameters
    ----------
    ask
        Asks the drive how it is, which feeds it; returns what it reports, None when nothing. Raises `DeviceError`.
    stop
        Stops the stage; must return at once.
    hang_s
        How long the deadman may go unfed while a sampled motion is under way.
    interval_s
        Time between two looks, of the wall's clock.
    """

    def __init__(
        self,
        ask: Callable[[], Trip | None],
        stop: Callable[[], None],
        lines: DigitalLines,
        coupling: MotionSamplingSync,
        deadman: Watchdog,
        hang_s: float,
        interval_s: float,
    ) -> None:
        self._ask, self._stop = ask, stop
        self._lines, self._coupling, self._deadman = lines, coupling, deadman
        self._hang_s, self._interval_s = hang_s, interval_s
        # One look at a time; re-entrant is not needed, for no look leads to another.
        self._looking = threading.Lock()
        self._sampled_since_s: float | None = None
        self._fault: Trip | None = None
        self._latched: Trip | None = None
        self._pressed = SwitchStates()
        self._tolerated: TripCause | None = None
        self._has_stopped = self._is_on = False
        self._ended = threading.Event()
        self._hurried = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="drive monitor", daemon=True)

    @property
    def fault(self) -> Trip | None:
        """What forbade motion at the last look; what has stopped a motion stays until `clear`."""
        return self._fault

    @property
    def pressed(self) -> SwitchStates:
        """Which switches were pressed at the last look."""
        return self._pressed

    def start(self) -> None:
        """Look once, then go on looking from the monitor's own thread."""
        self.look()
        self._thread.start()

    def look(self) -> Trip | None:
        """Look at switches and drive now, and return what forbids motion."""
        with self._looking:
            return self._look()

    def hurry(self) -> None:
        """Look every few milliseconds until nothing moves any more."""
        self._hurried.set()

    def switched(self, on: bool) -> None:
        """Say whether the drive is meant to be on: then an emergency stop stays until `clear`, even at a standstill."""
        self._is_on = on

    def latch(self, trip: Trip) -> None:
        """Keep a fault until `clear`, and stop what moves; the first one stands."""
        self._latched = self._latched or trip
        self._report(self._latched, moved=self._coupling.moving)

    def clear(self) -> None:
        """Forget what was latched; what is still wrong comes back at the next look."""
        self._latched = None

    def tolerate(self, cause: TripCause | None) -> None:
        """Let one limit switch forbid nothing, whatever it has done; None ends that."""
        self._tolerated = cause
        if self._latched is not None and self._latched.cause is cause:
            self._latched = None

    def close(self) -> None:
        """End the thread. Twice is once."""
        self._ended.set()
        self._hurried.set()
        if self._thread.is_alive():
            self._thread.join()

    def _watch(self) -> None:
        try:
            while not self._ended.is_set():
                self._go_round()
        except Exception as error:
            # A monitor that is gone watches nothing: stop, and let the drive's own silence timeout end the rest.
            self.latch(Trip(TripCause.WATCHDOG, f"the drive's monitor failed ({type(error).__name__}: {error})"))
            raise

    def _go_round(self) -> None:
        if self._is_hung():
            self.latch(
                Trip(TripCause.WATCHDOG, f"the program did not look at its data for {self._hang_s:g} s while it moved")
            )
            self._ended.wait(self._interval_s)
            return
        self._lines_beat()
        self.look()
        if self._hurried.is_set() and self._coupling.moving:
            self._ended.wait(_FAST_POLL_S)
        else:
            self._hurried.clear()
            self._hurried.wait(self._interval_s)

    def _is_hung(self) -> bool:
        if not (self._coupling.moving and self._coupling.armed and self._coupling.first_sample is not None):
            self._sampled_since_s = None
            return False
        now_s = time.monotonic()
        self._sampled_since_s = now_s if self._sampled_since_s is None else self._sampled_since_s
        return min(self._deadman.unfed_s, now_s - self._sampled_since_s) > self._hang_s

    def _look(self) -> Trip | None:
        # Asked before the drive answers, which may have stopped by itself already: the program's own stop follows.
        moved = self._coupling.moving
        by_lines = self._ask_lines()
        if by_lines is not None:
            self._report(self._latched or by_lines, moved=moved)
        by_drive = self._ask_drive()
        if by_drive is not None and by_lines is None:
            # Pressed between the two, a switch tells its own story better than the drive that it has stopped.
            by_lines = self._ask_lines()
        self._report(self._latched or by_lines or by_drive, moved=moved)
        return self._fault

    def _report(self, trip: Trip | None, *, moved: bool) -> None:
        self._fault = trip
        if not moved or trip is None:
            self._has_stopped = self._has_stopped and moved
            if self._is_on and trip is not None and trip.cause is TripCause.EMERGENCY_STOP:
                # Pressed and let go between two motions: whoever pressed it may still have a hand at the rig.
                self._latched = self._latched or trip
            return
        # Whoever asks why the stage stopped may ask after the cause is gone.
        self._latched = self._latched or trip
        if not self._has_stopped:
            # Once for a motion, for a stop feeds the drive too.
            self._has_stopped = True
            self._stop()

    def _lines_beat(self) -> None:
        try:
            self._lines.beat()
        except DeviceError as error:
            self.latch(Trip(TripCause.CARD_FAULT, reason_of(error)))

    def _ask_lines(self) -> Trip | None:
        try:
            self._pressed = self._lines.pressed()
        except DeviceError as error:
            # Switches that nobody can read count as pressed.
            return Trip(TripCause.CARD_FAULT, reason_of(error))
        return self._pressed.trip(but=self._tolerated)

    def _ask_drive(self) -> Trip | None:
        try:
            return self._ask()
        except DeviceError as error:
            return Trip(TripCause.DRIVE_FAULT, reason_of(error))
