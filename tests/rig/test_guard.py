"""The guard trips on what it should, once, and stays latched."""

import itertools
import math
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dragrig.config.rig import GuardSettings
from dragrig.rig.devices import Block, StageState, TravelEnd, Trip, TripCause
from dragrig.rig.guard import Guard
from dragrig.rig.profile import FloatArray, MotionExtremes, MotionProfile, Phase, stationary_piece, trapezoid
from dragrig.rig.reading import BlockExtremes

RATE = 1000.0
MOTION = MotionExtremes(lowest_mm=0.0, highest_mm=40.0, speed_mm_s=20.0, acceleration_mm_s2=400.0)
CLEAR = StageState(position_mm=40.0, enabled=True, homed=True, moving=False)


def armed() -> Guard:
    guard = Guard(GuardSettings())
    assert guard.reset(CLEAR) is None
    guard.watch(MOTION)
    return guard


def make_block(force: float = 30.0, start: float = 5.0, speed: float = 20.0, first: int = 0) -> Block:
    position = start + speed * np.arange(50) / RATE
    return Block(first, {"force": np.full(50, force, np.float32), "position": position.astype(np.float32)})


def with_command(block: Block, command_off: float = 0.0) -> tuple[npt.NDArray[np.float32], BlockExtremes]:
    command = (block.channels["position"] + command_off).astype(np.float32)
    return command, BlockExtremes.of(block, command)


def test_it_starts_tripped_and_is_armed_by_a_reset() -> None:
    guard = Guard(GuardSettings())
    assert guard.trip is not None
    assert guard.trip.cause is TripCause.START_UP
    assert guard.reset(CLEAR) is None


def test_a_reset_needs_all_conditions_clear() -> None:
    guard = Guard(GuardSettings())
    hot = Trip(TripCause.DRIVE_FAULT, "the drive reports overheated")
    still = guard.reset(StageState(40.0, enabled=True, homed=True, moving=False, fault=hot))
    assert still is not None
    assert still.cause is TripCause.DRIVE_FAULT


def test_a_run_as_planned_passes() -> None:
    guard = armed()
    for first in range(0, 500, 50):
        block = make_block(start=5 + first * 0.02, first=first)
        assert guard.inspect(block, *with_command(block), RATE) is None


@pytest.mark.parametrize(
    ("bad", "command_off", "cause"),
    [
        (make_block(force=8001.0), 0.0, TripCause.FORCE),
        (make_block(force=-8001.0), 0.0, TripCause.FORCE),
        (make_block(force=float("nan")), 0.0, TripCause.NOT_A_NUMBER),
        (make_block(start=40.5), 0.0, TripCause.POSITION),
        (make_block(start=-1.5, speed=0.0), 0.0, TripCause.POSITION),
        (make_block(speed=36.0), 0.0, TripCause.SPEED),
        (make_block(speed=0.0), 0.51, TripCause.FOLLOWING_ERROR),
    ],
)
def test_each_cause_trips(bad: Block, command_off: float, cause: TripCause) -> None:
    trip = armed().inspect(bad, *with_command(bad, command_off), RATE)
    assert trip is not None
    assert trip.cause is cause


def test_following_error_may_grow_with_speed() -> None:
    block = make_block(speed=20.0)
    assert armed().inspect(block, *with_command(block, 1.4), RATE) is None
    assert armed().inspect(block, *with_command(block, 1.6), RATE) is not None


def test_speed_is_seen_across_blocks_and_gaps() -> None:
    guard = armed()
    first, far = make_block(speed=0.0), make_block(start=9.0, speed=0.0, first=100)
    assert guard.inspect(first, *with_command(first), RATE) is None
    trip = guard.inspect(far, *with_command(far), RATE)
    assert trip is not None
    assert trip.cause is TripCause.SPEED


def test_it_trips_once_and_stays_latched() -> None:
    guard = armed()
    bad = make_block(force=9000.0)
    assert guard.inspect(bad, *with_command(bad), RATE) is not None
    assert guard.inspect(bad, *with_command(bad), RATE) is None
    assert guard.latch(Trip(TripCause.STALE_DATA, "late")) is None
    assert guard.trip is not None
    assert guard.trip.cause is TripCause.FORCE
    good = make_block()
    assert guard.inspect(good, *with_command(good), RATE) is None
    assert guard.trip.cause is TripCause.FORCE


