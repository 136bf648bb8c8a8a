"""A drive that is heard no more loses its power, whether it has a silence timeout of its own or not."""

import time
from dataclasses import dataclass, field

import pytest

from dragrig.config.errors import DeviceError
from dragrig.rig.devices import TripCause
from dragrig.rig.hardware.dialects.base import Command, Halt, Request
from dragrig.rig.hardware.drive.link import NoReplyError
from dragrig.rig.hardware.drive.monitor import Monitor
from dragrig.rig.hardware.drive.stage_base import DriveTracker
from dragrig.sim_backend.doubles.protocol_double import DoublePort
from dragrig.sim_backend.doubles.simulated_bench import MISSED_BEATS, SimulatedBench
from drive_ports import DrivePort, SocketPort
from driving import ANY_PORT, BenchLines, Driven, Reached, Stall, driven, reached, unhindered, until
from property_tests import thorough
from simulated import stroke
from voltage_bench import velocity_rig, voltage_rig

ENABLE, HEARTBEAT = "port1/line0", "port1/line4"
WIRINGS = {
    "enable line": {"enable": ENABLE},
    "relay": {"enable": "", "heartbeat": HEARTBEAT, "heartbeat_s": 0.05},
}
DIALECTS: dict[str, dict[str, object]] = {
    "nikki": {},
    "copley": {"station": 0, "counts_per_mm": 1000.0, "thrust_N_per_A": 8.0},
    "modbus": {},
}
SILENCE_S = 0.6
SPEED_MM_S = 20.0
LONG = stroke(travel_mm=140.0, speed_mm_s=SPEED_MM_S)


@dataclass
class LineLog:
    """When the program cleared the enable line, and when it last changed the heartbeat's."""

    bench: SimulatedBench
    cleared_s: float = float("inf")
    beaten_s: float = float("-inf")
    _levels: dict[str, bool] = field(default_factory=dict)

    def __post_init__(self) -> None:
        write = self.bench.write_line

        def logged(line: str, high: bool) -> None:
            if line == ENABLE and not high:
                self.cleared_s = min(self.cleared_s, time.monotonic())
            if line == HEARTBEAT and self._levels.get(line) is not high:
                self.beaten_s = time.monotonic()
            self._levels[line] = high
            write(line, high)

        self.bench.write_line = logged  # type: ignore[method-assign]


def lose_link(rig: Driven, fault: str) -> tuple[float, float, LineLog]:
    """Cut the link in motion; return for how long the power stayed, how far the stage went, and the lines."""
    rig.ready().stage.move(LONG)
    until(lambda: rig.bench.speed_mm_s() > 0.9 * SPEED_MM_S)
    log = LineLog(rig.bench)
    at_mm, lost_s = rig.bench.position_mm(), time.monotonic()
    rig.bench.faults.inject(drive_unwatched=True, **{fault: True})
    until(lambda: not rig.bench.moving)
    released_s = min(log.cleared_s, log.beaten_s if rig.bench.rig.hardware.card.lines.heartbeat else float("inf"))
    return released_s - lost_s, rig.bench.position_mm() - at_mm, log


@pytest.mark.parametrize(
    ("kind", "wiring"),
    [
        (ANY_PORT, "relay"),
        (ANY_PORT, "enable line"),
        thorough(SocketPort, "relay"),
        thorough(DoublePort, "relay"),
    ],
)
@pytest.mark.parametrize("fault", [thorough("drive_unplugged"), "drive_cut_off"])
def test_a_drive_that_is_heard_no_more_loses_its_power(kind: type[DrivePort], fault: str, wiring: str) -> None:
    _expect_power_gone(kind, fault, wiring, "nikki")


@pytest.mark.parametrize("fault", ["drive_unplugged", thorough("drive_cut_off")])
@pytest.mark.parametrize("dialect", ["copley", "modbus"])
def test_a_drive_of_another_make_loses_its_power_as_soon(fault: str, dialect: str) -> None:
    _expect_power_gone(ANY_PORT, fault, "relay", dialect)


def _expect_power_gone(kind: type[DrivePort], fault: str, wiring: str, dialect: str) -> None:
    drive = {"dialect": dialect, **DIALECTS[dialect]}

    def lost() -> tuple[float, float]:
        with driven(kind, lines=WIRINGS[wiring], silence_s=SILENCE_S, reply_s=0.1, **drive) as rig:
            with Stall() as stall:
                released_s, travelled_mm, _ = lose_link(rig, fault)
            assert rig.drive.status.halt is Halt.DISABLED
            fault_seen = rig.stage.fault
            assert fault_seen is not None
            assert fault_seen.cause is TripCause.DRIVE_FAULT
            assert "check" in fault_seen.message
            until(lambda: not rig.sync.moving)
            with pytest.raises(DeviceError):
                rig.stage.enable()
        # The program's threads and the doubles' may all be late.
        late_s = 0.1 + 3 * stall.longest_s
        return released_s - late_s, travelled_mm - SPEED_MM_S * late_s

    relay_s = MISSED_BEATS * 0.05 if wiring == "relay" else 0.0
    coasted_mm = SPEED_MM_S**2 / (2 * 250.0)
    most_s, most_mm = SILENCE_S, SPEED_MM_S * (SILENCE_S + relay_s) + coasted_mm
    # The drive may miss a reply before its link is cut, on a machine that holds its double up for so long.
    released_s, travelled_mm = unhindered(lost, lambda after: after[0] <= most_s and after[1] <= most_mm)
    assert released_s <= most_s
    assert travelled_mm <= most_mm


