"""The budget's shares against a direct least-squares fit of the same runs, and what its parts are called."""

from collections.abc import Mapping
from dataclasses import replace
from math import exp
from types import SimpleNamespace

import numpy as np
import pytest

from dragrig.analysis import Whitening
from dragrig.analysis.gap import budget
from dragrig.analysis.gap.budget import CausesOfGap, force_budget, gap_budget, presence_of_effects
from dragrig.analysis.gap.design import ColumnKind
from dragrig.analysis.gap.diagnosis import MODEL, SPECIMEN, UNEXPLAINED, BudgetEntry, Classification, Verdict
from dragrig.analysis.gap.gap_reduction import gap_of_run
from dragrig.analysis.gap.presence import Cause, CauseKind, CauseSet, Presence
from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import catalogue

RUNS, BLOCKS, WHITE, ZERO_SD = 6, 20, 0.2, 3.0
RANDOM = np.random.default_rng(5)
NOMINAL = RANDOM.normal(size=(RUNS, BLOCKS, 2))
COLUMNS = RANDOM.normal(size=(RUNS, BLOCKS, 5))
VARYING = RANDOM.normal(size=(RUNS, BLOCKS))
WIDTHS = RANDOM.uniform(0.5, 2.0, size=(RUNS, BLOCKS))
SAMPLES = RANDOM.integers(1, 9, size=(RUNS, BLOCKS)).astype(float)
MOTION_SD = RANDOM.uniform(0.0, 0.2, size=(RUNS, BLOCKS))
PRIOR_PRECISION, PRIOR_MEAN = np.array([9.0, 0.5, 2.0]), np.array([9.0, 0.3, -0.2])
"""Of a column that is no nuisance, and of the two nominal parameters."""
FORCE = 4.0 * COLUMNS[:, :, 0] + 1.5 * COLUMNS[:, :, 2] + 0.5 * COLUMNS[:, :, 4]
RESIDUAL = (
    NOMINAL @ np.array([0.6, -0.4]) + FORCE + WHITE * RANDOM.normal(size=(RUNS, BLOCKS))
    + 2.0 * RANDOM.normal(size=(RUNS, 1)) + 0.3 * RANDOM.normal(size=(RUNS, 1)) * VARYING
)  # fmt: skip
WHITENINGS = tuple(
    Whitening.of(np.diag(np.full(BLOCKS, WHITE)), np.column_stack((np.full(BLOCKS, ZERO_SD), 0.2 * VARYING[number])))
    for number in range(RUNS)
)


def cause(name: str, kind: CauseKind, *columns: int, scales: tuple[float, ...] = (1.0, 5.0), detail: str = "") -> Cause:
    return Cause(name, kind, np.array(columns), np.linspace(0.5, 1.0, len(columns)), scales, detail=detail)


CAUSES = (
    cause("stribeck", CauseKind.EFFECT, 0),
    cause("speed", CauseKind.LAW, 1, detail="in the gut"),
    cause("laws of the model", CauseKind.MODEL, 2, 3),
    cause("gain of a run", CauseKind.RUN, 4),
    cause("adhesion", CauseKind.EFFECT, 1),
    cause("exchange", CauseKind.EXCHANGE, 3),
)
CHOSEN: CauseSet = ((0, 1), (1, 0), (2, 0), (3, 1))
LOG_ODDS: Mapping[CauseSet, float] = {
    (): 0.0, CHOSEN: 30.0, CHOSEN[1:]: 20.0, ((2, 0), (3, 1), (4, 0)): 28.0, ((0, 1), (2, 0), (3, 1)): 29.0,
    ((1, 0), (2, 0), (3, 1), (4, 0)): 27.5,
}  # fmt: skip
PROBABILITIES = {
    "stribeck": 0.97, "speed": 0.7, "laws of the model": 0.95, "gain of a run": 0.9, "adhesion": 0.05, "exchange": 0.1,
}  # fmt: skip
EFFECTS = {"stribeck": 0.95, "adhesion": 0.3}
ESTABLISHED = {"stribeck": 0.95}