@pytest.mark.parametrize("offset", range(0, 50, 7))
def test_a_plain_lag_does_not_trip_where_the_stage_brakes_or_turns(offset: int) -> None:
    profile = MotionProfile.from_pieces([*trapezoid(40.0, 60.0, 400.0), *trapezoid(-40.0, 60.0, 400.0)])
    guard = Guard(GuardSettings())
    guard.reset(CLEAR)
    guard.watch(profile.extremes())
    starts = [0, *range(offset or 50, 1800, 50)]
    for first, end in itertools.pairwise(starts):
        time = np.arange(first, end) / RATE
        command = profile.position(time).astype(np.float32)
        lagging = profile.position(np.maximum(time - 0.02, 0.0)).astype(np.float32)
        block = Block(first, {"force": np.zeros(end - first, np.float32), "position": lagging})
        assert guard.inspect(block, command, BlockExtremes.of(block, command), RATE) is None


def test_an_encoder_that_dithers_in_short_blocks_has_no_speed() -> None:
    guard = armed()
    for first in range(0, 400, 2):
        position = np.array([5.0, 5.001 if first % 4 else 4.999], np.float32)
        block = Block(first, {"force": np.zeros(2, np.float32), "position": position})
        assert guard.inspect(block, *with_command(block), 20_000.0) is None


def driven(
    guard: Guard,
    profile: MotionProfile,
    shown: Callable[[FloatArray], FloatArray],
    block_s: float,
) -> Trip | None:
    """Let the guard see a motion whose encoder shows `shown` of the command, until it trips."""
    assert guard.reset(CLEAR) is None
    guard.watch(profile.extremes())
    per_block = round(block_s * RATE)
    for first in range(0, profile.samples(RATE) - per_block, per_block):
        time = np.arange(first, first + per_block) / RATE
        command = profile.position(time).astype(np.float32)
        block = Block(first, {"force": np.zeros(per_block, np.float32), "position": shown(time)})
        if trip := guard.inspect(block, command, BlockExtremes.of(block, command), RATE):
            return trip
    return None


@pytest.mark.parametrize("block_s", [0.01, 0.05])
@pytest.mark.parametrize(("speed", "accel"), [(0.5, 400.0), (5.0, 50.0), (20.0, 400.0), (60.0, 400.0), (100.0, 3000.0)])
@pytest.mark.parametrize("stuck_s", [0.0, 0.137])
def test_a_stuck_encoder_is_reported_before_anything_else(
    speed: float, accel: float, stuck_s: float, block_s: float
) -> None:
    profile = MotionProfile.from_pieces([stationary_piece(0.1, Phase.REST), *trapezoid(60.0, speed, accel)])
    trip = driven(Guard(GuardSettings()), profile, lambda time: profile.position(np.minimum(time, stuck_s)), block_s)
    assert trip is not None
    assert trip.cause is TripCause.ENCODER_SILENT


@pytest.mark.parametrize("counts", [100, -100, -400])
@pytest.mark.parametrize("speed", [2.0, 20.0, 50.0, 100.0, -100.0])
@pytest.mark.parametrize("at_s", [0.3, 0.349, 0.35])
def test_counts_that_are_lost_or_come_twice_are_a_jump_at_any_speed(at_s: float, speed: float, counts: int) -> None:
    travel_mm = math.copysign(min(60.0, abs(speed)), speed)
    profile = MotionProfile.from_pieces([stationary_piece(0.1, Phase.REST), *trapezoid(travel_mm, abs(speed), 3000.0)])

    def shown(time: FloatArray) -> FloatArray:
        return np.rint(1000.0 * profile.position(time) + counts * (time > at_s)) / 1000.0

    trip = driven(Guard(GuardSettings(), 0.001), profile, shown, 0.05)
    assert trip is not None
    assert trip.cause is TripCause.ENCODER_JUMP
    assert re.search(rf"by {abs(counts) / 1000:.2f}|by {abs(counts) / 1000 - 0.01:.2f}9", trip.message), trip.message
    undisturbed = driven(
        Guard(GuardSettings(), 0.001), profile, lambda time: np.rint(1000.0 * profile.position(time)) / 1000.0, 0.05
    )
    assert undisturbed is None


def test_one_wire_broken_is_silence_too() -> None:
    profile = MotionProfile.from_pieces(trapezoid(40.0, 20.0, 400.0))
    to_and_fro = driven(
        Guard(GuardSettings(), count_mm=0.001), profile, lambda time: 0.001 * (np.arange(len(time)) % 2), 0.05
    )
    assert to_and_fro is not None
    assert to_and_fro.cause is TripCause.ENCODER_SILENT


