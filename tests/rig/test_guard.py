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

from dragrig.config import TrippedError
from dragrig.config.rig import GuardSettings
from dragrig.rig.devices import Block, StageState, TravelEnd, Trip, TripCause
from dragrig.rig.guard import EncoderSilenceMonitor, Guard
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


def shown_at(positions: FloatArray, first: int = 0, force: float = 30.0) -> Block:
    return Block(first, {"force": np.full(len(positions), force), "position": np.asarray(positions, dtype=np.float64)})


def tripped_by(block: Block, command: FloatArray | None = None, guard: Guard | None = None) -> str:
    """Return the message of the trip that a block causes whose command is its position, and '' for none."""
    command = block.channels["position"] if command is None else command
    trip = (guard or armed()).inspect(block, command, BlockExtremes.of(block, command), RATE)
    assert trip is None or trip.message
    return "" if trip is None else trip.message


STILL = np.full(20, 5.0)
STEPPED = np.where(np.arange(20) < 10, 5.0, 5.0551)
"""A jump by 50.1 µm more than `_MAX_ACCELERATION_MM_S2` allows between two samples of `RATE`."""
JUMP = (
    "the position jumped by {:.3f} mm from a sample to the next: counts are lost or come twice; check the encoder's "
    "gap to its scale, its line receiver and the shield"
)


@pytest.mark.parametrize(
    ("inside", "outside", "message"),
    [
        (shown_at(STILL, force=8000.0), shown_at(STILL, force=8001.0), "force of 8001 mN is over the limit of 8000 mN"),
        (
            shown_at(STILL, force=-8000.0),
            shown_at(STILL, force=-8001.0),
            "force of 8001 mN is over the limit of 8000 mN",
        ),
        (
            shown_at(STILL + 36.0),
            shown_at(STILL + 36.001),
            "position 41.001 mm from the run's start is outside -1.000 to 41.000 mm",
        ),
        (
            shown_at(STILL - 6.0),
            shown_at(STILL - 6.001),
            "position -1.001 mm from the run's start is outside -1.000 to 41.000 mm",
        ),
        (shown_at(np.where(STEPPED > 5, 5.055, 5.0)), shown_at(STEPPED), JUMP.format(0.055)),
        (
            shown_at(5.0 + 0.034999 * np.arange(20)),
            shown_at(5.0 + 0.0351 * np.arange(20)),
            "speed of 35.1 mm/s is over the limit of 35.0 mm/s",
        ),
    ],
    ids=["force", "force the other way", "too far", "too far back", "jump", "speed"],
)
def test_a_trip_begins_at_its_limit_and_says_what_it_saw(inside: Block, outside: Block, message: str) -> None:
    assert tripped_by(inside) == ""
    assert tripped_by(outside) == message


def test_a_value_that_is_no_number_is_said() -> None:
    sentence = "a sample of force or position is not a number"
    for force, position in ((math.nan, 5.0), (30.0, math.nan), (math.inf, 5.0), (-math.inf, 5.0)):
        assert tripped_by(shown_at(np.full(20, position), force=force), STILL) == sentence


def test_a_tripped_guard_says_what_holds_it() -> None:
    guard = Guard(GuardSettings())
    with pytest.raises(TrippedError) as caught:
        guard.require_armed()
    assert str(caught.value) == (
        "the guard is tripped: the guard is tripped at start-up until it is reset; clear the cause and reset it."
    )
    late = Trip(TripCause.STALE_DATA, "late")
    guard.reset(CLEAR)
    guard.require_armed()
    assert guard.latch(late) is late
    with pytest.raises(TrippedError, match="the guard is tripped: late; clear"):
        guard.require_armed()


