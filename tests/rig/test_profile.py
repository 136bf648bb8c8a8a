"""Motion profiles: exact, bounded, and stoppable anywhere."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dragrig.rig.profile import MotionExtremes, MotionProfile, Phase, Piece, stationary_piece, trapezoid

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


def test_a_stroke_has_the_state_that_its_pieces_give_it() -> None:
    profile = stroke(-10.0, 20.0, 400.0)
    assert profile.pieces() == (
        Piece(1.0, 0.0, Phase.REST),
        Piece(pytest.approx(0.05), -400.0, Phase.ACCELERATE),
        Piece(pytest.approx(0.45), 0.0, Phase.STEADY),
        Piece(pytest.approx(0.05), 400.0, Phase.DECELERATE),
        Piece(3.0, 0.0, Phase.HOLD),
    )
    np.testing.assert_allclose(profile.start_s, [0.0, 1.0, 1.05, 1.5, 1.55])
    np.testing.assert_allclose(profile.position_mm, [0.0, 0.0, -0.5, -9.5, -10.0])
    np.testing.assert_allclose(profile.velocity_mm_s, [0.0, 0.0, -20.0, -20.0, 0.0])
    assert profile.phase.dtype == np.uint8
    assert profile.duration_s == pytest.approx(4.55)
    assert profile.motion_ends_s == pytest.approx(1.55)
    assert profile.extremes() == MotionExtremes(
        lowest_mm=pytest.approx(-10.0), highest_mm=0.0, speed_mm_s=pytest.approx(20.0), acceleration_mm_s2=400.0
    )
    np.testing.assert_array_equal(
        profile.acceleration([-0.1, 0.0, 1.0, 1.02, 1.2, 1.52, 1.6, 9.0]), [0, 0, -400, -400, 0, 400, 0, 0]
    )
    np.testing.assert_allclose(profile.position([-1.0, 1.05, 1.25, 9.0]), [0.0, -0.5, -4.5, -10.0])


def test_acceleration_ends_with_the_profile() -> None:
    ramp = MotionProfile.from_pieces([Piece(0.5, 2.0, Phase.ACCELERATE)])
    np.testing.assert_array_equal(ramp.acceleration([-1e-6, 0.0, 0.25, 0.5, 0.6]), [0, 2, 2, 0, 0])
    assert ramp.motion_ends_s == 0.5
    assert ramp.velocity(0.5) == 1.0


def test_a_move_too_short_for_its_speed_is_a_triangle() -> None:
    up, steady, down = trapezoid(-1.0, 40.0, 400.0)
    assert (up.duration_s, steady.duration_s, down.duration_s) == (0.05, 0.0, 0.05)
    assert (up.acceleration_mm_s2, steady.acceleration_mm_s2, down.acceleration_mm_s2) == (-400.0, 0.0, 400.0)
    assert (up.phase, steady.phase, down.phase) == (Phase.ACCELERATE, Phase.STEADY, Phase.DECELERATE)


def test_a_motion_of_no_pieces_is_none() -> None:
    nothing = MotionProfile.from_pieces([stationary_piece(0.0, Phase.REST)])
    shapes = {nothing.start_s.shape, nothing.position_mm.shape, nothing.velocity_mm_s.shape, nothing.phase.shape}
    assert shapes == {(0,)}
    assert (nothing.duration_s, nothing.motion_ends_s, nothing.pieces()) == (0.0, 0.0, ())
    resting = MotionProfile.from_pieces([stationary_piece(2.0, Phase.REST)])
    assert resting.motion_ends_s == 0.0
    assert resting.extremes() == MotionExtremes(0.0, 0.0, 0.0, 0.0)


def test_whatever_a_profile_is_made_of_can_no_longer_be_changed() -> None:
    profile = stroke(10.0, 20.0, 400.0)
    for name in ("start_s", "position_mm", "velocity_mm_s", "acceleration_mm_s2", "phase"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(profile, name)[0] = 1


def test_a_stopped_motion_brakes_and_is_held() -> None:
    forth, at_rest, back = (stroke(travel, 20.0, 400.0).stopped(at, 100.0, 0.5) for travel, at in
                            ((40.0, 1.5), (40.0, 0.5), (-40.0, 1.025)))  # fmt: skip
    assert forth.pieces()[2:] == (
        Piece(pytest.approx(0.45), 0.0, Phase.STEADY),
        Piece(pytest.approx(0.2), -100.0, Phase.DECELERATE),
        Piece(pytest.approx(0.5), 0.0, Phase.HOLD),
    )
    assert at_rest.pieces() == (Piece(0.5, 0.0, Phase.REST), Piece(0.5, 0.0, Phase.HOLD))
    assert back.pieces()[1:] == (
        Piece(pytest.approx(0.025), -400.0, Phase.ACCELERATE),
        Piece(pytest.approx(0.1), 100.0, Phase.DECELERATE),
        Piece(pytest.approx(0.5), 0.0, Phase.HOLD),
    )
    assert stroke(40.0, 20.0, 400.0).stopped(0.5, 100.0).duration_s == 0.5


def test_an_absurd_distance_is_for_its_limits_to_refuse() -> None:
    profile = MotionProfile.from_pieces([Piece(1e110, 1e150, Phase.ACCELERATE), Piece(1e110, -1e150, Phase.DECELERATE)])
    assert not np.isfinite(profile.position_mm).all()
