"""The hardware backend: opens card, drive, stage and sampler of a rig under one lock, checks and closes them."""

import contextlib
import ctypes
import errno
import gc
import hashlib
import os
import re
import socket
import struct
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TypeVar

import numpy as np
from filelock import FileLock, Timeout

from dragrig.config import DeviceError, DragrigError, HardwareSettings, RigSettings, reason_of
from dragrig.rig import (
    SWITCH_NAMES,
    Acquisition,
    BackendRequest,
    Clock,
    FloatArray,
    LiveView,
    RawReading,
    RigCheck,
    Sampler,
    Stage,
    StopName,
    WallClock,
    attempt,
)
from dragrig.rig.hardware.card import (
    MAX_AGGREGATE_RATE_HZ,
    Alias,
    CardSampler,
    Connection,
    NoiseLimits,
    PositionCounter,
    Scaling,
    driver_errors_wrapped,
)
from dragrig.rig.hardware.dialects import Command, Lack, Request, fitting_dialect
from dragrig.rig.hardware.drive import (
    DriveLink,
    MonitoredStage,
    PositionModeStage,
    StageDevices,
    VelocityModeStage,
    Watchdog,
    serial_ports,
    write_safeguards,
    write_travel,
)
from dragrig.rig.hardware.lines import CardLines
from dragrig.rig.hardware.stop_trial import StopTrial
from dragrig.rig.hardware.sync import MotionSamplingSync

_PEER = struct.Struct("3i")
"""Process, user and group of the other side of a socket (man 7 unix, SO_PEERCRED)."""
_MAX_NAME_BYTES = 100
"""A longer lock's name has no room in a socket's, or in a path of Windows."""
_LOCK_FOLDER = Path(os.environ.get("PROGRAMDATA", tempfile.gettempdir())) / "dragrig"


class RigLock(ExitStack):
    """The lock of one program on one rig, from construction to `close`.

    On Linux it is a name of the kernel's (man 7 unix, abstract sockets): it ends with its process, and there is no file
    that somebody could plant, link elsewhere or remove. Elsewhere it is a lock on a file in a folder of this machine.

    Parameters
    ----------
    scope
        Locks of different scopes know nothing of each other.

    Raises
    ------
    DeviceError
        When another program, or this one elsewhere, holds the rig (with its process id), or no lock can be made.
    """

    def __init__(self, hardware: HardwareSettings, scope: str = "") -> None:
        super().__init__()
        name, rig = f"{scope}{lock_name(hardware)}", f"{hardware.card.device} and {hardware.drive.port}"
        if len(name.encode()) > _MAX_NAME_BYTES:
            name = hashlib.sha256(name.encode()).hexdigest()
        try:
            self.callback(_hold_name(name) if sys.platform == "linux" else hold_file(name, _LOCK_FOLDER))
        except HeldError as error:
            raise DeviceError(f"{rig}: {error} uses this rig; end it, or wait until it is done.") from None
        except OSError as error:
            raise DeviceError(f"{rig}: no lock can be made ({error}): check who may write there.") from error


class HeldError(Exception):
    """Who holds a rig."""


def _hold_name(name: str) -> Callable[[], None]:
    address = f"\0dragrig {name}"
    holder = socket.socket(socket.AF_UNIX)
    try:
        holder.bind(address)
        holder.listen()
    except OSError as error:
        holder.close()
        if error.errno != errno.EADDRINUSE:
            raise
        raise HeldError(_holder_of(address)) from None
    return holder.close


def _holder_of(address: str) -> str:
    with socket.socket(socket.AF_UNIX) as asking, contextlib.suppress(OSError):
        asking.setblocking(False)
        asking.connect(address)
        pid, _, _ = _PEER.unpack(asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))
        return f"process {pid}"
    return "another program"


