"""A motion known only from encoder counts gives the force of the motion itself."""

from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dragrig.config.errors import AnalysisError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.rig.profile import FloatArray, MotionProfile
from dragrig.sim_backend.friction import RecordedMotion, prepare
from dragrig.sim_backend.friction.contact import COUNTED_RULE, FINE_RULE
from dragrig.sim_backend.friction.friction_force import SlidingForce
from dragrig.sim_backend.friction.motion import commanded_motion, measured_motion
from friction_cases import moves, sliding, sticking
from property_tests import examples, thorough

MODEL = FrictionModelSettings()

PROFILES = {
    "slow": moves((20.0, 0.5)),
    "fast": moves((40.0, 60.0)),
    "turning": moves((30.0, 10.0), (-30.0, 10.0)),
    "turning after rests": moves((3.0, 10.0), (-2.0, 20.0), (1.0, 5.0), (-10.0, 2.0), (4.0, 60.0), between=0.3),
}


def counts(profile: MotionProfile, rate: float) -> tuple[FloatArray, FloatArray]:
    time = np.arange(profile.samples(rate)) / rate
    return time, np.round(profile.position(time) * 1000) / 1000


def away_from_starts_and_stops(profile: MotionProfile, time: FloatArray) -> np.ndarray:
    """Where no start, stop or turn lies within 5 ms: a count more or less says no more than that."""
    ends = np.append(profile.start_s, profile.duration_s)
    still = np.abs(profile.velocity(ends)) < 1e-9
    return np.abs(time[:, None] - ends[still]).min(axis=1) > 0.005


@pytest.mark.parametrize("rate", [200.0, 1000.0, 10000.0])
@pytest.mark.parametrize("name", PROFILES)
def test_counts_give_the_force_of_the_motion(name: str, rate: float) -> None:
    profile = PROFILES[name]
    time, position = counts(profile, rate)
    truth = prepare(sliding(profile), MODEL).force(time)
    force = prepare(sliding(profile), MODEL, RecordedMotion.of(time, position)).force(time)
    away = away_from_starts_and_stops(profile, time)
    assert away.mean() > 0.9
    # f_c jumps when fresh wall comes to the equator: a sample or two may fall on the other side of that.
    error = np.sort(np.abs(force - truth)[away])[:-3]
    assert error.max() < 0.005 * np.ptp(truth)


def rippling() -> tuple[FloatArray, RecordedMotion]:
    time = np.arange(6000) / 1000
    position = 8.0 * np.clip(time - 1.0, 0.0, 4.0) + 0.15 * np.sin(2 * np.pi * np.clip(time - 1.0, 0.0, 4.0) / 0.25)
    return time, RecordedMotion.of(time, np.round(position * 1000) / 1000)


def test_the_quadrature_of_a_counted_motion_is_as_fine_as_a_sensor_can_tell() -> None:
    time, motion = rippling()
    coarse = prepare(sliding(moves()), MODEL, motion).friction
    assert isinstance(coarse, SlidingForce)
    assert coarse.rule == COUNTED_RULE
    of = SlidingForce.of(coarse.contact, coarse.history, 0.0, pressing=True, rule=FINE_RULE)
    error = coarse.components(time).f_e - of.components(time).f_e
    assert 0.0 < np.sqrt(np.mean(error**2)) < 0.05
    assert np.abs(error).max() < 0.4


@pytest.mark.parametrize("name", PROFILES)
def test_stretches_that_are_evaluated_at_once_give_the_same(name: str) -> None:
    time, position = counts(PROFILES[name], 1000.0)
    for motion in (RecordedMotion.of(time, position), rippling()[1]):
        force = prepare(sliding(PROFILES[name]), MODEL, motion).friction
        assert isinstance(force, SlidingForce)
        alone = replace(force, spans=force.intervals)
        for part, expected in zip(astuple(force.components(time)), astuple(alone.components(time)), strict=True):
            np.testing.assert_array_equal(part, expected)
    assert len(force.spans) < 0.2 * len(force.intervals)


def test_a_resting_stage_makes_no_friction() -> None:
    time, position = counts(PROFILES["slow"], 1000.0)
    motion = RecordedMotion.of(time, position)
    assert not motion.velocity(np.linspace(0.0, 0.99, 100)).any()
    parts = prepare(sliding(PROFILES["slow"]), MODEL, motion).components(time[time < 0.99])
    assert not parts.f_c.any()
    assert not parts.f_v.any()


def test_a_dithering_encoder_is_still_at_rest_when_its_jitter_is_told() -> None:
    profile = moves((20.0, 5.0))
    time, position = counts(profile, 1000.0)
    noisy = position + np.round(np.random.default_rng(0).normal(0.0, 1.0, time.size)) / 1000
    motion = RecordedMotion.of(time, noisy, jitter_mm=0.007)
    assert motion.signs.tolist() == [0, *[1] * (motion.signs.size - 2), 0]
    truth = prepare(sliding(profile), MODEL).force(time)
    force = prepare(sliding(profile), MODEL, motion).force(time)
    away = np.abs(time[:, None] - profile.start_s[[1, -1]]).min(axis=1) > 0.02
    assert np.abs(force - truth)[away].max() < 0.01 * np.ptp(truth)


