"""The stage in velocity mode: the drive takes its speed as a voltage, and the position loop is closed here.

The serial link carries no motion: it switches the drive on and off, requests its status, and sets its thrust limit,
soft limits and silence timeout. Homing is done by the program, since a drive in velocity mode takes no position
commands: it creeps onto a limit switch and off it again until the counter has seen the index pulse.
"""

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

from dragrig.config import Calibration, DeviceError, SettingsError
from dragrig.rig import LIMIT_SWITCH_CAUSES, MotionProfile, StageLimits, TravelEnd, TripCause, trapezoid
from dragrig.rig.hardware.card import AO_RANGE_V, Connection, PositionCounter, Scaling, VoltageOutput
from dragrig.rig.hardware.drive.monitor import StageDevices
from dragrig.rig.hardware.drive.stage_base import MonitoredStage, write_safeguards, write_travel
from dragrig.rig.hardware.drive.trial import PULSE_ACCELERATION_MM_S2, PULSE_MM, PULSE_SPEED_MM_S, Pulse
from dragrig.rig.hardware.drive.velocity_loop import VelocityLoop, first_motion_s

_UNREFERENCED_MM = 10_000.0
"""Position of the counter before the index pulse: longer than any stage."""
_HOMING_OVERTRAVEL_MM = 50.0
"""How much longer than between the soft limits the way to a limit switch may be."""
_HOMING_ACCELERATION_MM_S2 = 500.0
_POLL_S = 0.005
_ARRIVAL_COUNTS = 3
_ARRIVAL_TIMEOUT_S = 1.0
_STANDSTILL_TIMEOUT_S = 1.0
_PULSE_SETTLING_S = 0.05
"""Added to the drive's lag, after which it stands at 0 V."""
_MAX_HOLD_ERROR_MM = 0.02


