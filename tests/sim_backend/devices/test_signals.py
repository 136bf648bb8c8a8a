"""What the simulated sensors show: noise, offset, converter, encoder, motor force, specimens."""

import numpy as np
import pytest

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import EncoderSettings, ForceSensorSettings, MotorSettings, NoiseSettings, VariationSettings
from dragrig.rig.devices import BackendRequest, Contact
from dragrig.sim_backend.devices import open_backend
from dragrig.sim_backend.devices.simulated_sampler import ForceConverter
from dragrig.sim_backend.devices.simulated_stage import PositionEncoder
from dragrig.sim_backend.devices.variability import (
    BETWEEN_SPECIMENS,
    CONTACT_ANGLE_SD_DEG,
    MAX_DEVIATIONS,
    RandomStream,
    SlowNoise,
    draw_run_model,
    draw_specimen_model,
    force_noise,
    random_generator,
)
from dragrig.sim_backend.friction import prepare
from simulated import acquire, record, rest, session, settings, stroke

QUIET = {"white_mN": 0.0, "slow_mN": 0.0, "zero_mN": 0.0}
SAME = {"run_stiffness": 0.0, "run_friction": 0.0}


def test_white_noise_has_its_deviation_and_no_memory() -> None:
    noise = force_noise(NoiseSettings(white_mN=1.5, slow_mN=0.0, zero_mN=0.0), 1, acquire(rest(1.0)), 1000.0)
    values = noise.read(0, 200_000)
    relative_error = 1 / np.sqrt(2 * len(values))
    assert values.std() == pytest.approx(1.5, rel=5 * relative_error)
    assert abs(values.mean()) < 5 * 1.5 / np.sqrt(len(values))
    assert abs(np.corrcoef(values[1:], values[:-1])[0, 1]) < 5 / np.sqrt(len(values))


def test_slow_noise_has_its_deviation_and_correlation_time() -> None:
    rate, tau, deviation = 50.0, 0.2, 0.5
    values = SlowNoise(random_generator(2, RandomStream.FORCE_SLOW), deviation, tau, rate).draw(400_000)
    independent = len(values) / (2 * tau * rate)
    assert values.std() == pytest.approx(deviation, rel=5 / np.sqrt(2 * independent))
    for lag in (1, 10, 30):
        expected = np.exp(-lag / rate / tau)
        correlation = np.corrcoef(values[lag:], values[:-lag])[0, 1]
        assert correlation == pytest.approx(expected, abs=5 / np.sqrt(independent))


def test_slow_noise_is_stationary_from_its_first_sample_and_the_same_in_any_portions() -> None:
    firsts = [
        SlowNoise(random_generator(3, RandomStream.FORCE_SLOW, order), 2.0, 0.2, 1000.0).draw(1)[0]
        for order in range(2000)
    ]
    assert np.std(firsts) == pytest.approx(2.0, rel=5 / np.sqrt(2 * len(firsts)))
    whole = SlowNoise(random_generator(4, RandomStream.FORCE_SLOW), 1.0, 0.2, 1000.0).draw(1000)
    portions = SlowNoise(random_generator(4, RandomStream.FORCE_SLOW), 1.0, 0.2, 1000.0)
    np.testing.assert_array_equal(np.concatenate([portions.draw(n) for n in (1, 7, 400, 592)]), whole)


def test_zero_offset_spreads_from_run_to_run() -> None:
    quiet = NoiseSettings(white_mN=0.0, slow_mN=0.0, zero_mN=3.0)
    offsets = np.array(
        [force_noise(quiet, 5, acquire(rest(1.0), order), 1000.0).read(0, 1)[0] for order in range(2000)]
    )
    assert offsets.std() == pytest.approx(3.0, rel=5 / np.sqrt(2 * len(offsets)))
    assert abs(offsets.mean()) < 5 * 3.0 / np.sqrt(len(offsets))
    steady = force_noise(quiet, 5, acquire(rest(1.0), 7), 1000.0).read(0, 1000)
    assert np.ptp(steady) == 0


