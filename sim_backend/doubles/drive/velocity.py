"""The drive's double in velocity mode: it is switched on and off, and otherwise lets the voltage move the carriage."""

import time

from dragrig.rig.hardware.dialects.base import Dialect, Halt, Parameter, Refusal
from dragrig.sim_backend.doubles.drive.drive import DriveDouble
from dragrig.sim_backend.doubles.world.world import World


def drive_double(world: World, dialect: Dialect, station: int = 1) -> DriveDouble:
    """Return the double of the drive in the mode that the rig's settings name."""
    kind = VelocityDriveDouble if world.rig.hardware.drive.mode == "velocity" else DriveDouble
    return kind(world, dialect, station)


class VelocityDriveDouble(DriveDouble):
    """A drive whose speed is its voltage. Position commands are unknown to it, and so is a stop.

    Without its enable line or its power, which the heartbeat relay takes, the motor has no current and friction stops
    the carriage; e-stop, alarm and silence brake it and switch the drive off.
    """

    def look(self) -> None:
        """Look at power, lines, alarm and silence once."""
        with self._lock:
            if (text := self.world.mishaps.now.drive_alarm) and not self._alarm:
                self._raise_alarm(text)
            if not self._enabled:
                return
            if not (self._line(self._lines.enable) and self.world.powered):
                self._end(Halt.DISABLED)
            elif not self._line(self._lines.e_stop):
                self._end(Halt.EMERGENCY_STOP)
            elif self.world.moving and 0 < self._parameters[Parameter.SILENCE_S] < time.monotonic() - self._heard_s:
                self._end(Halt.SILENCE)

    def _enable(self) -> Refusal | None:
        refused = super()._enable()
        if refused is None and not self.world.powered:
            refused, self._enabled = Refusal.DISABLED, False
        self.world.obey_voltage(self._enabled)
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
        self._halt = why if self.world.moving else self._halt
        self._enabled = False
        self.world.obey_voltage(False)
        motor = self.world.rig.simulated.motor
        friction_mm_s2 = 1000.0 * motor.coulomb_mN / motor.moving_mass_g
        brakes = self._parameters[Parameter.STOP_ACCELERATION_MM_S2]
        self.world.brake(friction_mm_s2 if why is Halt.DISABLED else brakes)
