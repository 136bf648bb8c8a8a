"""What holds for the force of every acquisition."""

import dataclasses

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.interpolate import PPoly

from dragrig.config.errors import AnalysisError, SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Fixture
from dragrig.rig.devices import Acquisition
from dragrig.rig.profile import MotionProfile
from dragrig.sim_backend.friction import prepare, wall_parameters
from dragrig.sim_backend.friction.contact import PanelPolynomials
from dragrig.sim_backend.friction.friction_force import ELEMENT_SCALES
from friction_cases import ROUGH, SMOOTH, blank, moves, sliding, sticking
from property_tests import examples, thorough

MODEL = FrictionModelSettings()

strokes = st.lists(
    st.tuples(st.floats(0.5, 30.0), st.booleans(), st.floats(0.5, 80.0)).map(
        lambda drawn: (drawn[0] if drawn[1] else -drawn[0], drawn[2])
    ),
    max_size=4,
)
profiles = st.builds(
    lambda moved, between: moves(*moved, rest=0.1, hold=0.2, between=between), strokes, st.sampled_from([0.0, 0.05])
)


def mirrored(profile: MotionProfile) -> MotionProfile:
    return MotionProfile.from_pieces(
        dataclasses.replace(piece, acceleration_mm_s2=-piece.acceleration_mm_s2) for piece in profile.pieces()
    )


def acquisitions(profile: MotionProfile) -> tuple[Acquisition, ...]:
    return (sliding(profile), sliding(profile, SMOOTH, Fixture.VACUUM), sticking(profile, 1.0), blank(profile))


@settings(max_examples=examples(25), deadline=None, derandomize=True)
@given(profile=profiles, seed=st.integers(0, 2**32 - 1))
def test_a_value_does_not_depend_on_what_else_is_asked_for(profile: MotionProfile, seed: int) -> None:
    rng = np.random.default_rng(seed)
    time = np.arange(1001) * (profile.duration_s / 1000)
    chosen = rng.permutation(time.size)[: rng.integers(1, time.size)]
    cuts = np.sort(rng.integers(0, time.size, 5))
    for acquisition in acquisitions(profile):
        force = prepare(acquisition, MODEL)
        whole = force.force(time)
        assert np.isfinite(whole).all()
        np.testing.assert_array_equal(force.force(time[chosen]), whole[chosen])
        blocks = [force.force(block) for block in np.split(time, cuts)]
        np.testing.assert_array_equal(np.concatenate(blocks), whole)
        np.testing.assert_array_equal(force.force(time[1:].reshape(50, 20)).ravel(), whole[1:])
        np.testing.assert_array_equal(prepare(acquisition, MODEL).force(time[::7]), whole[::7])


@settings(max_examples=examples(25), deadline=None, derandomize=True)
@example(profile=moves((-7.0, 17.482548145009005)))  # the last piece seems to turn round just before its end
@example(profile=moves((-1.0, 1.0), (0.5, 1.0), rest=0.1, hold=0.2))  # a reversal as long as the shortest that counts
@given(profile=profiles.filter(lambda profile: bool(profile.velocity_mm_s.any())))
def test_a_mirrored_motion_gives_the_mirrored_force(profile: MotionProfile) -> None:
    time = np.linspace(0.0, profile.duration_s, 500)
    for acquisition, opposite in zip(acquisitions(profile), acquisitions(mirrored(profile)), strict=True):
        force, second = prepare(acquisition, MODEL).force(time), prepare(opposite, MODEL).force(time)
        np.testing.assert_allclose(second, -force, atol=1e-6)


def test_at_rest_the_wall_relaxes_from_the_insertion_on() -> None:
    time = np.array([0.0, 0.5, 2.5])
    just_inserted = prepare(sliding(moves(rest=3.0), dwell=0.5), MODEL).force(time)
    long_ago = [float(prepare(sliding(moves(), dwell=0.5 + at), MODEL).force(np.zeros(1))[0]) for at in time]
    np.testing.assert_allclose(just_inserted, long_ago, rtol=1e-6)
    assert just_inserted[0] > just_inserted[1] + 1 > just_inserted[2] + 2