def test_force_comes_in_steps_of_the_converter_and_is_clipped_at_its_range() -> None:
    converter = ForceConverter.of(ForceSensorSettings(range_mN=10_000.0, bits=16))
    step = 20_000 / 65_536
    true = np.linspace(-11_000, 11_000, 9_973)
    shown = converter.convert(true.copy())
    assert shown.dtype == np.float32
    inside = np.abs(true) < 9_999
    assert np.abs(shown[inside] - true[inside]).max() <= step / 2 + 0.001
    np.testing.assert_allclose(shown / step, np.rint(shown / step), atol=1e-3)
    assert (float(shown.min()), float(shown.max())) == converter.range_mN
    assert converter.range_mN == pytest.approx((-10_000.0, 10_000.0 - step), abs=1e-3)


def test_a_force_beyond_the_range_reads_as_the_sampler_s_range() -> None:
    rig = settings(force_sensor={"range_mN": 50.0}, guard={"force_limit_mN": 40.0})
    backend = session(rig)
    force = record(backend, acquire(stroke()))["force"]
    assert float(force.max()) == backend.sampler.force_range_mN[1]


def test_positions_are_counts_of_the_absolute_position_exact_to_nanometres() -> None:
    encoder = PositionEncoder.of(EncoderSettings(resolution_um=1.0))
    relative = np.linspace(0.0, 300.0, 100_001)
    shown = encoder.record(relative.copy(), 12.3456)
    assert np.abs(shown - relative).max() <= 0.001 + 1e-9
    counts = shown * 1000.0
    assert np.abs(counts - np.rint(counts)).max() < 1e-5
    absolute = relative[777] + 12.3456
    assert shown[777] == pytest.approx(encoder.read(absolute) - encoder.read(12.3456), abs=1e-9)


def test_coarse_encoders_show_coarse_steps() -> None:
    position = record(session(settings(encoder={"resolution_um": 20.0})), acquire(stroke(speed_mm_s=10.0)))["position"]
    assert position.dtype == np.float64
    np.testing.assert_allclose(position / 0.02, np.rint(position / 0.02), atol=1e-9)
    assert len(np.unique(position)) == 251


def test_recorded_force_is_the_model_s_within_half_a_step() -> None:
    rig = settings(simulated={"noise": QUIET, "variation": SAME}, force_sensor={"bits": 24})
    acquisition = acquire(stroke(travel_mm=20.0))
    got = record(session(rig), acquisition)
    true = prepare(acquisition, FrictionModelSettings()).force(got.index / 1000.0)
    np.testing.assert_allclose(got["force"], true, atol=0.002)
    assert true.max() > 100.0


def test_force_gain_acts_once_and_on_the_sensor_alone() -> None:
    motor = {"offset_mN": 0.0, "coulomb_mN": 0.0, "viscous_mN_s_mm": 0.0, "noise_mN": 0.0}
    rig = settings(simulated={"noise": QUIET, "variation": SAME, "motor": motor})
    acquisition = acquire(stroke(travel_mm=20.0))
    plain = record(session(rig), acquisition)
    backend = open_backend(BackendRequest(rig, FrictionModelSettings(force_gain=2.0)))
    backend.stage.enable()
    backend.stage.home()
    doubled = record(backend, acquisition)
    np.testing.assert_allclose(doubled["force"], 2 * plain["force"], atol=0.5)
    np.testing.assert_allclose(doubled["motor_force"], plain["motor_force"], rtol=1e-6, atol=1e-3)


def test_motor_force_is_inertia_bearing_and_load() -> None:
    motor = MotorSettings(moving_mass_g=1200.0, viscous_mN_s_mm=4.0, coulomb_mN=300.0, offset_mN=15.0, noise_mN=0.0)
    rig = settings(simulated={"motor": motor.model_dump(), "noise": QUIET})
    profile = stroke(travel_mm=20.0, speed_mm_s=50.0, accel_mm_s2=400.0)
    got = record(session(rig), acquire(profile, contact=Contact.NONE))
    time = got.index / 1000.0
    phase = profile.phase_at(time)
    steady, resting = got["motor_force"][phase == 2], got["motor_force"][phase == 0]
    np.testing.assert_allclose(resting, 15.0, atol=1e-3)
    np.testing.assert_allclose(steady, 15.0 + 300.0 + 4.0 * 50.0, atol=1e-2)
    speeding_up = got["motor_force"][phase == 1][-1]
    assert speeding_up == pytest.approx(
        15.0 + 300.0 + 4.0 * float(profile.velocity(time[phase == 1][-1])) + 480.0, abs=0.01
    )
    pulling = record(session(rig), acquire(profile))
    load = pulling["motor_force"] - got["motor_force"]
    np.testing.assert_allclose(load, pulling["force"], atol=0.2)


