"""The guard trips on what it should, once, and stays latched."""

import itertools

import numpy as np
import numpy.typing as npt
import pytest

from dragrig.config.rig import GuardSettings
from dragrig.rig.devices import Block, StageState
from dragrig.rig.guard import Guard
from dragrig.rig.profile import Extremes
from dragrig.rig.reading import Look
from dragrig.rig.trips import Cause, Trip

RATE = 1000.0
CLEAR = StageState(position_mm=40.0, enabled=True, homed=True, moving=False)


def armed() -> Guard:
    guard = Guard(GuardSettings())
    assert guard.reset(CLEAR) is None
    guard.watch(Extremes(lowest_mm=0.0, highest_mm=40.0, speed_mm_s=20.0, acceleration_mm_s2=400.0))
    return guard


def block(force: float = 30.0, start: float = 5.0, speed: float = 20.0, first: int = 0) -> Block:
    position = start + speed * np.arange(50) / RATE
    return Block(first, {"force": np.full(50, force, np.float32), "position": position.astype(np.float32)})


def seen(one: Block, command_off: float = 0.0) -> tuple[npt.NDArray[np.float32], Look]:
    command = (one.channels["position"] + command_off).astype(np.float32)
    return command, Look.at(one, command)


def test_it_starts_tripped_and_is_armed_by_a_reset() -> None:
    guard = Guard(GuardSettings())
    assert guard.trip is not None
    assert guard.trip.cause is Cause.START_UP
    assert guard.reset(CLEAR) is None


def test_a_reset_needs_all_conditions_clear() -> None:
    guard = Guard(GuardSettings())
    hot = Trip(Cause.DRIVE_FAULT, "the drive reports overheated")
    still = guard.reset(StageState(40.0, enabled=True, homed=True, moving=False, fault=hot))
    assert still is not None
    assert still.cause is Cause.DRIVE_FAULT


def test_a_run_as_planned_passes() -> None:
    guard = armed()
    for first in range(0, 500, 50):
        one = block(start=5 + first * 0.02, first=first)
        assert guard.inspect(one, *seen(one), RATE) is None


@pytest.mark.parametrize(
    ("bad", "command_off", "cause"),
    [
        (block(force=8001.0), 0.0, Cause.FORCE),
        (block(force=-8001.0), 0.0, Cause.FORCE),
        (block(force=float("nan")), 0.0, Cause.NOT_A_NUMBER),
        (block(start=40.5), 0.0, Cause.POSITION),
        (block(start=-1.5, speed=0.0), 0.0, Cause.POSITION),
        (block(speed=36.0), 0.0, Cause.SPEED),
        (block(speed=0.0), 0.51, Cause.FOLLOWING_ERROR),
    ],
)
def test_each_cause_trips(bad: Block, command_off: float, cause: Cause) -> None:
    trip = armed().inspect(bad, *seen(bad, command_off), RATE)
    assert trip is not None
    assert trip.cause is cause


def test_following_error_may_grow_with_speed() -> None:
    one = block(speed=20.0)
    assert armed().inspect(one, *seen(one, 1.4), RATE) is None
    assert armed().inspect(one, *seen(one, 1.6), RATE) is not None


def test_speed_is_seen_across_blocks_and_gaps() -> None:
    guard = armed()
    first, far = block(speed=0.0), block(start=9.0, speed=0.0, first=100)
    assert guard.inspect(first, *seen(first), RATE) is None
    trip = guard.inspect(far, *seen(far), RATE)
    assert trip is not None
    assert trip.cause is Cause.SPEED


def test_it_trips_once_and_stays_latched() -> None:
    guard = armed()
    bad = block(force=9000.0)
    assert guard.inspect(bad, *seen(bad), RATE) is not None
    assert guard.inspect(bad, *seen(bad), RATE) is None
    assert guard.latch(Trip(Cause.STALE_DATA, "late")) is None
    assert guard.trip is not None
    assert guard.trip.cause is Cause.FORCE
    good = block()
    assert guard.inspect(good, *seen(good), RATE) is None
    assert guard.trip.cause is Cause.FORCE


@pytest.mark.parametrize("offset", range(0, 50, 7))
def test_a_plain_lag_does_not_trip_where_the_stage_brakes_or_turns(offset: int) -> None:
    from dragrig.rig.profile import MotionProfile, trapezoid

    profile = MotionProfile.from_pieces([*trapezoid(40.0, 60.0, 400.0), *trapezoid(-40.0, 60.0, 400.0)])
    guard = Guard(GuardSettings())
    guard.reset(CLEAR)
    guard.watch(profile.extremes())
    starts = [0, *range(offset or 50, 1800, 50)]
    for first, end in itertools.pairwise(starts):
        time = np.arange(first, end) / RATE
        command = profile.position(time).astype(np.float32)
        lagging = profile.position(np.maximum(time - 0.02, 0.0)).astype(np.float32)
        one = Block(first, {"force": np.zeros(end - first, np.float32), "position": lagging})
        assert guard.inspect(one, command, Look.at(one, command), RATE) is None


def test_an_encoder_that_dithers_in_short_blocks_has_no_speed() -> None:
    guard = armed()
    for first in range(0, 400, 2):
        position = np.array([5.0, 5.001 if first % 4 else 4.999], np.float32)
        one = Block(first, {"force": np.zeros(2, np.float32), "position": position})
        assert guard.inspect(one, *seen(one), 20_000.0) is None