@pytest.mark.parametrize(("error_mm", "speed_mm_s", "limit_mm"), [(0.5, 0.0, 0.5), (1.0, 10.0, 1.0)])
def test_a_following_error_is_said_with_its_limit(error_mm: float, speed_mm_s: float, limit_mm: float) -> None:
    """The command moves within the block, or within the one before, for a stage that lags."""
    command = 5.0 + speed_mm_s * np.arange(20) / RATE
    over = f"following error of {error_mm + 0.002:.3f} mm is over the limit of {limit_mm:.3f} mm"
    assert tripped_by(shown_at(command - error_mm + 0.001), command) == ""
    assert tripped_by(shown_at(command - error_mm - 0.002), command) == over
    guard = armed()
    assert tripped_by(shown_at(command), command, guard) == ""
    then = np.full(20, command[-1])
    assert tripped_by(shown_at(then - error_mm + 0.001, 1000), then, guard) == ""
    guard.watch(MOTION)
    if speed_mm_s:
        assert tripped_by(shown_at(then - error_mm + 0.001, 2000), then, guard).startswith("following error of 0.999")


def test_a_jump_between_blocks_counts_only_where_none_is_lost() -> None:
    for first, message in ((20, JUMP.format(0.3)), (21, ""), (19, "")):
        guard = armed()
        assert tripped_by(shown_at(STILL), None, guard) == ""
        assert tripped_by(shown_at(STILL + 0.3, first), None, guard) == message
    guard = armed()
    assert tripped_by(shown_at(STILL), None, guard) == ""
    guard.watch(MOTION)
    assert tripped_by(shown_at(STILL + 0.3, 20), None, guard) == ""


def test_coarse_counts_are_no_jump() -> None:
    """Three counts, for a count may come late and go early; with a finer encoder the rig's own bound decides."""
    for count_mm, bound_mm in ((0.1, 0.3), (0.001, 0.05)):
        for jump_mm, jumps in ((bound_mm + 0.0049, False), (bound_mm + 0.0052, True)):
            guard = Guard(GuardSettings(), count_mm)
            guard.reset(CLEAR)
            guard.watch(MOTION)
            shown = np.where(np.arange(20) < 10, 5.0, 5.0 + jump_mm)
            assert tripped_by(shown_at(shown), None, guard) == (JUMP.format(jump_mm) if jumps else "")


@pytest.mark.parametrize("samples", [1, 2, 3, 4])
def test_a_jump_shows_in_blocks_of_any_length(samples: int) -> None:
    guard = armed()
    course = np.concatenate((np.full(9, 5.0), np.full(9, 5.2)))
    messages = [
        tripped_by(shown_at(course[first : first + samples], first), None, guard) for first in range(0, 18, samples)
    ]
    assert JUMP.format(0.2) in messages


def test_a_stage_that_is_held_up_changes_its_speed_once_and_does_not_jump() -> None:
    """The steps of 0.06 mm begin and end 10 samples apart."""
    course = 5.0 + np.cumsum(np.where((np.arange(40) >= 10) & (np.arange(40) < 20), 0.06, 0.0))
    guard = Guard(GuardSettings(speed_margin_mm_s=100.0))
    guard.reset(CLEAR)
    guard.watch(MOTION)
    assert tripped_by(shown_at(course), None, guard) == ""


def test_a_silent_encoder_is_said_with_time_and_way() -> None:
    """At 20 mm/s the command may move 0.4 + 0.05 × 20 = 1.4 mm, which it has after 71 samples."""
    guard = armed()
    told = []
    for first in range(0, 100, 10):
        command = 5.0 + 20.0 * np.arange(first, first + 10) / RATE
        told.append(tripped_by(shown_at(np.full(10, 5.0), first), command, guard))
    assert told == [
        *[""] * 7,
        "the encoder showed no count for 79 ms, while the command moved by 1.58 mm; check its cable, and whether the "
        "stage is blocked",
        *[""] * 2,
    ]
    assert guard.silent_from_rest
    replaced = guard.explain_silence(0.0, 0.05)
    assert replaced is guard.trip
    assert replaced == Trip(
        TripCause.NO_MOTION,
        "neither drive nor encoder moved for 79 ms, while the command moved by 1.58 mm; the drive begins too late, or "
        "the stage is blocked",
    )
    assert not guard.silent_from_rest


