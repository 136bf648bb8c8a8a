"""What the tests of the drive share: a drive's double on a port, and what talks to it."""

import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Generic, Self, TypeVar

import pytest

from dragrig.config.errors import DeviceError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.rig.devices import Backend, Stage
from dragrig.rig.hardware.dialects.base import find_dialect
from dragrig.rig.hardware.drive.link import DriveLink
from dragrig.rig.hardware.drive.monitor import StageDevices, Watchdog
from dragrig.rig.hardware.drive.position_mode import PositionModeStage
from dragrig.rig.hardware.lines import CardLines, SwitchStates
from dragrig.rig.hardware.sync import FirstSample, MotionSamplingSync
from dragrig.rig.profile import MotionProfile
from dragrig.sim_backend.doubles.drive_double import DriveDouble
from dragrig.sim_backend.doubles.protocol_double import DoublePort
from dragrig.sim_backend.doubles.simulated_bench import DoubleClock, SimulatedBench
from drive_ports import DrivePort, PtyPort, SocketPort
from simulated import settings

RATE = 1000.0
_NAP_S, _HELD_UP_S = 0.002, 0.02
T = TypeVar("T")
Opened = TypeVar("Opened", bound=Backend)
PORTS = [pytest.param(PtyPort, id="pty", marks=pytest.mark.skipif(os.name == "nt", reason="no pty on Windows")),
         pytest.param(SocketPort, id="socket"), pytest.param(DoublePort, id="in process")]  # fmt: skip
ANY_PORT = SocketPort if os.name == "nt" else PtyPort


def until(condition: Callable[[], bool], within_s: float = 600.0) -> float:
    """Wait for something to become true, on a busy machine too; return how long it took."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < within_s, "it never happened"
        time.sleep(0.01)
    return time.monotonic() - began


class Stall:
    """The longest time for which this busy machine kept a thread from waking up, while the context lasts."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        slept_s = time.monotonic()
        while not self._ended.wait(_NAP_S):
            woken_s = time.monotonic()
            self.longest_s, slept_s = max(self.longest_s, woken_s - slept_s - _NAP_S), woken_s


def unhindered(measure: Callable[[], T], holds: Callable[[T], bool], tries: int = 6) -> T:
    """Measure again while it does not hold and this process was held up meanwhile, as beside many busy ones."""
    for _ in range(tries):
        with Stall() as stall:
            try:
                measured = measure()
            except DeviceError:
                if stall.longest_s < _HELD_UP_S:
                    raise
                continue
        if holds(measured) or stall.longest_s < _HELD_UP_S:
            return measured
    pytest.fail("this machine held the test up at each try")


def is_back(stage: Stage, stroke: Callable[[float], MotionProfile], near_mm: float = 0.01) -> bool:
    """Tell whether a stage stands at its zero; if it does not, move it there.

    A stage that is told speeds creeps by some counts between a look and the motion, which then may end beyond its
    travel and is refused: look again.
    """
    state = stage.state()
    if not state.moving and abs(state.position_mm) > near_mm:
        with suppress(DeviceError):
            stage.move(stroke(state.position_mm))
    return not state.moving and abs(state.position_mm) <= near_mm


class Room(Generic[Opened]):
    """Room for one open rig: it is opened once for all tests that put it back, until a test needs the room itself."""

    def __init__(self, opened: Callable[[], Opened]) -> None:
        self._opened = opened
        self._rig: Opened | None = None

    def rig(self) -> Opened:
        if self._rig is None:
            self._rig = self._opened()
        return self._rig

    def clear(self) -> None:
        rig, self._rig = self._rig, None
        if rig is not None:
            rig.close()


class BenchLines:
    """The lines of the bench, without a card in between."""

    def __init__(self, bench: SimulatedBench) -> None:
        self.bench = bench
        self.names = bench.rig.hardware.card.lines
        self.beats = 0

    @property
    def has_heartbeat(self) -> bool:
        return bool(self.names.heartbeat)

    def read_switches(self) -> SwitchStates:
        wired = {name: getattr(self.names, name) for name in SwitchStates.__dataclass_fields__}
        return SwitchStates(**{name: not self.bench.read_line(line) for name, line in wired.items() if line})

    def set_enable(self, on: bool) -> None:
        self.bench.write_line(self.names.enable, on)

    def toggle_heartbeat(self) -> None:
        self.beats += 1
        self.bench.write_line(self.names.heartbeat, bool(self.beats % 2))


