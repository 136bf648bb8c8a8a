"""Sizes of promised effects, how far a gap closes, and what is made of both, against direct fits of the same blocks."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from dragrig.analysis import Whitening, select_runs
from dragrig.analysis.gap import evaluation
from dragrig.analysis.gap.design import Candidate
from dragrig.analysis.gap.diagnosis import GapReduction, R2BeforeAfter
from dragrig.analysis.gap.evaluation import (
    SIZE_GRID,
    ForceEvaluation,
    ModelEvaluation,
    PromiseVerdict,
    RelativeEffectSize,
    best_size,
    evaluate,
    is_allowed_size,
    refitted_chi2,
    resized_model,
    size_in_position,
    unseen_effect_size,
)
from dragrig.analysis.gap.gap_reduction import closed_share, position_sums
from dragrig.analysis.gap.position_channel import PositionErrors, predicted_position_error
from dragrig.config import AnalysisError, FrictionModelSettings, find_settings, parse_effects
from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import active_effects, find_effect
from places import CAMPAIGN, DATA
from property_tests import thorough

RUNS, BLOCKS = 5, 30
RANDOM = np.random.default_rng(11)
COLUMNS = RANDOM.normal(size=(RUNS, BLOCKS, 2))
SIGNATURES = RANDOM.normal(size=(RUNS, BLOCKS, 2))
"""What each of two effects adds at its promised size."""
PRECISION = np.array([1.0, 4.0])
WHITENINGS = tuple(
    Whitening.of(np.diag(RANDOM.uniform(0.3, 0.6, BLOCKS)), np.full((BLOCKS, 1), 2.0)) for _ in range(RUNS)
)
GRID = (-1.0, 0.0, 0.5, 1.0, 1.5, 2.0, 3.0)


def forces_of(true_sizes: tuple[float, float]) -> ForceEvaluation:
    """Return runs in which two effects have these sizes, as seen about the amended model that promises 1 of each."""
    residuals = (
        SIGNATURES @ (np.array(true_sizes) - 1.0) + COLUMNS @ np.array([0.4, -0.3])
        + 0.4 * np.random.default_rng(2).normal(size=(RUNS, BLOCKS))
    )  # fmt: skip
    runs = tuple(
        SimpleNamespace(residual=residuals[number], columns=COLUMNS[number], whitening=WHITENINGS[number])
        for number in range(RUNS)
    )
    promised = tuple(SIGNATURES[number].sum(axis=1) for number in range(RUNS))
    tried = tuple(
        tuple(
            np.array([SIGNATURES[number] @ np.where(np.arange(2) == effect, size, 1.0) for size in GRID])
            for effect in range(2)
        )
        for number in range(RUNS)
    )
    effects = tuple(SimpleNamespace(effect=SimpleNamespace(id=name)) for name in ("folds", "adhesion"))
    amended = SimpleNamespace(runs=runs, prior_precision=PRECISION)
    return ForceEvaluation(None, amended, effects, (GRID, GRID), tried, promised)  # type: ignore[arg-type]


def normal_equations(found: ForceEvaluation, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return gram and moment of both effects' sizes, as prior 10 wide, and the specimen's parameters."""
    gram, moment = np.diag([0.0, 0.01, *PRECISION]), np.zeros(4)
    for number, run in enumerate(found.amended.runs):
        values = run.whitening.whiten(
            np.column_stack((run.residual + SIGNATURES[number].sum(axis=1), SIGNATURES[number], run.columns))
        )
        gram = gram + weights[number] * values[:, 1:].T @ values[:, 1:]
        moment = moment + weights[number] * values[:, 1:].T @ values[:, 0]
    return gram, moment


def size_of_first(found: ForceEvaluation, weights: FloatArray) -> float:
    """Of the first effect, whose size has no prior, as that is tried on a grid; that of the other has one about 0."""
    gram, moment = normal_equations(found, weights)
    # The others' sizes are relative to the promised force, of which residuals have one already.
    moment = moment - gram[:, 1] + np.array([0.0, 0.01, 0.0, 0.0])
    return float(np.linalg.solve(gram, moment)[0])


