"""The stage on its drive's double: the real serial library, over a pseudo-terminal and over a socket."""

import threading
import time
from contextlib import closing
from dataclasses import replace
from math import nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dragrig.config.errors import DeviceError
from dragrig.config.rig import DriveSettings
from dragrig.rig.devices import TravelEnd, TripCause
from dragrig.rig.hardware.dialects.base import Command, Halt, Parameter, Refusal, Reply, Request
from dragrig.rig.hardware.dialects.nikki import NikkiDialect
from dragrig.rig.hardware.drive.position_mode import PositionModeStage, split_into_strokes
from dragrig.rig.hardware.sync import FirstSample
from dragrig.rig.profile import MotionProfile, Phase, Piece, stationary_piece, trapezoid
from dragrig.sim_backend.doubles.protocol_double import DoublePort
from drive_ports import DrivePort, SocketPort
from driving import ANY_PORT, PORTS, RATE, BenchLines, Driven, Stall, driven, reached, until
from property_tests import thorough
from simulated import NEVER, stroke

LONG = stroke(travel_mm=100.0, speed_mm_s=50.0)
THERE_AND_BACK = MotionProfile.from_pieces(
    (
        stationary_piece(0.1, Phase.REST),
        *trapezoid(5.0, 50.0, 1000.0),
        stationary_piece(0.05, Phase.HOLD),
        *trapezoid(-3.0, 25.0, 500.0),
        *trapezoid(3.0, 25.0, 500.0),
        stationary_piece(0.05, Phase.HOLD),
    )
)


def stands(rig: Driven) -> bool:
    return not rig.sync.moving


def is_under_way(rig: Driven) -> bool:
    return abs(rig.bench.speed_mm_s()) > 10.0


@pytest.mark.parametrize("kind", [ANY_PORT, thorough(SocketPort), DoublePort])
def test_strokes_are_driven_when_and_where_the_profile_says(kind: type[DrivePort]) -> None:
    with driven(kind) as rig:
        rig.ready().sample(THERE_AND_BACK)
        assert rig.stage.state().moving
        rig.bench.clock.sleep(THERE_AND_BACK.duration_s, NEVER)
        until(lambda: not rig.stage.state().moving)
        samples = THERE_AND_BACK.samples(RATE)
        seen = rig.bench.sample(0, samples)["encoder_counts"] / 1000.0
        off = np.abs(seen - THERE_AND_BACK.position(np.arange(samples) / RATE)).max()
        assert rig.stage.start_uncertainty_s > 0
        assert off <= 50.0 * (rig.stage.start_uncertainty_s + 1.5 / RATE) + 0.002
        assert rig.stage.state().position_mm == pytest.approx(5.0, abs=1e-3)
        assert rig.stage.fault is None


def test_a_stroke_begins_within_milliseconds_of_its_time() -> None:
    with driven() as rig:
        rig.ready()
        uncertain = []
        with Stall() as stall:
            for _ in range(3):
                rig.sample(stroke(travel_mm=1.0))
                until(lambda: stands(rig))
                uncertain.append(rig.stage.start_uncertainty_s)
                rig.bench.end_sampling()
                rig.sync.disarm()
        # The stage's threads and the double's may all be late.
        assert 0 < min(uncertain) < 0.01 + 3 * stall.longest_s


def test_limits_are_written_and_read_back_before_a_move() -> None:
    with driven(thrust_limit_N=12.5, silence_s=3.7) as rig:
        rig.ready().stage.move(stroke())
        until(lambda: stands(rig))
        limits = rig.bench.rig.stage
        for parameter, value in (
            (Parameter.THRUST_LIMIT_N, 12.5), (Parameter.SILENCE_S, 3.7), (Parameter.LOWEST_MM, limits.lowest_mm),
            (Parameter.HIGHEST_MM, limits.highest_mm), (Parameter.STOP_ACCELERATION_MM_S2, limits.stop_accel_mm_s2),
        ):  # fmt: skip
            assert rig.drive.parameter(parameter) == pytest.approx(value)


def test_a_drive_that_keeps_another_limit_moves_nothing() -> None:
    with driven(thrust_limit_N=150.0) as rig:
        rig.stage.enable()
        with pytest.raises(DeviceError, match=r"holds 100\.0 as its thrust limit.*thrust_limit_N"):
            rig.stage.home()
        assert not {Command.HOME, Command.GO} & {request.command for request in rig.drive.requests}