def as_kinds(*kinds: ColumnKind) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Columns of the design: one that is no nuisance, then the nominal parameters."""
    assert set(kinds) == {ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR}
    return np.array([1, 2])


def scaled_columns(causes: CauseSet) -> tuple[FloatArray, FloatArray]:
    rows = [1 + CAUSES[index].columns for index, _ in causes]
    sds = [CAUSES[index].sds * CAUSES[index].scales[scale] for index, scale in causes]
    return np.concatenate((*rows, np.zeros(0, dtype=np.intp))), np.concatenate((*sds, np.zeros(0)))


def prepared(scale: float = 1.0, runs: int = RUNS) -> tuple[SimpleNamespace, CausesOfGap]:
    """Return the study of the runs, their gap times a factor, and its causes."""
    residual = scale * RESIDUAL
    design = SimpleNamespace(
        runs=[
            SimpleNamespace(
                residual=residual[number],
                columns=np.column_stack((np.full(BLOCKS, 7.0), NOMINAL[number])),
                whitening=WHITENINGS[number],
                motion_sd=MOTION_SD[number],
            )
            for number in range(runs)
        ],
        run_rows=[slice(number * BLOCKS, (number + 1) * BLOCKS) for number in range(runs)],
        columns_of=as_kinds,
        prior_precision=PRIOR_PRECISION,
        prior_mean=PRIOR_MEAN,
    )
    competition = SimpleNamespace(
        causes=CAUSES, design=design, whitenings=WHITENINGS[:runs], pieces=(np.concatenate(COLUMNS[:runs]),),
        scaled_columns=scaled_columns,
    )  # fmt: skip
    presence = Presence(PROBABILITIES, {entry.name: entry.kind for entry in CAUSES}, LOG_ODDS)
    study = SimpleNamespace(
        runs=[
            SimpleNamespace(
                file=f"{number}.h5",
                label=f"run {number}",
                experiment=SimpleNamespace(kind="drag"),
                condition=("drag", float(number // 2)),
                coordinates=SimpleNamespace(
                    time_s=np.arange(BLOCKS) + number, width_s=WIDTHS[number], position_mm=np.arange(BLOCKS) * 2.0
                ),
                block_data=SimpleNamespace(blocks=SimpleNamespace(samples=SAMPLES[number])),
            )
            for number in range(runs)
        ],
        problem=SimpleNamespace(noises=[SimpleNamespace(white=WHITE, slow_sd=0.1)] * runs, zero_sds=[ZERO_SD] * runs),
    )
    return study, CausesOfGap(competition, presence, EFFECTS)  # type: ignore[arg-type]


PARTS = {"stribeck": (0, 1), MODEL: (2, 3), SPECIMEN: (4,)}
"""Columns of each part: a law of the coordinate of an effect is that effect in another form."""
SDS = np.array([2.5, 0.5, 0.5, 1.0, 2.5])
FOLDS = ((0, 1), (2, 3), (4, 5))


def direct(folds: tuple[tuple[int, ...], ...], scale: float = 1.0) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return gap and parts of each run, by one fit of parameters and causes to the runs outside its fold."""
    gaps, parts = [np.zeros(0)] * RUNS, [np.zeros((0, 0))] * RUNS
    for fold in folds:
        others = [number for number in range(RUNS) if number not in fold] or list(fold)
        rows = [
            WHITENINGS[number].whiten(
                np.column_stack((scale * RESIDUAL[number], NOMINAL[number], COLUMNS[number] * SDS))
            )
            for number in others
        ]
        values = np.concatenate(rows)
        gram = values.T @ values
        nominal = gram[1:3, 1:3] + np.diag(PRIOR_PRECISION[1:])
        told = gram[1:3, 0] + PRIOR_PRECISION[1:] * PRIOR_MEAN[1:]
        alone = np.linalg.solve(nominal, told)
        joint = gram[1:, 1:] + np.diag([*PRIOR_PRECISION[1:], *np.ones(5)])
        fitted = np.linalg.solve(joint, np.append(told, gram[3:, 0]))
        absorbed = np.linalg.solve(nominal, gram[1:3, 3:])
        for number in fold:
            gap = scale * RESIDUAL[number] - NOMINAL[number] @ alone
            each = (COLUMNS[number] * SDS - NOMINAL[number] @ absorbed) * fitted[2:]
            rest, whitening = gap - each.sum(axis=1), WHITENINGS[number]

            def own_factors(values: FloatArray, effects: FloatArray = whitening.run_effects) -> FloatArray:
                return np.asarray(np.linalg.solve(np.eye(2) + effects.T @ effects, effects.T @ values / WHITE))

            own = WHITE * whitening.run_effects[:, 1] * np.clip(own_factors(rest)[1], -4.0, 4.0)
            gaps[number] = gap - own - ZERO_SD * own_factors(rest - own)[0]
            parts[number] = np.array([each[:, list(columns)].sum(axis=1) for columns in PARTS.values()])
    return gaps, parts