class VelocityModeStage(MonitoredStage):
    """One axis in velocity mode. It monitors drive and switches from its construction until `close`.

    It follows any profile within the stage's limits. The voltage starts with the card's own trigger of the first
    sample, and a loop on the encoder's second counter holds the stage until it is switched off.

    Parameters
    ----------
    connection
        The card that has the output and the counter.
    calibrations
        The calibrations in force, by quantity; the encoder's is used.

    Raises
    ------
    DeviceError
        When drive or card do not answer.
    """

    def __init__(self, devices: StageDevices, connection: Connection, calibrations: Mapping[str, Calibration]) -> None:
        settings = devices.settings
        velocity = settings.hardware.drive.velocity
        super().__init__(devices, settings.hardware.drive.silence_s)
        max_speed_mm_s = min(settings.stage.max_speed_mm_s, AO_RANGE_V * velocity.per_V)
        self.limits = replace(self.limits, speed_mm_s=max_speed_mm_s)
        self._homed = self._keeps_tolerance = False
        mm_per_count = Scaling.from_settings(settings, calibrations).mm_per_count
        self._counter = PositionCounter(connection, velocity.counter, mm_per_count)
        self._output = VoltageOutput(
            connection, velocity.channel, velocity.rate_hz, velocity.ahead * velocity.update_samples
        )
        self._loop = VelocityLoop(
            devices, self._output, self._counter, self._monitor.latch, self._cut_power, self._end_override
        )
        self._counter.begin(0.0)
        self._monitor.start()

    @property
    def start_uncertainty_s(self) -> float:
        """One sample of the voltage where the card's trigger began the last motion; else that of the clocks."""
        return self._loop.start_uncertainty_s

    def enable(self) -> None:
        """Switch the drive on at 0 V and hold the position."""
        with self._commands:
            self._refuse_fault()
            if self._is_enabled:
                return
            self._output.zero()
            self._power_on()
            # A loop whose sense is unknown may run away.
            self._loop.start(closed=not self.trial_due)

    def stop(self) -> None:
        """Brake to a standstill; the voltage goes down as soon as the written voltages are put out."""
        self._sync.set_stop_requested()
        self._loop.brake()

    def close(self) -> None:
        """Stop, and disconnect from drive and card. Safe to call twice."""
        self._loop.brake()
        self._loop.end()
        self._monitor.close()
        self._counter.close()
        self._link.close()

    @property
    def _is_enabled(self) -> bool:
        return self._tracker.status.enabled and self._loop.running

    @property
    def _is_homed(self) -> bool:
        return self._homed

    @property
    def _stop_count(self) -> int:
        return self._loop.stop_count

    def _position_mm(self) -> float:
        return self._loop.position_mm()

    def _drive_position_mm(self, position_mm: float) -> float:
        # What the loop follows is the card's count.
        del position_mm
        return self._tracker.position_mm()

    def _refuse_moving(self) -> None:
        self._loop.position_mm()  # updates whether it still moves
        super()._refuse_moving()

    def _origin_mm(self) -> float:
        # The commanded position, not the measured one: the loop's residual error must not add up, nor count as a limit.
        hold_mm = self._loop.hold_position_mm()
        inside_mm = min(max(hold_mm, self.limits.lowest_mm), self.limits.highest_mm)
        return inside_mm if abs(inside_mm - hold_mm) <= _MAX_HOLD_ERROR_MM else hold_mm

    def _make_pulse(self, planned_at: int) -> Pulse:
        switches, low_first = self._lines.read_switches(), self._drive.homing_direction == "low"
        upward = switches.limit_low or (not low_first and not switches.limit_high)
        travel_mm = PULSE_MM if upward else -PULSE_MM
        speed_mm_s = min(PULSE_SPEED_MM_S, self.limits.speed_mm_s)
        acceleration = min(PULSE_ACCELERATION_MM_S2, self.limits.acceleration_mm_s2)
        profile = MotionProfile.from_pieces(trapezoid(travel_mm, speed_mm_s, acceleration))
        # It may come onto the switch that homing looks for.
        with self._tolerating(self._override or TravelEnd(self._drive.homing_direction)):
            driven_from_mm, counted_from_mm = self._tracker.position_mm(), self._loop.position_mm()
            self._loop.follow(profile, counted_from_mm, planned_at, closed=False)
            self._await_standstill(_STANDSTILL_TIMEOUT_S)
            self._clock.sleep(_PULSE_SETTLING_S + self._drive.velocity.lag_s, threading.Event())
            pulse = Pulse(
                travel_mm, self._tracker.position_mm() - driven_from_mm, self._loop.position_mm() - counted_from_mm
            )
            # A poll that saw it move may read the switches only now.
            self._monitor.poll()
        if not pulse.problem(self._settings):
            self._loop.hold()
        return pulse

    def _find_index(self, side: TravelEnd, planned_at: int) -> None:
        self._homed = False
        with self._tolerating(side):
            try:
                self._search_index(side, planned_at)
            except DeviceError:
                # The fault that stopped the stage explains more than that it stopped.
                self._refuse_fault(LIMIT_SWITCH_CAUSES[side])
                raise
            finally:
                self._loop.brake()
        self._refuse_fault()
        self._homed = True

    def _search_index(self, side: TravelEnd, planned_at: int) -> None:
        """Find the index pulse over a limit switch, make it 0, and go to it or to the soft limit next to it.

        Raises
        ------
        SettingsError
            When switch or index pulse are not wired.
        DeviceError
            When a stop or a fault came first, or one of the two was not found.
        """
        card, lines = self._settings.hardware.card, self._settings.hardware.card.lines
        if not ((lines.limit_low if side is TravelEnd.LOW else lines.limit_high) and card.encoder.z):
            raise SettingsError(
                f"homing in velocity mode needs the {LIMIT_SWITCH_CAUSES[side]} and the index pulse: name them in "
                f"hardware.card.lines.limit_{side} and hardware.card.encoder.z."
            )
        direction = -1.0 if side is TravelEnd.LOW else 1.0
        travel_mm = self.limits.highest_mm - self.limits.lowest_mm
        if not self._is_on_switch(side):
            planned_at = self._creep(
                direction * (travel_mm + _HOMING_OVERTRAVEL_MM),
                lambda: self._is_on_switch(side),
                f"the {LIMIT_SWITCH_CAUSES[side]} was found: see what stopped the stage",
                planned_at,
            )
        # Passed from the switch alone, because the place of an index pulse is repeatable from one side only.
        self._loop.reset_counter(_UNREFERENCED_MM, index=True)
        planned_at = self._creep(
            -direction * travel_mm,
            lambda: abs(self._loop.position_mm()) < _UNREFERENCED_MM / 2,
            "the index pulse was found: see what stopped the stage; if nothing did, check z and z_phase of "
            "hardware.card.encoder",
            planned_at,
        )
        position_mm = self._loop.position_mm()
        self._loop.reset_counter(position_mm, index=False)
        target_mm = min(max(0.0, self.limits.lowest_mm), self.limits.highest_mm)
        self._loop.follow(self._creeping(target_mm - position_mm), position_mm, planned_at)
        self._poll_while(lambda: self._sync.moving)
        arrival_mm = _ARRIVAL_COUNTS * self._settings.encoder.resolution_um / 1000.0
        # A drive with a small offset never quite gets there, and need not: the counter knows where it is.
        until_s = self._clock.monotonic() + _ARRIVAL_TIMEOUT_S
        self._poll_while(
            lambda: abs(self._loop.position_mm() - target_mm) > arrival_mm and self._clock.monotonic() < until_s
        )
        if self._loop.stop_count != planned_at:
            raise DeviceError("homing was stopped: home again.")

    def _creep(self, travel_mm: float, is_there: Callable[[], bool], aim: str, planned_at: int) -> int:
        """Move slowly by `travel_mm` at most, until `is_there`, then brake; return the loop's new `stop_count`."""
        self._loop.follow(self._creeping(travel_mm), self._loop.position_mm(), planned_at, closed=False)
        reached = False
        while self._sync.moving:
            if not reached and is_there():
                reached = True
                stop_count = self._loop.brake()
                if stop_count != planned_at + 1:
                    break
                planned_at = stop_count
            self._loop.position_mm()
            self._clock.sleep(_POLL_S, threading.Event())
        if not reached or self._loop.stop_count != planned_at:
            raise DeviceError(f"homing ended before {aim}, then home again.")
        return planned_at

    def _poll_while(self, condition: Callable[[], bool]) -> None:
        while condition():
            self._loop.position_mm()
            self._clock.sleep(_POLL_S, threading.Event())

    def _creeping(self, travel_mm: float) -> MotionProfile:
        acceleration = min(_HOMING_ACCELERATION_MM_S2, self.limits.acceleration_mm_s2)
        return MotionProfile.from_pieces(trapezoid(travel_mm, self._drive.homing_speed_mm_s, acceleration))

    @contextmanager
    def _tolerating(self, side: TravelEnd) -> Iterator[None]:
        """Let a limit switch forbid nothing until the end of the block, however often the stage comes to rest in it."""
        self._keeps_tolerance = True
        self._monitor.tolerate(LIMIT_SWITCH_CAUSES[side])
        try:
            yield
        finally:
            self._keeps_tolerance = False
            self._end_override()

    def _follow(self, profile: MotionProfile, origin_mm: float, limits: StageLimits, planned_at: int) -> None:
        write_safeguards(self._link, self._settings)
        # The drive was not homed, so that its positions have another zero.
        shift_mm = self._tracker.position_mm() - origin_mm
        lowest_mm, highest_mm = limits.lowest_mm + shift_mm, limits.highest_mm + shift_mm
        write_travel(self._link, replace(limits, lowest_mm=lowest_mm, highest_mm=highest_mm))
        self._refuse_late_start(first_motion_s(profile))
        self._watchdog.feed()
        self._loop.follow(profile, origin_mm, planned_at)

    def _come_to_rest(self) -> None:
        self._await_standstill(_STANDSTILL_TIMEOUT_S)
        self._loop.end()

    def _may_beat(self) -> bool:
        # The heartbeat relay takes the drive's power when the program is not well.
        fault = self._monitor.fault
        return fault is None or fault.cause is not TripCause.WATCHDOG

    def _cut_power(self) -> None:
        try:
            self._power_off()
        except DeviceError:
            # Neither drive nor card answer: the heartbeat, which stops with the card, takes the power.
            return

    def _end_override(self) -> None:
        if not self._keeps_tolerance:
            super()._end_override()