@pytest.mark.parametrize("true", [(1.0, 1.0), (0.0, 1.0), thorough((2.0, 0.5))], ids=["kept", "absent", "twice"])
def test_a_size_is_that_of_a_direct_fit_with_all_else_free(true: tuple[float, float]) -> None:
    found = forces_of(true)
    first, second = found.sizes()
    assert (first.effect, second.effect) == ("folds", "adhesion")
    assert first.size == pytest.approx(size_of_first(found, np.ones(RUNS)), abs=2e-3)
    assert (first.size, second.size) == pytest.approx(true, abs=0.15)
    gram, _ = normal_equations(found, np.ones(RUNS))
    error = float(np.sqrt(np.linalg.inv(gram)[0, 0]))
    weights = np.random.default_rng(0).dirichlet(np.ones(RUNS), 500) * RUNS
    low, high = np.quantile([size_of_first(found, entry) for entry in weights], (0.025, 0.975))
    assert first.low == pytest.approx(min(low, first.size - 1.959964 * error), abs=3e-3)
    assert first.high == pytest.approx(max(high, first.size + 1.959964 * error), abs=3e-3)
    whole = gram[1:, 1:]
    assert first.d_prime**2 == pytest.approx(gram[0, 0] - gram[0, 1:] @ np.linalg.solve(whole, gram[1:, 0]), rel=1e-6)


def test_an_effect_explains_its_share_of_chi_square() -> None:
    found = forces_of((1.0, 1.0))
    chi2 = []
    for with_effects in (False, True):
        values = np.concatenate([
            run.whitening.whiten(np.column_stack((run.residual + (0.0 if with_effects else force), run.columns)))
            for run, force in zip(found.amended.runs, found.promised_forces, strict=True)
        ])  # fmt: skip
        fitted = np.linalg.solve(values[:, 1:].T @ values[:, 1:] + np.diag(PRECISION), values[:, 1:].T @ values[:, 0])
        chi2.append(float(np.sum((values[:, 0] - values[:, 1:] @ fitted) ** 2)))
        residuals = found.refitted(with_effects=with_effects)
        for run, force, residual in zip(found.amended.runs, found.promised_forces, residuals, strict=True):
            whole = run.residual + (0.0 if with_effects else force)
            np.testing.assert_allclose(residual, whole - run.columns @ fitted)
    before, after = chi2
    assert found.explained_share() == pytest.approx((before - after) / (before - RUNS * BLOCKS))
    assert replace(found, effects=()).explained_share() is None
    nothing = replace(found, promised_forces=tuple(0.0 * force for force in found.promised_forces))
    assert nothing.explained_share() is None


def test_a_parabola_through_the_lowest_sizes_gives_size_and_error() -> None:
    def grams(chi2: FloatArray) -> FloatArray:
        return np.array([np.diag([value, 1.0]) for value in chi2])

    sizes = np.array(GRID)
    for best in (0.7, 2.6, -0.5, 3.4):
        size, error = best_size(GRID, grams(5.0 + 4.0 * (sizes - best) ** 2), np.ones(1))
        assert (size, error) == (pytest.approx(best), pytest.approx(0.5))
    assert best_size(GRID, grams(5.0 - sizes**2), np.ones(1)) == (0.0, 10.0)
    assert best_size(GRID, grams(5.0 + 1e-3 * (sizes - 60.0) ** 2), np.ones(1)) == (10.0, 10.0)
    assert best_size(GRID, grams(5.0 + 1e-3 * (sizes + 60.0) ** 2), np.ones(1))[0] == -5.0
    gram = np.array([[9.0, 2.0], [2.0, 3.0]])
    assert refitted_chi2(gram, np.array([1.0])) == pytest.approx(9.0 - 4.0 / 4.0)


@pytest.mark.parametrize(
    ("size", "low", "high", "verdict"),
    [
        (1.0, 0.9, 1.1, PromiseVerdict.KEPT),
        (0.71, 0.51, 0.9, PromiseVerdict.KEPT),
        (1.41, 0.9, 1.99, PromiseVerdict.KEPT),
        (1.0, 0.5, 1.5, PromiseVerdict.NO_POWER),
        (1.0, 0.8, 2.0, PromiseVerdict.NO_POWER),
        (0.7, 0.6, 0.99, PromiseVerdict.NOT_KEPT),
        (0.7, 0.6, 1.0, PromiseVerdict.NO_POWER),
        (1.42, 1.01, 1.7, PromiseVerdict.NOT_KEPT),
        (0.3, -0.1, 1.0, PromiseVerdict.NO_POWER),
        (0.3, -1.0, 0.99, PromiseVerdict.NOT_KEPT),
    ],
)
def test_a_size_keeps_its_promise_within_limits(size: float, low: float, high: float, verdict: PromiseVerdict) -> None:
    assert RelativeEffectSize("folds", size, low, high, 5.0).verdict is verdict


KEPT = RelativeEffectSize("folds", 1.0, 0.9, 1.1, 5.0)
UNCERTAIN, BROKEN = replace(KEPT, low=0.0), replace(KEPT, size=0.1, high=0.5)
NOTHING = R2BeforeAfter(None, None, None, None)
REDUCTION = GapReduction(1.0, 1.0, 1.0, None, None, None, NOTHING, NOTHING, ())