class NoDigitalLines:
    """A rig whose drive has all switches on its own terminals."""

    has_heartbeat = False

    def read_switches(self) -> SwitchStates:
        return SwitchStates()

    def set_enable(self, on: bool) -> None:
        pass

    def toggle_heartbeat(self) -> None:
        pass


@dataclass
class Reached:
    """A drive's double, and what a stage works with on the program's side of the cable."""

    bench: SimulatedBench
    drive: DriveDouble
    devices: StageDevices
    port: DrivePort

    @property
    def link(self) -> DriveLink:
        return self.devices.link

    @property
    def sync(self) -> MotionSamplingSync:
        return self.devices.sync

    @property
    def watchdog(self) -> Watchdog:
        return self.devices.watchdog

    @property
    def lines(self) -> CardLines | BenchLines | NoDigitalLines:
        return self.devices.lines


@dataclass
class Driven(Reached):
    """The same, and the stage."""

    stage: PositionModeStage

    def sample(self, profile: MotionProfile) -> None:
        """Move with a first sample, as the engine does."""
        self.sync.arm()
        self.stage.move(profile)
        self.bench.begin_sampling(RATE)
        self.sync.set_first_sample(FirstSample(self.bench.clock.monotonic(), 0.0))

    def ready(self) -> "Driven":
        self.stage.enable()
        self.bench.place(0.0)
        try:
            self.stage.home()
        except DeviceError as error:
            # A busy machine may look so late that the drive has been to its switch and back: which way it went first
            # cannot be told then, so it is stopped, and a person homes again.
            if "homes the wrong way" not in str(error):
                raise
            self.bench.place(0.0)
            self.stage.home()
        return self


@contextmanager
def linked(
    kind: Callable[[DriveDouble], DrivePort] = ANY_PORT,
    pace: float = 1.0,
    program: Mapping[str, object] | None = None,
    **drive: object,
) -> Iterator[tuple[DriveDouble, DriveLink]]:
    """A drive's double whose enable line is not wired, and a link to it, with other settings if `program` says so."""
    rig = settings(hardware={"drive": {"reply_s": 0.5, **drive}, "card": {"lines": {"enable": ""}}})
    bench = SimulatedBench(rig, FrictionModelSettings(), DoubleClock(pace))
    with DriveDouble(bench) as double, kind(double) as port:
        reached = rig.hardware.drive.model_copy(update={"port": port.address, **(program or {})})
        link = DriveLink(reached, find_dialect(reached.dialect))
        try:
            yield double, link
        finally:
            link.close()


@contextmanager
def reached(
    kind: type[DrivePort] = ANY_PORT,
    pace: float = 1.0,
    wired: bool = False,
    lines: dict[str, object] | None = None,
    hang_s: float = 5.0,
    stale_s: float = 5.0,
    **drive: object,
) -> Iterator[Reached]:
    """A drive's double for a stage `wired` to the bench's switches and enable, by other `lines`, or to nothing."""
    wired = wired or lines is not None
    wires = (lines or {}) if wired else {"enable": ""}
    card = {"lines": wires}
    # Long waits, for on a busy machine even a double may be kept from answering for a tenth of a second.
    patient = {"homing_speed_mm_s": 50, "reply_s": 1.0, "silence_s": 5.0}
    # Nothing samples here, so that no sample can be fresh.
    hardware = {"drive": {**patient, **drive}, "card": card, "hang_s": hang_s}
    rig = settings(guard={"stale_data_s": stale_s}, hardware=hardware)
    bench = SimulatedBench(rig, FrictionModelSettings(), DoubleClock(pace))
    # The gut's first samples take seconds of imports, in which no thread would answer.
    bench.begin_sampling(RATE)
    bench.end_sampling()
    with ExitStack() as stack:
        dialect = find_dialect(rig.hardware.drive.dialect)
        double = stack.enter_context(DriveDouble(bench))
        port = stack.enter_context(kind(double))
        link = DriveLink(rig.hardware.drive.model_copy(update={"port": port.address}), dialect)
        stack.callback(link.close)
        wiring = BenchLines(bench) if wired else NoDigitalLines()
        devices = StageDevices(rig, link, wiring, MotionSamplingSync(), bench.clock, Watchdog())
        yield Reached(bench, double, devices, port)


@contextmanager
def driven(kind: type[DrivePort] = ANY_PORT, **choices: Any) -> Iterator[Driven]:
    """A stage on a drive's double, with the choices of `reached`."""
    with reached(kind, **choices) as rig:
        stage = PositionModeStage(rig.devices)
        try:
            yield Driven(rig.bench, rig.drive, rig.devices, rig.port, stage)
        finally:
            stage.close()