@pytest.mark.parametrize("kind", PORTS[-1:])
def test_a_stop_from_another_thread_brakes_and_leaves_the_stage_ready(kind: type[DrivePort]) -> None:
    with driven(kind) as rig:
        rig.ready().sample(LONG)
        until(lambda: is_under_way(rig))
        stopper = threading.Thread(target=rig.stage.stop)
        stopper.start()
        stopper.join()
        until(lambda: stands(rig))
        state = rig.stage.state()
        assert rig.drive.status.halt is Halt.STOP
        assert state.enabled
        assert state.fault is None
        assert 0 < state.position_mm < 50.0
        rig.bench.end_sampling()
        rig.sync.disarm()
        rig.stage.move(stroke(travel_mm=1.0))
        until(lambda: stands(rig))
        assert rig.stage.state().position_mm == pytest.approx(state.position_mm + 1.0, abs=1e-3)


def test_a_stop_that_is_heeded_late_leaves_the_motion_after_it_alone() -> None:
    with reached() as rig:
        heeding, go_on, heeded = threading.Event(), threading.Event(), threading.Event()
        go_on.set()

        def hold_up() -> None:
            heeding.set()
            assert go_on.wait(600.0)

        # Listeners are called in turn, so this holds up the stage's own as a busy machine does.
        rig.link.on_stop(hold_up)
        with closing(PositionModeStage(rig.devices)) as stage:
            rig.link.on_stop(heeded.set)
            stage.enable()
            rig.bench.place(0.0)
            stage.home()
            go_on.clear()
            stage.stop()
            assert heeding.wait(600.0)
            rig.sync.arm()
            stage.move(THERE_AND_BACK)
            go_on.set()
            assert heeded.wait(600.0)
            rig.bench.begin_sampling(RATE)
            rig.sync.set_first_sample(FirstSample(rig.bench.clock.monotonic(), 0.0))
            stage.await_end(NEVER)
            until(lambda: not rig.sync.moving)
            assert stage.state().position_mm == pytest.approx(5.0, abs=0.01)


def test_a_stop_before_the_first_sample_drops_the_motion() -> None:
    with driven() as rig:
        rig.ready().sync.arm()
        rig.stage.move(stroke())
        assert rig.stage.state().moving
        rig.stage.stop()
        until(lambda: stands(rig))
        assert Command.GO not in {request.command for request in rig.drive.requests}


def test_homing_goes_to_the_switch_and_back_to_the_index() -> None:
    with driven(pace=5.0) as rig:
        rig.stage.enable()
        rig.bench.place(20.0)
        rig.bench.begin_sampling(RATE)
        rig.stage.home()
        counts = rig.bench.sample(0, rig.bench.available())["encoder_counts"] / 1000.0 + 20.0
        assert -4.1 < counts.min() <= -3.0
        assert counts[-1] == pytest.approx(0.0, abs=1e-3)
        state = rig.stage.state()
        assert (state.homed, state.moving) == (True, False)
        assert state.position_mm == pytest.approx(0.0, abs=1e-4)


def test_homing_can_be_stopped_and_is_then_unknown() -> None:
    with driven() as rig:
        rig.stage.enable()
        stopper = threading.Thread(target=lambda: (until(lambda: is_under_way(rig)), rig.stage.stop()))
        stopper.start()
        with pytest.raises(DeviceError, match="before the index pulse"):
            rig.stage.home()
        stopper.join()
        state = rig.stage.state()
        assert (state.homed, state.moving, state.enabled) == (False, False, True)
        with pytest.raises(DeviceError, match="home it"):
            rig.stage.move(stroke())


@pytest.mark.parametrize(
    "trouble", [{"drive_garbled": True}, thorough({"drive_silent": True}), thorough({"drive_reply_late_s": 2.5})]
)
def test_replies_that_cannot_be_believed_stop_the_stage(trouble: dict[str, float]) -> None:
    with driven(reply_s=0.1, silence_s=1.5) as rig:
        rig.ready().sample(stroke(travel_mm=140.0, speed_mm_s=20.0))
        until(lambda: is_under_way(rig))
        rig.bench.faults.inject(**trouble)
        until(lambda: rig.stage.fault is not None)
        assert rig.stage.fault is not None
        assert rig.stage.fault.cause is TripCause.DRIVE_FAULT
        assert "did not answer" in rig.stage.fault.message
        until(lambda: stands(rig))
        assert rig.drive.status.halt is Halt.STOP
        assert rig.bench.position_mm() < 139.0
        rig.bench.faults.clear()
        # A busy machine polls late, and a drive that is still unheard is not switched on.
        until(lambda: rig.port.has_sent_all and rig.link.unheard_s == 0.0)
        assert rig.stage.state().fault is not None
        rig.sync.disarm()
        rig.stage.disable()
        rig.stage.enable()
        rig.stage.move(stroke(travel_mm=1.0))
        until(lambda: stands(rig))
        assert rig.stage.fault is None