def test_motor_noise_has_its_deviation_and_may_be_left_out() -> None:
    got = record(session(), acquire(rest(20.0), contact=Contact.NONE))
    assert got["motor_force"].std() == pytest.approx(8.0, rel=5 / np.sqrt(2 * 20_000))
    bare = session(settings(sampling={"motor_force": False}))
    assert [channel.name for channel in bare.sampler.channels] == ["force", "position"]
    assert list(record(bare, acquire(rest(0.1))).blocks[0].channels) == ["force", "position"]


def test_specimens_differ_by_the_list_s_deviations() -> None:
    nominal = FrictionModelSettings()
    drawn = [draw_specimen_model(nominal, seed) for seed in range(2000)]
    error = 5 / np.sqrt(2 * len(drawn))
    for name, deviation in BETWEEN_SPECIMENS.items():
        factors = np.array([getattr(model, name) for model in drawn]) / getattr(nominal, name)
        assert factors.std() == pytest.approx(deviation, rel=2 * error), name
        assert factors.mean() == pytest.approx(1.0, abs=5 * deviation / np.sqrt(len(drawn))), name
        assert factors.min() > 0
    angles = np.array([model.contact_angle_offset_deg for model in drawn])
    assert angles.std() == pytest.approx(CONTACT_ANGLE_SD_DEG, rel=2 * error)
    assert np.abs(angles).max() <= MAX_DEVIATIONS * CONTACT_ANGLE_SD_DEG
    stiffness, friction = (
        np.array([getattr(model, name) for model in drawn]) for name in ("stiffness_scale", "friction_coefficient")
    )
    assert abs(np.corrcoef(stiffness, friction)[0, 1]) < 5 / np.sqrt(len(drawn))


def test_runs_on_one_specimen_differ_a_little() -> None:
    nominal, variation = FrictionModelSettings(), VariationSettings()
    runs = [draw_run_model(nominal, variation, 9, order) for order in range(2000)]
    error = 5 / np.sqrt(2 * len(runs))
    stiffness = np.array([run.stiffness_scale for run in runs])
    friction = np.array([run.friction_coefficient for run in runs]) / nominal.friction_coefficient
    assert stiffness.std() == pytest.approx(0.02, rel=2 * error)
    assert friction.std() == pytest.approx(0.015, rel=2 * error)
    assert runs[0].e1_scale == nominal.e1_scale


def test_a_session_s_specimen_is_drawn_once_and_only_on_request() -> None:
    quiet = {"noise": QUIET, "variation": {**SAME, "specimen": True}}
    drawing = session(settings(simulated=quiet))
    first = record(drawing, acquire(stroke(), order=0))["force"]
    drawing.stage.home()
    second = record(drawing, acquire(stroke(), order=1))["force"]
    np.testing.assert_array_equal(first, second)
    force = record(session(settings(simulated={**quiet, "seed": 77})), acquire(stroke()))["force"]
    nominal = record(session(settings(simulated={"noise": QUIET, "variation": SAME})), acquire(stroke()))["force"]
    assert np.abs(first - nominal).max() > 5.0
    assert np.abs(first - force).max() > 5.0


def test_description_tells_the_seed_and_not_the_draw() -> None:
    description = session(settings(simulated={"seed": 42, "variation": {"specimen": True}})).description()
    assert description["seed"] == 42
    assert description["sensor_serial"] == "simulated"
    assert description["specimen_drawn"] is True
    assert not BETWEEN_SPECIMENS.keys() & description.keys()
