"""The stage in velocity mode: the real nidaqmx and the real pyserial on the doubles of card and drive."""

import subprocess
import sys
import threading
from collections.abc import Iterator
from operator import attrgetter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from dragrig.config.errors import DeviceError, SettingsError
from dragrig.config.rig import StageSettings, VelocityOutputSettings
from dragrig.rig.devices import TravelEnd, TripCause
from dragrig.rig.hardware.dialects.base import Parameter
from dragrig.rig.hardware.drive.velocity_loop import MotionCommand, SpeedController
from dragrig.rig.profile import MotionProfile, Phase, Piece, stationary_piece
from dragrig.sim_backend.doubles.simulated_bench import SWITCH_OFFSET_MM
from driving import Room, Stall, is_back, until
from property_tests import thorough
from remote_doubles import RemoteDoubles
from simulated import NEVER, acquire, begin, blocks, record, session, settings, stroke
from voltage_bench import LEAD_S, RATE, VoltageRig, open_voltage_rig, velocity_rig, voltage_rig

FOLLOWS_MM, FASTEST_MM_S = 0.1, 100.0
STANDS_MM = 0.02
LONG = stroke(travel_mm=120.0, speed_mm_s=40.0, hold_s=0.3)


@pytest.fixture(scope="module")
def room() -> Iterator[Room[VoltageRig]]:
    room = Room(lambda: open_voltage_rig(velocity_rig()).ready())
    yield room
    room.clear()


@pytest.fixture
def cold(room: Room[VoltageRig]) -> Iterator[VoltageRig]:
    """A rig that was just opened."""
    room.clear()
    with voltage_rig() as rig:
        yield rig


@pytest.fixture
def rig(room: Room[VoltageRig]) -> Iterator[VoltageRig]:
    """A rig that is homed, on and at its zero."""
    rig = room.rig()
    yield rig
    rig.bench.faults.clear()
    rig.bench.clock.waits_for_voltage = True
    rig.sampler.stop()
    rig.stage.disable()
    until(lambda: rig.bench.powered)
    rig.stage.enable()
    until(lambda: is_back(rig.stage, lambda away_mm: stroke(-away_mm, 100.0)))


def wavy(duration_s: float = 1.0) -> MotionProfile:
    """A motion that is no chain of trapezoids."""
    time_s = np.arange(0.0, duration_s, 0.01)
    speed = 20.0 * np.sin(2 * np.pi * time_s) ** 2 * np.sign(np.sin(2 * np.pi * time_s / duration_s))
    changes = np.diff(np.append(speed, 0.0)) / 0.01
    return MotionProfile.from_pieces(
        (*(Piece(0.01, a, Phase.STEADY) for a in changes), stationary_piece(0.4, Phase.HOLD))
    )


def test_follows_any_profile_from_the_first_sample_on(rig: VoltageRig) -> None:
    for order, profile in enumerate((stroke(60.0, 100.0, 3000.0, hold_s=0.4), wavy(), stroke(-20.0, 20.0, hold_s=0.4))):
        with Stall() as stall:
            got = record(rig, acquire(profile, order))
        samples = profile.samples(RATE)
        assert got.blocks[-1].end_index == samples
        off_mm = np.abs(got["position"] - profile.position(np.arange(samples) / RATE))
        # While a busy machine holds the loop up, the stage goes on as it was told last.
        assert off_mm.max() <= FOLLOWS_MM + FASTEST_MM_S * stall.longest_s
        assert off_mm[-1] <= STANDS_MM + FASTEST_MM_S * stall.longest_s
        assert rig.stage.start_uncertainty_s == pytest.approx(0.001)
    assert rig.stage.fault is None
    # The drive took the place where it was switched on, 1 mm, for its zero.
    for parameter, value in (
        (Parameter.LOWEST_MM, -1.0),
        (Parameter.HIGHEST_MM, 149.0),
        (Parameter.THRUST_LIMIT_N, 20.0),
        (Parameter.SILENCE_S, 5.0),
    ):
        assert rig.drive.parameter(parameter) == pytest.approx(value, abs=0.01)


@pytest.mark.thorough
def test_the_force_is_that_of_the_simulated_rig(rig: VoltageRig) -> None:
    acquisition = acquire(stroke(30.0, 40.0, rest_s=0.2, hold_s=0.3))
    expected = record(session(), acquisition)["force"]
    rig.bench.present(acquisition)
    got = record(rig, acquisition)["force"]
    for part in (slice(0, 190), slice(500, 850)):
        assert got[part].mean() == pytest.approx(expected[part].mean(), abs=3.0)