def hold_file(name: str, folder: Path) -> Callable[[], None]:
    """Hold the lock of this name with a file in `folder`; return its release.

    The process is named in a file beside it: Windows lets nobody read a locked file. Raises `HeldError` when another
    program, or this one elsewhere, holds it, and `OSError` when there can be no such file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{re.sub(r'[^A-Za-z0-9.]+', '_', name)}.lock"
    lock, holder = FileLock(path, timeout=0, thread_local=False), path.with_suffix(".holder")
    try:
        lock.acquire()
    except Timeout:
        with contextlib.suppress(OSError, ValueError):
            raise HeldError(f"process {int(holder.read_bytes())}") from None
        raise HeldError("another program") from None
    held = ExitStack()
    held.callback(lock.release)
    held.callback(attempt, holder.unlink)
    attempt(lambda: holder.write_text(str(os.getpid()), "ascii"))
    return held.close


def port_name(port: str) -> str:
    """Return the one name of a serial port: where its path leads, and of Windows' ports and addresses the text.

    A port of Windows is no file: to ask the file system about it opens it, or a file of this name beside the program.
    """
    return str(Path(port).resolve()) if port.startswith("/") else port.removeprefix("\\\\.\\").upper()


def lock_name(hardware: HardwareSettings) -> str:
    """Return the name of a rig's lock: card device and drive port, however the port is spelled."""
    parts = (hardware.card.server, hardware.card.device, port_name(hardware.drive.port))
    return "-".join(re.sub(r"[^a-z0-9.]+", "_", part.lower()).strip("_") for part in parts if part)


CHECK_DURATION_S = 0.5
"""How long force and encoder are sampled for a check."""
_PRODUCT = "PCI-6229"
_M_SERIES = re.compile(r"62\d\d")
_MAX_ZERO_FRACTION = 0.1
"""Zero force, as a fraction of half the force range, above which the sensor is suspected of a load or an overload."""
_MAX_RATE_ERROR = 0.01
_SETTLED_S = 7e-6
_SETTLING = ((_SETTLED_S, 15e-6), (5e-6, 30e-6), (4e-6, 90e-6), (0.0, 1.0))
"""Shortest times between two inputs, and what is left then of the step between them (PCI-6229 specifications)."""
_MAX_JITTER_COUNTS = 2
"""An encoder that stands between two counts may jitter by so many."""


def identify_card(connection: Connection) -> dict[str, str]:
    """Return the card as run files state it: its name, product and serial number.

    Raises `DeviceError` when the driver or the card is not there.
    """
    card = connection.card
    with driver_errors_wrapped(card, "it is looked up"):
        device = connection.device()
        product, serial = str(device.product_type), int(device.serial_num)
    return {"card_device": card.device, "card_product": product, "card_serial": f"{serial:08X}"}


def check_card(
    connection: Connection, rig: RigSettings, sampler: CardSampler, scaling: Scaling, lines: CardLines
) -> Iterator[RigCheck]:
    """Check card, switches, force sensor and encoder with an idle sampler; an error of the card ends the checks."""
    try:
        identity = identify_card(connection)
        yield _check_product(identity)
        trip = lines.read_switches().trip()
        yield RigCheck("switches", trip is None, _wired_remark(lines) if trip is None else trip.message)
        yield from _check_sampling(rig, sampler)
        reading = sampler.measure(CHECK_DURATION_S)
        alias = sampler.probe_aliases()
    except DeviceError as error:
        yield RigCheck("card", False, reason_of(error))
        return
    yield RigCheck("card's tasks", True, "analog inputs, counter and digital lines can be reserved, and samples arrive")
    yield _check_force(rig, scaling, sampler.noise_limits, reading)
    yield _check_aliases(rig, scaling, sampler, alias)
    moved = reading.counts_span
    jitter = f"counted {moved} in {CHECK_DURATION_S:g} s while nothing moved: check line receiver and shield"
    still = "steady at rest; a jog shows whether it counts"
    yield RigCheck("encoder", moved <= _MAX_JITTER_COUNTS, still if moved <= _MAX_JITTER_COUNTS else jitter)


def _wired_remark(lines: CardLines) -> str:
    """Say that no switch is pressed, and which the program would not see if it were."""
    unseen = ", ".join(name for switch, name in SWITCH_NAMES.items() if switch not in lines.wired_switches)
    if not unseen:
        return "none is pressed"
    return (
        f"none is pressed; not wired to the card, so that the drive alone, and not the program, stops there: {unseen} "
        "(hardware.card.lines)"
    )


def _check_product(identity: dict[str, str]) -> RigCheck:
    product = identity["card_product"]
    note = "" if product == _PRODUCT else f", not a {_PRODUCT}: check channels, ranges and rate against its manual"
    detail = f"{product} {identity['card_serial']} as {identity['card_device']}{note}"
    return RigCheck("card", _M_SERIES.search(product) is not None, detail)


