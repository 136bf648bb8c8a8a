"""Homing by the program: slowly onto a limit switch, off it again until the counter has seen the index pulse."""

import threading
from collections.abc import Callable

from dragrig.config.errors import DeviceError, SettingsError
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import Clock, Side
from dragrig.rig.hardware.coupling import Coupling
from dragrig.rig.hardware.drive.looping import VelocityLoop
from dragrig.rig.hardware.lines import Lines
from dragrig.rig.profile import MotionProfile, trapezoid

_FAR_MM = 10_000.0
"""What the counter reads before the index pulse: no stage is so long."""
_BEYOND_LIMITS_MM = 50.0
_ACCELERATION_MM_S2 = 500.0
_LOOK_S = 0.005
_ARRIVED_COUNTS = 3
_ARRIVING_S = 1.0


class Seeker:
    """Finds the index pulse by means of the velocity loop. Whoever calls it holds the stage's commands."""

    def __init__(
        self, loop: VelocityLoop, lines: Lines, settings: RigSettings, coupling: Coupling, clock: Clock
    ) -> None:
        self._loop, self._lines, self._coupling, self._clock = loop, lines, coupling, clock
        self._stage, self._drive = settings.stage, settings.hardware.drive
        self._wired = settings.hardware.card
        self._arrived_mm = _ARRIVED_COUNTS * settings.encoder.resolution_um / 1000.0

    def seek(self, mark: int) -> None:
        """Find the index pulse, make it 0, and go to it or to the soft limit next to it.

        Parameters
        ----------
        mark
            What the loop's `stops` was when this was planned: a stop since then ends it at once.

        Raises
        ------
        SettingsError
            When switch or index pulse are not wired.
        DeviceError
            When a stop or a fault came first, or one of the two was not found.
        """
        side = Side(self._drive.homing_direction)
        self._refuse_unwired(side)
        towards = -1.0 if side is Side.LOW else 1.0
        if not self._is_pressed(side):
            mark = self._creep(towards, lambda: self._is_pressed(side), f"the {side} limit switch", mark)
        self._loop.recount(_FAR_MM, index=True)
        mark = self._creep(-towards, lambda: abs(self._loop.look()) < _FAR_MM / 2, "the index pulse", mark)
        position_mm = self._loop.look()
        self._loop.recount(position_mm, index=False)
        target_mm = min(max(0.0, self._stage.lowest_mm), self._stage.highest_mm)
        self._loop.follow(self._way(target_mm - position_mm), position_mm, mark)
        while self._coupling.moving:
            self._loop.look()
            self._clock.sleep(_LOOK_S, threading.Event())
        # A drive with a little offset never quite gets there, and need not: the counter knows where it is.
        until_s = self._clock.monotonic() + _ARRIVING_S
        while abs(self._loop.look() - target_mm) > self._arrived_mm and self._clock.monotonic() < until_s:
            self._clock.sleep(_LOOK_S, threading.Event())
        if self._loop.stops != mark:
            raise DeviceError("homing was stopped: home again.")

    def _creep(self, direction: float, found: Callable[[], bool], what: str, mark: int) -> int:
        travel_mm = self._stage.highest_mm - self._stage.lowest_mm + _BEYOND_LIMITS_MM
        self._loop.follow(self._way(direction * travel_mm), self._loop.look(), mark, closed=False)
        is_found = False
        while self._coupling.moving:
            if not is_found and found():
                is_found = True
                stopped = self._loop.brake()
                if stopped != mark + 1:
                    break
                mark = stopped
            self._loop.look()
            self._clock.sleep(_LOOK_S, threading.Event())
        if not is_found or self._loop.stops != mark:
            raise DeviceError(f"homing ended before {what} was found: see what stopped the stage, then home again.")
        return mark

    def _way(self, travel_mm: float) -> MotionProfile:
        acceleration = min(_ACCELERATION_MM_S2, self._stage.max_accel_mm_s2)
        return MotionProfile.from_pieces(trapezoid(travel_mm, self._drive.homing_speed_mm_s, acceleration))

    def _is_pressed(self, side: Side) -> bool:
        pressed = self._lines.pressed()
        return pressed.limit_low if side is Side.LOW else pressed.limit_high

    def _refuse_unwired(self, side: Side) -> None:
        lines = self._wired.lines
        wired = lines.limit_low if side is Side.LOW else lines.limit_high
        if not (wired and self._wired.encoder.z):
            raise SettingsError(
                f"homing in velocity mode needs the {side} limit switch and the index pulse: name them in "
                f"hardware.card.lines.limit_{side} and hardware.card.encoder.z."
            )
