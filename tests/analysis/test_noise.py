"""Noise as rigs have it is told from what stage and specimen do: jitter, slow sampling, 1/f noise, impulses."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dragrig.analysis.gap.position_channel import position_errors
from dragrig.analysis.gap.spectral_lines import (
    SpectralLine,
    SpectralLines,
    find_moving_line,
    find_spectral_lines,
    lines_that_matter,
    moving_line_remark,
)
from dragrig.analysis.linear_gaussian import JointProblem, MovingLine, prepare_channels, repeat_differences
from dragrig.analysis.models.capsule_model import MODEL
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.noise import FLICKER_TIMES_S, BlockPairs, NoiseModel, estimate_noise
from dragrig.analysis.segments import force_pulses
from dragrig.analysis.selection import select_loaded_runs
from dragrig.config.specimen import Fixture
from dragrig.rig.profile import FloatArray, MotionProfile, Phase, stationary_piece, trapezoid
from dragrig.rig.runfile.model import Run
from property_tests import thorough
from relaxations import relaxation
from sliding_runs import noise, slid

COUNT_MM = 0.001
NOMINAL = np.array([parameter.nominal for parameter in MODEL.parameters])


def changed(run: Run, channel: str, values: FloatArray) -> Run:
    return replace(run, trace=replace(run.trace, channels={**run.trace.channels, channel: values}))


def slower(run: Run, step: int) -> Run:
    """Keep every so manieth sample."""
    trace = run.trace
    channels = {name: values[::step] for name, values in trace.channels.items()}
    kept = {"time": trace.time[::step], "phase": trace.phase[::step], "command": np.asarray(trace.command)[::step]}
    rate_hz = trace.sample_rate_hz / step
    return replace(run, trace=replace(trace, sample_rate_hz=rate_hz, channels=channels, **kept))


def sheared(seed: int = 0, hold_s: float = 20.0) -> Run:
    """A relaxation of the nominal wall with an exact command."""
    run = relaxation((2.8688, 1.1729, 1.0634, 0.07446, 0.49427), slow_mN=0.0, hold_s=hold_s, seed=seed)
    profile = MotionProfile.from_pieces(
        [stationary_piece(1.0, Phase.REST), *trapezoid(2.5, 20.0, 2000.0), stationary_piece(hold_s, Phase.HOLD)]
    )
    return replace(run, trace=replace(run.trace, command=profile.position(run.trace.time)))


def with_position(run: Run, error_mm: FloatArray) -> Experiment:
    command = np.asarray(run.trace.command)
    return Experiment(changed(run, "position", np.round((command + error_mm) / COUNT_MM) * COUNT_MM))


@pytest.mark.parametrize("speed_mm_s", [10.0, 60.0])
def test_a_clock_that_jitters_is_no_error_of_the_stage(speed_mm_s: float) -> None:
    run = slid("drag", speed_mm_s)
    random = np.random.default_rng(1)
    velocity = np.gradient(np.asarray(run.trace.command), run.trace.time)
    experiment = with_position(run, velocity * random.normal(0.0, 2e-4, velocity.size))
    assert experiment.clock_jitter_s == pytest.approx(2e-4, rel=0.1)
    assert experiment.follows_command
    assert not any(errors.has_position_error for errors in position_errors([experiment]))


def test_lag_and_ripple_are_no_jitter() -> None:
    run = slid("drag", 60.0)
    command, time = np.asarray(run.trace.command), run.trace.time
    lagging = np.interp(time - 0.004, time, command) - command
    rippling = 0.02 * np.sin(2 * np.pi * command / 0.9)
    for error_mm in (lagging, rippling):
        experiment = with_position(run, error_mm)
        assert experiment.clock_jitter_s == 0.0
        assert any(errors.has_position_error for errors in position_errors([experiment]))


def test_where_the_force_changes_fast_a_jittering_clock_makes_it_uncertain() -> None:
    run = sheared()
    velocity = np.gradient(np.asarray(run.trace.command), run.trace.time)
    jittering = with_position(run, velocity * np.random.default_rng(2).normal(0.0, 2e-4, velocity.size))
    (blocks,), (steady_blocks,) = (
        list(prepare_channels([experiment], MODEL)) for experiment in (jittering, Experiment(run))
    )
    ramp = np.asarray(jittering.run.trace.phase)[np.searchsorted(jittering.time_s, blocks.blocks.middle_s)] == int(
        Phase.STEADY
    )
    more, less = blocks.uncertainty(NOMINAL), steady_blocks.uncertainty(NOMINAL)
    # 20 mm/s shear a wall of 2.5 mm, 5 kPa and 616 mm² by 25 mN in a millisecond.
    assert 1.0 < np.median(more[ramp][:5]) < 10.0
    assert np.median(less[ramp]) < 0.1
    assert np.median(more[~ramp]) < 0.1


@pytest.mark.parametrize("step", [1, 2, 10])
def test_friction_may_set_in_anywhere_between_two_samples(step: int) -> None:
    experiment = Experiment(slower(slid("drag", 20.0), step))
    (blocks,) = prepare_channels([experiment], MODEL, 0.4)
    residual = blocks.blocks.mean - blocks.predict(NOMINAL).total
    assert np.all(np.abs(residual) < 3.0 + 3.0 * blocks.uncertainty(NOMINAL))


@pytest.mark.parametrize("step", [2, 5, 10])
def test_a_slowly_sampled_ramp_is_predicted_as_well_as_is_said(step: int) -> None:
    run = sheared(hold_s=2.0)
    (fine,), (coarse,) = (list(prepare_channels([Experiment(slower(run, every))], MODEL)) for every in (1, step))
    at_samples = coarse.experiment.time_s
    error = coarse.predictor.predict(NOMINAL, at_samples).total - fine.predictor.predict(NOMINAL, at_samples).total
    assert np.all(np.abs(error) < 1.0 + 3.0 * coarse.predictor.uncertainty(NOMINAL, at_samples))
    peak = fine.predictor.predict(NOMINAL, fine.experiment.time_s).total.argmax()
    blocks = fine.blocks
    assert np.any(np.abs(blocks.nodes_s - fine.experiment.time_s[peak]) < 1e-9)


def pink(samples: int, random: np.random.Generator, sd: float, power: float = 1.0) -> FloatArray:
    frequency = np.fft.rfftfreq(2 * samples, 1 / 500.0)
    gain = np.maximum(frequency, 0.02) ** (-0.5 * power)
    values = np.fft.irfft(np.fft.rfft(random.standard_normal(2 * samples)) * gain)[:samples]
    return np.asarray(sd * values / values.std())


def test_1_over_f_noise_is_found_where_it_is_and_not_elsewhere() -> None:
    runs = [relaxation(seed=seed) for seed in range(6)]
    random = np.random.default_rng(3)
    plain = estimate_noise([Experiment(run) for run in runs], "force")
    assert plain.flicker == 0.0
    assert plain.slow_sd == plain.slow
    noisy = [
        changed(run, "force", np.asarray(run.trace.force) + pink(run.trace.time.size, random, 2.0)) for run in runs
    ]
    found = estimate_noise([Experiment(run) for run in noisy], "force")
    # 12 e-folds of frequency hold the 2 mN, of which each of the times has a factor of 4.
    assert found.flicker == pytest.approx(2.0 * np.sqrt(np.log(4.0) / np.log(250.0 / 0.02)), rel=0.3)
    assert found.white == pytest.approx(1.5, rel=0.1)


@pytest.mark.parametrize("power", [thorough(0.75), 1.25])
def test_the_power_of_the_frequency_is_found(power: float) -> None:
    random = np.random.default_rng(4)
    runs = [relaxation(seed=seed, hold_s=60.0) for seed in range(8)]
    noisy = [
        changed(run, "force", np.asarray(run.trace.force) + pink(run.trace.time.size, random, 4.0, power))
        for run in runs
    ]
    found = estimate_noise([Experiment(run) for run in noisy], "force")
    assert found.flicker_power == pytest.approx(power, abs=0.15)
    # Noise slower than a hold is left to the hold's own cubic.
    assert found.slow_sd == pytest.approx(4.0, rel=0.3)


@pytest.mark.parametrize("power", [0.8, 1.0, 1.2])
def test_1_over_f_noise_falls_with_frequency_as_it_should(power: float) -> None:
    noise = NoiseModel(0.0, 0.0, 1.0, 0, flicker=1.0, flicker_power=power)
    width = 0.001
    lag = noise.covariances(BlockPairs.even(1500, width, 1))
    spectrum = np.abs(np.fft.rfft(np.concatenate((lag, lag[-2:0:-1]))))
    frequency = np.fft.rfftfreq(2 * lag.size - 2, width)
    at = [int(np.argmin(np.abs(frequency - hertz))) for hertz in (4.0, 40.0)]
    assert spectrum[at[0]] / spectrum[at[1]] == pytest.approx(10.0**power, rel=0.25)
    assert len(FLICKER_TIMES_S) == 10


def test_slow_motion_shows_slow_noise_as_rests_do() -> None:
    runs = [slid("coulomb", 0.5, seed=seed, travel_mm=10.0) for seed in range(3)]
    found = estimate_noise([Experiment(run) for run in runs], "force")
    assert found.slow == pytest.approx(0.5, rel=0.15)
    assert found.correlation_s == pytest.approx(0.2, rel=0.3)


def test_a_swing_in_slow_motion_is_not_taken_for_noise() -> None:
    swinging = []
    for seed in range(3):
        run = slid("coulomb", 0.5, seed=seed, travel_mm=10.0)
        wave = 4.0 * np.sin(2 * np.pi * 1.3 * run.trace.time) * (np.asarray(run.trace.phase) == int(Phase.STEADY))
        swinging.append(Experiment(changed(run, "force", np.asarray(run.trace.force) + wave)))
    assert estimate_noise(swinging, "force").slow < 1.0


def test_a_force_that_relaxes_at_rest_is_no_noise() -> None:
    relaxing = []
    for seed in range(4):
        run = slid("coulomb", 20.0, seed=seed)
        tail = 60.0 * np.exp(-run.trace.time / 0.5)
        relaxing.append(Experiment(changed(run, "force", np.asarray(run.trace.force) + tail)))
    assert estimate_noise(relaxing, "force").slow < 1.5


def disturbed(seed: int, at: tuple[int, ...] = (), zero: slice | None = None, height_mN: float = 90.0) -> Run:
    run = slid("drag", 20.0, seed=seed, repeat=seed)
    force = np.asarray(run.trace.force, dtype=np.float64).copy()
    for sample in at:
        force[sample : sample + 2] += height_mN
    if zero is not None:
        force[zero] = 0.0
    return changed(run, "force", force)


def test_impulses_and_dropouts_are_left_out_and_said() -> None:
    runs = [disturbed(seed) for seed in range(4)]
    runs[1] = disturbed(1, at=(1, 200, 800, 1200))
    runs[2] = disturbed(2, at=(300,), zero=slice(1000, 1012))
    selection = select_loaded_runs(runs)
    clean, second, third, _ = selection.experiments
    assert clean.valid.all()
    assert np.flatnonzero(second.faulty).tolist() == [1, 2, 200, 201, 800, 801, 1200, 1201]
    assert np.flatnonzero(third.faulty).tolist() == [300, 301, *range(1000, 1012)]
    (remark,) = selection.remarks
    assert "5 impulses and 1 dropout of up to" in remark
    assert "2 runs" in remark
    assert estimate_noise(selection.experiments, "force").white == pytest.approx(1.5, rel=0.05)


def test_an_impulse_on_a_ramp_is_found_and_the_ramp_is_none() -> None:
    run = relaxation(seed=1)
    force = np.asarray(run.trace.force, dtype=np.float64).copy()
    assert not select_loaded_runs([run]).experiments[0].faulty.any()
    force[530:533] -= 120.0
    (experiment,) = select_loaded_runs([changed(run, "force", force)]).experiments
    assert np.flatnonzero(experiment.faulty).tolist() == [530, 531, 532]


def test_what_the_motion_does_at_its_begin_in_every_run_is_no_impulse() -> None:
    start = int(np.flatnonzero(np.diff(np.asarray(disturbed(0).trace.phase)))[0])
    pulled = [slid("blank", 20.0, seed=seed, fixture=Fixture.NONE, repeat=seed) for seed in range(6)]
    everywhere, once = [], []
    for number, run in enumerate(pulled):
        force = np.asarray(run.trace.force, dtype=np.float64) * 0.0 + noise(
            np.random.default_rng(number), run.trace.time.size
        )
        pulse = force.copy()
        pulse[start + 1 : start + 3] += 60.0
        everywhere.append(changed(run, "force", pulse))
        once.append(changed(run, "force", pulse if number == 2 else force))
    assert not any(experiment.faulty.any() for experiment in select_loaded_runs(everywhere).experiments)
    assert [int(experiment.faulty.sum()) for experiment in select_loaded_runs(once).experiments] == [0, 0, 2, 0, 0, 0]


@pytest.mark.parametrize(
    ("frequency_hz", "rate_hz", "source_hz"),
    [(50.3, 500.0, 50.0), (150.0, 1000.0, 150.0), (40.0, 100.0, 60.0), (10.2, 50.0, 60.0), (23.0, 100.0, None)],
)
def test_hum_is_known_by_its_alias(frequency_hz: float, rate_hz: float, source_hz: float | None) -> None:
    line = SpectralLine(frequency_hz, 1.0, 100.0, rate_hz)
    assert line.mains_multiple_hz == source_hz
    assert line.is_mains is (source_hz is not None)
    aliased = source_hz is not None and 2 * source_hz > rate_hz
    assert line.source_hz == (source_hz if aliased else frequency_hz)


def test_a_line_below_the_tolerance_is_noise() -> None:
    lines = SpectralLines(SpectralLine(50.0, 0.6, 400.0), SpectralLine(33.0, 0.8, 400.0))
    kept = lines_that_matter(lines, 0.5)
    assert (kept.mains.llr, kept.non_mains.llr) == (0.0, 400.0)


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_noise_that_motion_adds_is_read_from_the_motion(factor: float) -> None:
    runs = []
    for seed in range(5):
        run = slid("coulomb", 2.0, seed=seed, travel_mm=10.0, repeat=seed)
        moves = np.asarray(run.trace.phase) == int(Phase.STEADY)
        more = 1.5 * np.sqrt(factor**2 - 1) * np.random.default_rng(seed).normal(size=moves.size)
        runs.append(changed(run, "force", np.asarray(run.trace.force) + more * moves))
    problem = JointProblem.of(select_loaded_runs(runs), MODEL)
    blocks = problem.channels[0]
    added = 1.5 * np.sqrt(factor**2 - 1)
    assert blocks.moving_white == pytest.approx(added, rel=0.1, abs=0.1)
    steady = (blocks.blocks.middle_s > 2.0) & (blocks.blocks.middle_s < 5.0)
    expected = added / np.sqrt(blocks.blocks.samples)
    assert blocks.uncertainty(NOMINAL)[steady] == pytest.approx(expected[steady], rel=0.1, abs=0.02)
    assert problem.noises[0].white == pytest.approx(1.5, rel=0.05)


def with_rests(run: Run, seed: int, slow: FloatArray) -> Run:
    """A run whose sensor has noise of 1 mN and slower noise besides."""
    white = np.random.default_rng(seed).normal(size=slow.size)
    return changed(run, "force", np.asarray(run.trace.force) + white + slow)


@pytest.mark.parametrize("sd_mN", [thorough(0.0), 1.5])
def test_what_repeats_differ_by_shows_noise_that_is_slower_than_the_rests(sd_mN: float) -> None:
    random = np.random.default_rng(7)
    runs = [slower(slid("drag", 1.0, repeat=repeat), 10) for repeat in range(6)]
    size = runs[0].trace.time.size
    noisy = [with_rests(run, seed, pink(10 * size, random, sd_mN)[::10]) for seed, run in enumerate(runs)]
    experiments = [Experiment(run) for run in noisy]
    repeats = repeat_differences(tuple(prepare_channels(experiments, MODEL)), "force", MODEL)
    assert len(repeats) == 5
    found = estimate_noise(experiments, "force", repeats=repeats)
    expected = sd_mN * np.sqrt(np.log(4.0) / np.log(250.0 / 0.02))
    assert found.flicker == pytest.approx(expected, rel=0.4, abs=0.05)
    assert found.slow_sd == pytest.approx(sd_mN, rel=0.3, abs=0.4)


def test_what_a_specimen_does_between_repeats_is_no_noise() -> None:
    runs = [slower(slid("drag", 1.0, repeat=repeat), 10) for repeat in range(4)]
    swinging = []
    for seed, run in enumerate(runs):
        moves = np.asarray(run.trace.phase) == int(Phase.STEADY)
        swing = 6.0 * moves * np.sin(2 * np.pi * run.trace.time / 8.0 + 2.0 * seed)
        swinging.append(Experiment(with_rests(run, seed, np.asarray(swing))))
    repeats = repeat_differences(tuple(prepare_channels(swinging, MODEL)), "force", MODEL)
    assert estimate_noise(swinging, "force", repeats=repeats).slow_sd < 0.6


def test_the_mains_sampled_at_its_own_rate_is_hum_and_no_drift() -> None:
    runs = [slower(slid("drag", 1.0, repeat=repeat), 10) for repeat in range(4)]
    random = np.random.default_rng(9)
    humming = []
    for seed, run in enumerate(runs):
        hertz, turn = 50.0 + 0.03 * random.standard_normal(), random.random()
        hum = 1.5 * np.sin(2 * np.pi * (hertz * run.trace.time + turn))
        humming.append(Experiment(with_rests(run, seed, np.asarray(hum))))
    repeats = repeat_differences(tuple(prepare_channels(humming, MODEL)), "force", MODEL)
    found = estimate_noise(humming, "force", repeats=repeats)
    assert (found.flicker, found.hum_hz) == (0.0, 0.0)
    assert found.hum == pytest.approx(1.5, rel=0.4)
    assert found.slow_sd == pytest.approx(1.5 / np.sqrt(2.0), rel=0.4)


def pulsed(pulses: Mapping[int, tuple[int, float]], seed: int = 0) -> tuple[Run, NDArray[np.bool_]]:
    """A drag at 50 Hz with pulses of some samples and heights, by where they begin; and which samples they are."""
    run = slower(slid("drag", 1.0, seed=seed), 10)
    force = np.asarray(run.trace.force, dtype=np.float64).copy()
    off = np.zeros(force.size, dtype=np.bool_)
    for begin, (count, height_mN) in pulses.items():
        force[begin : begin + count] += height_mN
        off[begin : begin + count] = True
    return changed(run, "force", force), off


@pytest.mark.parametrize(
    "pulses",
    [
        {900: (3, 9.0)},
        {900: (1, 15.0)},
        {900: (2, 60.0), 906: (3, -45.0)},
        {900: (2, 60.0), 902: (3, 35.0)},
        {46: (3, -300.0)},
        {0: (2, 40.0)},
        {-3: (3, 30.0)},
    ],
    ids=["small", "single", "two", "two in succession", "before the motion", "at the begin", "at the end"],
)
def test_impulses_are_found_at_low_rates_too(pulses: dict[int, tuple[int, float]]) -> None:
    size = pulsed({})[1].size
    run, off = pulsed({begin % size: value for begin, value in pulses.items()})
    (experiment,) = select_loaded_runs([run]).experiments
    assert np.flatnonzero(experiment.faulty).tolist() == np.flatnonzero(off).tolist()


def test_a_clean_record_has_no_faults() -> None:
    for seed in range(6):
        for run in (slid("drag", 60.0, seed=seed), relaxation(seed=seed), sheared(seed)):
            for step in (1, 5, 10):
                (experiment,) = select_loaded_runs([slower(run, step)]).experiments
                assert not experiment.faulty.any()


@pytest.mark.parametrize("held", [False, True], ids=["zero", "held"])
def test_a_dropout_of_150_ms_is_found_by_its_constant_reading(held: bool) -> None:
    run = disturbed(0)
    force = np.round(np.asarray(run.trace.force, dtype=np.float64) / 0.3) * 0.3
    force[800:875] = force[799] if held else 0.0
    (experiment,) = select_loaded_runs([changed(run, "force", force)]).experiments
    first = 799 if held else 800
    assert np.flatnonzero(experiment.faulty).tolist() == list(range(first, 875))
    (fault,) = experiment.faults
    assert fault.dropout


def test_the_signal_of_a_drive_that_holds_its_place_is_no_dropout() -> None:
    rng = np.random.default_rng(5)
    command = np.concatenate((np.linspace(0, 20, 800), np.full(100, 20), np.linspace(20, 0, 800)))
    force = 2000 * np.sign(np.gradient(command)) + rng.normal(0, 20, command.size)
    force[800:900], force[400:460] = 350.0, force[399]
    trace = replace(
        slid("drag", 60.0).trace,
        signal="motor_force",
        sample_rate_hz=500.0,
        time=np.arange(command.size) / 500.0,
        phase=np.full(command.size, int(Phase.STEADY), np.uint8),
        command=command,
        channels={"motor_force": force, "position": command + rng.normal(0, 0.01, command.size)},
    )
    (fault,) = (pulse for pulse in force_pulses(trace) if pulse.dropout)
    assert (fault.begin, fault.end) == (399, 460)


@pytest.mark.parametrize("count_mN", [0.3, 1.2, 4.9])
def test_a_coarse_converter_has_no_dropouts(count_mN: float) -> None:
    for seed in range(4):
        run = slid("drag", 1.0, seed=seed)
        force = np.round(np.asarray(run.trace.force, dtype=np.float64) / count_mN) * count_mN
        assert not select_loaded_runs([changed(run, "force", force)]).experiments[0].faulty.any()


def test_a_short_motion_shows_a_jitter_with_the_chance_of_few_samples() -> None:
    for seed in range(40):
        run = slower(slid("coulomb", 20.0, travel_mm=1.5), 2)
        velocity = np.gradient(np.asarray(run.trace.command), run.trace.time)
        jittering = replace(
            with_position(run, velocity * np.random.default_rng(seed).normal(0.0, 2e-4, velocity.size)),
            shared_jitter_s=2e-4,
        )
        assert not any(errors.has_position_error for errors in position_errors([jittering]))


def rippling(wave: Callable[[Run], FloatArray], *, at_rest: bool = False) -> list[Experiment]:
    """Coulomb runs at several speeds whose force has a wave of 2 mN while the stage moves, or all the time."""
    runs = []
    for seed, speed_mm_s in enumerate((5.0, 10.0, 20.0, 30.0, 45.0, 60.0)):
        run = slid("coulomb", speed_mm_s, seed=seed)
        moves = np.asarray(run.trace.phase) == int(Phase.STEADY)
        force = np.asarray(run.trace.force) + 2.0 * np.sin(2 * np.pi * wave(run) + seed) * (moves | at_rest)
        runs.append(Experiment(changed(run, "force", force)))
    return runs


@pytest.mark.parametrize("at_rest", [False, True])
def test_a_line_of_the_drive_is_found_at_its_frequency(at_rest: bool) -> None:
    line = find_moving_line(rippling(lambda run: 33.0 * run.trace.time, at_rest=at_rest), "force")
    assert line is not None
    assert (line.frequency_hz, line.wavelength_mm) == (pytest.approx(33.0, abs=0.5), 0.0)
    assert line.amplitude == pytest.approx(2.0, rel=0.1)
    assert "at 33 Hz of 2" in moving_line_remark(line)


def test_a_line_of_the_drive_is_found_along_the_way() -> None:
    line = find_moving_line(rippling(lambda run: np.asarray(run.trace.command) / 0.25), "force")
    assert line is not None
    assert (line.frequency_hz, line.wavelength_mm) == (0.0, pytest.approx(0.25, rel=0.01))
    assert line.amplitude == pytest.approx(2.0, rel=0.1)
    assert "every 0.25 mm of travel" in moving_line_remark(line)


def test_noise_folds_and_hum_are_no_lines_of_the_drive() -> None:
    quiet = [Experiment(slid("coulomb", speed, seed=1)) for speed in (5.0, 10.0, 20.0, 40.0)]
    assert find_moving_line(quiet, "force") is None
    assert find_moving_line(rippling(lambda run: np.asarray(run.trace.command) / 6.0), "force") is None
    humming = rippling(lambda run: 50.0 * run.trace.time, at_rest=True)
    assert find_moving_line(humming, "force") is None
    assert find_spectral_lines(humming, "force").mains.amplitude == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize("line", [MovingLine(2.0, frequency_hz=33.0), MovingLine(2.0, wavelength_mm=0.25)])
def test_blocks_know_of_a_line_in_motion_as_far_as_they_do_not_average_it_out(line: MovingLine) -> None:
    (blocks,) = prepare_channels([Experiment(slid("coulomb", 2.0, seed=0))], MODEL)
    known = replace(blocks, moving_line=line)
    layout, variance = blocks.blocks, known.uncertainty(NOMINAL) ** 2 - blocks.uncertainty(NOMINAL) ** 2
    variance += np.sum(known.line_signatures**2, axis=1)
    width_s, moves = layout.end_s - layout.start_s, blocks.experiment.velocity(layout.middle_s) > 0
    hertz = line.frequency_hz or 2.0 / line.wavelength_mm
    short, long = moves & (width_s < 0.1 / hertz), moves & (width_s > 3.0 / hertz)
    assert short.any()
    assert np.all(variance[short] > 0.8 * 2.0)
    assert np.all(variance[long] < 0.05 * 2.0)
    assert np.all(variance[~moves] == 0.0)
    assert known.equivalence_key != blocks.equivalence_key