def silences(
    shown: Callable[[FloatArray], FloatArray], command: FloatArray, per_block: int = 10, dither_mm: float = 0.0015
) -> list[tuple[float, float, bool]]:
    """Return travel [mm], duration [ms] and whether from rest, after each block of a motion at `RATE`."""
    monitor = EncoderSilenceMonitor(dither_mm)
    found = []
    for first in range(0, len(command), per_block):
        index = np.arange(first, first + per_block, dtype=float)
        block, ordered = shown_at(shown(index), first), command[first : first + per_block]
        silence = monitor.add(block, ordered, BlockExtremes.of(block, ordered), RATE)
        found.append((round(silence.travel_mm, 6), round(1000 * silence.duration_s, 6), silence.from_rest))
    return found


STEADY = 0.02 * np.arange(40)
NONE = (0.0, 0.0, False)


def test_silence_is_measured_from_the_first_movement_after_the_last_count() -> None:
    assert silences(np.zeros_like, STEADY) == [
        (0.18, 9.0, True), (0.38, 19.0, True), (0.58, 29.0, True), (0.78, 39.0, True),
    ]  # fmt: skip
    counted_until_14 = silences(lambda index: 0.02 * np.minimum(index, 14), STEADY)
    assert counted_until_14 == [NONE, NONE, (0.3, 15.0, False), (0.5, 25.0, False)]
    alternating = silences(lambda index: 0.001 * (index % 2), STEADY)
    assert alternating == silences(np.zeros_like, STEADY)
    assert silences(lambda index: 0.002 * (index % 2), STEADY) == [NONE] * 4
    backwards = silences(np.zeros_like, -STEADY)
    assert backwards == silences(np.zeros_like, STEADY)


def test_a_count_between_two_blocks_ends_a_silence() -> None:
    once = silences(lambda index: 0.002 * (index >= 20), STEADY)
    assert once == [(0.18, 9.0, True), (0.38, 19.0, True), (0.18, 9.0, False), (0.38, 19.0, False)]
    creeping = silences(lambda index: 0.001 * (index // 10), STEADY)
    assert creeping == [(0.18, 9.0, True), (0.38, 19.0, True), (0.18, 9.0, False), (0.38, 19.0, False)]


def test_a_command_that_stands_is_no_silence_and_its_way_counts_when_it_goes_on() -> None:
    paused = np.concatenate((STEADY[:10], np.full(10, STEADY[9]), STEADY[10:30]))
    assert silences(np.zeros_like, paused) == [(0.18, 9.0, True), NONE, (0.38, 10.0, True), (0.58, 20.0, True)]
    counting = silences(lambda index: 0.02 * np.minimum(index, 9), paused)
    assert counting[1:] == [NONE, (0.2, 10.0, True), (0.4, 20.0, True)]
    returning = np.concatenate((STEADY[:10], STEADY[9] - 0.01 * np.arange(10)))
    assert silences(np.zeros_like, returning)[1] == (0.18, 19.0, True)


def test_only_an_emergency_stop_takes_the_place_of_what_a_stopped_stage_looks_like() -> None:
    stop, hot = Trip(TripCause.EMERGENCY_STOP, "pressed"), Trip(TripCause.DRIVE_FAULT, "hot")
    for cause in TripCause:
        guard = Guard(GuardSettings())
        guard.reset(CLEAR)
        assert guard.explain_standing(stop) is None
        assert not guard.may_be_stopped
        latched = Trip(cause, "seen")
        guard.latch(latched)
        standing = cause in {TripCause.ENCODER_SILENT, TripCause.FOLLOWING_ERROR, TripCause.NO_MOTION}
        assert guard.may_be_stopped is standing
        assert guard.explain_standing(None) is None
        assert guard.explain_standing(hot) is None
        assert guard.trip is latched
        assert guard.explain_standing(stop) is (stop if standing else None)
        assert guard.trip is (stop if standing else latched)
        assert guard.explain_silence(1.0, 1.0) is None


def test_a_refused_override_frees_nothing() -> None:
    guard = Guard(GuardSettings())
    low = pressed(TripCause.LIMIT_SWITCH_LOW)
    assert guard.override(TravelEnd.LOW, CLEAR) is None
    assert guard.override(TravelEnd.HIGH, low) is low.fault
    guard.watch(MOTION)
    for state in (low, pressed(TripCause.LIMIT_SWITCH_HIGH)):
        assert state.fault is not None
        assert not guard.permits(state.fault)