def noise_square() -> float:
    return float(np.sum(WIDTHS * (WHITE**2 / SAMPLES + 0.1**2 + MOTION_SD**2)))


def test_shares_are_those_of_a_direct_fit_to_the_other_runs() -> None:
    study, causes = prepared()
    found = force_budget(study, causes, ESTABLISHED)  # type: ignore[arg-type]
    gaps, parts = direct(FOLDS)
    gap_square = float(np.sum(WIDTHS * np.array(gaps) ** 2)) - noise_square()
    assert found.held_out
    assert found.gap_mN == pytest.approx(np.sqrt(gap_square / WIDTHS.sum()))
    *named, rest = found.entries
    assert [entry.cause for entry in named] == ["stribeck", MODEL, SPECIMEN]
    together = np.stack(parts, axis=1)
    for entry, by_run in zip(named, together, strict=True):
        assert entry.channel == "force"
        assert entry.share == pytest.approx(float(np.sum(WIDTHS * by_run * np.array(gaps))) / gap_square)
        assert entry.rms_mN == pytest.approx(np.sqrt(np.sum(WIDTHS * by_run**2) / WIDTHS.sum()))
        assert entry.share_95ci is not None
        assert entry.share_95ci[0] < entry.share < entry.share_95ci[1]
    assert rest.cause == UNEXPLAINED
    assert rest.share == pytest.approx(1.0 - sum(entry.share for entry in named))
    left = float(np.sum(WIDTHS * (np.array(gaps) - together.sum(axis=0)) ** 2)) - noise_square()
    assert rest.rms_mN == pytest.approx(np.sqrt(max(left, 0.0) / WIDTHS.sum()))
    assert [entry.presence for entry in found.entries] == [0.95, 0.95, 0.9, None]
    assert [entry.what for entry in found.entries] == ["", "laws of the model", "gain of a run", ""]
    assert [entry.not_separable_from for entry in found.entries] == [("adhesion",), (), (), ()]
    for number, run in enumerate(found.runs):
        assert (run.file, run.kind, run.label, run.channel, run.unit) == (
            f"{number}.h5", "drag", f"run {number}", "force", "mN",
        )  # fmt: skip
        np.testing.assert_allclose(run.gap, gaps[number])
        np.testing.assert_allclose(np.array([run.parts[name] for name in PARTS]), parts[number], atol=1e-9)
        np.testing.assert_array_equal(run.time_s, np.arange(BLOCKS) + number)
        np.testing.assert_array_equal(run.width_s, WIDTHS[number])
        np.testing.assert_array_equal(run.position_mm, np.arange(BLOCKS) * 2.0)


def test_too_few_runs_are_fitted_themselves_and_two_give_no_interval() -> None:
    study, causes = prepared(runs=3)
    found = force_budget(study, causes, ESTABLISHED)  # type: ignore[arg-type]
    assert not found.held_out
    assert all(entry.share_95ci for entry in found.entries)
    study, causes = prepared(runs=2)
    assert [entry.share_95ci for entry in force_budget(study, causes, ESTABLISHED).entries] == [None] * 4  # type: ignore[arg-type]


def test_runs_of_one_condition_are_held_out_in_turn() -> None:
    study, causes = prepared()
    for run in study.runs:
        run.condition = ("drag", 1.0)
    found = force_budget(study, causes, ESTABLISHED)  # type: ignore[arg-type]
    gaps, _ = direct(tuple(tuple(range(first, RUNS, 4)) for first in range(4)))
    assert found.held_out
    np.testing.assert_allclose(found.runs[3].gap, gaps[3], rtol=1e-6)


