"""The real rig as a whole: card, drive, stage and sampler put together, held by one program at a time."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from typing import TypeVar

from dragrig.config.errors import DeviceError, DragrigError, plain
from dragrig.config.rig import RigSettings
from dragrig.rig.acquiring import attempt
from dragrig.rig.backend import BackendRequest, Finding
from dragrig.rig.clock import WallClock
from dragrig.rig.devices import Clock, Sampler, Stage
from dragrig.rig.hardware.card.connection import Connection
from dragrig.rig.hardware.card.examine import examine as examine_card
from dragrig.rig.hardware.card.examine import identify
from dragrig.rig.hardware.card.lines import CardLines
from dragrig.rig.hardware.card.sampler import CardSampler
from dragrig.rig.hardware.card.scaling import Scaling
from dragrig.rig.hardware.coupling import Coupling
from dragrig.rig.hardware.deadman import Deadman
from dragrig.rig.hardware.dialects.base import find_dialect
from dragrig.rig.hardware.drive.examine import examine as examine_drive
from dragrig.rig.hardware.drive.link import DriveLink
from dragrig.rig.hardware.drive.stage import SerialStage
from dragrig.rig.hardware.drive.velocity import VelocityStage
from dragrig.rig.hardware.drive.watched import WatchedStage
from dragrig.rig.hardware.owner import Owner
from dragrig.rig.hardware.pauses import short_collections

PartT = TypeVar("PartT")


class HardwareBackend:
    """The rig that the settings wire up. Nothing is touched before `connect` or `examine`.

    Parameters
    ----------
    clock
        The rig's time; the wall's unless given.
    """

    def __init__(self, request: BackendRequest, clock: Clock | None = None) -> None:
        self._rig: RigSettings = request.rig
        self._calibrations = request.calibrations
        self._clock = clock or WallClock(request.origin)
        self._coupling, self._deadman = Coupling(), Deadman()
        self._open = ExitStack()
        self._closed = False
        self._owner: Owner | None = None
        self._connection: Connection | None = None
        self._lines: CardLines | None = None
        self._sampler: CardSampler | None = None
        self._link: DriveLink | None = None
        self._stage: WatchedStage | None = None
        self._facts: Mapping[str, str] = {}

    @property
    def name(self) -> str:
        """Name that the run files carry."""
        return "hardware"

    @property
    def needs_hands(self) -> bool:
        """A person has to be at this rig."""
        return True

    @property
    def stage(self) -> Stage:
        """The axis; raises `DeviceError` before the rig is connected."""
        return _connected(self._stage)

    @property
    def sampler(self) -> Sampler:
        """The acquisition; raises `DeviceError` before the rig is connected."""
        return _connected(self._sampler)

    @property
    def clock(self) -> Clock:
        """The time that this rig lives in."""
        return self._clock

    def description(self) -> Mapping[str, str | float | int | bool]:
        """Return sensor, card and drive, as run files name them."""
        drive = self._rig.hardware.drive
        return {
            "sensor_serial": self._rig.force_sensor.serial or "unknown",
            "drive_port": drive.port,
            "drive_dialect": drive.dialect,
            "drive_mode": drive.mode,
            **self._facts,
        }

    def connect(self) -> None:
        """Take the rig, and open card and drive.

        Raises
        ------
        SettingsError, DeviceError
            When another program is at the rig, or a device is not there or not right; all is let go of then.
        """
        try:
            self._take()
            self._open_card()
            self._open_drive()
            self._open.enter_context(short_collections())
        except BaseException:
            self.close()
            raise

    def examine(self) -> Iterator[Finding]:
        """Look at owner, card and drive in turn; each is connected for it, and what cannot be says why.

        A rig that another program is at is not touched.
        """
        yield from self._try("owner", self._take_if_free)
        if self._owner is None:
            return
        yield from self._try("card", self._look_at_card)
        yield from self._try("drive", self._look_at_drive)

    def close(self) -> None:
        """Stop the stage and let go of every device, whatever becomes of the others.

        What a device refuses here is not raised: it would take the place of what the session has to say.
        """
        if self._closed:
            return
        self._closed = True
        for device in (self._stage, self._sampler):
            if device is not None:
                attempt(device.stop)
        if self._stage is not None:
            attempt(self._stage.disable)
        self._open.close()

    def _take(self) -> None:
        if self._owner is None:
            self._owner = Owner(self._rig.hardware)
            self._open.callback(attempt, self._owner.close)

    def _open_card(self) -> CardLines:
        if self._connection is None:
            self._connection = Connection(self._rig.hardware.card)
            self._open.callback(attempt, self._connection.close)
        self._facts = identify(self._connection)
        if self._lines is None:
            self._lines = CardLines(self._connection)
            self._open.callback(attempt, self._lines.close)
        if self._sampler is None:
            self._sampler = CardSampler(
                self._connection, self._rig, self._calibrations, self._coupling, self._clock, self._deadman.feed
            )
        return self._lines

    def _open_drive(self) -> WatchedStage:
        if self._stage is None:
            drive = self._rig.hardware.drive
            self._link = DriveLink(drive, find_dialect(drive.dialect))
            self._open.callback(attempt, self._link.close)
            shared = self._rig, self._link, _connected(self._lines), self._coupling, self._clock, self._deadman
            if drive.mode == "velocity":
                self._stage = VelocityStage(*shared, _connected(self._connection), self._calibrations)
            else:
                self._stage = SerialStage(*shared)
            self._open.callback(attempt, self._stage.close)
        return self._stage

    def _try(self, what: str, look: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
        try:
            yield from look()
        except DragrigError as error:
            yield Finding(what, False, plain(error))

    def _take_if_free(self) -> Iterator[Finding]:
        self._take()
        yield Finding("owner", True, "no other program is at this rig")

    def _look_at_card(self) -> Iterator[Finding]:
        lines = self._open_card()
        scaling = Scaling.of(self._rig, self._calibrations)
        yield from examine_card(_connected(self._connection), self._rig, _connected(self._sampler), scaling, lines)

    def _look_at_drive(self) -> Iterator[Finding]:
        stage = self._open_drive()
        yield from examine_drive(stage, _connected(self._link), self._rig)


def open_backend(request: BackendRequest) -> HardwareBackend:
    """Return the real rig, connected unless the request says otherwise.

    Raises
    ------
    SettingsError, DeviceError
        When another program is at the rig, or a device is not there or not right.
    """
    backend = HardwareBackend(request)
    if request.connect:
        backend.connect()
    return backend


def _connected(part: PartT | None) -> PartT:
    if part is None:
        raise DeviceError("the rig is not connected: connect it first.")
    return part
