"""What every stage with a drive on a serial link shares: its limits, its monitor, its override and what it refuses."""

import threading
from abc import ABC, abstractmethod

from dragrig.config.errors import DeviceError
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import Clock, Side, StageLimits, StageState
from dragrig.rig.guard import SWITCHES
from dragrig.rig.hardware.coupling import Coupling
from dragrig.rig.hardware.deadman import Deadman
from dragrig.rig.hardware.drive.axis import Axis
from dragrig.rig.hardware.drive.link import DriveLink
from dragrig.rig.hardware.drive.monitor import Monitor, interval_of
from dragrig.rig.hardware.drive.power import Power
from dragrig.rig.hardware.drive.readiness import Readiness
from dragrig.rig.hardware.drive.refusals import POSITION_TOLERANCE_MM, refuse_towards
from dragrig.rig.hardware.lines import Lines
from dragrig.rig.profile import MotionProfile
from dragrig.rig.refusals import limits_of, refuse_beyond, widened
from dragrig.rig.trips import Cause, Trip


class WatchedStage(ABC):
    """A stage whose drive and switches are watched from `_watch` until `close`.

    Parameters
    ----------
    clock
        The rig's time, in which motions are.
    deadman
        Fed by whoever reads the samples.
    unheard_s
        After so long without an answer the drive has stopped by itself, of the wall's clock.

    Raises
    ------
    DeviceError
        When the drive does not answer.
    """

    def __init__(
        self,
        settings: RigSettings,
        link: DriveLink,
        lines: Lines,
        coupling: Coupling,
        clock: Clock,
        deadman: Deadman,
        unheard_s: float,
    ) -> None:
        self._settings, self._drive = settings, settings.hardware.drive
        self._limits = limits_of(settings.stage)
        self._link, self._coupling, self._clock = link, coupling, clock
        self._deadman = deadman
        # One command at a time; a stop waits for none.
        self._commands = threading.RLock()
        self._override: Side | None = None
        self._axis = Axis(link, coupling, self._drive.silence_s / 2, unheard_s, self._let_go)
        self._monitor = Monitor(
            self._axis.poll, self.stop, lines, coupling, deadman, settings.hardware.hang_s, interval_of(settings)
        )
        self._ready, self._power = Readiness(self._monitor, coupling), Power(link, lines)

    @property
    def limits(self) -> StageLimits:
        """Soft limits of travel, and the greatest speed and acceleration."""
        return self._limits

    @property
    def fault(self) -> Trip | None:
        """What drive and switches reported when the monitor last looked; what was latched stays until `disable`."""
        return self._monitor.fault

    @property
    @abstractmethod
    def start_uncertainty_s(self) -> float:
        """How far time 0 of the last motion may be off the first sample."""

    @abstractmethod
    def state(self) -> StageState:
        """Ask drive and switches now."""

    @abstractmethod
    def enable(self) -> None:
        """Switch the drive on and hold the position."""

    @abstractmethod
    def home(self) -> None:
        """Find the origin of absolute positions; return when the stage stands there."""

    @abstractmethod
    def move(self, profile: MotionProfile) -> None:
        """Begin to follow a profile: now, or with the first sample when the sampler is armed."""

    @abstractmethod
    def stop(self) -> None:
        """Brake to a standstill now; returns at once."""

    @abstractmethod
    def close(self) -> None:
        """Stop, and let go of the drive. Twice is once."""

    @abstractmethod
    def _come_to_rest(self) -> None:
        """Wait until the stage stands after a stop, or long enough, and hold it no longer."""

    def disable(self) -> None:
        """Stop, switch the drive off and clear its alarm and whatever was latched.

        Raises
        ------
        DeviceError
            When the drive does not answer; its enable line is taken away all the same.
        """
        self.stop()
        with self._commands:
            try:
                self._come_to_rest()
                self._switched(on=False)
                self._power.off()
            finally:
                self._let_go()
                self._monitor.clear()
                self._monitor.look()

    def override_limit(self, side: Side) -> None:
        """Let a pressed limit switch forbid nothing until the next move has ended, which must lead slowly away from it.

        Raises
        ------
        DeviceError
            While the stage moves.
        """
        with self._commands:
            self._ready.refuse_moving()
            self._override = side
            self._monitor.tolerate(SWITCHES[side])
            self._axis.forget_mishap(SWITCHES[side])
            self._monitor.look()

    def _switched(self, on: bool) -> None:
        self._axis.switched(on)
        self._monitor.switched(on)

    def _let_go(self) -> None:
        self._override = None
        self._monitor.tolerate(None)

    def _allowed(self, profile: MotionProfile, origin_mm: float) -> StageLimits:
        """Return the limits of a profile from a position, with an override; raises `DeviceError` beyond them."""
        limits = widened(self._limits, self._override, origin_mm)
        if self._override is not None:
            refuse_towards(profile, self._override, self._drive.homing_speed_mm_s)
        refuse_beyond(profile, origin_mm, limits, POSITION_TOLERANCE_MM)
        return limits

    def _refuse_unready(self, *, enabled: bool, but: Cause | None = None) -> None:
        self._ready.refuse_fault(but)
        if not enabled:
            raise DeviceError("the drive is off: enable the stage first.")
        self._ready.refuse_moving()
