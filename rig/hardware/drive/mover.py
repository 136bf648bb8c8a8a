"""One motion of the drive in position mode: its strokes, each sent at its time by a thread of the motion's own."""

import threading
import time
from collections.abc import Callable, Sequence

from dragrig.config.errors import DeviceError
from dragrig.rig.devices import Clock
from dragrig.rig.hardware.coupling import Coupling
from dragrig.rig.hardware.dialects.base import Command, Parameter, Refusal, Request
from dragrig.rig.hardware.drive.link import DriveLink, RefusedError, StoppedFirstError
from dragrig.rig.hardware.drive.movement import Movement
from dragrig.rig.hardware.drive.strokes import Stroke

_RESERVED_ROUND_TRIPS = 3
_SETTLING_S = 0.5


class Strokes(Movement):
    """Strokes from one absolute position.

    Parameters
    ----------
    as_of
        As of `Movement`.
    round_trip_s
        Time between a request and its reply, in the rig's time: a request takes half of it to the drive.
    failed
        Called from the motion's thread with what the drive did not take.
    over
        Called once no stroke is left to be sent.
    """

    def __init__(
        self,
        strokes: Sequence[Stroke],
        origin_mm: float,
        link: DriveLink,
        as_of: int,
        coupling: Coupling,
        clock: Clock,
        round_trip_s: float,
        failed: Callable[[DeviceError], None],
        over: Callable[["Strokes"], None],
    ) -> None:
        super().__init__(link, as_of)
        self._strokes, self._origin_mm = strokes, origin_mm
        self._coupling, self._clock = coupling, clock
        self._round_trip_s = round_trip_s
        self._failed, self._over = failed, over
        self._cancel = threading.Event()
        self._uncertainty_s = 0.0
        self._first_uncertainty_s = 0.0
        self._sent = 0
        self._tried = False
        self._set: tuple[float, float] | None = None

    @property
    def start_uncertainty_s(self) -> float:
        """How far any stroke's start may be off its time, as measured, in the rig's time."""
        return self._first_uncertainty_s + self._uncertainty_s

    @property
    def has_tried(self) -> bool:
        """Whether the drive may have heard of it."""
        return self._tried

    @property
    def direction(self) -> float:
        """Which way the latest stroke goes; 0 before the first."""
        if not self._sent:
            return 0.0
        before_mm = self._strokes[self._sent - 2].end_mm if self._sent > 1 else 0.0
        return 1.0 if self._strokes[self._sent - 1].end_mm > before_mm else -1.0

    def set_out(self, parameters: tuple[float, float]) -> None:
        """Start the thread. `parameters` are the speed and acceleration that the drive holds already."""
        self._set = parameters
        threading.Thread(target=self._send_all, name="drive motion", daemon=True).start()

    def cancel(self) -> None:
        """Send nothing more."""
        self._cancel.set()

    def _send_all(self) -> None:
        try:
            began_s = self._await_start()
            if began_s is not None:
                for stroke in self._strokes:
                    self._send(stroke, began_s)
        except StoppedFirstError:
            # Nothing is to be sent any more, and whoever stopped knows why.
            return
        except DeviceError as error:
            self._failed(error)
        finally:
            self.complete()
            self._over(self)

    def _await_start(self) -> float | None:
        if not self._coupling.armed:
            return self._clock.monotonic()
        first = self._coupling.await_first_sample(self._cancel)
        if first is None:
            return None
        self._first_uncertainty_s = first.uncertainty_s
        return first.at_s

    def _send(self, stroke: Stroke, began_s: float) -> None:
        due_s = began_s + stroke.start_s
        if self._set != (stroke.speed_mm_s, stroke.acceleration_mm_s2):
            self._prepare(stroke)
        # Close to the start the line is kept free, or the monitor's question would delay it by a round trip.
        self._sleep_until(due_s - _RESERVED_ROUND_TRIPS * self._round_trip_s)
        with self._link.reserved():
            self._sleep_until(due_s - self._round_trip_s / 2)
            self._tried = True
            sent_s = self._clock.monotonic()
            self._go(stroke)
            replied_s = self._clock.monotonic()
        if not self._coupling.armed and not self._sent:
            due_s = (sent_s + replied_s) / 2
        off_s = abs((sent_s + replied_s) / 2 - due_s) + (replied_s - sent_s) / 2
        self._uncertainty_s = max(self._uncertainty_s, off_s)
        self._sent += 1
        self.begun()
        if self._sent == len(self._strokes):
            self.complete()
        self._sleep_until(began_s + stroke.ends_s)

    def _prepare(self, stroke: Stroke) -> None:
        # Not while it moves: some drives apply a new speed to the stroke under way.
        self._await_standstill()
        self._link.set(Parameter.SPEED_MM_S, stroke.speed_mm_s)
        self._link.set(Parameter.ACCELERATION_MM_S2, stroke.acceleration_mm_s2)
        self._set = (stroke.speed_mm_s, stroke.acceleration_mm_s2)

    def _go(self, stroke: Stroke) -> None:
        request = Request(Command.GO, value=self._origin_mm + stroke.end_mm)
        try:
            self._link.exchange(request, self._as_of)
        except RefusedError as error:
            # Refused is not done, so that it may be sent again once the stroke before has ended.
            if error.refusal is not Refusal.MOVING or not self._sent:
                raise
            self._await_standstill()
            self._link.exchange(request, self._as_of)

    def _await_standstill(self) -> None:
        until_s = time.monotonic() + _SETTLING_S
        while time.monotonic() < until_s:
            status = self._link.exchange(Request(Command.STATUS), self._as_of).status
            if status is not None and not status.moving:
                return

    def _sleep_until(self, due_s: float) -> None:
        if not self._clock.sleep(due_s - self._clock.monotonic(), self._cancel):
            raise StoppedFirstError("the stage was stopped before the motion was over.")
