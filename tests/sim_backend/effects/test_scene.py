"""What effects see of a run: contact ages and forces agree with the friction model's own quadrature."""

import numpy as np
import pytest

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Capsule, Fixture, Specimen
from dragrig.rig.devices import Acquisition, Contact
from dragrig.rig.profile import MotionProfile, Phase, Piece, stationary_piece
from dragrig.sim_backend.effects.run_state import RunState, first_order, gut_run_state, resonator
from dragrig.sim_backend.friction.motion import ProfileMotion

SPEED, ACCELERATION, TRAVEL = 10.0, 400.0, 15.0


def drag(speed_mm_s: float = SPEED) -> Acquisition:
    ramp_s = speed_mm_s / ACCELERATION
    pieces = [
        stationary_piece(1.0, Phase.REST),
        Piece(ramp_s, ACCELERATION, Phase.ACCELERATE),
        Piece(TRAVEL / speed_mm_s - ramp_s, 0.0, Phase.STEADY),
        Piece(ramp_s, -ACCELERATION, Phase.DECELERATE),
        stationary_piece(3.0, Phase.HOLD),
    ]
    return Acquisition(
        run_id="drag",
        order=0,
        kind="drag",
        profile=MotionProfile.from_pieces(pieces),
        capsule=Capsule(
            name="c", surface="smooth", diameter_mm=12.9, length_mm=15.2, mass_g=50.1, contact_angle_deg=60.0
        ),
        specimen=Specimen(name="jejunum"),
        fixture=Fixture.FOAM,
        contact=Contact.SLIDING,
        insertion_dwell_s=60.0,
    )


def scene(speed_mm_s: float = SPEED) -> RunState:
    acquisition = drag(speed_mm_s)
    motion = ProfileMotion.of(acquisition.profile)
    time = np.arange(0.0, acquisition.profile.duration_s, 0.01)
    return gut_run_state(acquisition, FrictionModelSettings(), motion, time)


@pytest.mark.parametrize("speed_mm_s", [0.5, 10.0, 60.0])
def test_the_wall_seen_point_by_point_adds_up_to_the_model_s_resistance(speed_mm_s: float) -> None:
    seen = scene(speed_mm_s)
    wall = seen.wall
    assert wall is not None
    elements, age = wall.parameters, wall.age_s
    fast, slow = (np.exp(-age * rate) for rate in elements.rates)
    stress = wall.strain * (elements.E1 * fast + elements.E2 * slow + elements.E3)
    assert wall.resistance(stress) == pytest.approx(seen.f_e, abs=0.02 * seen.f_e.max())


def test_pressing_at_the_equator_is_what_coulomb_friction_multiplies() -> None:
    seen = scene()
    wall = seen.wall
    assert wall is not None
    elements, age = wall.equator_parameters, wall.equator_age_s
    fast, slow = (np.exp(-age * float(rate)) for rate in elements.rates)
    stress = wall.strain_at_equator * (elements.E1 * fast + elements.E2 * slow + elements.E3)
    normal = seen.weight_mN + wall.side_force(stress)
    moving = seen.slip.moving > 0
    expected = seen.friction_coefficient * normal * seen.coulomb_sign
    assert seen.f_c[moving] == pytest.approx(expected[moving], rel=1e-6)


def test_starts_and_stops_are_counted_from_where_they_happen() -> None:
    seen = scene()
    slip = seen.slip
    assert slip.slid_mm[-1] == pytest.approx(TRAVEL)
    assert slip.slid_mm[0] == 0.0
    stop = 1.0 + TRAVEL / SPEED + SPEED / ACCELERATION
    assert slip.since_stop_s[-1] == pytest.approx(seen.time_s[-1] - stop)
    assert set(slip.heading[seen.time_s > 1.01]) == {1.0}


def test_dynamics_do_not_depend_on_where_a_straight_input_is_sampled() -> None:
    coarse = np.array([0.0, 0.3, 0.35, 0.9, 2.0])
    passed = np.union1d(coarse, np.linspace(0.0, 2.0, 501))
    driving = np.array([0.0, 1.0, 1.0, -2.0, 3.0])
    inside = np.searchsorted(passed, coarse)
    dense = np.interp(passed, coarse, driving)
    assert first_order(coarse, driving, 0.1) == pytest.approx(first_order(passed, dense, 0.1)[inside])
    assert resonator(coarse, driving, 3.0, 0.1) == pytest.approx(resonator(passed, dense, 3.0, 0.1)[inside])
    assert resonator(passed, np.ones_like(passed), 3.0, 0.1) == pytest.approx(1.0)
    assert first_order(passed, passed, 0.01)[-1] == pytest.approx(2.0 - 0.01, rel=1e-3)