def _describe_sampling(rig: RigSettings, sampler: CardSampler) -> dict[str, str | float]:
    """Return the card's clocks and filter as run files state them; asks the card the first time."""
    return {
        "scan_order": ", ".join(_scan_order(rig)),
        "card_rate_hz": sampler.timing.rate_hz,
        "inter_channel_delay_s": sampler.timing.conversion_s,
        "anti_alias_filter": sampler.anti_alias.description,
    }


def _scan_order(rig: RigSettings) -> list[str]:
    return ["force", *(channel.name for channel in rig.hardware.card.inputs)]


def _check_sampling(rig: RigSettings, sampler: CardSampler) -> Iterator[RigCheck]:
    """Say which rate the card has instead of the requested one, and how its inputs follow each other."""
    rate_hz, timing, factor = sampler.sample_rate_hz, sampler.timing, sampler.anti_alias.factor
    names = _scan_order(rig)
    made = f", {factor} samples of the card each" if factor > 1 else ""
    detail = (
        f"{rate_hz:.7g} Hz where {rig.sampling.rate_hz:g} are asked{made}: {len(names)} × {timing.rate_hz:.7g} of "
        f"{MAX_AGGREGATE_RATE_HZ:,} samples a second"
    )
    yield RigCheck("sampling rate", abs(rate_hz / rig.sampling.rate_hz - 1) <= _MAX_RATE_ERROR, detail)
    if len(names) == 1:
        return
    follow = f"{', '.join(names)}: each is converted {1e6 * timing.conversion_s:.3g} µs after the one before"
    settled = timing.conversion_s >= _SETTLED_S
    left = next(share for fastest_s, share in _SETTLING if timing.conversion_s >= fastest_s * (1 - 1e-6))
    advice = (
        f", and settles to {1e6 * left:.0f} ppm of the step between them, not to the "
        f"converter's own: lower sampling.rate_hz, or leave out some of hardware.card.inputs, until there are "
        f"{1e6 * _SETTLED_S:g} µs"
    )
    yield RigCheck("scan", settled, follow if settled else f"{follow}{advice}")


def _check_aliases(rig: RigSettings, scaling: Scaling, sampler: CardSampler, alias: Alias) -> RigCheck:
    """Say how much of the input is too fast for the recorded rate, and which filter keeps that out.

    A tone fails even where the filter keeps it out: something oscillates that takes up range, and may drift.
    """
    gain, accuracy_mN = abs(scaling.mN_per_V), rig.force_sensor.accuracy_mN
    recorded_mN, tone_mN = gain * alias.recorded_V, gain * alias.strongest.rms_V
    half_hz, card_hz = sampler.sample_rate_hz / 2, sampler.timing.rate_hz
    found = f"{gain * alias.input_V:.2f} mN beyond {half_hz:g} Hz at the input, {recorded_mN:.2f} mN of it recorded"
    if max(recorded_mN, tone_mN) <= accuracy_mN:
        keeps = f"nothing is oversampled at this rate: an analog filter has to keep out what is beyond {half_hz:g} Hz"
        if sampler.anti_alias.factor > 1:
            keeps = (
                f"the digital filter keeps out all but what is within {half_hz:g} Hz of a multiple of {card_hz:g} Hz, "
                "for which only an analog filter helps"
            )
        return RigCheck("aliases", True, f"{found}; {keeps}")
    if recorded_mN > accuracy_mN:
        line = f"most as a line at {alias.folded.recorded_hz:.0f} Hz from {alias.folded.frequency_hz:.0f} Hz"
    else:
        line = (
            f"{tone_mN:.2f} mN are a tone of {alias.strongest.frequency_hz:.0f} Hz, which the digital filter keeps "
            "out, but which takes up the input's range"
        )
    advice = "find its source (an amplifier that oscillates, a chopper), or put an analog low-pass before the card"
    detail = f"{found}, over the sensor's accuracy of {accuracy_mN:g} mN; {line}: {advice}"
    return RigCheck("aliases", False, detail)