def test_a_motion_of_no_length_stands_still() -> None:
    for acquisition in acquisitions(MotionProfile.from_pieces([])):
        force = prepare(acquisition, MODEL)
        standing = prepare(dataclasses.replace(acquisition, profile=moves()), MODEL)
        np.testing.assert_allclose(force.force(np.zeros((2, 2))), standing.force(np.zeros((2, 2))), atol=1e-6)
        assert force.force(np.zeros(0)).shape == (0,)


@pytest.mark.parametrize("speed", [2.0, 60.0])
def test_after_the_stop_the_force_relaxes_toward_the_spring(speed: float) -> None:
    profile = moves((20.0, speed), hold=60.0)
    stop = profile.duration_s - 60.0
    held = prepare(sliding(profile), MODEL).force(stop + np.geomspace(1e-4, 59.9, 400))
    spring_alone = float(prepare(sliding(moves(), dwell=1e6), MODEL).force(np.array([0.5]))[0])
    assert (np.diff(held) <= 1e-4).all()
    assert held[0] > spring_alone + 5
    assert held[-1] == pytest.approx(spring_alone, abs=1e-5)


def test_scales_act_where_they_say() -> None:
    profile = moves((10.0, 10.0))
    time = np.linspace(0.0, profile.duration_s, 300)

    def parts(**scales: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        prepared = prepare(sliding(profile), FrictionModelSettings(**scales))
        components = prepared.components(time)
        return components.f_e, components.f_v, components.f_c, prepared.force(time)

    f_e, f_v, f_c, force = parts()
    np.testing.assert_allclose(f_e + f_v + f_c, force)
    stiff = parts(stiffness_scale=2.0)
    np.testing.assert_allclose(stiff[0], 2 * f_e, rtol=1e-9)
    np.testing.assert_allclose(stiff[1], f_v)
    entry = parts(e1_scale=2.0, e2_scale=2.0, e3_scale=2.0, eta1_scale=2.0, eta2_scale=2.0)
    np.testing.assert_allclose(entry[3], stiff[3], rtol=1e-9)
    np.testing.assert_allclose(parts(mucus_scale=3.0)[3], f_e + 3 * f_v + f_c)
    np.testing.assert_allclose(parts(friction_coefficient=0.164)[3], f_e + f_v + 2 * f_c)
    np.testing.assert_allclose(parts(force_gain=1.1)[3], 1.1 * force)
    assert parts(contact_angle_offset_deg=2.0)[0].max() > 1.05 * f_e.max()
    longer = prepare(dataclasses.replace(sliding(profile), insertion_dwell_s=0.5), MODEL).force(time)
    scaled = dataclasses.replace(sliding(profile), insertion_dwell_s=0.25)
    np.testing.assert_array_equal(prepare(scaled, FrictionModelSettings(insertion_dwell_scale=2.0)).force(time), longer)
    assert np.abs(longer - force).max() > 1


def test_fixtures_leave_out_what_they_should() -> None:
    profile = moves((10.0, 10.0))
    time = np.linspace(0.0, profile.duration_s, 300)
    held_open = prepare(sliding(profile, SMOOTH, Fixture.VACUUM), MODEL).components(time)
    assert not held_open.f_e.any()
    assert held_open.f_c.max() == pytest.approx(0.082 * 50.1 * 9.80665)
    assert held_open.f_v.max() == pytest.approx(prepare(sliding(profile), MODEL).components(time).f_v.max())
    assert not prepare(blank(profile), MODEL).force(time).any()


def test_the_newtonian_form_is_the_shear_stress_on_the_contact() -> None:
    for speed, force in ((0.5, 5.5), (60.0, 68.0)):
        profile = moves((40.0, speed))
        model = FrictionModelSettings(viscous="newtonian")
        f_v = prepare(sliding(profile), model).components(np.array([1.0 + 20.0 / speed])).f_v
        assert f_v[0] == pytest.approx(force, rel=0.01)


@pytest.mark.parametrize("wall", ["eq14", thorough("table1")])
def test_sticking_solves_the_branches_own_equations(wall: str) -> None:
    profile = moves((5.0, 20.0), (-1.0, 5.0), acceleration=2000.0, rest=0.1, hold=1.0, between=0.2)
    model = FrictionModelSettings.model_validate({"wall": wall, "e1_scale": 1.3, "eta2_scale": 0.8})
    p = wall_parameters(model.wall, 1.5).scaled(model)

    def change(time: float, stress: np.ndarray) -> np.ndarray:
        strain_rate = float(profile.velocity(time)) / 2.5
        return np.array([p.E1, p.E2]) * strain_rate - stress * np.array(p.rates)

    times = np.linspace(0.0, profile.duration_s - 1e-9, 400)
    solved = solve_ivp(change, (0.0, profile.duration_s), [0.0, 0.0], t_eval=times, max_step=1e-3, rtol=1e-8)
    expected = (solved.y.sum(axis=0) + p.E3 * (0.5 + profile.position(times) / 2.5)) * np.pi * 12.9 * 15.2
    force = prepare(sticking(profile, 1.5, sheared_from=0.5), model).force(times)
    assert np.abs(force - expected).max() < 1e-4 * np.ptp(expected)


def test_a_sticking_run_has_no_parts() -> None:
    prepared = prepare(sticking(moves((2.5, 20.0)), 1.0), MODEL)
    with pytest.raises(AnalysisError, match="000-test"):
        prepared.components(np.zeros(1))


def test_a_contact_beyond_the_parameters_is_refused() -> None:
    steep = ROUGH.model_copy(update={"contact_angle_deg": 85.0})
    with pytest.raises(SettingsError, match="smaller angle"):
        prepare(sliding(moves(), steep), MODEL)
    with pytest.raises(SettingsError, match="between 0° and 90°"):
        prepare(sliding(moves(), steep), FrictionModelSettings(contact_angle_offset_deg=10.0))
    with pytest.raises(SettingsError, match="shear_strain"):
        prepare(sticking(moves((2.5, 20.0)), 4.0), MODEL)


@pytest.mark.parametrize("wall", ["eq14", thorough("table1")])
def test_derivatives_by_elements_are_those_of_the_force(wall: str) -> None:
    model = FrictionModelSettings.model_validate({"wall": wall, "e2_scale": 1.1, "force_gain": 1.02})
    run = sliding(moves((12.0, 5.0), (-9.0, 20.0), between=0.1))
    time = np.linspace(0.0, run.profile.duration_s, 400)
    log_derivatives = prepare(run, model).log_derivatives(time)
    step = 0.02
    for name, slopes in zip(ELEMENT_SCALES, log_derivatives, strict=True):
        ahead, behind = (
            prepare(run, model.model_copy(update={name: getattr(model, name) * factor})).force(time)
            for factor in (np.exp(step), np.exp(-step))
        )
        differences = (ahead - behind) / (2 * step)
        # The interpolation of each force, good to a few µN, is divided by the step.
        np.testing.assert_allclose(slopes, differences, atol=0.02 * np.abs(differences).max() + 0.2)


def test_all_elements_scaled_alike_scale_what_the_wall_does() -> None:
    run = sliding(moves((12.0, 5.0)))
    time = np.linspace(0.0, run.profile.duration_s, 200)
    prepared = prepare(run, MODEL)
    parts = prepared.components(time)
    weight = prepare(sliding(run.profile, fixture=Fixture.VACUUM), MODEL).components(time).f_c
    np.testing.assert_allclose(prepared.log_derivatives(time).sum(axis=0), parts.f_e + parts.f_c - weight, atol=0.02)


@given(st.integers(0, 2**32 - 1), st.sampled_from([(), (5,)]))
def test_panels_are_evaluated_as_by_scipy_to_the_bit(seed: int, values: tuple[int, ...]) -> None:
    draw = np.random.default_rng(seed)
    edges_s, coefficients = np.cumsum(draw.uniform(0.1, 1.0, 9)), draw.normal(size=(draw.integers(1, 17), 8, *values))
    time_s = np.concatenate((draw.uniform(-1.0, 11.0, 50), edges_s))
    np.testing.assert_array_equal(PanelPolynomials(coefficients, edges_s)(time_s), PPoly(coefficients, edges_s)(time_s))