@pytest.mark.parametrize(("late_s", "speed", "accel"), [(0.02, 100.0, 3000.0), (0.06, 20.0, 400.0), (0.3, 1.0, 10.0)])
@pytest.mark.parametrize("offset_s", [0.0, 0.011, 0.023, 0.037])
def test_a_late_start_is_no_silence(offset_s: float, late_s: float, speed: float, accel: float) -> None:
    profile = MotionProfile.from_pieces([stationary_piece(0.2 + offset_s, Phase.REST), *trapezoid(60.0, speed, accel)])
    settings = GuardSettings(following_error_mm=5.0)
    assert driven(Guard(settings), profile, lambda time: profile.position(time - late_s), 0.05) is None


@pytest.mark.parametrize(
    ("counted_mm", "drive_mm", "stuck_s", "cause"),
    [
        (0.0, 0.0, 0.0, TripCause.NO_MOTION),
        (0.001, 0.7, 0.0, TripCause.ENCODER_SILENT),
        (0.6, 0.7, 0.0, TripCause.NO_MOTION),
        (0.0, math.nan, 0.0, TripCause.ENCODER_SILENT),
        (0.6, math.nan, 0.0, TripCause.NO_MOTION),
        (0.6, 0.0, 0.3, TripCause.ENCODER_SILENT),
    ],
    ids=["nothing moved", "drive alone", "both, too late", "nobody knows", "only the encoder's word", "counted before"],
)
def test_a_stage_that_set_out_too_late_is_told_from_a_silent_encoder(
    counted_mm: float, drive_mm: float, stuck_s: float, cause: TripCause
) -> None:
    stroke = (stationary_piece(0.2, Phase.REST), *trapezoid(20.0, 20.0, 400.0))
    once, twice = MotionProfile.from_pieces(stroke), MotionProfile.from_pieces((*stroke, *stroke))
    for profile, rest_s in ((once, 0.0), (twice, once.duration_s)):
        # Of two strokes, the second one is late.
        guard = Guard(GuardSettings(), 0.001)
        trip = driven(
            guard,
            profile,
            lambda time, profile=profile, rest_s=rest_s: profile.position(np.minimum(time, rest_s + stuck_s)),
            0.05,
        )
        assert trip is not None
        assert trip.cause is TripCause.ENCODER_SILENT
        assert (guard.explain_silence(counted_mm, drive_mm) is not None) is (cause is TripCause.NO_MOTION)
        assert guard.trip is not None
        assert guard.trip.cause is cause


@given(st.lists(st.integers(-3, 3), min_size=400, max_size=400), st.integers(1, 60))
def test_whatever_an_encoder_shows_is_judged(shown: list[int], per_block: int) -> None:
    positions = 0.001 * np.array(shown)
    profile = MotionProfile.from_pieces([stationary_piece(0.05, Phase.REST), *trapezoid(2.0, 10.0, 400.0)])
    trip = driven(
        Guard(GuardSettings(), count_mm=0.001), profile, lambda time: positions[: len(time)], per_block / RATE
    )
    assert trip is None or trip.cause in {TripCause.ENCODER_SILENT, TripCause.FOLLOWING_ERROR}


def test_rest_hold_and_creeping_are_no_silence() -> None:
    rests = [stationary_piece(5.0, Phase.REST), *trapezoid(0.1, 0.01, 400.0), stationary_piece(5.0, Phase.HOLD)]
    profile = MotionProfile.from_pieces(rests)
    coarse = driven(Guard(GuardSettings()), profile, lambda time: np.rint(profile.position(time) / 0.02) * 0.02, 0.05)
    assert coarse is None


def pressed(cause: TripCause) -> StageState:
    return replace(CLEAR, fault=Trip(cause, "pressed"))


def test_an_override_frees_one_switch_for_one_motion() -> None:
    guard = Guard(GuardSettings())
    low, high = pressed(TripCause.LIMIT_SWITCH_LOW), pressed(TripCause.LIMIT_SWITCH_HIGH)
    assert guard.reset(low) is low.fault
    assert guard.override(TravelEnd.HIGH, low) is low.fault
    assert guard.trip is low.fault
    assert guard.override(TravelEnd.LOW, low) is None
    guard.watch(MOTION)
    assert low.fault is not None
    assert high.fault is not None
    assert guard.permits(low.fault)
    assert not guard.permits(high.fault)
    bad = make_block(force=9000.0)
    assert guard.inspect(bad, *with_command(bad), RATE) is not None


@pytest.mark.parametrize("reset_between", [False, True])
def test_an_override_lasts_for_one_motion_only(reset_between: bool) -> None:
    guard = Guard(GuardSettings())
    low = pressed(TripCause.LIMIT_SWITCH_LOW)
    assert guard.override(TravelEnd.LOW, low) is None
    if reset_between:
        assert guard.reset(CLEAR) is None
    else:
        guard.watch(MOTION)
    guard.watch(MOTION)
    assert low.fault is not None
    assert not guard.permits(low.fault)
