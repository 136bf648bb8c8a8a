"""The simulated stage: limits, states and faults of a drive."""

import threading

from dragrig.config.errors import DeviceError
from dragrig.config.rig import StageSettings
from dragrig.rig.devices import Side, StageLimits, StageState
from dragrig.rig.profile import MotionProfile
from dragrig.rig.refusals import limits_of, refuse_beyond, widened
from dragrig.rig.trips import Cause, Trip
from dragrig.sim_backend.devices.axis import Axis, Track
from dragrig.sim_backend.devices.faults import NO_FAULTS, Faults
from dragrig.sim_backend.devices.instruments import Encoder
from dragrig.sim_backend.devices.kinematics import run_away

POSITION_TOLERANCE_MM = 1e-6
END_STOP_MM = 5.0
"""How far beyond the soft limits the hard end of the axis lies."""


class SimulatedStage:
    """One axis that follows profiles exactly, as long as no fault says otherwise."""

    def __init__(self, settings: StageSettings, axis: Axis, encoder: Encoder, faults: Faults) -> None:
        self._limits = limits_of(settings)
        self._stop_accel_mm_s2 = settings.stop_accel_mm_s2
        self._axis = axis
        self._encoder = encoder
        self._faults = faults
        self._enabled = False
        self._homed = False
        self._override: Side | None = None
        self._override_used = False
        self._commands = threading.RLock()

    @property
    def limits(self) -> StageLimits:
        """Soft limits of travel, and the greatest speed and acceleration."""
        return self._limits

    def enable(self) -> None:
        """Switch the drive on.

        Raises
        ------
        DeviceError
            When the drive has a fault; `disable` clears it.
        """
        with self._commands:
            self._refuse_fault()
            self._enabled = True

    def home(self) -> None:
        """Go to the origin, or to the soft limit nearest to it, at once.

        Raises
        ------
        DeviceError
            When the drive is off, moving or has a fault.
        """
        with self._commands:
            self._refuse_unready()
            self._axis.place(min(max(0.0, self._limits.lowest_mm), self._limits.highest_mm))
            self._homed = True

    def move(self, profile: MotionProfile) -> None:
        """Begin to follow a profile: now, or with the first sample when the sampler is armed.

        Raises
        ------
        DeviceError
            When the drive is off, not homed, moving or has a fault, when the first sample is already past, or when
            the profile leaves the stage's limits or does not end at a standstill.
        """
        with self._commands:
            self._refuse_unready()
            if not self._homed:
                raise DeviceError("the stage does not know where it is: home it before it moves.")
            if profile.duration_s <= 0:
                return
            origin_mm, _, _ = self._axis.look()
            limits = widened(self._limits, self._overridden(moving=False), origin_mm)
            refuse_beyond(profile, origin_mm, limits, POSITION_TOLERANCE_MM)
            self._axis.begin(self._track(profile, origin_mm))
            self._override_used = self._override is not None

    @property
    def start_uncertainty_s(self) -> float:
        """0, because a motion begins with the first sample."""
        return 0.0

    def stop(self) -> None:
        """Brake to a standstill now; an acquisition under way ends there. Allowed at any time, from any thread."""
        self._axis.stop()

    def override_limit(self, side: Side) -> None:
        """Free one motion from the limit switch and the soft limit of this side."""
        with self._commands:
            self._override, self._override_used = side, False

    def disable(self) -> None:
        """Stop, switch the drive off and clear its fault."""
        self._axis.stop()
        with self._commands:
            self._axis.clear_fault()
            self._enabled = False
            self._override = None

    @property
    def fault(self) -> Trip | None:
        """What the drive reports; None when nothing."""
        if self._faults.limit_switch is None:
            return self._axis.fault
        position_mm, moving, fault = self._axis.look()
        return fault or self._pressed_switch(position_mm, moving)

    def state(self) -> StageState:
        """Where the stage is, to the encoder's resolution, and how it is."""
        position_mm, moving, fault = self._axis.look()
        fault = fault or self._pressed_switch(position_mm, moving)
        return StageState(self._encoder.read(position_mm), self._enabled, self._homed, moving, fault)

    def _pressed_switch(self, position_mm: float, moving: bool) -> Trip | None:
        switch = self._faults.limit_switch
        if switch is None or not switch.pressed(position_mm) or switch.side is self._overridden(moving):
            return None
        cause = Cause.LIMIT_SWITCH_LOW if switch.side is Side.LOW else Cause.LIMIT_SWITCH_HIGH
        return Trip(cause, f"the limit switch at the {switch.side} end is pressed")

    def _overridden(self, moving: bool) -> Side | None:
        return self._override if moving or not self._override_used else None

    def _refuse_fault(self) -> None:
        if fault := self.fault:
            raise DeviceError(f"{fault.message}: see to it, then switch the drive off and on.")

    def _refuse_unready(self) -> None:
        self._refuse_fault()
        if not self._enabled:
            raise DeviceError("the drive is off: enable the stage first.")
        if self._axis.look()[1]:
            raise DeviceError("the stage is still moving: wait until it stands or stop it first.")

    def _track(self, profile: MotionProfile, origin_mm: float) -> Track:
        acquisition = self._axis.acquisition
        faults = NO_FAULTS if acquisition is None else self._faults.during(acquisition)
        if faults.runaway is not None:
            away = faults.runaway
            end = self._limits.highest_mm + END_STOP_MM if away.speed_mm_s > 0 else self._limits.lowest_mm - END_STOP_MM
            accel = self._limits.acceleration_mm_s2
            profile = run_away(profile, away.at_s, away.speed_mm_s, end - origin_mm, accel)
        if faults.drive_fault is None:
            return Track(profile, origin_mm)
        failing = faults.drive_fault
        braked = profile.stopped(failing.at_s, self._stop_accel_mm_s2, hold_s=profile.duration_s)
        braking_s = abs(float(profile.velocity(failing.at_s))) / self._stop_accel_mm_s2
        over_s = failing.at_s + braking_s
        return Track(braked, origin_mm, fails_s=failing.at_s, fault=failing.message, over_s=over_s)