def test_a_sticking_run_takes_a_recorded_motion_too() -> None:
    profile = moves((2.5, 20.0), acceleration=2000.0, hold=5.0)
    time, position = counts(profile, 1000.0)
    acquisition = sticking(profile, 1.0)
    truth = prepare(acquisition, MODEL).force(time)
    force = prepare(acquisition, MODEL, RecordedMotion.of(time, position)).force(time)
    assert np.abs(force - truth).max() < 0.02 * np.ptp(truth)
    assert np.abs(force - truth)[time > 1.2].max() < 0.002 * np.ptp(truth)


def test_a_gap_is_bridged() -> None:
    profile = moves((20.0, 5.0))
    time, position = counts(profile, 1000.0)
    remaining = (time < 3.0) | (time > 3.1)
    truth = prepare(sliding(profile), MODEL).force(time)
    force = prepare(sliding(profile), MODEL, RecordedMotion.of(time[remaining], position[remaining])).force(time)
    away = away_from_starts_and_stops(profile, time)
    assert np.abs(force - truth)[away].max() < 0.01 * np.ptp(truth)


@settings(max_examples=examples(30), deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), samples=st.integers(5, 400), scale=st.sampled_from([0.0, 0.001, 0.1, 5.0]))
def test_any_record_gives_a_finite_force_near_its_positions(seed: int, samples: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.5e-3, 2e-3, samples))
    position = np.cumsum(rng.normal(0.0, scale, samples)) * 0.01
    motion = RecordedMotion.of(time, position)
    force = prepare(sliding(moves()), MODEL, motion).force(time - time[0])
    assert np.isfinite(force).all()
    assert np.abs(motion.position(time - time[0])).max() <= np.ptp(position) * 1.2 + 1e-9


@pytest.mark.parametrize(
    ("time", "position", "message"),
    [
        ([0.0, 1.0], [0.0, 1.0], "at least 5"),
        ([0.0, 1.0, 2.0, 2.0, 3.0], [0.0] * 5, "must rise"),
        ([0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 0.0, float("nan"), 0.0, 0.0], "NaN"),
    ],
)
def test_a_record_that_is_none_is_refused(time: list[float], position: list[float], message: str) -> None:
    with pytest.raises(AnalysisError, match=message):
        RecordedMotion.of(time, position)


@pytest.mark.parametrize("rate", [50.0, 60.0, 70.0, 300.0])
@pytest.mark.parametrize("strain", [0.5, 1.3, 2.0])
def test_a_followed_motion_has_no_two_points_at_one_time(rate: float, strain: float) -> None:
    profile = moves((2.5 * strain, 20.0))
    time, position = counts(profile, rate)
    followed = measured_motion(RecordedMotion.of(time, position), time, position)
    assert np.diff(followed.breaks_s).min() > 1e-6
    assert np.abs(followed.velocity(time)).max() < 30.0


@pytest.mark.parametrize("name", PROFILES)
def test_a_computed_position_is_taken_as_it_is(name: str) -> None:
    profile = PROFILES[name]
    time = np.arange(profile.samples(1000.0)) / 1000
    motion = RecordedMotion.computed(time, profile.position(time))
    assert motion.position(time) == pytest.approx(profile.position(time), abs=3e-4)
    truth = prepare(sliding(profile), MODEL).force(time)
    force = prepare(sliding(profile), MODEL, motion).force(time)
    error = np.sort(np.abs(force - truth)[away_from_starts_and_stops(profile, time)])[:-3]
    assert error.max() < 0.002 * np.ptp(truth)


def test_a_fast_ripple_is_not_smoothed_away() -> None:
    time = np.arange(4000) / 2000
    position = 30.0 * time + 0.05 * np.sin(2 * np.pi * 60.0 * time)
    motion = RecordedMotion.computed(time, position)
    velocity = motion.velocity(time[1:-1] + 1e-5)
    assert np.ptp(velocity) == pytest.approx(2 * 0.05 * 2 * np.pi * 60.0, rel=0.02)


def test_the_shortest_ways_back_cost_hardly_more_than_none() -> None:
    time = np.arange(3000) / 2000
    ringing = np.clip(10.0 * time, 0.0, 12.0) + 0.1 * np.sin(2 * np.pi * 20.0 * time) * (time > 1.0)
    profile = moves((12.0, 10.0))
    friction = prepare(sliding(profile), MODEL, RecordedMotion.computed(time, ringing)).friction
    assert isinstance(friction, SlidingForce)
    assert len(friction.intervals) < 200


@pytest.mark.parametrize("rate", [200.0, 1000.0, thorough(5000.0)])
def test_a_command_that_starts_and_stops_gradually_comes_to_rest(rate: float) -> None:
    time = np.arange(round(22 * rate)) / rate
    # 0.5 mm/s with changes of velocity over 60 ms each: less than float32 resolves from sample to sample.
    velocity = 0.5 * np.clip(np.minimum(time - 1.0, 21.0 - time) / 0.06, 0.0, 1.0)
    position = (np.concatenate(([0.0], np.cumsum(velocity)[:-1])) / rate).astype(np.float32)
    motion = commanded_motion(time, position)
    assert motion.signs.tolist()[0] == motion.signs.tolist()[-1] == 0
    assert motion.velocity(time) == pytest.approx(velocity, abs=0.05)
    assert motion.position(time) == pytest.approx(position - position[0], abs=1e-3)