@pytest.mark.parametrize(
    ("sizes", "explained", "verdict"),
    [
        ((KEPT, KEPT), 0.9, PromiseVerdict.KEPT),
        ((KEPT, UNCERTAIN), 0.9, PromiseVerdict.NO_POWER),
        ((UNCERTAIN, BROKEN), 0.9, PromiseVerdict.NOT_KEPT),
        ((KEPT,), 0.25, PromiseVerdict.KEPT),
        ((KEPT,), 0.24, PromiseVerdict.NOT_KEPT),
        ((UNCERTAIN,), 0.0, PromiseVerdict.NO_POWER),
        ((KEPT,), None, PromiseVerdict.KEPT),
    ],
)
def test_a_model_keeps_its_promise_where_every_effect_does(
    sizes: tuple[RelativeEffectSize, ...], explained: float | None, verdict: PromiseVerdict
) -> None:
    assert ModelEvaluation(REDUCTION, None, None, None, None, explained, sizes).verdict is verdict


def test_the_share_that_closes_is_of_the_gap_above_the_floor() -> None:
    """Weight, and mean squares before, after and of the floor times it, of four runs."""
    sums = np.array([[1.0, 10.0, 3.0, 1.0], [2.0, 12.0, 8.0, 2.0], [1.0, 4.0, 2.0, 1.0], [4.0, 50.0, 10.0, 4.0]])
    share, (low, high) = closed_share(sums)
    assert share == pytest.approx((76.0 - 23.0) / (76.0 - 8.0))
    random = np.random.default_rng(0)
    shares = [
        (entry[1] - entry[2]) / max(entry[1] - entry[3], 0.44 * entry[3])
        for entry in random.dirichlet(np.ones(4), 500) @ sums
    ]
    assert (low, high) == pytest.approx(tuple(np.quantile(shares, (0.025, 0.975))))
    without_gap, _ = closed_share(np.array([[2.0, 2.1, 2.5, 2.0]]))
    assert without_gap == pytest.approx((2.1 - 2.5) / (0.44 * 2.0))


SCALE = find_effect("encoder_scale")
PROMISED = Candidate(SCALE, {**SCALE.defaults, SCALE.size.name: 0.01})


def position_errors_of(size: float, seed: int, noise_mm: float = 0.002, blocks: int = 40) -> PositionErrors:
    command = np.linspace(0.0, 40.0, blocks)
    error = size * 0.01 * command + noise_mm * np.random.default_rng(seed).normal(size=blocks)
    return PositionErrors(
        experiment=SimpleNamespace(),  # type: ignore[arg-type]
        time_s=np.arange(blocks) * 0.1, command_mm=command, velocity_mm_s=np.full(blocks, 10.0),
        error_mm=error - error[0], session_s=0.0, noise_mm=noise_mm,
    )  # fmt: skip


def test_a_size_in_position_weighs_all_runs_alike() -> None:
    runs = [position_errors_of(size, seed) for size, seed in ((1.0, 1), (1.2, 2), (0.9, 3))]
    predictions = [predicted_position_error(PROMISED, run) for run in runs]
    found = size_in_position(PROMISED, runs)
    products = []
    for run, prediction in zip(runs, predictions, strict=True):
        weight = 1 / (float(np.sqrt(np.mean(run.error_mm**2))) + run.encoder_count_mm) ** 2 / run.error_mm.size
        products.append((weight * prediction @ prediction, weight * prediction @ run.error_mm))
    power, moment = np.array(products).T
    assert found.effect == "encoder_scale"
    assert found.size == pytest.approx(moment.sum() / power.sum())
    weights = np.random.default_rng(0).dirichlet(np.ones(3), 500) * 3
    assert (found.low, found.high) == pytest.approx(
        tuple(np.quantile((weights @ moment) / (weights @ power), (0.025, 0.975)))
    )
    squares = sum(float(prediction @ prediction) for prediction in predictions)
    variance = float(np.mean([run.noise_variance for run in runs]))
    assert found.d_prime == pytest.approx(np.sqrt(squares / variance))
    sums = position_sums(PROMISED, runs, predicted_position_error)
    for row, run, prediction in zip(sums, runs, predictions, strict=True):
        assert row == pytest.approx([
            1.0, np.mean(run.error_mm**2), np.mean((run.error_mm - prediction) ** 2), run.noise_variance,
        ])  # fmt: skip