def _check_force(rig: RigSettings, scaling: Scaling, limits: NoiseLimits, reading: RawReading) -> RigCheck:
    zero = scaling.mN_per_V * reading.force_V + scaling.zero_mN
    noise = abs(scaling.mN_per_V) * reading.force_V_sd
    accuracy = rig.force_sensor.accuracy_mN
    low, high = scaling.force_range_mN
    problem = ""
    if reading.fault is not None:
        problem = reading.fault.message
    elif not noise <= accuracy:
        problem = f"noisier than its accuracy of {accuracy:g} mN; check shield and ground"
    elif not abs(zero) <= _MAX_ZERO_FRACTION * (high - low) / 2:
        problem = "far from zero; is something hanging on it, or was it overloaded?"
    detail = f"zero {zero:.1f} mN, noise {noise:.2f} mN ({reading.force_V:.4f} V)"
    if problem:
        return RigCheck("force sensor", False, f"{detail}: {problem}")
    return RigCheck("force sensor", True, f"{detail}; {_liveness_remark(rig, limits, reading)}")


def _liveness_remark(rig: RigSettings, limits: NoiseLimits, reading: RawReading) -> str:
    """Say how a dead sensor would show, and which setting is missing for that."""
    if limits.least_V:
        fast_uV, dead_uV = 1e6 * reading.force_noise_V, 1e6 * limits.least_V
        alive = f"alive: {fast_uV:.0f} µV from millisecond to millisecond, a dead input has less than {dead_uV:.0f}"
    else:
        alive = "alive; how quiet a dead input is, is not known yet: dragrig calibrate force measures it"
    if rig.hardware.card.force.unplugged == "floating":
        alive += "; a pulled cable may not show: put a resistor at the input (hardware.card.force.unplugged)"
    return alive


def check_drive(stage: Stage, link: DriveLink, rig: RigSettings) -> Iterator[RigCheck]:
    """Request the drive's state, and write its limits and read them back."""
    state = stage.state()
    homed = f"homed, at {state.position_mm:g} mm" if state.homed else "not homed yet"
    late = f", {link.late_replies} times only after hardware.drive.reply_s" if link.late_replies else ""
    answers = f"answers on {link.port} within {1000 * link.round_trip_s:.1f} ms{late}; {homed}"
    yield RigCheck("drive", state.fault is None, answers if state.fault is None else state.fault.message)
    limits, drive = stage.limits, rig.hardware.drive
    try:
        write_safeguards(link, rig)
        if state.homed:
            write_travel(link, limits)
    except DeviceError as error:
        yield RigCheck("drive's limits", False, reason_of(error))
        return
    travel = f"{limits.lowest_mm:g} to {limits.highest_mm:g} mm" if state.homed else "travel is set once it is homed"
    silent = f"stops after {drive.silence_s:g} s of silence"
    if Lack.SILENCE_TIMEOUT in link.dialect.lacks:
        silent = "is stopped by its heartbeat relay alone when the program falls silent"
    detail = f"holds {drive.thrust_limit_N:g} N, {travel}, and {silent}"
    yield RigCheck("drive's limits", True, detail)


