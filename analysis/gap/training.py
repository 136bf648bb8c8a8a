"""The learning of a verdict from campaigns whose hidden effects are known: thresholds and weights, cross-validated."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.gap.classifier import MOTION_ERROR_LOG_ODDS, classify, judge, presence_inputs
from dragrig.analysis.gap.diagnosis import Classification
from dragrig.analysis.gap.features import (
    DecisionInputs,
    GapGate,
    PresenceWeights,
    VerdictCalibration,
    hypothesis_features,
    largest_llr,
)
from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import catalogue

CALIBRATION_VERSION = 2
FEATURE_RIDGE = 0.02
"""Prior precision of a feature's weight."""
PRIOR_GATE = GapGate(least_gain=18.0, gain_width=3.0, least_left=0.075, left_width=0.012)
"""Prior of the thresholds: the best variant reaches Δχ²/2 of 8 in noise alone, and rarely more than 15 where the
nominal model is slightly wrong."""
GATE_PRIOR_SD = 0.03
"""Relative prior standard deviation of the thresholds."""
MIN_TRAINING_LLR = 11.0
"""A campaign trains the choice of effects only if a hypothesis reaches this log likelihood ratio."""

POSITIVE_FEATURES = ("plain", "flexible", "further: share", "further: gain", "further: worse")
NEGATIVE_FEATURES = ("behind", "left", "nameless", "further: alike", "third")
"""Prefixes of features with known sign: a better explanation never makes a hypothesis less likely."""


@dataclass(frozen=True, slots=True)
class TrainingCase:
    """Decision inputs of a campaign, with the effects hidden in it."""

    inputs: DecisionInputs
    effects: frozenset[str]
    """Hidden effects of the catalogue."""
    outside: bool = False
    """Whether an effect outside the catalogue was hidden."""
    size: float = 1.0
    """Smallest size of the hidden effects; small ones do not train the gate."""


def fit_weights(cases: Sequence[TrainingCase], tolerance_mN: float, left_out: Collection[str] = ()) -> dict[str, float]:
    """Return the weights that maximise the penalised likelihood of the correct choices, without features left out.

    Raises `ValueError` when no case is informative.
    """
    from scipy.optimize import minimize

    informative = [
        (case, hypothesis_features(case.inputs, tolerance_mN)) for case in cases if _is_informative(case, tolerance_mN)
    ]
    labelled = [(case, hypotheses) for case, hypotheses in informative if hypotheses]
    if not labelled:
        raise ValueError("No campaign among these has a force from which effects can be learnt")
    names = sorted(
        {name for _, hypotheses in labelled for hypothesis in hypotheses for name in hypothesis.features} - {*left_out}
    )
    # Features of each campaign's hypotheses, shape `(H, F)`, and the index of the correct one, H for none.
    choices = []
    for labelled_case, hypotheses in labelled:
        rows = [[hypothesis.features.get(name, 0.0) for name in names] for hypothesis in hypotheses]
        correct = _correct_choice(labelled_case, [hypothesis.effects for hypothesis in hypotheses])
        choices.append((np.array(rows), correct))

    def loss(weights: FloatArray) -> tuple[float, FloatArray]:
        total, slope = 0.5 * FEATURE_RIDGE * float(weights @ weights), FEATURE_RIDGE * weights
        for features, correct in choices:
            utilities = np.append(features @ weights, 0.0)
            shares = np.exp(utilities - utilities.max())
            shares /= shares.sum()
            total -= float(np.log(shares[correct] + 1e-300))
            residuals = shares[:-1].copy()
            if correct < len(residuals):
                residuals[correct] -= 1.0
            slope = slope + features.T @ residuals
        return total, slope

    bounds = [
        (0.0 if name.startswith(POSITIVE_FEATURES) else None, 0.0 if name.startswith(NEGATIVE_FEATURES) else None)
        for name in names
    ]
    best = minimize(loss, np.zeros(len(names)), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 2000})
    return {name: round(float(weight), 4) for name, weight in zip(names, best.x, strict=True)}


def fit_gate(cases: Sequence[TrainingCase], tolerance_mN: float, min_size: float = 0.2) -> GapGate:
    """Return the gate that maximises the penalised likelihood of gap or no gap."""
    from scipy.optimize import minimize
    from scipy.special import expit

    rows = [
        (
            largest_llr(case.inputs, tolerance_mN),
            case.inputs.excess / max(case.inputs.block_count, 1),
            bool(case.effects or case.outside),
        )
        for case in cases
        if not case.inputs.has_position_error
        and _force_effects(case) == case.effects
        and (not case.effects or case.size >= min_size)
    ]
    llr, excess, has_gap = (np.array(column) for column in zip(*rows, strict=True))

    def loss(steps: FloatArray) -> float:
        gate = _gate_at(steps)
        probability = np.maximum(
            expit((llr - gate.least_gain) / gate.gain_width),
            expit((excess - gate.least_left) / gate.left_width),
        )
        limited = np.clip(probability, 1e-3, 1.0 - 1e-3)
        return -float(np.sum(np.log(np.where(has_gap, limited, 1.0 - limited)))) + 0.5 * float(np.sum(steps**2))

    solution = minimize(loss, np.zeros(4), method="Nelder-Mead", options={"maxiter": 2000})
    return _gate_at(np.asarray(solution.x, dtype=np.float64))


def _gate_at(steps: FloatArray) -> GapGate:
    factors = np.exp(GATE_PRIOR_SD * steps).tolist()
    prior: dict[str, float] = PRIOR_GATE.model_dump()
    return GapGate(
        **{name: round(value * factor, 4) for (name, value), factor in zip(prior.items(), factors, strict=True)}
    )


