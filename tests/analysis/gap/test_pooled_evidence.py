"""What a campaign says of shared causes is what dense Gaussian algebra on its blocks says."""

from collections.abc import Mapping

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from dragrig.analysis.gap.pooled_evidence import (
    FORM_COLUMNS,
    POOLED_MODEL_SCALES,
    POOLED_SCALES_MN,
    ForceEvidence,
    force_evidence,
    normalised,
)
from dragrig.analysis.gap.presence import (
    Cause,
    CauseKind,
    CauseSet,
    Competition,
    PeriodicColumns,
    Presence,
    VariantSpan,
    log_evidence,
)
from dragrig.rig import FloatArray

BLOCKS = 60
RANDOM = np.random.default_rng(3)
TABLE = RANDOM.normal(size=(BLOCKS, 23))
"""Residual and columns, whitened."""
RESIDUAL = TABLE[:, 0] + TABLE[:, 1]
TABLE[:, 0] = RESIDUAL
COLUMNS = TABLE[:, 1:]
MIXING = np.array([[1.0, 0.0], [0.5, 2.0], [0.0, 1.5]])
SIZES = np.array([2.0, 0.5, 4.0])


def span(variants: list[int], mixing: FloatArray, sizes: FloatArray) -> VariantSpan:
    return VariantSpan(np.array(variants), mixing, sizes)


def own(*columns: int) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    return np.array(columns, dtype=np.intp)


CAUSES = (
    Cause("adhesion", CauseKind.EFFECT, own(0, 1, 2, 3, 4, 5, 6, 7), np.linspace(0.3, 1.0, 8), (1.0, 3.0),
          span=span([0, 2, 5], MIXING, SIZES)),
    Cause("stribeck", CauseKind.EFFECT, own(8, 9), np.array([0.6, 0.4]), (1.0, 3.0), np.array([1.0, 0.0]),
          span=span([1], np.ones((1, 1)), np.array([3.0]))),
    Cause("stribeck", CauseKind.EFFECT, own(10), np.array([0.5]), (1.0,), np.array([1.0])),
    Cause("speed", CauseKind.LAW, own(11, 12), np.ones(2), (1.0, 10.0), span=span([0, 3], np.eye(2), np.ones(2))),
    Cause("laws of the model", CauseKind.MODEL, own(13), np.ones(1), (3.0,), span=span([0], np.eye(1), np.ones(1))),
    Cause("gain of a run", CauseKind.RUN, own(14, 15), np.ones(2), (0.1,), span=span([0, 1], np.eye(2), np.ones(2))),
    Cause("velocity_ripple", CauseKind.EFFECT, own(16), np.ones(1), (1.0,),
          span=span([0], np.eye(1), np.ones(1))),
)  # fmt: skip
PERIODIC = {
    "velocity_ripple": PeriodicColumns(own(17, 18, 19, 20), np.array([2.0, 0.0, 1.0, 0.5])),
    "cogging": PeriodicColumns(own(21), np.array([0.0])),
}
COMPETITION = Competition(CAUSES, TABLE.T @ TABLE)
LOG_ODDS: Mapping[CauseSet, float] = {
    (): 0.0,
    ((1, 1),): 9.0,
    ((1, 1), (5, 0)): 12.0,
    ((0, 0), (1, 1), (5, 0)): 11.0,
    ((0, 1), (1, 1)): 10.5,
    ((0, 1), (1, 1), (3, 1)): 10.0,
    ((0, 0), (1, 1), (6, 0)): 30.0 - 21.5,
    ((1, 1), (4, 0)): 7.0,
    ((1, 1), (3, 0)): 6.5,
}
PROBABILITIES = {
    "adhesion": 0.3, "stribeck": 0.99, "speed": 0.1, "laws of the model": 0.95, "gain of a run": 0.8,
    "velocity_ripple": 0.02,
}  # fmt: skip
PRESENCE = Presence(PROBABILITIES, {cause.name: cause.kind for cause in CAUSES}, LOG_ODDS)


@pytest.fixture
def evidence() -> ForceEvidence:
    return force_evidence(COMPETITION, PRESENCE, PERIODIC)


def covariance_of(causes: CauseSet) -> FloatArray:
    """Return the covariance of the blocks: noise, and a set of causes."""
    total = np.eye(BLOCKS)
    for index, scale in causes:
        cause = CAUSES[index]
        scaled = COLUMNS[:, cause.columns] * cause.sds * cause.scales[scale]
        total += scaled @ scaled.T
    return total