@contextmanager
def _garbage_frozen() -> Iterator[None]:
    """Exempt all present objects from garbage collection.

    A full collection of the objects of the libraries stops every thread for some 90 ms: long enough for the velocity
    output's buffer to run empty, and for a motion to start late.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


class CardLook:
    """The signals of card and lines while a person works on the rig."""

    def __init__(self, read: Callable[[], tuple[FloatArray, FloatArray]], lines: CardLines, scaling: Scaling) -> None:
        self._read, self._lines, self._scaling = read, lines, scaling

    @property
    def wired_switches(self) -> tuple[str, ...]:
        """Switches that have a line."""
        return self._lines.wired_switches

    @property
    def count_mm(self) -> float:
        """Length of a count in force."""
        return abs(self._scaling.mm_per_count)

    def view(self) -> LiveView:
        """Read a block and the switches now; raises `DeviceError`."""
        volts, counts = self._read()
        force_V, count = float(np.mean(volts)), round(float(counts[-1]))
        force_mN = self._scaling.mN_per_V * force_V + self._scaling.zero_mN
        pressed = self._lines.read_switches().pressed
        switches = ", ".join(
            f"{SWITCH_NAMES[switch]} {'PRESSED' if switch in pressed else 'released'}" for switch in self.wired_switches
        )
        text = f"force {force_V:+.4f} V = {force_mN:+.1f} mN, encoder {count:+d} = {count * self.count_mm:+.3f} mm"
        return LiveView(force_V, force_mN, count, pressed, f"{text}, {switches}" if switches else text)


class HardwareBackend:
    """The rig that the settings describe. Nothing is touched before `connect` or `examine`.

    Parameters
    ----------
    clock
        The rig's time; default: the wall clock.
    on_arm
        Called with each acquisition before the sampler prepares it.

    Raises
    ------
    SettingsError
        When the drive's dialect is not known, or lacks a function that nothing on the rig stands in for.
    """

    name = "hardware"
    """Name that the run files carry."""
    needs_hands = True
    """A person has to be at this rig."""

    def __init__(
        self,
        request: BackendRequest,
        clock: Clock | None = None,
        on_arm: Callable[[Acquisition], None] = lambda _: None,
    ) -> None:
        self._rig: RigSettings = request.rig
        self._dialect = fitting_dialect(request.rig.hardware)
        self._calibrations = request.calibrations
        self.clock = clock or WallClock(request.origin)
        self._on_arm = on_arm
        self._sync, self._watchdog = MotionSamplingSync(), Watchdog()
        self._open = ExitStack()
        self._closed = False
        self._lock: RigLock | None = None
        self._connection: Connection | None = None
        self._lines: CardLines | None = None
        self._sampler: CardSampler | None = None
        self._link: DriveLink | None = None
        self._stage: MonitoredStage | None = None
        self._identity: Mapping[str, str] = {}

    @property
    def stage(self) -> Stage:
        """The axis; raises `DeviceError` before the rig is connected."""
        return _connected(self._stage)

    @property
    def sampler(self) -> Sampler:
        """The acquisition; raises `DeviceError` before the rig is connected."""
        return _connected(self._sampler)

    def description(self) -> Mapping[str, str | float | int | bool]:
        """Return sensor, card and drive, as run files name them."""
        drive = self._rig.hardware.drive
        return {
            "sensor_serial": self._rig.force_sensor.serial or "unknown",
            "drive_port": drive.port,
            "drive_dialect": drive.dialect,
            "drive_mode": drive.mode,
            **self._identity,
            **({} if self._sampler is None else _describe_sampling(self._rig, self._sampler)),
        }

    def connect(self) -> None:
        """Take the rig, and open card and drive.

        Raises `SettingsError` or `DeviceError` when another program is at the rig, or a device is missing or faulty;
        everything is closed then.
        """
        try:
            self._take_rig()
            self._open_card()
            # Before anything watches the drive: a full collection is longer than a heartbeat relay waits for an edge.
            self._open.enter_context(_garbage_frozen())
            if sys.platform == "win32":
                # It ends waits every 15.6 ms otherwise, so that a look at the switches every 25 ms would come every 31.
                timer = ctypes.WinDLL("winmm")
                timer.timeBeginPeriod(1)
                self._open.callback(timer.timeEndPeriod, 1)
            self._open_drive()
        except BaseException:
            self.close()
            raise

    def examine(self) -> Iterator[RigCheck]:
        """Check owner, card and drive in turn; each is connected for it, and a check that fails says why.

        A rig that another program is at is not touched.
        """
        for device, checks in (("owner", self._check_owner), ("card", self._check_card), ("drive", self._check_drive)):
            try:
                yield from checks()
            except DragrigError as error:
                yield RigCheck(device, False, reason_of(error))
            if self._lock is None:
                return

    @contextmanager
    def look(self) -> Iterator["CardLook"]:
        """Open force input, encoder and lines; the drive is opened once its enable line is looked at."""
        self._take_rig()
        lines = self._open_card()
        with _connected(self._sampler).watch() as read:
            yield CardLook(read, lines, Scaling.from_settings(self._rig, self._calibrations))

    def check_port(self) -> RigCheck:
        """List the serial ports that exist, and look whether the drive's is among them."""
        port, ports = self._rig.hardware.drive.port, serial_ports()
        known = ", ".join(f"{name} ({what})" for name, what in ports.items()) or "none"
        if "://" in port:
            return RigCheck("serial port", True, f"the drive is reached at {port}; serial ports here: {known}")
        if port_name(port) in map(port_name, ports) or (port.startswith("/") and Path(port).exists()):
            return RigCheck("serial port", True, f"the drive is on {port}; serial ports here: {known}")
        return RigCheck(
            "serial port", False, f"hardware.drive.port is {port}, and here is {known}: connect it, or name it"
        )

    @property
    def creeps(self) -> bool:
        """Whether `try_stops` can try in motion: in position mode."""
        return self._rig.hardware.drive.mode == "position"

    def try_stops(self, *, in_motion: bool) -> Iterator[RigCheck]:
        """Take enable line, heartbeat and requests away from the drive: at a standstill, or at 1 mm/s over 2 mm."""
        try:
            lines, stage = self._open_card(), self._open_drive()
        except DeviceError as error:
            yield RigCheck(StopName.ENABLE.value, False, reason_of(error))
            return
        yield from StopTrial(self._rig, stage, lines, self.clock, self._dialect).run(in_motion=in_motion)

    def close(self) -> None:
        """Stop the stage and close every device, also where another one fails.

        The refusal of a device is not raised here: it would hide the session's own error.
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

    def _take_rig(self) -> None:
        if self._lock is None:
            self._lock = RigLock(self._rig.hardware)
            self._open.callback(attempt, self._lock.close)

    def _open_card(self) -> CardLines:
        if self._connection is None:
            self._connection = Connection(self._rig.hardware.card)
            self._open.callback(attempt, self._connection.close)
        self._identity = identify_card(self._connection)
        if self._lines is None:
            self._lines = CardLines(self._connection)
            self._open.callback(attempt, self._lines.close)
        if self._sampler is None:
            self._sampler = CardSampler(
                self._connection,
                self._rig,
                self._calibrations,
                self._sync,
                self.clock,
                self._watchdog.feed,
                self._on_arm,
            )
        return self._lines

    def _open_link(self) -> DriveLink:
        if self._link is None:
            drive = self._rig.hardware.drive
            self._link = DriveLink(drive, self._dialect)
            self._open.callback(attempt, self._link.close)
        return self._link

    def _open_drive(self) -> MonitoredStage:
        if self._stage is None:
            link, lines = self._open_link(), _connected(self._lines)
            devices = StageDevices(self._rig, link, lines, self._sync, self.clock, self._watchdog)
            if self._rig.hardware.drive.mode == "velocity":
                self._stage = VelocityModeStage(devices, _connected(self._connection), self._calibrations)
            else:
                self._stage = PositionModeStage(devices, self._spare_counter())
            self._open.callback(attempt, self._stage.close)
        return self._stage

    def _spare_counter(self) -> PositionCounter:
        """Return the counter that samples nothing, on the encoder as well."""
        spare = "ctr1" if self._rig.hardware.card.encoder.counter == "ctr0" else "ctr0"
        mm_per_count = Scaling.from_settings(self._rig, self._calibrations).mm_per_count
        return PositionCounter(_connected(self._connection), spare, mm_per_count)

    def _check_owner(self) -> Iterator[RigCheck]:
        self._take_rig()
        yield RigCheck("owner", True, "no other program uses this rig")

    def _check_card(self) -> Iterator[RigCheck]:
        lines = self._open_card()
        scaling = Scaling.from_settings(self._rig, self._calibrations)
        yield from check_card(_connected(self._connection), self._rig, _connected(self._sampler), scaling, lines)

    def _check_drive(self) -> Iterator[RigCheck]:
        if self._lines is None:
            # Without the card nothing may be switched on, but whether the drive answers can be said.
            link = self._open_link()
            status = link.exchange(Request(Command.STATUS)).status
            alarm = "" if status is None or not status.alarm else f"; it reports {link.dialect.alarm(status.alarm)}"
            answers = f"answers on {link.port} within {1000 * link.round_trip_s:.1f} ms{alarm}"
            yield RigCheck("drive", not alarm, f"{answers}; checked without the card, so its lines were not")
            return
        stage = self._open_drive()
        yield from check_drive(stage, _connected(self._link), self._rig)


def open_backend(request: BackendRequest) -> HardwareBackend:
    """Return the real rig, connected if the request asks for it.

    Raises `SettingsError` or `DeviceError` when another program is at the rig, or a device is missing or faulty.
    """
    backend = HardwareBackend(request)
    if request.connect:
        backend.connect()
    return backend


DeviceT = TypeVar("DeviceT")


def _connected(device: DeviceT | None) -> DeviceT:
    if device is None:
        raise DeviceError("the rig is not connected: connect it first.")
    return device
