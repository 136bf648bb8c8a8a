"""Whether the stage may do what it is told, and waiting until it stands: the same whatever moves it."""

import time

from dragrig.config.errors import DeviceError
from dragrig.rig.hardware.coupling import Coupling
from dragrig.rig.hardware.drive.monitor import Monitor
from dragrig.rig.trips import Cause

_LOOK_S = 0.01


class Readiness:
    """Looks at drive and switches before every answer."""

    def __init__(self, monitor: Monitor, coupling: Coupling) -> None:
        self._monitor, self._coupling = monitor, coupling

    def refuse_fault(self, but: Cause | None = None) -> None:
        """Raise `DeviceError` when anything but one cause forbids motion."""
        fault = self._monitor.look()
        if fault is not None and fault.cause is not but:
            raise DeviceError(f"{fault.message}: see to it, then switch the drive off and on.")

    def refuse_moving(self) -> None:
        """Raise `DeviceError` while something moves."""
        if self._coupling.moving:
            raise DeviceError("the stage is still moving: wait until it stands or stop it first.")

    def await_standstill(self, longest_s: float) -> bool:
        """Wait until nothing moves, for so long of the wall's time at most; return whether it stands."""
        until_s = time.monotonic() + longest_s
        while self._coupling.moving:
            if time.monotonic() > until_s:
                return False
            self._monitor.look()
            if self._coupling.moving:
                time.sleep(_LOOK_S)
        return True