def _force_effects(case: TrainingCase) -> frozenset[str]:
    """Return the hidden effects that the weights concern: not those found in the position or as a line."""
    known = catalogue()
    return frozenset(name for name in case.effects if name not in known or known[name].has_force_signature)


def _is_informative(case: TrainingCase, tolerance_mN: float) -> bool:
    """Whether a campaign has a gap in the force, and some hypothesis explains part of it."""
    force_effects = _force_effects(case)
    llrs = [hypothesis.llr for hypothesis in case.inputs.hypotheses if hypothesis.change_mN >= tolerance_mN]
    return (bool(force_effects) or (case.outside and not case.inputs.has_position_error)) and max(
        llrs, default=0.0
    ) > MIN_TRAINING_LLR


def _correct_choice(case: TrainingCase, hypotheses: Sequence[tuple[str, ...]]) -> int:
    """Return the index of the hypothesis with most of the hidden effects and no others; their number for none."""
    hidden = _force_effects(case)
    if case.outside:
        return len(hypotheses)
    subsets = [number for number, names in enumerate(hypotheses) if set(names) <= hidden]
    return max(subsets, key=lambda number: len(hypotheses[number]), default=len(hypotheses))


PRESENCE_PRIOR = PresenceWeights(constant=0.0, classifier=1.0, competition=0.0)
"""Without campaigns to learn from, the classifier decides."""
PRESENCE_PRECISION = 0.1
"""Prior precision of each weight of presence."""
INNER_FOLDS = 5
"""What weighs the classifier must see it judge campaigns that it did not learn from."""


def fit_presence(cases: Sequence[TrainingCase], on_force: Sequence[Classification]) -> PresenceWeights:
    """Return the weights of classifier and competition by logistic regression over all effects on the force.

    Parameters
    ----------
    cases
        Campaigns whose hidden effects are known.
    on_force
        The result on the force of each by a classifier that did not learn from it.
    """
    from scipy.optimize import minimize

    rows, shifts, present = [], [], []
    for case, classification in zip(cases, on_force, strict=True):
        for name, value in case.inputs.competition.items():
            if name in catalogue():
                rows.append(presence_inputs(name, classification, value))
                shifts.append(-MOTION_ERROR_LOG_ODDS if case.inputs.moves_astray else 0.0)
                present.append(name in case.effects)
    columns, sides = np.array(rows).reshape(-1, 3), np.where(present, 1.0, -1.0)
    prior = np.array(list(PRESENCE_PRIOR.model_dump().values()))

    def loss(weights: FloatArray) -> float:
        signed = (columns @ weights + np.array(shifts)) * sides
        return float(np.logaddexp(0.0, -signed).sum() + 0.5 * PRESENCE_PRECISION * np.sum((weights - prior) ** 2))

    constant, classifier, competition = np.round(minimize(loss, prior, method="BFGS").x, 4).tolist()
    return PresenceWeights(constant=constant, classifier=classifier, competition=competition)


def calibrate(
    cases: Sequence[TrainingCase],
    tolerance_mN: float,
    seeds: Sequence[int] = (),
    command: str = "",
    left_out: Collection[str] = (),
) -> VerdictCalibration:
    """Return the weights that campaigns teach: first the classifier, then its weight beside the competition of causes.

    Parameters
    ----------
    cases
        Campaigns whose hidden effects are known.
    tolerance_mN
        Smallest rms change of the force that matters.
    seeds, command
        Origin of the campaigns.
    left_out
        Features that nothing is to be learnt of.

    Raises
    ------
    ValueError
        When no case is informative.
    """

    def without_presence(taught_by: Sequence[TrainingCase]) -> VerdictCalibration:
        return VerdictCalibration(
            version=CALIBRATION_VERSION,
            command=command,
            seeds=tuple(seeds),
            cases=len(taught_by),
            gate=fit_gate(taught_by, tolerance_mN),
            weights=fit_weights(taught_by, tolerance_mN, left_out),
            presence=PRESENCE_PRIOR,
        )

    learnt = without_presence(cases)
    presence = PRESENCE_PRIOR
    if len(cases) >= INNER_FOLDS and any(case.inputs.competition for case in cases):
        on_force = [
            classify(case.inputs, tolerance_mN, weights)
            for case, weights in _in_turn(cases, INNER_FOLDS, without_presence)
        ]
        presence = fit_presence(cases, on_force)
    return learnt.model_copy(update={"presence": presence})


def _in_turn(
    cases: Sequence[TrainingCase], folds: int, teach: Callable[[Sequence[TrainingCase]], VerdictCalibration]
) -> Iterator[tuple[TrainingCase, VerdictCalibration]]:
    """Yield every case with the weights that the cases of other folds teach."""
    taught = [teach([case for index, case in enumerate(cases) if index % folds != fold]) for fold in range(folds)]
    for index, case in enumerate(cases):
        yield case, taught[index % folds]


CROSS_VALIDATION_FOLDS = 10


def cross_validate(
    cases: Sequence[TrainingCase], tolerance_mN: float, folds: int = CROSS_VALIDATION_FOLDS
) -> tuple[Classification, ...]:
    """Judge each campaign by the weights that the other folds teach.

    Parameters
    ----------
    cases
        Campaigns whose hidden effects are known.
    tolerance_mN
        Smallest rms change of the force that matters.
    folds
        Number of folds; with 10, campaigns 1, 11, … are one fold.

    Raises
    ------
    ValueError
        When there are fewer campaigns than folds, fewer than two folds, or no informative campaign in the others.
    """
    if not 2 <= folds <= len(cases):
        raise ValueError(f"{len(cases)} campaigns cannot be divided into {folds} folds")
    in_turn = _in_turn(cases, folds, lambda others: calibrate(others, tolerance_mN))
    return tuple(judge(case.inputs, tolerance_mN, taught).verdict for case, taught in in_turn)