CONTEXTS: Mapping[str, CauseSet] = {
    "adhesion": ((1, 1), (5, 0)),
    "stribeck": ((5, 0),),
    "speed": ((1, 1),),
    "laws of the model": ((1, 1),),
    "velocity_ripple": ((1, 1), (5, 0)),
}
"""All else of the best set with a cause that has no weak effect besides; of one in no such set, what is best."""


def test_a_cause_is_looked_at_beside_what_is_likely_with_it(evidence: ForceEvidence) -> None:
    assert set(evidence.columns) == set(CONTEXTS) == set(evidence.context_of)
    assert evidence.context_of["speed"] == evidence.context_of["laws of the model"]
    assert len(evidence.contexts) == 3
    shared = np.column_stack((
        COLUMNS[:, :2] @ MIXING.T, COLUMNS[:, 8:9], COLUMNS[:, 11:13], COLUMNS[:, 13:14], COLUMNS[:, [17, 19, 20]],
    ))  # fmt: skip
    rows = np.concatenate([evidence.columns[name].rows for name in evidence.columns])
    assert list(evidence.columns) == list(CONTEXTS)
    for name, context in CONTEXTS.items():
        values = np.column_stack((RESIDUAL, shared))
        expected = values.T @ np.linalg.solve(covariance_of(context), values)
        found = evidence.information_for(name)[np.ix_(np.append(0, rows), np.append(0, rows))]
        np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-3)
        assert evidence.columns[name].chi2 == pytest.approx(expected[0, 0], rel=1e-5)


def test_shared_columns_say_what_they_are(evidence: ForceEvidence) -> None:
    told = {
        name: (shared.kind, shared.numbers.tolist(), shared.sizes_mN.tolist(), shared.one_signed, shared.scales)
        for name, shared in evidence.columns.items()
    }
    assert told == {
        "adhesion": (CauseKind.EFFECT, [0, 2, 5], [2.0, 0.5, 4.0], False, POOLED_SCALES_MN),
        "stribeck": (CauseKind.EFFECT, [1], [3.0], True, POOLED_SCALES_MN),
        "speed": (CauseKind.LAW, [0, 3], [1.0, 1.0], False, POOLED_SCALES_MN),
        "laws of the model": (CauseKind.MODEL, [0], [1.0], False, POOLED_MODEL_SCALES),
        "velocity_ripple": (CauseKind.EFFECT, [0, 2, 3], [2.0, 1.0, 0.5], False, POOLED_SCALES_MN),
    }
    assert {name: (shared.name, shared.form_rows.size) for name, shared in evidence.columns.items()} == {
        "adhesion": ("adhesion", FORM_COLUMNS), "stribeck": ("stribeck", 1), "speed": ("speed", 0),
        "laws of the model": ("laws of the model", 0), "velocity_ripple": ("velocity_ripple", 0),
    }  # fmt: skip
    every = np.concatenate([np.append(shared.rows, shared.form_rows) for shared in evidence.columns.values()])
    assert sorted(every.tolist()) == list(range(1, len(evidence.contexts[0])))


def test_form_directions_are_those_that_differ_most_beside_the_core(evidence: ForceEvidence) -> None:
    """Beside the core the remaining columns, with their priors, differ by a Gram matrix of which the best are kept."""
    core, others = COLUMNS[:, :2], COLUMNS[:, 2:8] * CAUSES[0].sds[2:]
    ridge = 1e-6 * np.trace(core.T @ core) / 2 * np.eye(2)
    beside = others.T @ others - others.T @ core @ np.linalg.solve(core.T @ core + ridge, core.T @ others)
    vectors = np.linalg.eigh(beside)[1][:, ::-1][:, :FORM_COLUMNS]
    rows = evidence.columns["adhesion"].form_rows
    found = evidence.information_for("adhesion")[np.ix_(rows, rows)]
    kept = others @ vectors
    expected = kept.T @ np.linalg.solve(covariance_of(CONTEXTS["adhesion"]), kept)
    np.testing.assert_allclose(np.abs(found), np.abs(expected), rtol=2e-4, atol=2e-3)