def test_a_gap_within_the_noise_has_no_parts() -> None:
    study, causes = prepared(scale=1e-3)
    study.problem.noises = [SimpleNamespace(white=3.0, slow_sd=0.1)] * RUNS
    found = force_budget(study, causes, ESTABLISHED)  # type: ignore[arg-type]
    assert (found.entries, found.gap_mN, found.held_out, found.runs) == ((), 0.0, True, ())
    loud = np.sqrt((np.sum(WIDTHS * np.array(direct(FOLDS)[0]) ** 2) / 1.05 - np.sum(WIDTHS * (0.1**2 + MOTION_SD**2)))
                   / np.sum(WIDTHS / SAMPLES))  # fmt: skip
    study, causes = prepared()
    study.problem.noises = [SimpleNamespace(white=float(loud), slow_sd=0.1)] * RUNS
    found = force_budget(study, causes, ESTABLISHED)  # type: ignore[arg-type]
    square = float(np.sum(WIDTHS * np.array(direct(FOLDS)[0]) ** 2))
    assert found.entries == ()
    assert found.gap_mN == pytest.approx(np.sqrt(square * (1 - 1 / 1.05) / WIDTHS.sum()))


def test_intervals_widen_with_what_else_explains_the_runs_and_with_the_form() -> None:
    """A share of 0.9 and one that may be none: with an effect that may be absent the interval reaches far down."""
    study, causes = prepared()
    sure = force_budget(study, causes, ESTABLISHED).entries[0]  # type: ignore[arg-type]
    doubtful = force_budget(study, replace(causes, effects={**EFFECTS, "stribeck": 0.6}), {"stribeck": 0.6}).entries[0]  # type: ignore[arg-type]
    assert sure.share_95ci is not None
    assert doubtful.share_95ci is not None
    assert doubtful.share_95ci[0] < 0.2 < sure.share_95ci[0]
    assert sure.share_95ci[1] - sure.share >= 0.09
    assert budget.with_form_error(0.5, (0.5, 0.5)) == pytest.approx((0.41, 0.59))
    assert budget.with_form_error(0.5, (0.38, 0.9)) == pytest.approx(
        (0.5 - np.hypot(0.12, 0.09), 0.5 + np.hypot(0.4, 0.09))
    )
    assert budget.with_form_error(0.5, (0.6, 0.4)) == pytest.approx((0.41, 0.59))
    assert budget.with_form_error(0.5, None) is None


def test_likely_explanations_drop_what_may_not_be_there() -> None:
    """Their weights are the tempered odds of the compared sets with what is established, times what is trusted."""
    _, causes = prepared()
    weights = budget.likely_explanations(causes, CHOSEN, ESTABLISHED)
    assert sum(weights.values()) == pytest.approx(1.0)
    expected: dict[CauseSet, float] = {}
    for key, value in {CHOSEN: 30.0, ((0, 1), (2, 0), (3, 1)): 29.0}.items():
        for kept in range(2 ** len(key)):
            members = tuple(member for place, member in enumerate(key) if kept >> place & 1)
            if key[0] not in members:
                continue
            expected[members] = expected.get(members, 0.0) + exp(0.5 * (value - 30.0)) * 0.5 ** (len(key) - 1)
    total = sum(expected.values())
    assert set(weights) == set(expected)
    for key, weight in weights.items():
        assert weight == pytest.approx(expected[key] / total)
    unsure = budget.likely_explanations(replace(causes, effects={"stribeck": 0.6, "adhesion": 0.3}), CHOSEN, {})
    assert sum(weight for key, weight in unsure.items() if (0, 1) in key) < 0.9
    sure = replace(causes.presence, probabilities={**PROBABILITIES, "exchange": 0.9995}, log_odds={((5, 0),): 9.0})
    assert budget.likely_explanations(replace(causes, presence=sure), ((5, 0),), {}) == {((5, 0),): 1.0}
    likely = replace(sure, probabilities={**PROBABILITIES, "exchange": 0.998})
    assert budget.likely_explanations(replace(causes, presence=likely), ((5, 0),), {}) == {((5, 0),): 0.5, (): 0.5}
    nothing = budget.likely_explanations(causes, CHOSEN, {"stribeck": 0.95, "payload_inertia": 0.9})
    assert max(nothing, key=lambda key: nothing[key]) in expected
    assert set(nothing) <= {key for key in expected if set(key) <= set(CHOSEN)} | {CHOSEN[:1]}