def test_holds_its_place_comes_back_when_pushed_and_trips_when_pushed_away(cold: VoltageRig) -> None:
    rig = cold.ready()
    rig.stage.move(stroke(10.0))
    rig.await_standstill()
    rig.clock.sleep(1.5, NEVER)
    seen = []
    for _ in range(20):
        rig.clock.sleep(0.05, NEVER)
        seen.append(rig.bench.position_mm())
    assert np.ptp(seen) <= 0.005
    assert np.abs(np.array(seen) - 10.0).max() <= 0.01
    rig.bench.place(10.3)
    until(lambda: abs(rig.bench.position_mm() - 10.0) <= STANDS_MM)
    assert rig.stage.fault is None
    rig.bench.place(16.0)
    until(lambda: rig.stage.fault is not None)
    fault = rig.stage.fault
    assert fault is not None
    assert fault.cause is TripCause.FOLLOWING_ERROR
    assert "following_error_mm" in fault.message
    rig.await_standstill()
    assert rig.bench.position_mm() == pytest.approx(16.0, abs=1.5)
    with pytest.raises(DeviceError, match="off and on"):
        rig.stage.move(stroke())


def test_an_encoder_that_sticks_in_motion_stops_the_stage(rig: VoltageRig) -> None:
    rig.stage.move(LONG)
    until(lambda: rig.is_under_way)
    rig.bench.faults.inject(encoder_stuck=True)
    until(lambda: abs(rig.bench.speed_mm_s()) < 0.1)
    assert rig.bench.position_mm() < 60.0
    fault = rig.stage.fault
    assert fault is not None
    assert fault.cause is TripCause.FOLLOWING_ERROR


def test_a_stop_from_another_thread_brakes_within_what_is_written_ahead(rig: VoltageRig) -> None:
    begin(rig, acquire(LONG))
    got, stopped_s = [], 0.0
    with Stall() as stall:
        for block in blocks(rig):
            got.append(block)
            if block.end_index >= 500 and not stopped_s:
                stopped_s = rig.clock.monotonic() - rig.bench.began_s
                stopper = threading.Thread(target=rig.stage.stop)
                stopper.start()
                stopper.join()
    rig.sampler.stop()
    speed = np.gradient(np.concatenate([block.channels["position"] for block in got])) * RATE
    braked_s = (np.flatnonzero(speed > 39.0)[-1] + 1) / RATE
    assert stopped_s - 0.01 <= braked_s <= stopped_s + LEAD_S + 0.02 + stall.longest_s
    assert abs(speed[-20:]).max() <= 2.0
    assert rig.stands
    rig.stage.move(stroke())
    rig.await_standstill()
    assert rig.stage.fault is None


@pytest.mark.parametrize("ends", ["stage.stop", thorough("sampler.stop")])
def test_a_motion_whose_first_sample_never_comes_is_dropped(rig: VoltageRig, ends: str) -> None:
    rig.sampler.arm(acquire(LONG))
    rig.stage.move(LONG)
    attrgetter(ends)(rig)()
    rig.await_standstill()
    rig.sampler.start() if ends == "stage.stop" else None
    rig.sampler.stop()
    rig.clock.sleep(2 * LEAD_S, NEVER)
    assert rig.bench.position_mm() == pytest.approx(0.0, abs=FOLLOWS_MM)
    record(rig, acquire(stroke(hold_s=0.3), order=1))
    # Where a busy machine held the loop up at the motion's end, it still has some way to go.
    until(lambda: abs(rig.bench.position_mm() - 5.0) <= FOLLOWS_MM)