def dense_log_evidence(columns: FloatArray, covariance: FloatArray, direction: FloatArray | None = None) -> float:
    """Return the log Bayes factor of columns with coefficients of unit prior, by densities of the blocks."""
    with_columns = covariance + columns @ columns.T
    value = float(
        multivariate_normal(np.zeros(BLOCKS), with_columns).logpdf(RESIDUAL)
        - multivariate_normal(np.zeros(BLOCKS), covariance).logpdf(RESIDUAL)
    )
    if direction is None:
        return value
    posterior = np.linalg.inv(np.eye(columns.shape[1]) + columns.T @ np.linalg.solve(covariance, columns))
    mean = posterior @ columns.T @ np.linalg.solve(covariance, RESIDUAL)
    return value + float(norm.logcdf(direction @ mean / np.sqrt(direction @ posterior @ direction))) + np.log(2.0)


@pytest.mark.parametrize("scale", [0.1, 1.0, 30.0])
@pytest.mark.parametrize("direction", [None, np.array([1.0, -0.5])], ids=["either sign", "one sign"])
def test_evidence_is_that_of_the_blocks_densities(scale: float, direction: FloatArray | None) -> None:
    columns = COLUMNS[:, :2]
    sign = 0.0 if direction is None else direction
    found = log_evidence(columns.T @ columns, columns.T @ RESIDUAL, np.array([scale]), sign)[0]
    assert found == pytest.approx(dense_log_evidence(scale * columns, np.eye(BLOCKS), direction))


@pytest.mark.parametrize("name", ["adhesion", "stribeck", "velocity_ripple"])
def test_other_forms_of_an_effect_are_integrated_out_within_the_scale(evidence: ForceEvidence, name: str) -> None:
    shared = evidence.columns[name]
    information = evidence.information_for(name).astype(float)
    scale = 3.0
    gram, moment = normalised(information, shared, shared.sizes_mN, scale)
    unit = 1.0 / (shared.sizes_mN * np.sqrt(len(shared.rows)))
    rows, forms = shared.rows, shared.form_rows
    inside = np.linalg.inv(np.eye(forms.size) / scale**2 + information[np.ix_(forms, forms)])
    taken = information[np.ix_(rows, forms)] @ inside
    np.testing.assert_allclose(
        gram,
        (information[np.ix_(rows, rows)] - taken @ information[np.ix_(forms, rows)]) * np.outer(unit, unit),
        rtol=1e-6,
    )
    np.testing.assert_allclose(moment, (information[rows, 0] - taken @ information[forms, 0]) * unit, rtol=1e-6)


def test_what_all_forms_add_to_the_shared_ones_is_kept_by_scale(evidence: ForceEvidence) -> None:
    for name, number, direction in (("adhesion", 0, 0.0), ("stribeck", 1, 1.0)):
        shared, cause = evidence.columns[name], CAUSES[number]
        covariance, information = covariance_of(CONTEXTS[name]), evidence.information_for(name)
        for scale, found in zip(shared.scales, shared.forms, strict=True):
            everything = dense_log_evidence(scale * COLUMNS[:, cause.columns] * cause.sds, covariance, cause.direction)
            own = normalised(information, shared, shared.sizes_mN, scale)
            these = log_evidence(*own, np.array([scale]), direction)[0]
            assert found == pytest.approx(everything - these, abs=2e-3)
    for name in ("speed", "laws of the model", "velocity_ripple"):
        shared = evidence.columns[name]
        assert shared.forms == (0.0,) * len(shared.scales)


def test_an_effect_may_be_likelier_by_other_sets_than_beside_what_it_is_looked_at(evidence: ForceEvidence) -> None:
    """With adhesion there are three sets beside strong effects; without it four, of which its own is the best."""
    with_it, here, without = [11.0, 10.5, 10.0], 11.0, [0.0, 9.0, 12.0, 7.0, 6.5]
    expected = np.logaddexp.reduce(with_it) - here - (np.logaddexp.reduce(without) - 12.0)
    assert evidence.columns["adhesion"].elsewhere == pytest.approx(expected)
    of_strong = [9.0, 12.0, 7.0, 6.5]
    assert evidence.columns["stribeck"].elsewhere == pytest.approx(np.logaddexp.reduce(of_strong) - 12.0)
    assert evidence.columns["velocity_ripple"].elsewhere == pytest.approx(-(np.logaddexp.reduce(without) - 12.0))
    assert {evidence.columns[name].elsewhere for name in ("speed", "laws of the model")} == {0.0}