CLASSIFIED = Classification(Verdict.EFFECT, ("stribeck",), {"stribeck": 0.9, "no_gap": 0.1}, ())


def test_the_budget_joins_lines_and_position_to_the_force() -> None:
    study, causes = prepared()
    force = force_budget(study, causes, ESTABLISHED)  # type: ignore[arg-type]
    named = replace(
        CLASSIFIED,
        effects=("stribeck", "mains_hum", "velocity_ripple"),
        probabilities={"stribeck+mains_hum": 0.8, "stribeck+mains_hum+velocity_ripple": 0.15, "no_gap": 0.05},
    )
    plain = gap_budget(study, causes, CLASSIFIED, (), "", None, {"mains_hum": 3.0})  # type: ignore[arg-type]
    assert [entry.share for entry in plain.entries] == [entry.share for entry in force.entries]
    assert (plain.gap_mN, plain.held_out, len(plain.runs)) == (force.gap_mN, True, RUNS)
    found = gap_budget(
        study, causes, named, ("velocity_ripple",), "velocity_ripple", (0.7, (0.6, 0.75)), {"mains_hum": 3.0}  # type: ignore[arg-type]
    )  # fmt: skip
    of_line = 9.0 / (9.0 + force.gap_mN**2)
    by_cause = {(entry.channel, entry.cause): entry for entry in found.entries}
    line = by_cause["force", "mains_hum"]
    assert (line.share, line.rms_mN, line.presence) == (pytest.approx(of_line), 3.0, pytest.approx(0.95))
    for entry in force.entries:
        scaled = by_cause["force", entry.cause]
        assert scaled.share == pytest.approx(entry.share * (1 - of_line))
        assert entry.share_95ci is not None
        assert scaled.share_95ci == pytest.approx([end * (1 - of_line) for end in entry.share_95ci])
    assert found.gap_mN == pytest.approx(np.hypot(force.gap_mN, 3.0))
    of_force = [entry for entry in found.entries if entry.channel == "force"]
    assert [entry.share for entry in of_force[:-1]] == sorted((entry.share for entry in of_force[:-1]), reverse=True)
    assert of_force[-1].cause == UNEXPLAINED
    position, rest = found.entries[-2:]
    low, high = 0.7 - np.hypot(0.1, 0.09), 0.7 + np.hypot(0.05, 0.09)
    assert (position.cause, position.channel, position.share, position.rms_mN) == (
        "velocity_ripple", "position", 0.7, None,
    )  # fmt: skip
    assert (position.share_95ci, position.presence) == (pytest.approx((low, high)), pytest.approx(0.15))
    assert (rest.cause, rest.channel, rest.share, rest.rms_mN) == (UNEXPLAINED, "position", pytest.approx(0.3), None)
    assert rest.share_95ci == pytest.approx((1 - high, 1 - low))
    for elsewhere in (((), "velocity_ripple", (0.7, (0.6, 0.75))), (("velocity_ripple",), "velocity_ripple", None),
                      (("servo_lag",), "servo_lag", (0.7, (0.6, 0.75)))):  # fmt: skip
        without = gap_budget(study, causes, named, *elsewhere, {})  # type: ignore[arg-type]
        assert {entry.channel for entry in without.entries} == {"force"}
    nothing = gap_budget(study, causes, replace(CLASSIFIED, verdict=Verdict.NO_GAP, effects=()), (), "", None, {})  # type: ignore[arg-type]
    assert (nothing.entries, nothing.runs) == ((), ())


def test_a_line_alone_is_the_whole_gap_and_no_line_changes_nothing() -> None:
    line, rest = budget.with_line((), 0.0, "mains_hum", 2.0, 0.9)
    assert line == BudgetEntry("mains_hum", "force", 1.0, None, 2.0, presence=0.9)
    assert rest == BudgetEntry(UNEXPLAINED, "force", 0.0, None, 0.0)
    given = (BudgetEntry(UNEXPLAINED, "force", 1.0, None, 0.0),)
    assert budget.with_line(given, 0.0, "mains_hum", 0.0, 0.9) is given


