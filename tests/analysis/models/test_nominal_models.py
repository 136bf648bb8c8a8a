"""Nominal models that ship: the stage alone, and how models are found."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dragrig
from dragrig.analysis.identification.identification import JointFit
from dragrig.analysis.identification.identify import fit_jointly
from dragrig.analysis.models.capsule_model import CapsuleModel
from dragrig.analysis.models.catalogue import find_model, model_names
from dragrig.analysis.models.drive_model import MODEL
from dragrig.analysis.models.experiment import Experiment, fit_velocity
from dragrig.analysis.models.nominal_model import Predictor
from dragrig.analysis.selection import RunSelection, select_loaded_runs
from dragrig.config.errors import SettingsError
from dragrig.config.rig import RigSettings
from dragrig.config.settings import parse
from dragrig.rig.profile import MotionProfile, Phase, stationary_piece, trapezoid
from dragrig.sim_backend.friction import RecordedMotion
from property_tests import examples

TRUE = {"moving_mass_g": 1200.0, "viscous_mN_s_mm": 4.0, "coulomb_mN": 300.0, "offset_mN": 15.0}


def simulated(seed: int, plan: str = "blank", *assigned: str, **motor: float) -> RunSelection:
    answer = [f"rig.simulated.motor.{key}={value}" for key, value in motor.items()]
    common = [f"rig.simulated.seed={seed}", "rig.sampling.rate_hz=500"]
    return select_loaded_runs(dragrig.simulate(plan, assignments=[*common, *assigned, *answer]))


def strayed(fit: JointFit, truth: dict[str, float]) -> np.ndarray:
    result = {parameter.name: parameter for parameter in fit.parameters}
    return np.array([(result[key].value - value) / result[key].standard_error for key, value in truth.items()])


@pytest.fixture(scope="module")
def blanks() -> RunSelection:
    return simulated(1)


@pytest.fixture(scope="module")
def drags() -> RunSelection:
    return simulated(2, "drag", "speed_mm_s=[2, 10, 40]", "way_back=by_hand")


@pytest.mark.parametrize("rate", [500.0, 1000.0, 5000.0])
@pytest.mark.parametrize(("travel_mm", "speed"), [(40.0, 40.0), (-40.0, 5.0), (10.0, 60.0), (5.0, 1.0)])
def test_counts_say_when_a_stroke_changes_its_acceleration(rate: float, travel_mm: float, speed: float) -> None:
    profile = MotionProfile.from_pieces(
        (stationary_piece(1.0003, Phase.REST), *trapezoid(travel_mm, speed, 400.0), stationary_piece(1.0, Phase.HOLD))
    )
    time = np.arange(profile.samples(rate)) / rate
    position = np.round(profile.position(time) * 1000) / 1000
    joints, velocity = fit_velocity(RecordedMotion.of(time, position), time, position)
    assert len(joints) == 6
    assert joints[1:-1] == pytest.approx(profile.start_s[1:], abs=max(0.003 / speed, 2e-4))
    assert velocity[2:4] == pytest.approx(np.copysign(speed, travel_mm), rel=3e-3)
    assert not velocity[[0, 1, 4, 5]].any()


def test_a_stage_with_rounded_ramps_keeps_its_mass() -> None:
    rate, passed = 1000.0, 10
    time = np.arange(int(3.1 * rate * passed)) / rate / passed
    ramps = np.clip((time - 1) / 0.1, 0, 1) - np.clip((time - 2) / 0.1, 0, 1)
    velocity = np.convolve(40 * ramps, np.full(200, 1 / 200), mode="same")
    position = np.round(np.cumsum(velocity) / rate / passed * 1000) / 1000
    time, position, truth = time[::passed], position[::passed], np.gradient(velocity, time)[::passed]
    joints, chain = fit_velocity(RecordedMotion.of(time, position), time, position)
    piece = np.clip(np.searchsorted(joints, time, side="right") - 1, 0, len(joints) - 2)
    result = (np.diff(chain) / np.diff(joints))[piece]
    assert (result @ truth) / (result @ result) == pytest.approx(1.0, abs=0.02)


@settings(max_examples=examples(20), deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), samples=st.integers(5, 300), scale=st.sampled_from([0.0, 0.001, 0.1, 5.0]))
def test_any_record_has_a_velocity(seed: int, samples: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.5e-3, 2e-3, samples))
    time -= time[0]
    position = np.cumsum(rng.normal(0.0, scale, samples)) * 0.01
    joints, velocity = fit_velocity(RecordedMotion.of(time, position), time, position)
    assert (np.diff(joints) > 0).all()
    assert joints[[0, -1]] == pytest.approx(time[[0, -1]])
    assert np.isfinite(velocity).all()


def test_blank_runs_give_the_stage_back_whatever_it_is() -> None:
    stages = (
        TRUE,
        {"moving_mass_g": 80.0, "viscous_mN_s_mm": 0.0, "coulomb_mN": 0.0, "offset_mN": -400.0},
        {"moving_mass_g": 9000.0, "viscous_mN_s_mm": 60.0, "coulomb_mN": 5000.0, "offset_mN": 0.0},
    )
    for seed, truth in enumerate(stages):
        fit = fit_jointly(simulated(seed, **truth), MODEL)
        assert fit.converged, fit.remarks
        assert np.abs(strayed(fit, truth)).max() < 4.0
        assert fit.parameters[0].half_width < 0.01 or truth["moving_mass_g"] < 100


def test_runs_with_a_load_give_the_stage_back_too(drags: RunSelection) -> None:
    loaded = replace(drags, experiments=drags.of_kind("drag"))
    assert len(loaded.experiments) > 1
    fit = fit_jointly(loaded, MODEL)
    assert np.abs(strayed(fit, TRUE)).max() < 4.0
    result = {parameter.name: parameter for parameter in fit.parameters}
    assert result["coulomb_mN"].standard_error < 3.0
    # The sensor's zero is as unknown as the offset.
    assert result["offset_mN"].standard_error > 2.0


def test_the_identified_stage_is_one_that_the_simulator_loads(blanks: RunSelection) -> None:
    fit = fit_jointly(blanks, MODEL)
    rig = parse(RigSettings, MODEL.document(fit.values), "identified")
    assert rig.simulated.motor.moving_mass_g == pytest.approx(1200, rel=0.01)
    assert rig.simulated.motor.offset_mN == pytest.approx(15, abs=1)
    creeping = MODEL.document({**fit.values, "viscous_mN_s_mm": -0.01})
    assert parse(RigSettings, creeping, "identified").simulated.motor.viscous_mN_s_mm == 0


def test_sensitivities_are_exact(drags: RunSelection) -> None:
    values = np.array([1100.0, 3.0, 250.0, 10.0, 0.99])
    for experiment in drags.of_kind("drag")[:2]:
        predictor = MODEL.prepare(experiment)["motor_force"]
        exact = predictor.sensitivities(values, experiment.time_s)
        by_differences = Predictor.sensitivities(predictor, values, experiment.time_s)
        assert exact == pytest.approx(by_differences, rel=1e-6, abs=1e-6)
        assert predictor.uncertainty(values, experiment.time_s).min() >= 0


def changed(experiment: Experiment, **channels: np.ndarray | None) -> Experiment:
    trace = experiment.run.trace
    remaining = {**trace.channels, **channels}
    trace = replace(trace, channels={name: values for name, values in remaining.items() if values is not None})
    return Experiment(replace(experiment.run, trace=trace))


def test_a_load_that_is_missing_for_a_while_does_not_count_there(drags: RunSelection) -> None:
    (experiment, *_) = drags.of_kind("drag")
    force = np.array(experiment.run.trace.force)
    away = slice(len(force) // 2, len(force) // 2 + 50)
    force[away] = np.nan
    predictor = MODEL.prepare(changed(experiment, force=force))["motor_force"]
    values = np.array([1200.0, 4.0, 300.0, 15.0, 1.0])
    doubt = predictor.uncertainty(values, experiment.time_s)
    assert doubt[away].min() > 20
    assert np.median(doubt) < 2
    assert np.isfinite(predictor.predict(values, experiment.time_s).total).all()


def test_a_run_without_motor_force_says_nothing_of_the_stage(blanks: RunSelection) -> None:
    experiment = blanks.experiments[0]
    assert MODEL.prepare(changed(experiment, motor_force=None)) == {}
    alone = MODEL.prepare(changed(experiment, force=None))["motor_force"]
    assert not alone.predict(np.zeros(5), experiment.time_s).varying.any()


def test_models_are_found_by_name() -> None:
    assert "drive" in model_names()
    assert find_model("drive") is MODEL
    assert find_model("capsule").name == "capsule"
    with pytest.raises(SettingsError, match="did you mean drive"):
        find_model("drvie")
    with pytest.raises(SettingsError, match="no such file"):
        find_model("models/mine.py")


def test_a_friction_model_as_toml_is_the_capsule_model_that_counts_from_it(tmp_path: Path) -> None:
    file = tmp_path / "soft.toml"
    file.write_text("name = 'soft'\nstiffness_scale = 0.8\n")
    model = find_model(str(file))
    assert isinstance(model, CapsuleModel)
    assert model.settings.stiffness_scale == 0.8
    file.write_text("stifness_scale = 0.8\n")
    with pytest.raises(SettingsError, match="did you mean stiffness_scale"):
        find_model(str(file))


def test_an_identification_counts_from_the_toml_it_is_given(tmp_path: Path) -> None:
    file = tmp_path / "soft.toml"
    file.write_text("name = 'soft'\nfriction_coefficient = 0.09\n[[effects]]\nid = 'stribeck'\n")
    (drag, *_) = dragrig.simulate("drag", assignments=["speed_mm_s=30", "way_back=stay"])
    identification = dragrig.identify([drag], nominal=file)
    assert isinstance(identification.nominal, CapsuleModel)
    assert identification.nominal.settings.friction_coefficient == 0.09
    assert identification.nominal.settings.effects == ()