def test_a_position_that_is_no_number_is_none() -> None:
    class Unsure(NikkiDialect):
        """A dialect whose drive may say that it does not know where it is."""

        def decode(self, request: Request, replies: tuple[bytes, ...], drive: DriveSettings) -> Reply:
            reply = super().decode(request, replies, drive)
            return Reply(nan) if request.command is Command.POSITION else reply

    with driven() as rig:
        rig.ready()
        rig.link.dialect = Unsure()
        with pytest.raises(DeviceError, match="answered without a position"):
            rig.stage.state()
        with pytest.raises(DeviceError, match="answered without a position"):
            rig.stage.move(stroke())


@pytest.mark.parametrize("kind", [ANY_PORT, thorough(SocketPort), thorough(DoublePort)])
def test_a_cable_pulled_in_motion_leaves_the_stop_to_the_drive(kind: type[DrivePort]) -> None:
    with driven(kind, reply_s=0.3, silence_s=1.0) as rig:
        rig.ready().sample(stroke(travel_mm=100.0, speed_mm_s=20.0))
        until(lambda: is_under_way(rig))
        rig.bench.faults.inject(drive_unplugged=True)
        until(lambda: rig.stage.fault is not None)
        until(lambda: not rig.bench.moving)
        assert rig.drive.status.halt is Halt.SILENCE
        assert rig.bench.position_mm() < 90.0
        until(lambda: stands(rig))
        assert rig.stage.fault is not None
        assert "check the cable" in rig.stage.fault.message
        with pytest.raises(DeviceError):
            rig.stage.disable()


def test_an_alarm_stays_until_it_is_seen_to_and_the_drive_switched_off_and_on() -> None:
    with driven() as rig:
        rig.ready().sample(LONG)
        until(lambda: is_under_way(rig))
        rig.bench.faults.inject(drive_alarm="overheating")
        until(lambda: rig.stage.fault is not None)
        assert rig.stage.fault is not None
        assert (rig.stage.fault.cause, rig.stage.fault.message) == (
            TripCause.DRIVE_FAULT,
            "the drive reports overheating",
        )
        until(lambda: stands(rig))
        assert rig.drive.status.halt is Halt.ALARM
        rig.stage.disable()
        with pytest.raises(DeviceError, match="overheating"):
            rig.stage.enable()
        rig.bench.faults.clear()
        with pytest.raises(DeviceError, match="overheating"):
            rig.stage.enable()
        rig.stage.disable()
        rig.stage.enable()
        assert rig.stage.state().fault is None


def test_a_drive_that_hears_nothing_more_stops_by_itself() -> None:
    with driven(silence_s=0.8, reply_s=0.3) as rig:
        rig.ready().sample(stroke(travel_mm=100.0, speed_mm_s=12.0))
        until(lambda: is_under_way(rig))
        with rig.stage.withholding(polls=True):
            until(lambda: not rig.bench.moving)
        assert rig.bench.position_mm() < 90.0
        assert rig.drive.status.halt is Halt.SILENCE
        state = rig.stage.state()
        assert state.fault is not None
        assert state.fault.cause is TripCause.WATCHDOG


def test_a_stage_of_which_no_fresh_sample_is_seen_is_stopped_though_the_program_looks() -> None:
    with driven(stale_s=0.4) as rig:
        rig.ready().sample(LONG)
        until(lambda: rig.stage.fault is not None)
        assert rig.stage.fault is not None
        assert rig.stage.fault.cause is TripCause.STALE_DATA
        assert "guard.stale_data_s" in rig.stage.fault.message
        until(lambda: not rig.bench.moving)
        assert rig.drive.status.halt is Halt.STOP
        assert rig.bench.position_mm() < 90.0


def test_a_program_that_no_longer_looks_is_stopped_and_its_drive_fed_no_more() -> None:
    with driven(hang_s=0.2) as rig:
        rig.ready().sample(LONG)
        until(lambda: rig.stage.fault is not None)
        assert rig.stage.fault is not None
        assert rig.stage.fault.cause is TripCause.WATCHDOG
        assert "0.2 s" in rig.stage.fault.message
        until(lambda: not rig.bench.moving)
        assert rig.drive.status.halt is Halt.STOP
        assert rig.bench.position_mm() < 90.0
        rig.watchdog.feed()
        until(lambda: stands(rig))
        assert rig.stage.fault is not None
        rig.sync.disarm()
        rig.stage.disable()
        assert rig.stage.state().fault is None