def test_every_effect_has_a_probability_that_is_never_sure() -> None:
    found = presence_of_effects(
        {"stribeck": 1.0, "adhesion": 0.3},
        replace(CLASSIFIED, probabilities={"mains_hum": 0.2, "velocity_ripple": 0.0, "stribeck": 0.8}),
        ("velocity_ripple",),
    )
    assert set(found) == set(catalogue())
    told = {name: found[name] for name in ("stribeck", "adhesion", "mains_hum", "velocity_ripple", "servo_lag")}
    assert told == {
        "stribeck": 0.997, "adhesion": 0.3, "mains_hum": 0.2, "velocity_ripple": 0.003, "servo_lag": 0.003,
    }  # fmt: skip


def test_a_wall_over_strain_and_the_models_laws_are_one_part() -> None:
    study, causes = prepared()
    renamed = {"stribeck": "hyperelastic_wall"}
    named = tuple(replace(cause, name=renamed.get(cause.name, cause.name)) for cause in CAUSES)
    causes.competition.causes = named  # type: ignore[misc]
    probabilities = {renamed.get(name, name): value for name, value in PROBABILITIES.items()}
    presence = Presence(probabilities, {cause.name: cause.kind for cause in named}, LOG_ODDS)
    causes = replace(causes, presence=presence, effects={"hyperelastic_wall": 0.95, "adhesion": 0.3})
    found = budget.force_budget(study, causes, {"hyperelastic_wall": 0.95})  # type: ignore[arg-type]
    assert {entry.cause for entry in found.entries} == {"hyperelastic_wall", SPECIMEN, UNEXPLAINED}
    assert found.shared_with == {"hyperelastic_wall": ("adhesion", MODEL)}


@pytest.mark.parametrize(("adhesion", "rivals"), [(0.95 * exp(-2.99), ("adhesion",)), (0.95 * exp(-3.01), ())])
def test_a_rival_that_is_unlikely_by_all_is_none(adhesion: float, rivals: tuple[str, ...]) -> None:
    study, causes = prepared()
    found = budget.force_budget(study, replace(causes, effects={**EFFECTS, "adhesion": adhesion}), ESTABLISHED)  # type: ignore[arg-type]
    assert found.entries[0].not_separable_from == rivals


def test_parts_are_called_by_what_is_likely() -> None:
    _, causes = prepared()
    everything: CauseSet = ((0, 1), (1, 0), (2, 0), (3, 1), (4, 0), (5, 0))
    found = budget.parts_of(causes.competition, causes.presence, everything, ESTABLISHED)
    assert found == {
        "stribeck": ((0, 1), (1, 0)), MODEL: ((2, 0),), SPECIMEN: ((3, 1),), UNEXPLAINED: ((4, 0), (5, 0)),
    }  # fmt: skip
    unlikely = replace(causes.presence, probabilities=dict.fromkeys(PROBABILITIES, 0.5))
    found = budget.parts_of(causes.competition, unlikely, everything, {})
    assert found == {UNEXPLAINED: everything}
    likely = replace(causes.presence, probabilities=dict.fromkeys(PROBABILITIES, 0.51))
    found = budget.parts_of(causes.competition, likely, everything, {})
    assert found == {UNEXPLAINED: ((0, 1), (1, 0), (4, 0)), MODEL: ((2, 0),), SPECIMEN: ((3, 1), (5, 0))}
    words = budget.words_of(causes.competition, everything)
    assert words == "stribeck, speed in the gut, laws of the model, gain of a run, adhesion, exchange"


