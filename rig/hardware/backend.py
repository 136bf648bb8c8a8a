"""The hardware backend: opens card, drive, stage and sampler of one rig, checks them, and closes them in order.

Only one program at a time holds a rig. `connect` opens everything and lets go of everything when one device fails;
`examine` (the command `rig check`) opens each device in turn and reports what it finds while nothing moves.
"""

import gc
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import TypeVar

from dragrig.config.errors import DeviceError, DragrigError, reason_of
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import BackendRequest, Clock, RawReading, RigCheck, Sampler, Stage, WallClock
from dragrig.rig.engine import attempt
from dragrig.rig.hardware.card.connection import Connection, driver_errors_wrapped
from dragrig.rig.hardware.card.sampler import MAX_AGGREGATE_RATE_HZ, CardSampler
from dragrig.rig.hardware.card.scaling import Scaling
from dragrig.rig.hardware.dialects.base import find_dialect
from dragrig.rig.hardware.drive.link import DriveLink
from dragrig.rig.hardware.drive.monitor import Watchdog
from dragrig.rig.hardware.drive.position_mode import PositionModeStage, write_safeguards, write_travel
from dragrig.rig.hardware.drive.stage_base import MonitoredStage
from dragrig.rig.hardware.drive.velocity_stage import VelocityModeStage
from dragrig.rig.hardware.lines import CardLines, DigitalLines
from dragrig.rig.hardware.rig_lock import RigLock
from dragrig.rig.hardware.sync import MotionSamplingSync