def test_a_program_that_looks_is_left_alone() -> None:
    profile = stroke(travel_mm=28.0, speed_mm_s=20.0)
    with driven(hang_s=1.0) as rig:
        rig.ready().sample(profile)
        while rig.sync.moving:
            rig.watchdog.feed()
            time.sleep(0.01)
        assert rig.stage.fault is None
        assert rig.bench.position_mm() == pytest.approx(28.0, abs=1e-3)


@pytest.mark.parametrize(
    ("trouble", "cause", "halt"),
    [({"e_stop_pressed": True}, TripCause.EMERGENCY_STOP, Halt.EMERGENCY_STOP),
     ({"limit_high_pressed": True}, TripCause.LIMIT_SWITCH_HIGH, Halt.LIMIT_SWITCH)],
)  # fmt: skip
@pytest.mark.parametrize("wired", [True, False], ids=["seen by the card", "seen by the drive alone"])
def test_a_switch_pressed_in_motion_stops_and_stays_told(
    wired: bool, trouble: dict[str, float], cause: TripCause, halt: Halt
) -> None:
    with driven(wired=wired) as rig:
        rig.ready().sample(LONG)
        until(lambda: is_under_way(rig))
        rig.bench.faults.inject(**trouble)
        until(lambda: rig.stage.fault is not None)
        assert rig.stage.fault is not None
        assert rig.stage.fault.cause is cause
        until(lambda: stands(rig))
        assert rig.drive.status.halt in {halt, Halt.STOP}
        assert rig.sync.stop_requested
        assert rig.bench.position_mm() < 50.0
        with pytest.raises(DeviceError, match="remove the cause"):
            rig.stage.move(stroke(travel_mm=-1.0))
        rig.bench.faults.clear()
        rig.sync.disarm()
        rig.stage.disable()
        assert rig.stage.state().fault is None


def test_an_override_frees_one_side_for_one_slow_move_away() -> None:
    with driven(wired=True, homing_speed_mm_s=10.0) as rig:
        rig.ready()
        rig.bench.place(-3.5)
        assert rig.stage.state().fault is not None
        with pytest.raises(DeviceError, match="lower limit switch"):
            rig.stage.move(stroke(travel_mm=0.2, speed_mm_s=5.0))
        rig.stage.override_limit(TravelEnd.LOW)
        assert rig.stage.state().fault is None
        with pytest.raises(DeviceError, match="away from it"):
            rig.stage.move(stroke(travel_mm=-0.1, speed_mm_s=5.0))
        with pytest.raises(DeviceError, match="10 mm/s at most"):
            rig.stage.move(stroke(travel_mm=5.0, speed_mm_s=20.0))
        rig.stage.move(stroke(travel_mm=0.2, speed_mm_s=5.0))
        until(lambda: stands(rig))
        assert rig.bench.position_mm() == pytest.approx(-3.3, abs=1e-3)
        fault = rig.stage.state().fault
        assert fault is not None
        assert fault.cause is TripCause.LIMIT_SWITCH_LOW
        rig.stage.override_limit(TravelEnd.LOW)
        rig.bench.faults.inject(limit_high_pressed=True)
        fault = rig.stage.state().fault
        assert fault is not None
        assert fault.cause is TripCause.LIMIT_SWITCH_HIGH


def test_the_enable_line_taken_away_brakes_and_is_told() -> None:
    with driven(wired=True) as rig:
        rig.ready().sample(LONG)
        until(lambda: is_under_way(rig))
        rig.lines.set_enable(False)
        until(lambda: not rig.bench.moving)
        assert rig.drive.status.halt is Halt.DISABLED
        until(lambda: rig.stage.fault is not None)
        assert not rig.stage.state().enabled


def test_the_drive_refuses_what_a_drive_refuses() -> None:
    def go(rig: Driven, to_mm: float) -> Refusal | None:
        return rig.drive.act(Request(Command.GO, value=to_mm)).refusal

    with driven() as rig:
        assert go(rig, 1.0) is Refusal.DISABLED
        rig.stage.enable()
        assert go(rig, 1.0) is Refusal.NOT_HOMED
        rig.ready().stage.move(stroke(travel_mm=20.0))
        until(lambda: is_under_way(rig))
        assert go(rig, 1.0) is Refusal.MOVING
        until(lambda: stands(rig))
        assert go(rig, 151.0) is Refusal.SOFT_LIMIT
        [frame] = rig.link.dialect.encode(Request(Command.STATUS), rig.devices.settings.hardware.drive)
        assert rig.drive.answer(frame[:-1] + b"?") == b""