def test_shares_are_sampled_over_runs_and_over_what_these_leave_open() -> None:
    study, causes = prepared()
    study.problem.noises = [SimpleNamespace(white=4.0, slow_sd=0.1)] * RUNS
    (explanation,) = budget.held_out_explanations(study, causes, ESTABLISHED, [CHOSEN])  # type: ignore[arg-type]
    names = ("stribeck", "not there", SPECIMEN)
    found = explanation.sampled_shares(4000, names, np.random.default_rng(1))
    values = np.concatenate([
        WHITENINGS[number].whiten(np.column_stack((NOMINAL[number], COLUMNS[number] * SDS))) for number in range(RUNS)
    ])  # fmt: skip
    covariance = np.linalg.inv(values.T @ values + np.diag([*PRIOR_PRECISION[1:], *np.ones(5)]))[2:, 2:]
    np.testing.assert_allclose(np.linalg.inv(explanation.root @ explanation.root.T), covariance, rtol=1e-6)
    random = np.random.default_rng(2)
    weights = random.dirichlet(np.ones(RUNS), 4000)
    deviations = random.multivariate_normal(np.zeros(5), covariance, 4000)
    gaps, _ = direct(FOLDS)
    square = np.sum(WIDTHS * (np.array(gaps) ** 2 - 4.0**2 / SAMPLES - 0.1**2 - MOTION_SD**2), axis=1)
    moments = explanation.moments
    explained = weights @ (explanation.coefficients * moments) + deviations * (weights @ moments)
    shares = explained / (weights @ square)[:, None]
    expected = np.column_stack((shares[:, :2].sum(axis=1), np.zeros(4000), shares[:, 4]))
    np.testing.assert_allclose(found.mean(axis=0), expected.mean(axis=0), atol=0.02)
    np.testing.assert_allclose(found.std(axis=0), expected.std(axis=0), rtol=0.15, atol=1e-12)
    silent = replace(explanation, runs=tuple(replace(run, noise_variance=run.gap**2) for run in explanation.runs))
    assert silent.sampled_shares(10, names, random).shape == (0, 3)


def test_what_an_explanation_keeps_of_each_run_is_its_moments_with_the_gap() -> None:
    study, causes = prepared()
    (explanation,) = budget.held_out_explanations(study, causes, ESTABLISHED, [CHOSEN])  # type: ignore[arg-type]
    assert (explanation.causes, explanation.parts, explanation.held_out) == (CHOSEN, tuple(PARTS), True)
    assert explanation.members.tolist() == [0, 0, 1, 1, 2]
    for run, coefficients, moments in zip(explanation.runs, explanation.coefficients, explanation.moments, strict=True):
        for number, members in enumerate(PARTS.values()):
            explained = sum(coefficients[member] * moments[member] for member in members)
            assert explained == pytest.approx(float(run.weights_s @ (run.parts[number] * run.gap)))
    few = [replace(explanation, runs=explanation.runs[:2])]
    assert budget.share_intervals(few, {CHOSEN: 1.0}, tuple(PARTS)) == [None] * 4
    assert budget.share_intervals([explanation], {CHOSEN: 0.4}, tuple(PARTS)) == [None] * 4
    whole = budget.share_intervals([explanation], {CHOSEN: 1.0}, tuple(PARTS))
    sampled = explanation.sampled_shares(1000, tuple(PARTS), np.random.default_rng(0))
    with_rest = np.column_stack((sampled, 1.0 - sampled.sum(axis=1)))
    np.testing.assert_allclose(whole, np.quantile(with_rest, (0.025, 0.975), axis=0).T)


@pytest.mark.parametrize(
    ("before", "after", "left_before", "left_after"),
    [(2.6, 3.1, 0.0, 0.0), (2.6, 0.4, 0.6, 0.0), (-2.6, 3.1, 0.6, 1.1), (5.0, 5.5, 1.0, 1.5)],
)
def test_a_run_that_is_off_with_and_without_the_effect_is_no_gap(
    before: float, after: float, left_before: float, left_after: float
) -> None:
    """Factors of a relaxation of 1 N, in standard deviations of 5 %; the more runs, the more are beyond two."""
    signature = np.full(BLOCKS, 50.0)
    whitening = Whitening.of(np.diag(np.full(BLOCKS, WHITE)), signature[:, None])
    blocks = SimpleNamespace(samples=np.ones(BLOCKS), mean=signature)
    run = SimpleNamespace(
        coordinates=SimpleNamespace(width_s=np.ones(BLOCKS), phase=np.zeros(BLOCKS)),
        block_data=SimpleNamespace(blocks=blocks),
        experiment=SimpleNamespace(kind="relaxation"),
    )
    gap = gap_of_run(
        run,  # type: ignore[arg-type]
        SimpleNamespace(white=WHITE, slow_sd=0.0),  # type: ignore[arg-type]
        np.zeros(BLOCKS),
        (before * signature, whitening),
        (after * signature, whitening),
        0.0,
        np.ones(BLOCKS, dtype=bool),
    )
    np.testing.assert_allclose(np.abs(gap.before), 50.0 * left_before, atol=0.05)
    np.testing.assert_allclose(np.abs(gap.after), 50.0 * left_after, atol=0.05)