def test_a_voltage_that_runs_dry_stops_the_stage(rig: VoltageRig, monkeypatch: pytest.MonkeyPatch) -> None:
    begin(rig, acquire(LONG))
    until(lambda: rig.is_under_way)
    rig.bench.clock.waits_for_voltage = False
    sleep, late = rig.bench.clock.sleep, []
    late_until_s = rig.clock.monotonic() + 3 * LEAD_S

    def oversleep(duration_s: float, cancel: threading.Event) -> bool:
        if threading.current_thread().name == "velocity loop" and not late:
            late.append(True)
            until(lambda: rig.clock.monotonic() > late_until_s)
        return sleep(duration_s, cancel)

    monkeypatch.setattr(rig.bench.clock, "sleep", oversleep)
    ended = sum(block.samples for block in blocks(rig))
    rig.sampler.stop()
    fault = rig.stage.fault
    assert fault is not None
    assert fault.cause is TripCause.WATCHDOG
    assert "ahead" in fault.message
    assert ended < LONG.samples(RATE) / 2
    until(lambda: not rig.bench.powered)
    assert abs(rig.bench.speed_mm_s()) < 0.1
    rig.stage.disable()
    until(lambda: rig.bench.powered)
    rig.stage.enable()
    at_mm = rig.stage.state().position_mm
    rig.stage.move(stroke())
    # Within a tenth of a millimetre per second of standing, the loop still has some way to go.
    until(lambda: rig.stands and abs(rig.stage.state().position_mm - at_mm - 5.0) <= STANDS_MM)


def test_a_heartbeat_that_ends_takes_the_power_from_a_voltage_that_goes_on(
    rig: VoltageRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.stage.move(LONG)
    until(lambda: rig.is_under_way)
    # Pulls the wire of the heartbeat alone: nothing in the program knows.
    monkeypatch.setattr(rig.bench, "write_line", lambda line, high: None)
    until(lambda: abs(rig.bench.speed_mm_s()) < 0.1)
    assert not rig.bench.powered
    assert rig.bench.position_mm() < 100.0


def test_a_card_that_is_pulled_in_motion_leaves_the_stop_to_the_relay(rig: VoltageRig) -> None:
    begin(rig, acquire(LONG))
    until(lambda: rig.is_under_way)
    rig.bench.faults.inject(card_unplugged=True)
    with pytest.raises(DeviceError):
        list(blocks(rig))
    until(lambda: abs(rig.bench.speed_mm_s()) < 0.1)
    assert rig.stage.fault is not None
    assert rig.bench.position_mm() < 100.0


@pytest.mark.parametrize(
    ("trouble", "cause"),
    [
        ({"e_stop_pressed": True}, TripCause.EMERGENCY_STOP),
        thorough({"drive_alarm": "overheating"}, TripCause.DRIVE_FAULT),
    ],
)
def test_what_stops_the_drive_ends_the_motion(rig: VoltageRig, trouble: dict[str, bool], cause: TripCause) -> None:
    rig.stage.move(LONG)
    until(lambda: rig.is_under_way)
    rig.bench.faults.inject(**trouble)
    rig.await_standstill()
    fault = rig.stage.fault
    assert fault is not None
    assert fault.cause is cause
    assert rig.bench.position_mm() < 60.0


def test_a_limit_switch_is_left_by_one_slow_move(rig: VoltageRig) -> None:
    rig.bench.faults.inject(limit_low_pressed=True)
    until(lambda: rig.stage.fault is not None)
    with pytest.raises(DeviceError, match="lower limit switch"):
        rig.stage.move(stroke(1.0, 10.0))
    rig.stage.override_limit(TravelEnd.LOW)
    with pytest.raises(DeviceError, match="away"):
        rig.stage.move(stroke(-1.0, 10.0))
    rig.stage.move(stroke(5.0, 10.0, 500.0))
    rig.bench.faults.clear()
    rig.await_standstill()
    until(lambda: abs(rig.stage.state().position_mm - 5.0) <= FOLLOWS_MM)
    assert rig.stage.fault is None


@pytest.mark.parametrize("start_mm", [thorough(0.5), -SWITCH_OFFSET_MM - 1.0])
def test_homing_finds_the_index_pulse_from_either_side_of_the_switch(cold: VoltageRig, start_mm: float) -> None:
    cold.bench.place(start_mm)
    cold.stage.disable()
    cold.stage.override_limit(TravelEnd.LOW)
    cold.stage.enable()
    cold.stage.home()
    state = cold.stage.state()
    assert state.homed
    assert state.position_mm == pytest.approx(0.0, abs=STANDS_MM)
    assert cold.bench.position_mm() == pytest.approx(0.0, abs=STANDS_MM)


def test_homing_that_is_stopped_says_so(cold: VoltageRig) -> None:
    cold.bench.place(100.0)
    cold.stage.enable()
    stopper = threading.Thread(target=lambda: (until(lambda: cold.is_under_way), cold.stage.stop()))
    stopper.start()
    with pytest.raises(DeviceError, match="before the lower limit switch"):
        cold.stage.home()
    stopper.join()
    cold.await_standstill()
    assert not cold.stage.state().homed


def test_homing_needs_the_index_pulse(room: Room[VoltageRig]) -> None:
    room.clear()
    with voltage_rig(velocity_rig(encoder={"z": ""})) as rig:
        rig.stage.enable()
        with pytest.raises(SettingsError, match=r"encoder\.z"):
            rig.stage.home()


def test_a_program_that_hangs_loses_the_drives_power(room: Room[VoltageRig]) -> None:
    room.clear()
    with voltage_rig(velocity_rig(hang_s=0.5, heartbeat_s=0.3)) as rig:
        rig.ready()
        begin(rig, acquire(LONG))
        until(lambda: rig.is_under_way)
        until(lambda: not rig.bench.powered)
        until(lambda: abs(rig.bench.speed_mm_s()) < 0.1)
        fault = rig.stage.fault
        assert fault is not None
        assert fault.cause is TripCause.WATCHDOG
        until(lambda: not rig.drive.status.enabled)
        assert rig.bench.position_mm() < 100.0


def test_velocity_mode_needs_a_relay_and_a_gain_that_settles() -> None:
    with pytest.raises(ValidationError, match="heartbeat relay"):
        settings(hardware={"drive": {"mode": "velocity"}})
    with pytest.raises(ValidationError, match="gain_per_s must not exceed"):
        VelocityOutputSettings(gain_per_s=50.0)


def test_no_speed_is_asked_for_that_ten_volts_do_not_say(room: Room[VoltageRig]) -> None:
    room.clear()
    with voltage_rig(velocity_rig(per_V=5.0)) as rig:
        assert rig.stage.limits.speed_mm_s == 50.0


@given(
    errors=st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=12),
    travel_mm=st.floats(-60.0, 60.0).filter(lambda first: abs(first) > 0.1),
    speed_mm_s=st.floats(1.0, 100.0),
    brakes_at=st.integers(0, 12),
)
def test_no_error_makes_it_ask_for_more_than_the_stage_may_do(
    errors: list[float], travel_mm: float, speed_mm_s: float, brakes_at: int
) -> None:
    velocity, stage = VelocityOutputSettings(), StageSettings()
    controller = SpeedController(velocity, stage)
    controller.follow(MotionCommand(stroke(travel_mm, speed_mm_s, 3000.0), 0.0, 0.0))
    parts = []
    for place, error_mm in enumerate(errors):
        if place == brakes_at:
            controller.brake()
        parts.append(controller.speeds(20, error_mm))
    controller.brake()
    parts.append(controller.speeds(100, errors[-1]))
    speeds = np.concatenate(parts)
    assert np.abs(speeds).max() <= stage.max_speed_mm_s
    assert np.abs(np.diff(speeds, prepend=0.0)).max() * velocity.rate_hz <= stage.max_accel_mm_s2 * (1 + 1e-9)
    assert speeds[-1] == 0.0
    assert controller.at_rest


