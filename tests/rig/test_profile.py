"""Motion profiles: exact, bounded, and stoppable anywhere."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dragrig.rig.profile import MotionProfile, Phase, stationary_piece, trapezoid

speeds = st.floats(0.1, 80)
accels = st.floats(50, 3000)
travels = st.floats(-60, 60).filter(lambda travel: abs(travel) > 0.5)


def stroke(travel: float, speed: float, accel: float) -> MotionProfile:
    pieces = (stationary_piece(1.0, Phase.REST), *trapezoid(travel, speed, accel), stationary_piece(3.0, Phase.HOLD))
    return MotionProfile.from_pieces(pieces)


@given(travels, speeds, accels)
def test_a_stroke_ends_where_it_should_and_never_exceeds_its_limits(travel: float, speed: float, accel: float) -> None:
    profile = stroke(travel, speed, accel)
    assert profile.position(profile.duration_s) == pytest.approx(travel, abs=1e-9)
    time = np.linspace(0, profile.duration_s, 4001)
    assert np.abs(profile.velocity(time)).max() <= speed * (1 + 1e-9)
    seen = profile.extremes()
    assert seen.lowest_mm == pytest.approx(min(travel, 0), abs=1e-9)
    assert seen.highest_mm == pytest.approx(max(travel, 0), abs=1e-9)
    assert seen.acceleration_mm_s2 == pytest.approx(accel)


@given(travels, speeds, accels)
def test_velocity_is_the_slope_of_position(travel: float, speed: float, accel: float) -> None:
    profile = stroke(travel, speed, accel)
    time = np.linspace(0.9, profile.duration_s - 2.9, 301)
    step = 1e-5
    slope = (profile.position(time + step) - profile.position(time - step)) / (2 * step)
    np.testing.assert_allclose(slope, profile.velocity(time), atol=accel * step + 1e-6)


@given(travels, speeds, accels, st.floats(0, 1))
def test_a_stop_keeps_the_past_and_ends_at_standstill(travel: float, speed: float, accel: float, part: float) -> None:
    profile = stroke(travel, speed, accel)
    at = part * profile.duration_s
    stopped = profile.stopped(at, 3000.0, hold_s=0.2)
    time = np.linspace(0, at, 200)
    np.testing.assert_allclose(stopped.position(time), profile.position(time), atol=1e-9)
    assert stopped.velocity(stopped.duration_s) == pytest.approx(0.0, abs=1e-6)
    braking_mm = speed**2 / 3000.0 / 2
    assert abs(float(stopped.position(stopped.duration_s)) - float(profile.position(at))) <= braking_mm + 1e-9


def test_a_phase_holds_its_first_instant_and_not_its_last() -> None:
    profile = stroke(40.0, 20.0, 400.0)
    time = np.array([0.0, 1.0 - 1e-6, 1.0 - 1e-10, 1.0, 1.05, 3.0, 3.05, 6.0])
    names = [Phase(int(number)) for number in profile.phase_at(time)]
    assert names == [
        Phase.REST, Phase.REST, Phase.ACCELERATE, Phase.ACCELERATE,
        Phase.STEADY, Phase.DECELERATE, Phase.HOLD, Phase.HOLD,
    ]  # fmt: skip


@pytest.mark.parametrize(("speed", "samples"), [(10.0, 4012), (0.5, 42001), (60.0, 2408), (40.0, 2550)])
def test_as_many_samples_as_rigs_elsewhere_take(speed: float, samples: int) -> None:
    assert stroke(40.0, speed, 400.0).samples(500.0) == samples


def test_extremes_see_the_turning_point_inside_a_piece() -> None:
    pieces = (*trapezoid(10.0, 20.0, 400.0)[:2], stationary_piece(0.0, Phase.HOLD))
    overshooting = MotionProfile.from_pieces(pieces).stopped(0.3, 100.0)
    assert overshooting.extremes().highest_mm == pytest.approx(float(overshooting.position(1.0)))
