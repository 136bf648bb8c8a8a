"""Follows what the drive does: asks it, judges its answer, and knows when a movement is over."""

import threading
import time
from collections.abc import Callable

from dragrig.config.errors import DeviceError
from dragrig.rig.hardware.coupling import Coupling
from dragrig.rig.hardware.dialects.base import Command, Request, Status
from dragrig.rig.hardware.drive.link import DriveLink, NoReplyError
from dragrig.rig.hardware.drive.movement import Movement
from dragrig.rig.trips import Cause, Trip


class Axis:
    """The drive's state as last heard, and the movement under way. Any thread may call anything.

    Parameters
    ----------
    patience_s
        For so long a drive that does not answer counts as it was last heard: a busy computer is no fault.
    unheard_s
        After so long without an answer the drive has stopped by itself, of the wall's clock.
    over
        Called when a movement is over.

    Raises
    ------
    DeviceError
        When the drive does not answer.
    """

    def __init__(
        self, link: DriveLink, coupling: Coupling, patience_s: float, unheard_s: float, over: Callable[[], None]
    ) -> None:
        self._link, self._coupling, self._over = link, coupling, over
        self._patience_s, self._unheard_s = patience_s, unheard_s
        self._lock = threading.RLock()
        self._movement: Movement | None = None
        self._mishap: Trip | None = None
        self._heard_s = time.monotonic()
        self._status = self._ask()
        # Left on by a program that was killed, it goes off with its enable line, which is no fault of its own.
        self._switched_on = False

    @property
    def status(self) -> Status:
        """What the drive said last."""
        return self._status

    def begin(self, movement: Movement) -> None:
        """Follow a movement from here on."""
        with self._lock:
            self._movement = movement
            self._heard_s = time.monotonic()
            self._coupling.set_moving(True)

    def cancel(self) -> None:
        """Let the movement under way send nothing more."""
        movement = self._movement
        if movement is not None:
            movement.cancel()

    def forget(self) -> None:
        """End the movement, which the drive never took."""
        with self._lock:
            self._end()

    def switched(self, on: bool) -> None:
        """Say whether the drive is meant to be on; switching it off forgets what went wrong."""
        with self._lock:
            self._switched_on = on
            self._mishap = self._mishap if on else None

    def forget_mishap(self, cause: Cause) -> None:
        """Forget that the drive ended a movement for this cause."""
        with self._lock:
            if self._mishap is not None and self._mishap.cause is cause:
                self._mishap = None

    def poll(self) -> Trip | None:
        """Ask the drive how it is and return what forbids motion.

        Raises
        ------
        DeviceError
            When it has not answered for `patience_s`, or its port fails. A drive unheard for `unheard_s` counts as
            standing.
        """
        asked_s = time.monotonic()
        try:
            status = self._ask()
        except DeviceError as error:
            with self._lock:
                unheard_s = time.monotonic() - self._heard_s
                if unheard_s > self._unheard_s:
                    self._end()
                if isinstance(error, NoReplyError) and unheard_s < self._patience_s:
                    return self._judge(self._status)
            raise
        with self._lock:
            self._heard_s, self._status = asked_s, status
            if self._movement is not None:
                self._mishap = self._mishap or self._movement.mishap(status, asked_s)
                if self._movement.is_over(status, asked_s):
                    self._end()
            return self._judge(status)

    def position_mm(self) -> float:
        """Ask where it is; raises `DeviceError` when it does not answer."""
        value = self._link.exchange(Request(Command.POSITION)).value
        if value is None:
            raise DeviceError(
                f"the drive on {self._link.port} answered without a position: check hardware.drive.dialect."
            )
        return value

    def _ask(self) -> Status:
        status = self._link.exchange(Request(Command.STATUS)).status
        if status is None:
            raise DeviceError(
                f"the drive on {self._link.port} answered without a status: check hardware.drive.dialect."
            )
        return status

    def _judge(self, status: Status) -> Trip | None:
        if status.alarm:
            return Trip(Cause.DRIVE_FAULT, f"the drive reports {self._link.dialect.alarm(status.alarm)}")
        if self._mishap is not None:
            return self._mishap
        if self._switched_on and not status.enabled:
            return Trip(Cause.DRIVE_FAULT, "the drive switched itself off")
        return None

    def _end(self) -> None:
        if self._movement is not None:
            self._movement = None
            self._over()
            self._coupling.set_moving(False)
