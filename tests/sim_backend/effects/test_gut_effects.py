"""Candidate effects in gut and interface: what each does to a run, as a tribologist would check it."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Fixture
from dragrig.rig.devices import Acquisition
from dragrig.rig.profile import FloatArray, MotionProfile
from dragrig.sim_backend.effects.base import ForceEffect, Location, catalogue, find_effect
from dragrig.sim_backend.effects.run_state import RunState, gut_run_state
from dragrig.sim_backend.friction.motion import ProfileMotion
from friction_cases import blank, moves, sliding, sticking

CLOSED_ONLY = {"adhesion", "folds", "mesentery_tether", "peristalsis", "wall_lift_off", "wall_inertia"}
TISSUE = {"hyperelastic_wall", "extra_relaxation", "tissue_ageing", "preconditioning"}
INTERFACE = {"stribeck", "breakaway", "presliding", "film_depletion"}
GUT = tuple(
    force_effect
    for force_effect in catalogue().values()
    if isinstance(force_effect, ForceEffect) and force_effect.id in CLOSED_ONLY | TISSUE | INTERFACE
)
TRAVEL = 40.0


def seen(acquisition: Acquisition, session_s: float = 0.0, step_s: float = 0.01) -> RunState:
    motion = ProfileMotion.of(acquisition.profile)
    time = np.arange(0.0, acquisition.profile.duration_s, step_s)
    return gut_run_state(acquisition, FrictionModelSettings(), motion, time, session_s)


@cache
def drag(speed_mm_s: float = 10.0, session_s: float = 500.0) -> RunState:
    return seen(sliding(moves((TRAVEL, speed_mm_s))), session_s)


@cache
def coulomb(speed_mm_s: float = 5.0) -> RunState:
    return seen(sliding(moves((TRAVEL, speed_mm_s)), fixture=Fixture.VACUUM), 500.0)


@cache
def relaxation(strain: float = 1.0, session_s: float = 500.0) -> RunState:
    return seen(sticking(moves((2.5 * strain, 20.0), acceleration=2000.0, hold=20.0), strain), session_s)


def there_and_back() -> MotionProfile:
    return moves((15.0, 10.0), (-15.0, 10.0), between=1.0)


def effect(name: str) -> ForceEffect:
    result = find_effect(name)
    assert isinstance(result, ForceEffect)
    return result


def added(name: str, scene: RunState, **values: float) -> FloatArray:
    force_effect = effect(name)
    return force_effect.added_force(scene, {**force_effect.defaults, **values})


def middle(scene: RunState, force: FloatArray) -> float:
    """Return the mean over the middle of the travel."""
    half = 0.5 * np.abs(scene.position_mm).max()
    return float(force[np.abs(np.abs(scene.position_mm) - half) < 0.25 * half].mean())


def holding(scene: RunState) -> FloatArray:
    return np.asarray(scene.slip.since_stop_s > 0.1)


@pytest.mark.parametrize("force_effect", GUT, ids=lambda force_effect: force_effect.id)
@pytest.mark.parametrize("scene", [drag(), coulomb(), relaxation()], ids=["drag", "coulomb", "relaxation"])
def test_size_0_is_nothing_and_every_shape_tried_is_finite(force_effect: ForceEffect, scene: RunState) -> None:
    assert not force_effect.added_force(scene, {**force_effect.defaults, force_effect.size.name: 0.0}).any()
    for shape in force_effect.shapes:
        for value in shape.grid:
            force = force_effect.added_force(scene, {**force_effect.defaults, shape.name: value})
            assert force.shape == scene.time_s.shape
            assert np.isfinite(force).all()


@pytest.mark.parametrize("force_effect", GUT, ids=lambda force_effect: force_effect.id)
def test_twice_the_size_is_twice_the_force(force_effect: ForceEffect) -> None:
    for scene in (drag(60.0), relaxation()):
        small, large = (
            force_effect.added_force(
                scene, {**force_effect.defaults, force_effect.size.name: f * force_effect.size.default}
            )
            for f in (0.5, 1.0)
        )
        assert np.abs(2 * small - large).max() <= 1e-9 * np.abs(large).max() + 1e-9


@pytest.mark.parametrize("force_effect", GUT, ids=lambda force_effect: force_effect.id)
def test_an_effect_acts_where_it_can(force_effect: ForceEffect) -> None:
    acts = [
        bool(np.abs(force_effect.added_force(scene, force_effect.defaults)).max() > 0.1)
        for scene in (relaxation(), coulomb(), drag())
    ]
    expected = [force_effect.id in TISSUE, force_effect.id in INTERFACE, True]
    assert acts == expected
    nothing = seen(blank(moves((TRAVEL, 10.0))))
    assert not force_effect.added_force(nothing, force_effect.defaults).any()


@pytest.mark.parametrize("force_effect", GUT, ids=lambda force_effect: force_effect.id)
def test_the_force_at_a_time_does_not_depend_on_which_other_times_are_asked_for(force_effect: ForceEffect) -> None:
    acquisition = sliding(there_and_back())
    motion = ProfileMotion.of(acquisition.profile)
    some = np.sort(np.random.default_rng(1).uniform(0.0, acquisition.profile.duration_s, 50))
    alone = gut_run_state(acquisition, FrictionModelSettings(), motion, some, 100.0)
    dense = np.union1d(some, np.arange(0.0, acquisition.profile.duration_s, 0.003))
    among = gut_run_state(acquisition, FrictionModelSettings(), motion, dense, 100.0)
    remaining = force_effect.added_force(among, force_effect.defaults)[np.searchsorted(dense, some)]
    assert force_effect.added_force(alone, force_effect.defaults) == pytest.approx(remaining, abs=1e-6)


@pytest.mark.parametrize("force_effect", GUT, ids=lambda force_effect: force_effect.id)
def test_neighbouring_shapes_overlap(force_effect: ForceEffect) -> None:
    """A shape between two that are tried is found by either."""
    if force_effect.phase is not None:
        pytest.skip("the phase has a say")
    scenes = (*(drag(v) for v in (0.5, 2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0)), coulomb(), relaxation(0.5),
              relaxation(2.0))  # fmt: skip
    for shape in force_effect.shapes:
        signatures = [signature(force_effect, scenes, {shape.name: value}) for value in shape.grid]
        for left, right in pairwise(signatures):
            assert float(left @ right) > 0.8


def signature(force_effect: ForceEffect, scenes: tuple[RunState, ...], values: Mapping[str, float]) -> FloatArray:
    parts = [
        force_effect.added_force(scene, {**force_effect.defaults, **values}) / np.sqrt(scene.time_s.size)
        for scene in scenes
    ]
    whole = np.concatenate(parts)
    return np.asarray(whole / np.linalg.norm(whole))


def test_the_catalogue_has_them_all_with_a_source_and_a_place() -> None:
    assert {force_effect.id for force_effect in GUT} == CLOSED_ONLY | TISSUE | INTERFACE
    for force_effect in GUT:
        assert len(force_effect.source) > 20
        assert force_effect.location in {Location.WALL, Location.INTERFACE, Location.SPECIMEN}
        assert force_effect.size.low <= force_effect.size.default <= force_effect.size.high
        assert all(shape.low <= value <= shape.high for shape in force_effect.shapes for value in shape.grid)


def test_lift_off_takes_from_f_e_alone_and_only_at_speed() -> None:
    slow, fast = drag(1.0), drag(60.0)
    assert abs(middle(slow, added("wall_lift_off", slow))) < 0.01 * middle(slow, slow.f_e)
    lost = added("wall_lift_off", fast, share=1.0)
    assert (lost <= 0).all()
    assert (lost >= -fast.f_e * 1.02).all()
    assert middle(fast, lost) < -0.8 * middle(fast, fast.f_e)
    assert np.abs(lost[holding(fast)]).max() < 1e-9


def test_inertia_goes_with_the_square_of_speed_and_against_the_motion() -> None:
    forces = [middle(drag(v), added("wall_inertia", drag(v), force_mN=36.0)) for v in (10.0, 20.0, 60.0)]
    assert forces == pytest.approx([1.0, 4.0, 36.0])
    back = seen(sliding(moves((-TRAVEL, 20.0))))
    assert middle(back, added("wall_inertia", back, force_mN=36.0)) == pytest.approx(-4.0)


def test_a_hyperelastic_wall_raises_peaks_the_more_the_larger_the_strain_and_the_faster_it_is_strained() -> None:
    growth = [
        added("hyperelastic_wall", scene).max() / scene.shear.max() for scene in (relaxation(0.5), relaxation(2.0))
    ]
    assert growth[1] > 4 * growth[0]
    slow, fast = drag(1.0), drag(60.0)
    only_fast = [
        middle(run, added("hyperelastic_wall", run, slow_share=0.0)) / middle(run, run.f_e) for run in (slow, fast)
    ]
    assert only_fast[1] > 3 * only_fast[0] > 0


def test_stiffening_of_all_branches_alike_is_what_the_friction_model_says_of_it() -> None:
    scene = drag(10.0)
    everywhere = added("hyperelastic_wall", scene, stiffening=0.1, power=0.0, slow_share=1.0)
    moving = (scene.slip.moving > 0) | holding(scene)
    assert everywhere[moving] == pytest.approx(
        0.1 * scene.stiffness_force[moving], abs=0.02 * 0.1 * scene.stiffness_force.max()
    )


@pytest.mark.parametrize("run", [sliding(moves((TRAVEL, 10.0))), sticking(moves((2.5, 20.0), hold=20.0), 1.0)])
def test_moduli_that_grow_alone_quicken_the_relaxation_as_elements_of_such_moduli_do(run: Acquisition) -> None:
    motion, time = ProfileMotion.of(run.profile), np.arange(0.0, run.profile.duration_s, 0.01)
    stiffer = FrictionModelSettings(e1_scale=1.5, e2_scale=1.5, e3_scale=1.5)
    scene, expected = (gut_run_state(run, settings, motion, time) for settings in (FrictionModelSettings(), stiffer))
    values = {"stiffening": 0.5, "power": 0.0, "slow_share": 1.0}
    force = added("hyperelastic_wall", scene, quickening=1.0, **values)
    moving = np.abs(scene.velocity_mm_s) > 1.0
    tolerance_mN = 0.01 * expected.nominal.max()
    assert force[moving] == pytest.approx((expected.nominal - scene.nominal)[moving], abs=tolerance_mN)
    slower = added("hyperelastic_wall", scene, **values)
    assert np.abs(slower - force)[moving].max() > 5 * tolerance_mN


def test_the_further_branch_still_relaxes_when_the_nominal_ones_have() -> None:
    scene = relaxation(1.0)
    force = added("extra_relaxation", scene, time_s=8.0, share=0.5)
    late = scene.time_s > 6.0
    nominal = scene.shear[late]
    assert np.ptp(nominal) < 0.01 * nominal.mean()
    assert np.polyfit(scene.time_s[late], np.log(force[late]), 1)[0] == pytest.approx(-1 / 8.0, rel=1e-3)
    assert force.max() == pytest.approx(
        0.5 * scene.sheared.moduli[2] * scene.sheared.area_mm2 if scene.sheared else 0.0, rel=0.02
    )


def test_a_spread_of_rates_keeps_the_first_slope_and_lasts_longer() -> None:
    scene = relaxation(1.0)
    single, many = (added("extra_relaxation", scene, time_s=8.0, spread=spread) for spread in (0.0, 1.0))
    after = scene.time_s - scene.time_s[np.argmax(single)]
    inside = (after > 0.5) & (after < 15.0)
    assert many[inside] / many.max() == pytest.approx(1 / (1 + after[inside] / 8.0), abs=0.02)
    assert many[-1] > single[-1]


def test_in_a_drag_run_the_further_branch_acts_on_fresh_wall() -> None:
    scene = drag(10.0)
    force = added("extra_relaxation", scene, time_s=8.0)
    assert force[0] < 0.01 * middle(scene, force)
    stopped = force[holding(scene)]
    assert stopped[-1] < 0.8 * stopped[0]


def test_breakaway_is_over_after_a_short_slip() -> None:
    scene = coulomb(5.0)
    force = added("breakaway", scene, slip_mm=0.1)
    assert force.max() > 5.0
    assert np.abs(force[scene.slip.slid_mm > 1.5]).max() < 1e-3
    assert (force >= 0).all()


def test_presliding_friction_builds_up_and_stays_locked_in() -> None:
    scene = coulomb(5.0)
    force = scene.nominal + added("presliding", scene, share=1.0, deflection_mm=0.1)
    steady = scene.friction_coefficient * scene.weight_mN
    assert force[holding(scene)] == pytest.approx(steady, rel=1e-6)
    early = (scene.slip.moving > 0) & (scene.slip.slid_mm < 0.05)
    assert (force[early] <= scene.nominal[early]).all()
    assert force[early].sum() < 0.5 * scene.nominal[early].sum()
    half = added("presliding", scene, share=0.5)
    assert half[holding(scene)] == pytest.approx(0.5 * steady, rel=1e-6)


def test_presliding_turns_gradually_where_the_motion_turns() -> None:
    scene = seen(sliding(there_and_back(), fixture=Fixture.VACUUM))
    force = scene.nominal + added("presliding", scene, share=1.0, deflection_mm=0.2) - scene.f_v
    steps = np.abs(np.diff(force))
    assert steps.max() < 0.75 * scene.friction_coefficient * scene.weight_mN
    assert force[-1] == pytest.approx(-scene.friction_coefficient * scene.weight_mN, rel=1e-3)


def test_tack_does_not_know_the_normal_force_and_fades_with_speed() -> None:
    slow, fast = drag(0.5), drag(60.0)
    light = seen(sliding(moves((TRAVEL, 10.0)), capsule=sliding(moves((1.0, 1.0))).capsule.model_copy(
        update={"mass_g": 10.0})), 500.0)  # fmt: skip
    assert middle(light, added("adhesion", light)) == pytest.approx(middle(drag(10.0), added("adhesion", drag(10.0))))
    assert middle(slow, added("adhesion", slow)) > 5 * middle(fast, added("adhesion", fast)) > 0
    assert not added("adhesion", slow)[holding(slow)].any()


def test_a_film_is_depleted_with_distance_at_whatever_speed() -> None:
    slow, fast = coulomb(2.0), coulomb(20.0)
    at = np.array([5.0, 15.0, 35.0])
    shares = []
    for scene in (slow, fast):
        moving = scene.f_c > 1.0
        force = added("film_depletion", scene)[moving] / scene.f_c[moving]
        shares.append(np.interp(at, scene.position_mm[moving], force))
    assert shares[0] == pytest.approx(shares[1], rel=1e-3)
    assert (np.diff(shares[0]) > 0).all()
    back = seen(sliding(there_and_back(), fixture=Fixture.VACUUM))
    grown = np.abs(added("film_depletion", back))
    assert grown[back.velocity_mm_s < -9.9].min() > grown[back.velocity_mm_s > 9.9].max()


def test_folds_pass_at_the_same_positions_at_every_speed() -> None:
    at = np.arange(5.0, 35.0, 0.5)
    shares = []
    for scene in (drag(2.0), drag(30.0)):
        moving = scene.slip.moving > 0
        share = added("folds", scene, wavelength_mm=5.0, phase_rad=0.7)[moving] / (scene.f_e + scene.f_c)[moving]
        shares.append(np.interp(at, scene.position_mm[moving], share))
    assert shares[0] == pytest.approx(shares[1], abs=1.5e-2)
    assert shares[0] == pytest.approx(0.1 * np.sin(2 * np.pi * at / 5.0 + 0.7), abs=1.5e-2)


def test_wavelengths_and_periods_tried_leave_no_gap_between_them() -> None:
    """A sine between two neighbours, over 40 mm or 90 s, is more than 0.8 along one of them, phase free."""
    for name, shape, extent in (("folds", "wavelength_mm", 40.0), ("peristalsis", "period_s", 90.0)):
        tried = next(parameter.grid for parameter in effect(name).shapes if parameter.name == shape)
        apart = np.abs(np.diff(1 / np.array(tried))).max() / 2
        assert np.sinc(apart * extent) > 0.8
        assert len(tried) <= 60


def test_a_tether_pulls_beyond_its_onset_and_goes_on_pulling_in_the_hold() -> None:
    scene = drag(10.0)
    force = added("mesentery_tether", scene, onset_mm=20.0, force_mN=10.0)
    assert not force[scene.position_mm < 20.0].any()
    assert force[holding(scene)] == pytest.approx(20.0)
    back = seen(sliding(moves((-TRAVEL, 10.0))))
    assert added("mesentery_tether", back)[-1] < 0


def test_peristalsis_goes_on_while_holding_and_knows_the_session_s_clock() -> None:
    scene = drag(10.0, 500.0)
    force = added("peristalsis", scene, period_s=2.0 * 3.0)
    assert np.ptp(force[holding(scene)]) > 2.0
    assert force.max() == pytest.approx(10.0, rel=1e-3)
    a_period_later = drag(10.0, 506.0)
    assert added("peristalsis", a_period_later, period_s=6.0) == pytest.approx(force)
    half_a_period_later = drag(10.0, 503.0)
    assert added("peristalsis", half_a_period_later, period_s=6.0) != pytest.approx(force, abs=1.0)


def test_ageing_grows_with_session_time_and_has_either_sign() -> None:
    early, late = relaxation(1.0, 0.0), relaxation(1.0, 3600.0)
    at_first = added("tissue_ageing", early, change=0.2)
    assert np.abs(at_first).max() < 0.01 * early.shear.max()
    an_hour_on = added("tissue_ageing", late, change=0.2)
    assert an_hour_on[10] == pytest.approx(0.2 * late.shear[10], rel=1e-2, abs=1e-9)
    assert an_hour_on[-1] == pytest.approx(0.2 * late.shear[-1], rel=1e-2)
    assert added("tissue_ageing", late, change=-0.2) == pytest.approx(-an_hour_on)
    sliding_late = drag(10.0, 3600.0)
    weight = sliding_late.friction_coefficient * sliding_late.weight_mN
    assert middle(sliding_late, added("tissue_ageing", sliding_late, change=0.2)) == pytest.approx(
        0.2 * middle(sliding_late, sliding_late.f_e + sliding_late.f_c - weight), rel=1e-2
    )


def test_preconditioning_fades_with_the_number_of_runs_not_with_time() -> None:
    acquisition = sticking(moves((2.5, 20.0), acceleration=2000.0), 1.0)
    forces = [added("preconditioning", seen(replace(acquisition, order=order)))[-1] for order in (0, 4, 40)]
    assert forces[1] == pytest.approx(forces[0] / np.e, rel=1e-6)
    assert forces[2] < 1e-3 * forces[0]
    assert added("preconditioning", seen(acquisition, 9999.0))[-1] == pytest.approx(forces[0])


def test_stribeck_friction_falls_with_speed_the_more_suddenly_the_larger_its_power() -> None:
    ratios = {
        power: [middle(coulomb(v), added("stribeck", coulomb(v), power=power)) / middle(coulomb(v), coulomb(v).f_c)
                for v in (1.0, 3.0, 9.0)]
        for power in (1.0, 2.0)
    }  # fmt: skip
    assert ratios[1.0] == pytest.approx(0.4 * np.exp([-1 / 3, -1.0, -3.0]), rel=1e-3)
    assert ratios[2.0][0] > ratios[1.0][0]
    assert ratios[2.0][2] < ratios[1.0][2]