PROGRAM = """
import sys
from dragrig.config.rig import RigSettings
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.rig.devices import BackendRequest
from dragrig.rig.hardware.backend import HardwareBackend
from dragrig.rig.profile import MotionProfile, trapezoid

rig = HardwareBackend(BackendRequest(RigSettings.model_validate_json(sys.argv[1]), FrictionModelSettings()))
rig.connect()
rig.stage.enable()
rig.stage.home()
rig.stage.move(MotionProfile.from_pieces(trapezoid(140.0, 20.0, 500.0)))
print("moves", flush=True)
sys.stdin.read()
"""


@pytest.mark.thorough
def test_a_program_that_is_killed_loses_the_drives_power() -> None:
    # Far ahead, for nothing stalls the clock of another process when this one starves.
    rig = velocity_rig(heartbeat_s=0.6, update_s=0.1, ahead=20, gain_per_s=0.25)
    with RemoteDoubles(rig) as doubles:
        arguments = [sys.executable, "-c", PROGRAM, doubles.rig().model_dump_json()]
        with subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as program:
            assert program.stdout is not None
            assert program.stdout.readline() == "moves\n"
            until(lambda: doubles.control.stage().speed_mm_s > 15.0)
            program.kill()
        until(lambda: doubles.control.stage().speed_mm_s == 0.0)
        look = doubles.control.stage()
        assert not look.enabled
        assert look.position_mm < 90.0
