"""Forces of any motion agree with brute force over the literal rule for contact ages."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.rig.devices import Acquisition
from dragrig.rig.profile import FloatArray, MotionProfile
from dragrig.sim_backend.friction import prepare, wall_parameters
from friction_cases import ROUGH, moves, sliding
from property_tests import every_third, examples

MODEL = FrictionModelSettings()
RADIUS, ANGLE, THICKNESS = 6.45, np.radians(60), 2.5
LENGTH = RADIUS * np.sin(ANGLE)
AREA = 2 * np.pi * RADIUS * LENGTH
REACH = LENGTH + 20.0
WEIGHT = 50.1 * 9.80665


def pressure(x: FloatArray, age: FloatArray) -> FloatArray:
    """P(x, t) of Eqs. 3, 5, 6 and 7, written out."""
    diameter = 2 * np.sqrt(RADIUS**2 - (LENGTH - x) ** 2)
    undisturbed = 2 * RADIUS * np.cos(ANGLE)
    strain = (diameter - undisturbed) / undisturbed
    wall = wall_parameters("eq14", strain)
    relaxing = wall.E1 * np.exp(-age * wall.E1 / wall.eta1) + wall.E2 * np.exp(-age * wall.E2 / wall.eta2)
    return np.asarray(2 * THICKNESS * strain * (relaxing + wall.E3) / diameter)


def axial(x: FloatArray, age: FloatArray) -> FloatArray:
    return np.asarray(pressure(x, age) * (LENGTH - x) / RADIUS * 2 * np.pi * RADIUS)


def forward_age(profile: MotionProfile, time: float, x: float, dwell: float) -> float:
    """t − t*, with t* the last time at which p(t*) = p(t) − x; the insertion where there is none."""
    target = float(profile.position(time)) - x
    if target <= 0:
        return dwell + time
    return time - float(brentq(lambda s: float(profile.position(s)) - target, 0.0, time, xtol=1e-13))


def literal_forward(profile: MotionProfile, time: float, dwell: float) -> tuple[float, float]:
    """f_e and f_c of a motion that never turns round."""
    travelled = min(float(profile.position(time)), LENGTH)

    def load(x: float) -> float:
        return float(axial(np.array(x), np.array(forward_age(profile, time, x, dwell))))

    pieces = [0.0, *(travelled * np.array([0.001, 0.01, 0.1, 0.5, 1.0])), LENGTH]
    f_e = sum(quad(load, a, b, epsabs=1e-7, limit=100)[0] for a, b in pairwise(pieces) if b > a)
    age = forward_age(profile, time, LENGTH, dwell)
    normal = WEIGHT + float(pressure(np.array(LENGTH), np.array(age))) * AREA
    return f_e, MODEL.friction_coefficient * normal * float(np.tanh(profile.velocity(time) / 0.05))


def literal_ages(profile: MotionProfile, time: float, z: FloatArray, dwell: float) -> FloatArray:
    """Age of wall points: since the last moment at which they lay outside the contact."""
    past = np.union1d(np.linspace(0.0, time, 1501), profile.start_s[profile.start_s < time])
    front = profile.position(past)[:, None]
    outside = (z > front) | (z < front - REACH)
    last = past.size - 1 - outside[::-1].argmax(axis=0)
    before, after = past[last], past[np.minimum(last + 1, past.size - 1)]
    for _ in range(40):
        middle = 0.5 * (before + after)
        out = (z > profile.position(middle)) | (z < profile.position(middle) - REACH)
        before, after = np.where(out, middle, before), np.where(out, after, middle)
    return np.where(outside.any(axis=0), time - after, dwell + time)


def literal_any(profile: MotionProfile, time: float, direction: float, dwell: float) -> tuple[float, float]:
    """f_e and f_c of a motion that may turn round, the wall summed in slices."""
    edges = LENGTH * np.linspace(0.0, 1.0, 4001)
    x = 0.5 * (edges[1:] + edges[:-1])
    position = float(profile.position(time))
    leading = np.append(x, LENGTH)
    z = position - leading if direction > 0 else position - REACH + leading
    ages = literal_ages(profile, time, z, dwell)
    f_e = direction * float(np.sum(axial(x, ages[:-1]) * np.diff(edges)))
    normal = WEIGHT + float(pressure(np.array(LENGTH), ages[-1])) * AREA
    return f_e, MODEL.friction_coefficient * normal * float(np.tanh(profile.velocity(time) / 0.05))


def components(acquisition: Acquisition, time: float) -> tuple[float, float]:
    parts = prepare(acquisition, MODEL).components(np.array([time]))
    return float(parts.f_e[0]), float(parts.f_c[0])


@settings(max_examples=examples(25), deadline=None, derandomize=True)
@given(
    speed=st.floats(0.5, 100.0),
    travel=st.floats(1.0, 30.0),
    when=st.floats(0.0, 1.0),
    dwell=st.floats(0.0, 60.0),
    acceleration=st.floats(50.0, 2000.0),
)
def test_a_forward_run_is_the_integral_over_literal_ages(
    speed: float, travel: float, when: float, dwell: float, acceleration: float
) -> None:
    profile = moves((travel, speed), acceleration=acceleration, rest=0.2, hold=0.3)
    time = when * profile.duration_s
    f_e, f_c = literal_forward(profile, time, dwell)
    assert components(sliding(profile, dwell=dwell), time) == (
        pytest.approx(f_e, rel=2e-6),
        pytest.approx(f_c, abs=1e-6),
    )


TURNING = {
    "there and back": moves((12.0, 10.0), (-12.0, 10.0), rest=0.2, hold=0.3),
    "back first": moves((-8.0, 20.0), (3.0, 5.0), rest=0.2, hold=0.3),
    "short strokes": moves((3.0, 10.0), (-2.0, 20.0), (1.0, 5.0), (-6.0, 4.0), (9.0, 60.0), rest=0.2, between=0.1),
    "beyond the reach": moves((30.0, 60.0), (-40.0, 40.0), (30.0, 60.0), rest=0.2, hold=0.3),
    "stop and go on": moves((4.0, 10.0), (4.0, 10.0), (4.0, 40.0), rest=0.2, between=0.05),
}


@pytest.mark.parametrize("name", every_third(list(TURNING)))
def test_a_motion_that_turns_round_follows_its_contact_episodes(name: str) -> None:
    profile = TURNING[name]
    velocity = profile.velocity(profile.start_s[1:] - 1e-6)
    rng = np.random.default_rng(1)
    for time in rng.uniform(0.25, profile.duration_s, 10):
        moved = velocity[(profile.start_s[1:] <= time) & (velocity != 0)]
        now = float(profile.velocity(time))
        direction = float(np.sign(now if now else moved[-1]))
        f_e, f_c = literal_any(profile, float(time), direction, 60.0)
        got = components(sliding(profile), float(time))
        assert got == (pytest.approx(f_e, abs=0.01), pytest.approx(f_c, abs=0.001)), time


def test_at_rest_before_moving_the_coming_direction_counts() -> None:
    before = {sign: components(sliding(moves((sign * 5.0, 10.0))), 0.5)[0] for sign in (1.0, -1.0)}
    standing = components(sliding(moves()), 0.5)[0]
    assert before[1.0] == -before[-1.0] == standing > 0


def test_wall_that_left_the_contact_and_comes_back_is_fresh() -> None:
    """After 30 mm forward and back at once, all wall under the rear hemisphere has been left and met again."""
    profile = moves((30.0, 20.0), (-30.0, 20.0), hold=0.1)
    time = profile.duration_s - 0.2
    once = moves((-30.0, 20.0), hold=0.1)
    again = components(sliding(profile), time)
    assert again == pytest.approx(components(sliding(once), once.duration_s - 0.2), rel=1e-6)


def test_the_quadrature_has_converged() -> None:
    from dragrig.sim_backend.friction.contact import FINE_RULE, QuadratureRule
    from dragrig.sim_backend.friction.friction_force import SlidingForce

    for profile in TURNING.values():
        prepared = prepare(sliding(profile), MODEL).friction
        assert isinstance(prepared, SlidingForce)
        rule = QuadratureRule(2 * FINE_RULE.ages, FINE_RULE.times)
        finer = SlidingForce.of(prepared.contact, prepared.history, ROUGH.mass_g, pressing=True, rule=rule)
        time = np.linspace(0.0, profile.duration_s, 2000)
        coarse, total = prepared.total(time), finer.total(time)
        assert np.abs(coarse - total).max() < 1e-5 * np.ptp(total)