def test_the_heartbeat_goes_on_while_all_is_well() -> None:
    with driven(wired=True) as rig:
        assert isinstance(rig.lines, BenchLines)
        before = rig.lines.beats
        until(lambda: rig.lines.beats >= before + 5)


def test_a_drive_that_does_not_answer_is_no_stage() -> None:
    with driven(reply_s=0.05, silence_s=1.0) as rig:
        rig.bench.faults.inject(drive_silent=True)
        with pytest.raises(DeviceError, match="did not answer"):
            rig.stage.state()


STROKES = st.lists(
    st.tuples(
        st.floats(0.01, 100.0), st.sampled_from([-1.0, 1.0]), st.floats(0.1, 100.0), st.floats(10.0, 3000.0),
        st.sampled_from([0.0, 0.1, 2.0]),
    ),
    min_size=1, max_size=5,
)  # fmt: skip


@given(STROKES)
def test_a_profile_is_cut_into_the_strokes_it_is_made_of(
    moves: list[tuple[float, float, float, float, float]],
) -> None:
    pieces: list[Piece] = []
    for travel, sign, speed, accel, pause in moves:
        pieces += [stationary_piece(pause, Phase.HOLD), *trapezoid(sign * travel, speed, accel)]
    profile = MotionProfile.from_pieces(pieces)
    strokes = split_into_strokes(profile)
    assert len(strokes) == len(moves)
    made: list[Piece] = []
    at_s = at_mm = 0.0
    for point in strokes:
        again = trapezoid(point.end_mm - at_mm, point.speed_mm_s, point.acceleration_mm_s2)
        made += [stationary_piece(max(point.start_s - at_s, 0.0), Phase.HOLD), *again]
        at_s, at_mm = point.ends_s, point.end_mm
    times = np.linspace(0.0, profile.duration_s, 200)
    np.testing.assert_allclose(MotionProfile.from_pieces(made).position(times), profile.position(times), atol=1e-4)


def test_what_no_drive_follows_is_refused() -> None:
    up, steady, down = trapezoid(5.0, 50.0, 1000.0)
    softer = Piece(2 * down.duration_s, down.acceleration_mm_s2 / 2, Phase.DECELERATE)
    bent = (Piece(0.05, -200.0, Phase.DECELERATE), Piece(0.08, -500.0, Phase.DECELERATE))
    for pieces in ((up, steady, softer), (up, *bent)):
        profile = MotionProfile.from_pieces(pieces)
        assert profile.velocity(profile.duration_s) == pytest.approx(0.0, abs=1e-9)
        with pytest.raises(DeviceError, match="strokes of one acceleration"):
            split_into_strokes(profile)


def test_a_reply_lost_on_a_busy_computer_ends_no_motion() -> None:
    with driven(reply_s=0.2, silence_s=2.0) as rig:
        rig.ready().stage.move(stroke(travel_mm=30.0, speed_mm_s=20.0))
        until(lambda: is_under_way(rig))
        rig.bench.faults.inject(drive_silent=True)
        silent_for_s = 0.6  # longer than a reply may take, asked for once more; shorter than half the silence timeout
        assert not threading.Event().wait(silent_for_s)
        rig.bench.faults.clear()
        until(lambda: stands(rig))
        assert rig.stage.fault is None
        assert rig.drive.status.halt is Halt.TARGET


@pytest.mark.thorough
@pytest.mark.parametrize("dialect", [{}, {"dialect": "modbus"}])
def test_a_motion_goes_on_though_load_makes_replies_late(dialect: dict[str, object]) -> None:
    with driven(reply_s=0.1, silence_s=2.0, **dialect) as rig:
        rig.ready()
        rig.bench.faults.inject(drive_reply_load_s=0.15 if dialect else 0.8)
        rig.stage.move(stroke(travel_mm=60.0, speed_mm_s=20.0))
        until(lambda: is_under_way(rig))
        until(lambda: stands(rig))
        assert rig.stage.fault is None
        assert rig.drive.status.halt is Halt.TARGET
        assert rig.stage.late_replies > 0


def test_homing_does_not_wait_for_ever_on_a_drive_that_says_it_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    with driven(pace=20.0, silence_s=0.5) as rig:
        rig.stage.enable()
        rig.bench.place(0.0)
        fget = type(rig.drive).status.fget
        assert fget is not None
        monkeypatch.setattr(type(rig.drive), "status", property(lambda drive: replace(fget(drive), moving=True)))
        with pytest.raises(DeviceError, match=r"still moves.*by hand"):
            rig.stage.home()
        assert Command.STOP in {request.command for request in rig.drive.requests}
