"""The drive's double: decodes frames of any dialect, moves the bench's carriage and refuses what a drive refuses.

It observes what a drive observes by itself, whatever the program does: soft limits, thrust limit, limit switches,
e-stop, enable line, and the silence timeout, which runs in wall time. It remembers why its last motion ended.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Mapping
from types import TracebackType
from typing import Self

from dragrig.rig.hardware.dialects.base import (
    Command,
    Dialect,
    FrameError,
    Halt,
    Parameter,
    Refusal,
    Reply,
    Request,
    Status,
)
from dragrig.rig.profile import trapezoid
from dragrig.sim_backend.doubles.simulated_bench import INDEX_POSITION_MM, SWITCH_OFFSET_MM, SimulatedBench

SWITCH_OVERTRAVEL_MM = 1.0
"""How far beyond the limit switch it goes at most."""
HOMING_ACCELERATION_MM_S2 = 500.0


class DriveHoming:
    """One search, leg by leg; owned by the drive's double.

    Parameters
    ----------
    towards
        −1 for the lower switch, +1 for the upper one.
    """

    def __init__(self, bench: SimulatedBench, towards: float, speed_mm_s: float) -> None:
        self._bench = bench
        self._speed_mm_s = speed_mm_s
        self._to_switch = math.copysign(1.0, towards)
        self.seeks_switch = True
        """Whether it is on its first leg."""

    @property
    def towards(self) -> float:
        """Which way it goes at present."""
        return self._to_switch if self.seeks_switch else -self._to_switch

    def begin(self) -> None:
        """Set out for the switch."""
        stage = self._bench.rig.stage
        switch_mm = stage.lowest_mm - SWITCH_OFFSET_MM if self._to_switch < 0 else stage.highest_mm + SWITCH_OFFSET_MM
        self._go(switch_mm + self._to_switch * SWITCH_OVERTRAVEL_MM)

    def go_on(self) -> bool:
        """Begin the next leg; False when there is none, for the carriage stands on the index."""
        if not self.seeks_switch:
            return False
        self.seeks_switch = False
        stage = self._bench.rig.stage
        self._go(min(max(INDEX_POSITION_MM, stage.lowest_mm), stage.highest_mm))
        return True

    def _go(self, to_mm: float) -> None:
        travel_mm = to_mm - self._bench.position_mm()
        self._bench.follow(trapezoid(travel_mm, self._speed_mm_s, HOMING_ACCELERATION_MM_S2))


FACTORY_PARAMETERS: Mapping[Parameter, float] = {
    Parameter.THRUST_LIMIT_N: 50.0,
    Parameter.LOWEST_MM: -1000.0,
    Parameter.HIGHEST_MM: 1000.0,
    Parameter.SPEED_MM_S: 0.0,
    Parameter.ACCELERATION_MM_S2: 0.0,
    Parameter.STOP_ACCELERATION_MM_S2: 1000.0,
    Parameter.HOMING_SPEED_MM_S: 0.0,
    Parameter.SILENCE_S: 0.0,
}
"""What a drive holds before anybody sets it; a silence timeout of 0 is none."""
RATED_THRUST_N = 100.0
"""A drive keeps a thrust limit beyond its rating at its rating, and says nothing."""
_WATCH_INTERVAL_S = 0.002
_DEFAULT_ALARM = 1
_G_MM_S2_PER_N = 1e6  # g mm/s²


class DriveDouble:
    """A drive with its stage. Any thread may call anything; as a context manager it also watches by itself."""

    def __init__(self, bench: SimulatedBench, dialect: Dialect, station: int = 1) -> None:
        self.bench = bench
        self.dialect = dialect
        self._station = station
        self._lines = bench.rig.hardware.card.lines
        self._lock = threading.RLock()
        self._ended = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="drive double", daemon=True)
        self._heard_s = time.monotonic()
        self._parameters = dict(FACTORY_PARAMETERS)
        self._zero_mm = bench.position_mm()
        self._enabled = self._homed = False
        self._alarm = 0
        self._halt = Halt.NONE
        self._homing: DriveHoming | None = None
        self._towards = 0.0
        self._heard: deque[Request] = deque(maxlen=1000)

    def __enter__(self) -> Self:
        self._watcher.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._ended.set()
        self._watcher.join()

    @property
    def status(self) -> Status:
        """What it says of itself."""
        with self._lock:
            moving = self._moving()
            halt = Halt.NONE if moving else self._halt
            return Status(self._enabled, self._homed, moving, self._alarm, halt)

    @property
    def heard(self) -> tuple[Request, ...]:
        """The latest requests that change something, in the order in which they came."""
        with self._lock:
            return tuple(self._heard)

    def parameter(self, parameter: Parameter) -> float:
        """Return what is set."""
        return self._parameters[parameter]

    def hear(self, frame: bytes) -> bytes:
        """Do what a frame says and return the reply; nothing for a frame that is damaged or another station's."""
        try:
            request = self.dialect.decode_request(frame, self._station)
        except FrameError:
            return b""
        with self._lock:
            self._heard_s = time.monotonic()
            self.look()
            reply = self._carry_out(request)
        return self.dialect.encode_reply(reply, self._station)

    def look(self) -> None:
        """Look at lines, alarm and silence once, and go on with homing."""
        with self._lock:
            if (text := self.bench.faults.active.drive_alarm) and not self._alarm:
                self._raise_alarm(text)
            if self._enabled and not self._line(self._lines.enable):
                self._end(Halt.DISABLED)
                self._enabled = False
            if not self.bench.moving:
                self._go_on_homing()
            elif not self._line(self._lines.e_stop):
                self._end(Halt.EMERGENCY_STOP)
            elif self._is_blocked(self._towards if self._homing is None else self._homing.towards):
                self._meet_switch()
            elif 0 < self._parameters[Parameter.SILENCE_S] < time.monotonic() - self._heard_s:
                self._end(Halt.SILENCE)

    def _watch(self) -> None:
        while not self._ended.wait(_WATCH_INTERVAL_S):
            self.look()

    def _carry_out(self, request: Request) -> Reply:
        command, parameter, value = request.command, request.parameter, request.value
        if command is Command.STATUS:
            return Reply(command, status=self.status)
        if command is Command.POSITION:
            return Reply(command, value=self.bench.position_mm() - self._zero_mm)
        if command is Command.READ and parameter is not None:
            return Reply(command, parameter, self._parameters[parameter])
        self._heard.append(request)
        return Reply(command, parameter, refusal=self._change(command, parameter, value or 0.0))

    def _change(self, command: Command, parameter: Parameter | None, value: float) -> Refusal | None:
        if command is Command.SET and parameter is not None:
            return self._set(parameter, value)
        if command is Command.GO:
            return self._go(value)
        if command is Command.HOME:
            return self._home(value)
        if command is Command.ENABLE:
            return self._enable()
        if command is Command.CLEAR_ALARM:
            self._alarm = self._alarm if self.bench.faults.active.drive_alarm else 0
            return None
        self._end(Halt.STOP if command is Command.STOP else Halt.DISABLED)
        self._enabled = self._enabled and command is Command.STOP
        return None

    def _set(self, parameter: Parameter, value: float) -> Refusal | None:
        if value < 0 and parameter not in {Parameter.LOWEST_MM, Parameter.HIGHEST_MM}:
            return Refusal.BAD_VALUE
        self._parameters[parameter] = min(value, RATED_THRUST_N) if parameter is Parameter.THRUST_LIMIT_N else value
        return None

    def _enable(self) -> Refusal | None:
        if self._alarm:
            return Refusal.ALARM
        if not self._line(self._lines.enable):
            return Refusal.DISABLED
        self._enabled = True
        return None

    def _unready(self) -> Refusal | None:
        for refused, why in (
            (self._alarm, Refusal.ALARM),
            (not self._enabled, Refusal.DISABLED),
            (not self._line(self._lines.e_stop), Refusal.EMERGENCY_STOP),
            (self._moving(), Refusal.MOVING),
        ):
            if refused:
                return why
        return None

    def _go(self, target_mm: float) -> Refusal | None:
        lowest, highest = self._parameters[Parameter.LOWEST_MM], self._parameters[Parameter.HIGHEST_MM]
        speed, accel = self._parameters[Parameter.SPEED_MM_S], self._parameters[Parameter.ACCELERATION_MM_S2]
        travel_mm = self._zero_mm + target_mm - self.bench.position_mm()
        if refused := self._unready():
            return refused
        for refusing, why in (
            (not self._homed, Refusal.NOT_HOMED),
            (not lowest <= target_mm <= highest, Refusal.SOFT_LIMIT),
            (min(speed, accel) <= 0, Refusal.BAD_VALUE),
            (self._is_blocked(travel_mm), Refusal.LIMIT_SWITCH),
        ):
            if refusing:
                return why
        if (
            self.bench.rig.simulated.motor.moving_mass_g * accel
            > self._parameters[Parameter.THRUST_LIMIT_N] * _G_MM_S2_PER_N
        ):
            self._raise_alarm("overload of the motor")
            return None
        self._halt, self._towards = Halt.TARGET, travel_mm
        self.bench.follow(trapezoid(travel_mm, speed, accel))
        return None

    def _home(self, towards: float) -> Refusal | None:
        if refused := self._unready():
            return refused
        speed = self._parameters[Parameter.HOMING_SPEED_MM_S]
        if speed <= 0:
            return Refusal.BAD_VALUE
        self._homed, self._halt = False, Halt.TARGET
        self._homing = DriveHoming(self.bench, towards, speed)
        self._homing.begin()
        return None

    def _go_on_homing(self) -> None:
        if self._homing is not None and not self._homing.go_on():
            self._homing = None
            self._zero_mm, self._homed = INDEX_POSITION_MM, True

    def _meet_switch(self) -> None:
        if self._homing is not None and self._homing.seeks_switch:
            self.bench.brake(self._parameters[Parameter.STOP_ACCELERATION_MM_S2])
        else:
            self._end(Halt.LIMIT_SWITCH)

    def _end(self, why: Halt) -> None:
        if self._moving() and self._halt is Halt.TARGET:
            self._halt = why
            self._homing = None
            self.bench.brake(self._parameters[Parameter.STOP_ACCELERATION_MM_S2])

    def _raise_alarm(self, text: str) -> None:
        codes = [code for code in range(1, 256) if self.dialect.alarm(code) == text]
        self._alarm = codes[0] if codes else _DEFAULT_ALARM
        self._end(Halt.ALARM)
        self._enabled = False

    def _moving(self) -> bool:
        return self.bench.moving or self._homing is not None

    def _is_blocked(self, direction: float) -> bool:
        switch = self._lines.limit_low if direction < 0 else self._lines.limit_high
        return direction != 0 and not self._line(switch)

    def _line(self, line: str) -> bool:
        return not line or self.bench.read_line(line)