def test_runs_that_cannot_show_an_effect_tell_neither_presence_nor_absence() -> None:
    nothing = RelativeEffectSize("encoder_scale", 0.0, -5.0, 10.0, 0.0)
    assert unseen_effect_size(SCALE) == nothing
    assert size_in_position(PROMISED, []) == nothing
    still = replace(position_errors_of(1.0, 1), command_mm=np.zeros(40))
    assert size_in_position(PROMISED, [still]) == nothing
    assert nothing.verdict is PromiseVerdict.NO_POWER


MODEL = find_settings(FrictionModelSettings, "model", str(DATA / "amended-breakaway.toml"))


def test_an_effect_is_tried_at_the_sizes_that_it_may_have() -> None:
    (active,) = active_effects(MODEL)
    allowed = [size for size in SIZE_GRID if is_allowed_size(active, size)]
    assert allowed == [size for size in SIZE_GRID if size >= 0.0]
    assert is_allowed_size(active, 0.0)
    assert is_allowed_size(active, 1.0)
    twice = resized_model(MODEL, active.effect, 2.0)
    assert dict(twice.effects[0].parameters) == {"ratio": pytest.approx(2 * 0.5707235), "slip_mm": 0.161375}
    assert resized_model(MODEL, active.effect, 0.0).effects == ()
    both = MODEL.model_copy(update={"effects": (*MODEL.effects, *parse_effects(["force_drift"]))})
    assert [entry.id for entry in resized_model(both, active.effect, 0.0).effects] == ["force_drift"]
    assert resized_model(both, active.effect, 0.5).effects[1] == both.effects[1]


FEW = ("001-relaxation.h5", "008-coulomb.h5", "010-drag.h5", "018-drag.h5")


@pytest.fixture(scope="module")
def several() -> ModelEvaluation:
    """A model of effects on force, position and hum, and what runs without any of them say of it."""
    effects = (*MODEL.effects, *parse_effects(["encoder_scale", "mains_hum"]))
    model = MODEL.model_copy(update={"effects": effects})
    selection = select_runs(CAMPAIGN)
    chosen = tuple(entry for entry in selection.experiments if entry.file in FEW)
    assert len(chosen) == len(FEW)
    return evaluate(replace(selection, experiments=chosen), model)


def test_a_model_of_several_effects_is_evaluated_in_each_channel(several: ModelEvaluation) -> None:
    found = several
    assert [size.effect for size in found.sizes] == ["breakaway", "encoder_scale", "mains_hum"]
    of_force, of_position, of_hum = found.sizes
    assert abs(of_force.size) < 0.3
    assert of_force.d_prime > 3.0
    assert abs(of_position.size) < 0.3
    assert abs(of_hum.size) < 0.5
    assert of_hum.high - of_hum.size == pytest.approx(of_hum.size - of_hum.low)
    assert of_hum.d_prime == pytest.approx(4.0 / (of_hum.high - of_hum.size))
    assert found.verdict is PromiseVerdict.NOT_KEPT
    assert (found.promised, found.promised_95ci) == (pytest.approx(1.003561), None)
    assert found.achieved is not None
    assert found.achieved_95ci is not None
    assert found.achieved_95ci[0] <= found.achieved <= found.achieved_95ci[1]
    assert (found.diagnosed_runs, len(found.traces)) == (0, len(FEW))
    assert sorted(found.reduction.runs) == sorted(FEW)


def test_runs_of_the_diagnosis_are_left_out_and_all_of_them_refused() -> None:
    selection = select_runs(CAMPAIGN)
    ids = tuple(entry.run.info.header.run_id for entry in selection.experiments)
    assert MODEL.diagnosed is not None
    known = MODEL.model_copy(update={"diagnosed": MODEL.diagnosed.model_copy(update={"run_ids": ids[:3]})})
    left = evaluation.without_diagnosed(selection, known)
    assert [entry.run.info.header.run_id for entry in left.experiments] == list(ids[3:])
    fresh = MODEL.model_copy(update={"diagnosed": None})
    assert evaluation.without_diagnosed(selection, fresh).experiments == selection.experiments
    every = MODEL.model_copy(update={"diagnosed": MODEL.diagnosed.model_copy(update={"run_ids": ids})})
    with pytest.raises(AnalysisError) as caught:
        evaluate(selection, every)
    assert str(caught.value) == (
        f"all {len(ids)} runs took part in the diagnosis that made model amended, and can confirm nothing; name fresh "
        "runs of the same specimen."
    )
    with pytest.raises(AnalysisError) as caught:
        evaluate(selection, MODEL.model_copy(update={"effects": ()}))
    assert str(caught.value) == "model amended has no effects: there is nothing to evaluate."
