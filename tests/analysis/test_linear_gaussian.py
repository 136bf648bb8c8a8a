"""The fit's algebra against dense matrices: whitening, posteriors, and a model that is linear in its parameters."""

from collections.abc import Mapping
from dataclasses import replace
from math import log
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import block_diag
from threadpoolctl import threadpool_info, threadpool_limits

from dragrig.analysis.linear_gaussian import (
    LINE_SEARCH_FRACTIONS,
    ChannelBlocks,
    JointProblem,
    MovingLine,
    PriorScales,
    Whitening,
    _LeastSquaresPass,
    _ModelCache,
    is_at_bound,
    prepare_channels,
    repeat_differences,
    single_blas_thread,
    solve_joint,
    zero_remarks,
)
from dragrig.analysis.models.nominal_model import ChannelModel, MotionState, Parameter, Prediction
from dragrig.analysis.noise import average_in_blocks
from dragrig.config import AnalysisError
from dragrig.rig import FloatArray, Run
from sliding_runs import noise, selected, slid, with_force

RANDOM = np.random.default_rng(7)
PRIORS = (Parameter("lognormal", "1", 2.0, 0.5), Parameter("normal", "mN", -3.0, 4.0, positive=False))


def test_linear_algebra_works_in_one_thread_and_afterwards_in_as_many_as_before() -> None:
    with threadpool_limits(2, user_api="blas"):
        for _ in range(2):
            with single_blas_thread():
                assert {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"} == {1}
            assert {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"} == {2}


def test_a_prior_is_normal_or_lognormal_about_its_nominal_value() -> None:
    scales = PriorScales.of(PRIORS)
    np.testing.assert_allclose(scales.sd, [np.sqrt(log(1.25)), 4.0])
    np.testing.assert_allclose(scales.values(np.zeros(2)), [2.0, -3.0])
    np.testing.assert_allclose(scales.values(np.array([1.0, 1.0])), [2.0 * np.exp(scales.sd[0]), 1.0])
    z = np.array([-0.7, 1.3])
    np.testing.assert_allclose(scales.deviations(scales.values(z)), z)
    step = 1e-6
    slopes = (scales.values(z + step) - scales.values(z - step)) / (2 * step)
    np.testing.assert_allclose(scales.slopes(scales.values(z)), slopes, rtol=1e-6)
    assert scales.values(np.array([1e6, 0.0]))[0] == np.inf


def random_whitening(blocks: int = 7, effects: int = 2) -> tuple[Whitening, FloatArray, FloatArray]:
    """Return a whitening, the covariance of its noise, and the signatures of the run's effects."""
    root = np.tril(RANDOM.normal(size=(blocks, blocks))) + 4.0 * np.eye(blocks)
    signatures = RANDOM.normal(scale=3.0, size=(blocks, effects))
    return Whitening.of(root, signatures), root @ root.T, signatures


def test_whitened_residuals_are_independent_and_of_unit_variance() -> None:
    whitening, of_noise, signatures = random_whitening()
    by_columns = whitening.whiten(np.eye(7))
    np.testing.assert_allclose(by_columns @ (of_noise + signatures @ signatures.T) @ by_columns.T, np.eye(7), atol=1e-9)
    np.testing.assert_allclose(
        whitening.whiten_noise(np.eye(7)) @ of_noise @ whitening.whiten_noise(np.eye(7)).T, np.eye(7), atol=1e-9
    )
    values = RANDOM.normal(size=7)
    np.testing.assert_allclose(whitening.whiten(values), by_columns @ values)
    np.testing.assert_allclose(whitening.run_effects, whitening.whiten_noise(signatures))
    nothing = Whitening.of(np.linalg.cholesky(of_noise), np.zeros((7, 0)))
    np.testing.assert_allclose(nothing.whiten(values), nothing.whiten_noise(values))


def test_products_of_whitened_columns_leave_out_what_is_zero() -> None:
    whitening, covariance, signatures = random_whitening()
    values = np.random.default_rng(3).standard_normal((7, 4))
    values[:, 2] = 0.0
    expected = values.T @ np.linalg.solve(covariance + signatures @ signatures.T, values)
    assert whitening.gram(values) == pytest.approx(expected)
    total = np.ones((4, 4))
    whitening.add_gram(total, values)
    assert total == pytest.approx(1.0 + expected)


def test_an_error_of_the_form_adds_to_the_noise_of_each_block() -> None:
    whitening, of_noise, signatures = random_whitening()
    sd = np.linspace(0.5, 3.0, 7)
    by_columns = whitening.with_form_error(sd).whiten(np.eye(7))
    covariance = of_noise + np.diag(sd**2) + signatures @ signatures.T
    np.testing.assert_allclose(by_columns @ covariance @ by_columns.T, np.eye(7), atol=1e-9)


def test_a_runs_own_values_are_those_of_the_joint_gaussian() -> None:
    """Of effects e and parameters p, residual = signatures e + slopes p + noise: the same by one dense solve."""
    whitening, of_noise, signatures = random_whitening()
    slopes, residual = RANDOM.normal(size=(7, 3)), RANDOM.normal(size=7)
    spread = RANDOM.normal(size=(3, 3))
    covariance = spread @ spread.T
    mean, total = whitening.posterior_run_effects(residual, slopes, covariance)
    precision = np.eye(2) + signatures.T @ np.linalg.solve(of_noise, signatures)
    gain = np.linalg.solve(precision, signatures.T @ np.linalg.inv(of_noise))
    np.testing.assert_allclose(mean, gain @ residual)
    np.testing.assert_allclose(total, np.linalg.inv(precision) + gain @ slopes @ covariance @ slopes.T @ gain.T)


def test_a_line_in_time_averages_out_over_its_waves() -> None:
    line = MovingLine(2.0, frequency_hz=10.0)
    sds = line.sds(np.array([0.001, 0.1, 1.0, 1.0]), np.array([5.0, 5.0, 5.0, 0.0]))
    np.testing.assert_allclose(sds, np.sqrt(2.0) / np.array([1.0, np.pi, 10 * np.pi, np.inf]))
    assert line.waves(np.arange(3.0), np.ones(3), np.ones(3, bool)).shape == (3, 0)


def test_a_line_along_the_way_is_in_step_with_it_but_for_a_part() -> None:
    line = MovingLine(2.0, wavelength_mm=4.0)
    sds = line.sds(np.array([0.1, 2.0, 2.0]), np.array([8.0, 8.0, 0.0]))
    np.testing.assert_allclose(sds, [0.3 * np.sqrt(2.0), 0.3 * np.sqrt(2.0) / (4 * np.pi), 0.0])
    waves = line.waves(np.array([0.0, 1.0, 0.5, 1.0]), np.array([0.0, 2.0, 4.0, 0.0]), np.array([1, 1, 1, 0], bool))
    np.testing.assert_allclose(waves, [[2, 0], [0, 2 * 2 / np.pi], [0, 0], [0, 0]], atol=1e-12)


class Linear(ChannelModel):
    """A force of a constant against the motion, and one in proportion to the speed."""

    name = "linear"
    parameters = (
        Parameter("constant_mN", "mN", 40.0, 20.0, positive=False),
        Parameter("viscous_mN_s_mm", "mN s/mm", 1.0, 3.0, positive=False),
    )
    run_to_run = 0.0

    def predict(self, values: Mapping[str, float], at: MotionState) -> FloatArray:
        return np.asarray(values["constant_mN"] * at.direction + values["viscous_mN_s_mm"] * at.velocity_mm_s)


class Varying(Linear):
    run_to_run = 0.1


def moved(speed_mm_s: float, zero_mN: float = 2.0, repeat: int = 0, constant_mN: float = 55.0) -> Run:
    """Return a run of a rig with 55 mN and 1.5 mN s/mm."""
    run = slid("drag", speed_mm_s, repeat=repeat)
    velocity = np.gradient(np.asarray(run.trace.position), run.trace.time)
    true = constant_mN * np.tanh(velocity / 0.05) + 1.5 * velocity
    rng = np.random.default_rng([repeat, round(10 * speed_mm_s)])
    return with_force(run, true + zero_mN + noise(rng, len(true)))


def problem_of(model: type[ChannelModel] = Linear) -> JointProblem:
    runs = [moved(5.0), moved(10.0, -3.0), moved(20.0), moved(20.0, 1.0, repeat=1)]
    return JointProblem.of(selected(runs), model())


def test_a_linear_model_is_fitted_as_one_dense_gaussian() -> None:
    problem = problem_of()
    found = solve_joint(problem)
    assert (found.converged, found.why, found.misfit) == (True, "", 1.0)
    np.testing.assert_allclose(problem.scales.values(found.z), [55.0, 1.5], rtol=0.05)
    covariances, residuals, columns = [], [], []
    for number, channel in enumerate(problem.channels):
        blocks = channel.blocks
        dense = problem.noises[number].covariance(blocks.start_s, blocks.end_s, blocks.samples)
        dense += np.diag(problem.uncertainties(found.z)[number] ** 2) + problem.zero_sds[number] ** 2
        covariances.append(dense)
        residuals.append(blocks.mean - channel.predict(problem.scales.values(np.zeros(2))).total)
        columns.append(channel.sensitivities(problem.scales.nominal).T * problem.scales.sd)
    covariance, residual, design = block_diag(*covariances), np.concatenate(residuals), np.concatenate(columns)
    posterior = np.linalg.inv(design.T @ np.linalg.solve(covariance, design) + np.eye(2))
    mean = posterior @ design.T @ np.linalg.solve(covariance, residual)
    np.testing.assert_allclose(found.z, mean, atol=2e-3)
    np.testing.assert_allclose(found.covariance, posterior, rtol=2e-2, atol=1e-9)
    for slopes, column in zip(found.slopes, columns, strict=True):
        np.testing.assert_allclose(slopes, column, rtol=1e-5, atol=1e-6)


def test_what_a_model_leaves_lowers_the_weight_of_the_runs() -> None:
    runs = [moved(5.0, constant_mN=20.0), moved(10.0, constant_mN=90.0), moved(20.0, constant_mN=20.0)]
    found = solve_joint(JointProblem.of(selected(runs), Linear()))
    assert found.misfit > 10.0
    whitened = [
        whitening.whiten(blocks.blocks.mean - blocks.predict(SCALED(found.z)).total)
        for blocks, whitening in zip(JointProblem.of(selected(runs), Linear()).channels, found.whitenings, strict=True)
    ]
    residual = np.concatenate(whitened)
    assert found.misfit == pytest.approx(float(residual @ residual) / residual.size, rel=0.1)
    weighted = np.concatenate([w.whiten(s) for w, s in zip(found.whitenings, found.slopes, strict=True)])
    np.testing.assert_allclose(
        found.covariance, np.linalg.inv(weighted.T @ weighted / found.misfit + np.eye(2)), rtol=1e-3, atol=1e-12
    )


SCALED = PriorScales.of(Linear.parameters).values


def test_equivalent_channels_are_computed_once_and_are_the_same_object() -> None:
    problem = problem_of()
    assert len(problem.representatives) == 4
    assert problem.representatives[0] == 0
    z = np.zeros(2)
    for computed in (problem.predictions(z), problem.uncertainties(z), problem.derivatives(z)):
        for number, first in enumerate(problem.representatives):
            assert computed[number] is computed[first]


def test_a_runs_own_factor_multiplies_what_the_model_predicts() -> None:
    problem = problem_of(Varying)
    z = np.zeros(2)
    predictions, uncertainties = problem.predictions(z), problem.uncertainties(z)
    whitenings = problem.whitenings(predictions, uncertainties)
    whitening = whitenings[0]
    signatures = whitening.noise_root @ whitening.run_effects
    np.testing.assert_allclose(signatures[:, 0], np.full(len(signatures), problem.zero_sds[0]), rtol=1e-9)
    np.testing.assert_allclose(signatures[:, 1], 0.1 * predictions[0].total, atol=1e-9)
    assert signatures.shape[1] == 2
    blocks, noise_model = problem.channels[0].blocks, problem.noises[0]
    covariance = noise_model.covariance(blocks.start_s, blocks.end_s, blocks.samples) + np.diag(uncertainties[0] ** 2)
    np.testing.assert_allclose(whitening.noise_root @ whitening.noise_root.T, covariance, rtol=1e-9, atol=1e-12)
    force = np.linspace(0.0, 3.0, len(signatures))
    for name, factor in (("run_to_run", 0.1), ("friction", 0.0)):
        again = problem.with_varying_force(0, predictions[0], name, force, whitening)
        np.testing.assert_allclose(
            again.noise_root @ again.run_effects, signatures + np.outer(force, [0.0, factor]), atol=1e-9
        )
        assert again.noise_root is whitening.noise_root
    near = problem.whitenings(predictions, [np.zeros(1)] * 4, whitenings)
    assert [entry.noise_root is given.noise_root for entry, given in zip(near, whitenings, strict=True)] == [True] * 4
    bare = replace(problem, zero_sds=(0.0,) * 4).whitenings(predictions, uncertainties)
    assert bare[0].run_effects.shape[1] == 1


def test_a_model_that_gives_no_number_is_named_with_the_run() -> None:
    problem = problem_of()
    for compute in (problem.predictions, problem.uncertainties, problem.derivatives):
        with pytest.raises(AnalysisError) as caught:
            compute(np.array([np.nan, 0.0]))
        assert str(caught.value) == (
            "the model linear gives NaN or infinity for force of drag-5-40-0.h5 at values within the fit's bounds; "
            "give its parameters narrower priors, or correct the model."
        )


class Elsewhere(Linear):
    channel = "temperature"


def test_a_model_of_what_no_run_recorded_is_refused() -> None:
    with pytest.raises(AnalysisError) as caught:
        JointProblem.of(selected([moved(5.0)]), Elsewhere())
    assert str(caught.value) == (
        "the model linear predicts nothing of these runs (drag), which recorded force, position; name another model "
        "with --nominal."
    )


def test_a_zero_further_off_than_the_model_allows_is_widened_and_told() -> None:
    near, far = (
        JointProblem.of(selected([moved(5.0, zero), moved(10.0, zero), moved(20.0, -zero)]), Linear())
        for zero in (2.0, 30.0)
    )
    assert set(near.zero_sds) == {5.0}
    assert list(zero_remarks(near)) == []
    assert far.zero_sds[0] == pytest.approx(60.0, rel=0.1)
    assert list(zero_remarks(far)) == [
        "the first samples of force lie further from the prediction than a zero known to 5 mN (zero_sd_mN) allows: the "
        f"zero was taken as known to {far.zero_sds[0]:.3g} mN"
    ]

    class Zeroed(Linear):
        zero_sd_mN = 0.0

    assert set(JointProblem.of(selected([moved(5.0, 30.0)]), Zeroed()).zero_sds) == {0.0}


def channel_of(run: Run) -> ChannelBlocks:
    (blocks,) = prepare_channels(selected([run]).experiments, Linear())
    return blocks


def test_motion_adds_its_noise_and_its_line_where_the_stage_moves() -> None:
    quiet = channel_of(moved(10.0))
    values = np.array([55.0, 1.5])
    blocks, speed = quiet.blocks, np.abs(quiet.experiment.velocity(quiet.blocks.middle_s))
    assert set((speed > 0).tolist()) == {True, False}
    plain = quiet.uncertainty(values)
    noisy = replace(quiet, moving_white=6.0).uncertainty(values)
    np.testing.assert_allclose(noisy**2, plain**2 + 36.0 * (speed > 0) / blocks.samples)
    line = MovingLine(3.0, wavelength_mm=5.0)
    rippling = replace(quiet, moving_white=6.0, moving_line=line)
    added = line.sds(blocks.end_s - blocks.start_s, speed)
    np.testing.assert_allclose(rippling.uncertainty(values) ** 2, noisy**2 + added**2)
    place, ends = quiet.experiment.position(blocks.middle_s), quiet.experiment.position(blocks.end_s)
    extent = np.abs(ends - quiet.experiment.position(blocks.start_s))
    np.testing.assert_allclose(rippling.line_signatures, line.waves(place, extent, speed > 0))
    assert quiet.line_signatures.shape == (blocks.mean.size, 0)
    assert len({quiet.equivalence_key, rippling.equivalence_key, replace(quiet, moving_line=line).equivalence_key}) == 3
    assert quiet.equivalence_key == replace(quiet).equivalence_key


def test_blocks_predict_means_and_their_derivatives() -> None:
    channel = channel_of(moved(10.0))
    values, step = np.array([55.0, 1.5]), 1e-4
    rows = channel.sensitivities(values)
    for index in range(2):
        ahead, behind = values.copy(), values.copy()
        ahead[index] += step
        behind[index] -= step
        slope = (channel.predict(ahead).total - channel.predict(behind).total) / (2 * step)
        np.testing.assert_allclose(rows[index], slope, atol=1e-6)
    nodes = channel.predictor.predict(values, channel.blocks.nodes_s)
    predicted = channel.predict(values)
    assert isinstance(predicted, Prediction)
    np.testing.assert_allclose(predicted.total, channel.blocks.of(nodes.total))
    assert predicted.varying.shape == (0, channel.blocks.mean.size)


def test_repeats_differ_by_what_is_measured_and_not_by_zero_or_factor() -> None:
    (first,) = prepare_channels(selected([moved(20.0)]).experiments, Varying())
    again = replace(first, blocks=replace(first.blocks, mean=first.blocks.mean + 2.5))
    (found,) = repeat_differences((first, again), "force", Varying())
    np.testing.assert_allclose(found.difference, 2.5)
    long = first.blocks.end_s - first.blocks.start_s >= 0.02
    for given, kept in (
        (found.start_s, first.blocks.start_s),
        (found.end_s, first.blocks.end_s),
        (found.samples, first.blocks.samples),
    ):
        np.testing.assert_array_equal(given, kept[long])
    own = np.column_stack((np.ones(long.size), first.predict(np.array([40.0, 1.0])).varying[0]))[long]
    assert found.signatures.shape == own.shape
    np.testing.assert_allclose(found.signatures @ found.signatures.T @ own, own, atol=1e-9)
    assert repeat_differences((first,), "force", Varying()) == ()
    assert repeat_differences((first, again), "motor_force", Varying()) == ()
    assert len(repeat_differences((first, again, first), "force", Varying())) == 2


def test_a_parameter_is_at_its_bound_within_a_thousandth() -> None:
    assert is_at_bound(np.array([5.998, 5.9995, -6.0, 0.0])).tolist() == [False, True, True, False]
    assert LINE_SEARCH_FRACTIONS[0] == 1.0


class Bounded(Linear):
    parameters = (
        Parameter("constant_mN", "mN", 0.0, 5.0, positive=False),
        Parameter("viscous_mN_s_mm", "mN s/mm", 1.0, 3.0, positive=False),
    )


def test_a_parameter_far_beyond_its_prior_stays_at_the_bound_and_the_others_are_fitted() -> None:
    """55 mN are 11 prior standard deviations from 0."""
    found = solve_joint(JointProblem.of(selected([moved(5.0), moved(10.0), moved(20.0)]), Bounded()))
    assert found.converged
    assert found.z[0] == pytest.approx(6.0)
    assert 1.5 < PriorScales.of(Bounded.parameters).values(found.z)[1] < 4.5


def one_residual(slope: float, misfit: float = 1.0) -> _LeastSquaresPass:
    """Return a problem whose only residual is 0 at z = 1, beside the prior."""
    cache = SimpleNamespace(
        residuals=lambda z: [slope * (z - 1.0)], derivatives=lambda z: [np.full((1, 1), slope)]
    )  # fmt: skip
    return _LeastSquaresPass(cache, (Whitening.of(np.eye(1), np.zeros((1, 0))),), misfit)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("step", "first", "lowest"),
    [(4.0, 1.0, 1.0), (1.9, 1.9, 0.95), (0.4, 0.4, 0.4), (-1.0, None, None), (0.0, None, None), (1e3, None, None)],
)
def test_a_line_search_takes_the_longest_step_that_helps_or_the_best(
    step: float, first: float | None, lowest: float | None
) -> None:
    """From 0, where χ² is 100, over 1, 0.5, 0.25 and 0.1 of the step."""
    present, z = one_residual(10.0), np.zeros(1)
    for found, expected in (
        (present.line_search(z, np.array([step])), first),
        (present.line_search(z, np.array([step]), lowest=True), lowest),
    ):
        assert (None if found is None else found.tolist()) == (None if expected is None else [pytest.approx(expected)])


def test_a_pass_weighs_the_runs_by_their_misfit_and_the_prior_by_one() -> None:
    present, z = one_residual(10.0, misfit=4.0), np.array([3.0])
    assert present.chi2(z) == pytest.approx(400.0 / 4.0 + 9.0)
    step, covariance = present.newton_step(z)
    assert (z + step).tolist() == [pytest.approx(25.0 / 26.0)]
    assert covariance.tolist() == [[pytest.approx(1.0 / 26.0)]]
    held, _ = one_residual(1e-6).newton_step(np.array([6.0]))
    assert held.tolist() == [pytest.approx(-6.0)]
    beyond = replace(one_residual(10.0), cache=SimpleNamespace(
        residuals=lambda z: [10.0 * (z - 9.0)], derivatives=lambda z: [np.full((1, 1), 10.0)]
    ))  # fmt: skip
    stays, _ = beyond.newton_step(np.array([6.0]))
    assert stays.tolist() == [0.0]
    bounded = beyond.line_search(np.array([5.0]), np.array([50.0]))
    assert bounded is not None
    assert bounded.tolist() == [6.0]


def test_a_clock_that_jitters_makes_uncertain_what_changes_fast() -> None:
    channel = channel_of(moved(10.0))
    values, blocks = np.array([55.0, 1.5]), channel.blocks
    plain = channel.uncertainty(values)
    last_s = float(channel.experiment.time_s[-1])
    jittering = SimpleNamespace(clock_jitter_s=0.02, time_s=channel.experiment.time_s)
    found = replace(channel, experiment=jittering).uncertainty(values)  # type: ignore[arg-type]
    early, late = (
        channel.predictor.predict(values, np.clip(blocks.nodes_s + shift_s, 0.0, last_s)).total
        for shift_s in (-0.02, 0.02)
    )
    added = blocks.of((0.5 * (late - early)) ** 2) / blocks.samples
    assert added.max() > 1.0
    np.testing.assert_allclose(found**2, plain**2 + added, atol=1e-9)


def test_derivatives_that_are_not_used_are_not_asked_for() -> None:
    asked: list[object] = []

    def sensitivities(without: object, values: FloatArray, time_s: FloatArray) -> FloatArray:
        asked.append(without)
        return np.zeros((values.size, time_s.size))

    problem = problem_of()
    predictor = SimpleNamespace(sensitivities_without=sensitivities, equivalence_key=1)
    bare = replace(problem, channels=tuple(replace(entry, predictor=predictor) for entry in problem.channels))
    bare.derivatives(np.zeros(2), ("constant_mN",))
    bare.derivatives(np.zeros(2))
    assert set(asked) == {("constant_mN",), ()}


def test_derivatives_are_reused_while_no_parameter_moves_by_a_twentieth() -> None:
    """Relative to its value, whose logarithm has a prior of 0.1 here: a twentieth of the value is half of that."""
    problem = SimpleNamespace(scales=SimpleNamespace(sd=np.array([0.1])), derivatives=derivatives)
    cache = _ModelCache(problem)  # type: ignore[arg-type]
    for z, steps in ((0.0, 1), (0.49, 1), (0.51, 2), (0.1, 2), (0.0, 3)):
        cache.derivatives(np.array([z]))
        assert cache.steps == steps
    cache.derivatives(np.array([0.01]), 0.0)
    assert cache.steps == 4


def derivatives(z: FloatArray) -> list[FloatArray]:
    return [z]


@pytest.mark.parametrize("jumps", [True, False])
def test_a_sample_stands_for_its_time_where_the_prediction_jumps(jumps: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    (experiment,) = selected([moved(10.0)]).experiments
    predictor = Linear().prepare(experiment)["force"]
    monkeypatch.setattr(type(predictor), "jumps", property(lambda _: jumps))
    (found,) = prepare_channels([experiment], Linear(), 3.0)
    expected = average_in_blocks(experiment, "force", predictor.events_s, jumps=jumps, longest_mm=3.0)
    np.testing.assert_array_equal(found.blocks.nodes_s, expected.nodes_s)
    np.testing.assert_array_equal(found.blocks.mean, expected.mean)
    assert np.abs(np.diff(experiment.position(found.blocks.middle_s))).max() < 3.5