def make_drive_double(bench: SimulatedBench, dialect: Dialect, station: int = 1) -> DriveDouble:
    """Return the double of the drive in the mode that the rig's settings name."""
    kind = VelocityDriveDouble if bench.rig.hardware.drive.mode == "velocity" else DriveDouble
    return kind(bench, dialect, station)


class VelocityDriveDouble(DriveDouble):
    """A drive whose speed is its voltage. Position commands are unknown to it, and so is a stop.

    Without its enable line or its power, which the heartbeat relay takes, the motor has no current and friction stops
    the carriage; e-stop, alarm and silence brake it and switch the drive off.
    """

    def look(self) -> None:
        """Look at power, lines, alarm and silence once."""
        with self._lock:
            if (text := self.bench.faults.active.drive_alarm) and not self._alarm:
                self._raise_alarm(text)
            if not self._enabled:
                return
            if not (self._line(self._lines.enable) and self.bench.powered):
                self._end(Halt.DISABLED)
            elif not self._line(self._lines.e_stop):
                self._end(Halt.EMERGENCY_STOP)
            elif self.bench.moving and 0 < self._parameters[Parameter.SILENCE_S] < time.monotonic() - self._heard_s:
                self._end(Halt.SILENCE)

    def _enable(self) -> Refusal | None:
        refused = super()._enable()
        if refused is None and not self.bench.powered:
            refused, self._enabled = Refusal.DISABLED, False
        self.bench.obey_voltage(self._enabled)
        return refused

    def _go(self, target_mm: float) -> Refusal | None:
        del target_mm
        return Refusal.UNKNOWN

    def _home(self, towards: float) -> Refusal | None:
        del towards
        return Refusal.UNKNOWN

    def _end(self, why: Halt) -> None:
        if why is Halt.STOP:
            return
        self._halt = why if self.bench.moving else self._halt
        self._enabled = False
        self.bench.obey_voltage(False)
        motor = self.bench.rig.simulated.motor
        friction_mm_s2 = 1000.0 * motor.coulomb_mN / motor.moving_mass_g
        brakes = self._parameters[Parameter.STOP_ACCELERATION_MM_S2]
        self.bench.brake(friction_mm_s2 if why is Halt.DISABLED else brakes)