@contextmanager
def garbage_frozen() -> Iterator[None]:
    """Let the garbage collector pass over all that is there already.

    A full collection of what the libraries loaded holds every thread for some 90 ms: long enough for a velocity's
    output to run dry, and for a motion to set out late.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


CHECK_DURATION_S = 0.5
"""How long force and encoder are looked at."""
_PRODUCT = "PCI-6229"
_M_SERIES = re.compile(r"62\d\d")
_MAX_ZERO_FRACTION = 0.1
"""Part of the force range that the zero may be off without a word."""
_MAX_JITTER_COUNTS = 2
"""Counts that an encoder between two of them may jitter."""


def identify_card(connection: Connection) -> dict[str, str]:
    """Return what run files say of the card: its name, product and serial number.

    Raises
    ------
    DeviceError
        When the driver or the card is not there.
    """
    card = connection.card
    with driver_errors_wrapped(card, "it is looked up"):
        device = connection.device()
        product, serial = str(device.product_type), int(device.serial_num)
    return {"card_device": card.device, "card_product": product, "card_serial": f"{serial:08X}"}


def check_card(
    connection: Connection, rig: RigSettings, sampler: CardSampler, scaling: Scaling, lines: DigitalLines | None = None
) -> Iterator[RigCheck]:
    """Look at the card; what it has not found it does not look at further.

    Parameters
    ----------
    sampler
        Idle.
    lines
        The lines where they are open already; else they are opened and closed again.
    """
    try:
        facts = identify_card(connection)
        yield _check_product(facts)
        yield _check_rate(rig)
        yield _check_switches(connection, lines)
        reading = sampler.measure(CHECK_DURATION_S)
    except DeviceError as error:
        yield RigCheck("card", False, reason_of(error))
        return
    yield RigCheck("card's tasks", True, "analog inputs, counter and digital lines can be reserved, and samples arrive")
    yield _check_force(rig, scaling, reading)
    yield _check_encoder(reading)


def _check_product(facts: dict[str, str]) -> RigCheck:
    product = facts["card_product"]
    known = _M_SERIES.search(product) is not None
    note = (
        "" if product == _PRODUCT else f", which is no {_PRODUCT}: check channels, ranges and rate against its manual"
    )
    detail = f"{product} {facts['card_serial']} as {facts['card_device']}{note}"
    return RigCheck("card", known, detail)


def _check_rate(rig: RigSettings) -> RigCheck:
    inputs = 1 + len(rig.hardware.card.inputs)
    asked = inputs * rig.sampling.rate_hz
    detail = f"{inputs} × {rig.sampling.rate_hz:g} of {MAX_AGGREGATE_RATE_HZ:,} samples a second"
    return RigCheck("sampling rate", asked <= MAX_AGGREGATE_RATE_HZ, detail)


def _check_switches(connection: Connection, lines: DigitalLines | None) -> RigCheck:
    if lines is None:
        own = CardLines(connection)
        try:
            trip = own.pressed().trip()
        finally:
            own.close()
    else:
        trip = lines.pressed().trip()
    return RigCheck("switches", trip is None, "none is pressed" if trip is None else trip.message)


def _check_force(rig: RigSettings, scaling: Scaling, reading: RawReading) -> RigCheck:
    zero = scaling.mN_per_V * reading.force_V + scaling.zero_mN
    noise = abs(scaling.mN_per_V) * reading.force_V_sd
    accuracy = rig.force_sensor.accuracy_mN
    low, high = scaling.force_range_mN
    detail = f"zero {zero:.1f} mN, noise {noise:.2f} mN ({reading.force_V:.4f} V)"
    if trip := scaling.fault_at(abs(reading.force_V)):
        return RigCheck("force sensor", False, f"{detail}: {trip.message}")
    if noise > accuracy:
        return RigCheck(
            "force sensor", False, f"{detail}: noisier than its accuracy of {accuracy:g} mN; check shield and ground"
        )
    if abs(zero) > _MAX_ZERO_FRACTION * (high - low) / 2:
        return RigCheck(
            "force sensor", False, f"{detail}: far from zero; is something hanging on it, or was it overloaded?"
        )
    return RigCheck("force sensor", True, detail)


def _check_encoder(reading: RawReading) -> RigCheck:
    moved = abs(reading.counts_end - reading.counts_begin)
    if moved > _MAX_JITTER_COUNTS:
        return RigCheck(
            "encoder",
            False,
            f"counted {moved} in {CHECK_DURATION_S:g} s while nothing moved: check line receiver and shield",
        )
    return RigCheck("encoder", True, "reads and stands still; a jog shows whether it counts")


def check_drive(stage: Stage, link: DriveLink, rig: RigSettings) -> Iterator[RigCheck]:
    """Ask how the drive is, and have it keep and repeat its limits."""
    state = stage.state()
    homed = f"homed, at {state.position_mm:g} mm" if state.homed else "not homed yet"
    answers = f"answers on {link.port} within {1000 * link.round_trip_s:.1f} ms; {homed}"
    yield RigCheck("drive", state.fault is None, answers if state.fault is None else state.fault.message)
    try:
        write_safeguards(link, rig)
        if state.homed:
            write_travel(link, stage.limits)
    except DeviceError as error:
        yield RigCheck("drive's limits", False, reason_of(error))
        return
    limits, drive = stage.limits, rig.hardware.drive
    travel = f"{limits.lowest_mm:g} to {limits.highest_mm:g} mm" if state.homed else "travel is set once it is homed"
    yield RigCheck(
        "drive's limits",
        True,
        f"keeps {drive.thrust_limit_N:g} N, {travel}, and stops after {drive.silence_s:g} s of silence",
    )


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
        self._coupling, self._deadman = MotionSamplingSync(), Watchdog()
        self._open = ExitStack()
        self._closed = False
        self._owner: RigLock | None = None
        self._connection: Connection | None = None
        self._lines: CardLines | None = None
        self._sampler: CardSampler | None = None
        self._link: DriveLink | None = None
        self._stage: MonitoredStage | None = None
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
            self._open.enter_context(garbage_frozen())
        except BaseException:
            self.close()
            raise

    def examine(self) -> Iterator[RigCheck]:
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
            self._owner = RigLock(self._rig.hardware)
            self._open.callback(attempt, self._owner.close)

    def _open_card(self) -> CardLines:
        if self._connection is None:
            self._connection = Connection(self._rig.hardware.card)
            self._open.callback(attempt, self._connection.close)
        self._facts = identify_card(self._connection)
        if self._lines is None:
            self._lines = CardLines(self._connection)
            self._open.callback(attempt, self._lines.close)
        if self._sampler is None:
            self._sampler = CardSampler(
                self._connection, self._rig, self._calibrations, self._coupling, self._clock, self._deadman.feed
            )
        return self._lines

    def _open_drive(self) -> MonitoredStage:
        if self._stage is None:
            drive = self._rig.hardware.drive
            self._link = DriveLink(drive, find_dialect(drive.dialect))
            self._open.callback(attempt, self._link.close)
            shared = self._rig, self._link, _connected(self._lines), self._coupling, self._clock, self._deadman
            if drive.mode == "velocity":
                self._stage = VelocityModeStage(*shared, _connected(self._connection), self._calibrations)
            else:
                self._stage = PositionModeStage(*shared)
            self._open.callback(attempt, self._stage.close)
        return self._stage

    def _try(self, what: str, look: Callable[[], Iterator[RigCheck]]) -> Iterator[RigCheck]:
        try:
            yield from look()
        except DragrigError as error:
            yield RigCheck(what, False, reason_of(error))

    def _take_if_free(self) -> Iterator[RigCheck]:
        self._take()
        yield RigCheck("owner", True, "no other program is at this rig")

    def _look_at_card(self) -> Iterator[RigCheck]:
        lines = self._open_card()
        scaling = Scaling.of(self._rig, self._calibrations)
        yield from check_card(_connected(self._connection), self._rig, _connected(self._sampler), scaling, lines)

    def _look_at_drive(self) -> Iterator[RigCheck]:
        stage = self._open_drive()
        yield from check_drive(stage, _connected(self._link), self._rig)


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
