"""The drive's double: understands frames of any dialect, moves the bench's carriage and refuses as a drive does.

It observes by itself, as a drive does, independent of the program: soft limits, thrust limit, limit switches,
e-stop, enable line, and the silence timeout, which runs in wall time. It remembers why its last motion ended. Without
enable line or power, which the heartbeat relay takes, the motor has no current, and friction stops the carriage.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Mapping
from typing import Self

import numpy as np

from dragrig.rig import Phase, stationary_piece, trapezoid
from dragrig.rig.hardware.dialects import (
    Command,
    Halt,
    Parameter,
    Refusal,
    Reply,
    Request,
    Status,
    find_dialect,
)
from dragrig.sim_backend.doubles.drive_sides import find_drive_side
from dragrig.sim_backend.doubles.simulated_bench import INDEX_POSITION_MM, SWITCH_OFFSET_MM, SimulatedBench

SWITCH_OVERTRAVEL_MM = 1.0
"""How far beyond the limit switch it goes at most."""
HOMING_ACCELERATION_MM_S2 = 500.0
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
"""What a drive holds before it is set up; a silence timeout of 0 is none."""
RATED_THRUST_N = 100.0
"""A drive limits a thrust limit beyond its rating to its rating, without an error."""
_WATCH_MOVING_S = 0.002
_DEFAULT_ALARM = 1
_G_MM_S2_PER_N = 1e6


class DriveDouble:
    """A drive with its stage. Any thread may call any method; as a context manager it polls its inputs by itself.

    It speaks the dialect that the rig's settings name, in their units and as their station. Raises `SettingsError` when
    that dialect is not known, or brings no drive's side.
    """

    _watch_at_rest_s = 0.01

    def __init__(self, bench: SimulatedBench) -> None:
        self.bench = bench
        drive = bench.rig.hardware.drive
        self._dialect = find_dialect(drive.dialect)
        self._side = find_drive_side(self._dialect, drive)
        self._lines = bench.rig.hardware.card.lines
        self._lock = threading.RLock()
        self._ended = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="drive double", daemon=True)
        self._received_s = time.monotonic()
        self._parameters = dict(FACTORY_PARAMETERS)
        self._zero_mm = bench.position_mm()
        self._enabled = self._homed = False
        self._alarm = 0
        self._halt = Halt.NONE
        self._direction = 0.0
        self._homing = self._seeks_switch = False
        self._requests: deque[Request] = deque(maxlen=1000)
        self._load = np.random.default_rng(bench.rig.simulated.seed)

    def __enter__(self) -> Self:
        self._watcher.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._watcher.join()

    @property
    def status(self) -> Status:
        """Its report."""
        with self._lock:
            moving = self._moving()
            halt = Halt.NONE if moving else self._halt
            return Status(self._enabled, self._homed, moving, self._alarm, halt)

    @property
    def requests(self) -> tuple[Request, ...]:
        """The latest requests that change something, in the order in which they came."""
        with self._lock:
            return tuple(self._requests)

    def parameter(self, parameter: Parameter) -> float:
        """Return the settings."""
        return self._parameters[parameter]

    def frame_length(self, received: bytes) -> int:
        """Length of the first whole frame among the bytes received so far; 0 while there is none."""
        return self._side.frame_length(received)

    def answer(self, frame: bytes) -> bytes:
        """Carry out a frame and return the reply; nothing for a damaged frame or another station's."""
        with self._lock:
            return self._side.answer(frame, self.act)

    def reply_due_s(self) -> float:
        """Return the reading of `time.monotonic` at which a reply that is made now reaches the program."""
        faults = self.bench.faults.active
        return time.monotonic() + faults.drive_reply_late_s + faults.drive_reply_load_s * self._load.random() ** 2

    def act(self, request: Request) -> Reply:
        """Carry out a request, which feeds the silence timeout."""
        with self._lock:
            self._received_s = time.monotonic()
            self.poll()
            return self._carry_out(request)

    def poll(self) -> None:
        """Read lines, alarm and silence once, and continue homing."""
        with self._lock:
            if (text := self.bench.faults.active.drive_alarm) and not self._alarm:
                self._raise_alarm(text)
            if self._enabled and not (self.bench.powered and self.bench.enabled):
                self._end(Halt.DISABLED)
                self._enabled = False
            self._supervise()

    def _supervise(self) -> None:
        """Look for the causes that end a motion while the drive has power."""
        if not self.bench.moving:
            if not self.bench.faults.active.carriage_blocked:
                self._continue_homing()
        elif not self._line(self._lines.e_stop):
            self._end(Halt.EMERGENCY_STOP)
        elif self._is_blocked(self._direction):
            # Looked at once: it may come onto the switch between two looks, which homing must not take for a fault.
            if self._seeks_switch:
                self.bench.brake(self._parameters[Parameter.STOP_ACCELERATION_MM_S2])
            else:
                self._end(Halt.LIMIT_SWITCH)
        elif self._hears_nothing():
            self._end(Halt.SILENCE)

    def _watch(self) -> None:
        # At rest every request polls as well.
        while not self._ended.wait(_WATCH_MOVING_S if self._moving() else self._watch_at_rest_s):
            self.poll()

    def _carry_out(self, request: Request) -> Reply:
        command, parameter, value = request.command, request.parameter, request.value
        if command is Command.STATUS:
            return Reply(status=self.status)
        if command is Command.POSITION:
            return Reply(value=self.bench.position_mm() - self._zero_mm)
        if command is Command.READ and parameter is not None:
            return Reply(self._parameters[parameter])
        self._requests.append(request)
        return Reply(refusal=self._change(command, parameter, value or 0.0))

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
        if not (self.bench.powered and self.bench.enabled):
            return Refusal.DISABLED
        self._enabled = True
        return None

    def _unready(self) -> Refusal | None:
        return _first_refusal(
            (bool(self._alarm), Refusal.ALARM),
            (not self._enabled, Refusal.DISABLED),
            (not self._line(self._lines.e_stop), Refusal.EMERGENCY_STOP),
            (self._moving(), Refusal.MOVING),
        )

    def _go(self, target_mm: float) -> Refusal | None:
        lowest, highest = self._parameters[Parameter.LOWEST_MM], self._parameters[Parameter.HIGHEST_MM]
        speed, accel = self._parameters[Parameter.SPEED_MM_S], self._parameters[Parameter.ACCELERATION_MM_S2]
        travel_mm = self._zero_mm + target_mm - self.bench.position_mm()
        if refused := self._unready() or _first_refusal(
            (not self._homed, Refusal.NOT_HOMED),
            (not lowest <= target_mm <= highest, Refusal.SOFT_LIMIT),
            (min(speed, accel) <= 0, Refusal.BAD_VALUE),
            (self._is_blocked(travel_mm), Refusal.LIMIT_SWITCH),
        ):
            return refused
        if (
            self.bench.rig.simulated.motor.moving_mass_g * accel
            > self._parameters[Parameter.THRUST_LIMIT_N] * _G_MM_S2_PER_N
        ):
            self._raise_alarm("overload of the motor")
            return None
        self._follow(travel_mm, speed, accel)
        return None

    def _home(self, direction: float) -> Refusal | None:
        if refused := self._unready():
            return refused
        if self._parameters[Parameter.HOMING_SPEED_MM_S] <= 0:
            return Refusal.BAD_VALUE
        direction = -direction if self.bench.faults.active.homing_reversed else direction
        self._homed, self._homing, self._seeks_switch = False, True, True
        stage = self.bench.rig.stage
        limit_mm = stage.lowest_mm if direction < 0 else stage.highest_mm
        self._home_to(limit_mm + math.copysign(SWITCH_OFFSET_MM + SWITCH_OVERTRAVEL_MM, direction))
        return None

    def _continue_homing(self) -> None:
        """Go from the switch to the index pulse, or end there."""
        if self._seeks_switch:
            self._seeks_switch = False
            stage = self.bench.rig.stage
            self._home_to(min(max(INDEX_POSITION_MM, stage.lowest_mm), stage.highest_mm))
        elif self._homing:
            self._homing = False
            self._zero_mm, self._homed = INDEX_POSITION_MM, True

    def _home_to(self, position_mm: float) -> None:
        travel_mm = position_mm - self.bench.position_mm()
        self._follow(travel_mm, self._parameters[Parameter.HOMING_SPEED_MM_S], HOMING_ACCELERATION_MM_S2)

    def _follow(self, travel_mm: float, speed_mm_s: float, acceleration_mm_s2: float) -> None:
        self._halt, self._direction = Halt.TARGET, travel_mm
        late_s = self.bench.faults.active.drive_starts_late_s
        late = [stationary_piece(late_s, Phase.REST)] if late_s else []
        self.bench.follow([*late, *trapezoid(travel_mm, speed_mm_s, acceleration_mm_s2)])

    def _end(self, why: Halt) -> None:
        if self._moving() and self._halt is Halt.TARGET:
            self._halt = why
            self._homing = self._seeks_switch = False
            self.bench.brake(self._deceleration_mm_s2(why))

    def _deceleration_mm_s2(self, why: Halt) -> float:
        """Without current, friction alone stops the carriage."""
        if why is not Halt.DISABLED:
            return self._parameters[Parameter.STOP_ACCELERATION_MM_S2]
        motor = self.bench.rig.simulated.motor
        return 1000.0 * motor.coulomb_mN / motor.moving_mass_g

    def _hears_nothing(self) -> bool:
        unwatched, limit_s = self.bench.faults.active.drive_unwatched, self._parameters[Parameter.SILENCE_S]
        return not unwatched and 0 < limit_s < time.monotonic() - self._received_s

    def _raise_alarm(self, text: str) -> None:
        codes = [code for code in range(1, 256) if self._dialect.alarm(code) == text]
        self._alarm = codes[0] if codes else _DEFAULT_ALARM
        self._end(Halt.ALARM)
        self._enabled = False

    def _moving(self) -> bool:
        return self.bench.moving or self._homing

    def _is_blocked(self, direction: float) -> bool:
        switch = self._lines.limit_low if direction < 0 else self._lines.limit_high
        return direction != 0 and not self._line(switch)

    def _line(self, line: str) -> bool:
        return not line or self.bench.read_line(line)