def test_a_drive_that_is_heard_again_moves_again() -> None:
    with driven(lines={"enable": ENABLE}, silence_s=3 * SILENCE_S, reply_s=0.1) as rig:
        lose_link(rig, "drive_cut_off")
        until(lambda: not rig.bench.read_line(ENABLE))
        rig.bench.faults.clear()
        rig.stage.disable()
        at_mm = rig.bench.position_mm()
        rig.stage.enable()
        rig.stage.move(stroke(travel_mm=1.0))
        until(lambda: not rig.sync.moving)
        assert rig.stage.fault is None
        assert rig.bench.position_mm() == pytest.approx(at_mm + 1.0, abs=1e-3)


def stepped_monitor(rig: Reached) -> Monitor:
    """A monitor whose threads' steps are made one by one, as after a computer stood still."""
    tracker = DriveTracker(rig.devices, 10.0, lambda: None)
    monitor = Monitor(rig.devices, tracker.poll, rig.link.stop, lambda: True, tracker.ending)
    monitor.watch_drive()
    monitor.set_drive_on(True)
    return monitor


@pytest.mark.parametrize("answered", [True, False])
def test_a_computer_that_stood_still_hears_first_what_came_meanwhile(answered: bool) -> None:
    def powers() -> list[bool]:
        """Return the power before the drive is heard again, and after each look at it then."""
        with reached(lines={"enable": ENABLE}, silence_s=0.3, reply_s=0.1) as rig:
            monitor = stepped_monitor(rig)

            def power_is_on() -> bool:
                monitor.watch_power()
                return rig.bench.read_line(ENABLE)

            rig.lines.set_enable(True)
            rig.bench.faults.inject(drive_silent=True)
            with pytest.raises(NoReplyError):
                rig.link.exchange(Request(Command.STATUS))
            until(lambda: rig.link.unheard_s > 0.6)
            found = [power_is_on()]
            if answered:
                rig.bench.faults.clear()
                for _ in range(4):
                    monitor.watch_drive()
                    found.append(power_is_on())
            else:
                until(lambda: not power_is_on())
        return found

    assert all(unhindered(powers, all))


@pytest.mark.parametrize("moving", [True, False])
def test_a_beat_that_comes_too_late_gives_no_power_back_to_a_moving_stage(moving: bool) -> None:
    def is_powered() -> bool:
        monitor.watch_power()
        return rig.bench.powered

    with reached(lines=WIRINGS["relay"], silence_s=5.0) as rig:
        monitor, lines = stepped_monitor(rig), rig.lines
        assert isinstance(lines, BenchLines)
        until(is_powered)
        rig.sync.set_moving(moving)
        before = lines.beats
        until(lambda: is_powered() and lines.beats > before)
        until(lambda: not rig.bench.powered)
        if moving:
            assert not any(is_powered() for _ in range(3))
            assert monitor.fault is not None
            assert monitor.fault.cause is TripCause.WATCHDOG
            assert "the heartbeat came" in monitor.fault.message
        else:
            until(is_powered)


@pytest.mark.parametrize("fault", [thorough("drive_unplugged"), "drive_cut_off"])
def test_in_velocity_mode_the_voltage_brakes_and_the_power_goes(fault: str) -> None:
    def braked_way() -> float:
        with voltage_rig(velocity_rig(silence_s=0.6, reply_s=0.1)) as rig:
            rig.ready()
            rig.stage.move(stroke(travel_mm=140.0, speed_mm_s=SPEED_MM_S))
            until(lambda: rig.bench.speed_mm_s() > 0.9 * SPEED_MM_S)
            rig.bench.faults.inject(drive_unwatched=True, **{fault: True})
            at_mm = rig.bench.position_mm()
            until(lambda: abs(rig.bench.speed_mm_s()) < 0.1)
            until(lambda: not rig.bench.powered and not rig.bench.read_line(ENABLE))
            way_mm = rig.bench.position_mm() - at_mm
            fault_seen = rig.stage.fault
            assert fault_seen is not None
            assert fault_seen.cause is TripCause.DRIVE_FAULT
            until(lambda: not rig.drive.status.enabled)
        return way_mm

    assert unhindered(braked_way, lambda way_mm: way_mm < 60.0) < 60.0