def _first_refusal(*conditions: tuple[bool, Refusal]) -> Refusal | None:
    return next((why for refused, why in conditions if refused), None)


def make_drive_double(bench: SimulatedBench) -> DriveDouble:
    """Return the double of the drive in the mode that the rig's settings name."""
    kind = VelocityDriveDouble if bench.rig.hardware.drive.mode == "velocity" else DriveDouble
    return kind(bench)


class VelocityDriveDouble(DriveDouble):
    """A drive whose speed is its voltage; it knows neither position commands nor a stop.

    E-stop, alarm and silence brake it and switch it off.
    """

    _watch_at_rest_s = 0.005  # a voltage moves it without a request

    def _supervise(self) -> None:
        if self._enabled and not self._line(self._lines.e_stop):
            self._end(Halt.EMERGENCY_STOP)
        elif self._enabled and self.bench.moving and self._hears_nothing():
            self._end(Halt.SILENCE)

    def _enable(self) -> Refusal | None:
        refused = super()._enable()
        self.bench.obey_voltage(self._enabled)
        return refused

    def _change(self, command: Command, parameter: Parameter | None, value: float) -> Refusal | None:
        unknown = command in {Command.GO, Command.HOME}
        return Refusal.UNKNOWN if unknown else super()._change(command, parameter, value)

    def _end(self, why: Halt) -> None:
        if why is Halt.STOP:
            return
        self._halt = why if self.bench.moving else self._halt
        self._enabled = False
        self.bench.obey_voltage(False)
        self.bench.brake(self._deceleration_mm_s2(why))
