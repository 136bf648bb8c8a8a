"""The verdict: hypotheses weighed by their features, and the training of weights and thresholds.

Which explanation of the force is right, and whether any is, is decided by weights learnt on simulated campaigns with
hidden effects (`calibration.json`, evaluated on other seeds); the probabilities are calibrated on these.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp

import numpy as np

from dragrig.analysis.gap.diagnosis import Verdict
from dragrig.analysis.gap.features import (
    EFFECT_FEATURE,
    EQUAL_SHARE,
    Calibration,
    DecisionInputs,
    GapGate,
    HypothesisFeatures,
    hypothesis_features,
    largest_llr,
    shipped_calibration,
)
from dragrig.analysis.gap.spectral_lines import hum_effect
from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import catalogue, confusable_effects

NO_GAP, UNKNOWN = "no_gap", "unknown"

MIN_MAINS_LLR, MIN_OTHER_LINE_LLR = 14.0, 60.0
MAINS_LLR_WIDTH, OTHER_LINE_LLR_WIDTH = 1.5, 8.0
MIN_POSITION_SHARE, POSITION_SHARE_WIDTH = 0.7, 0.04
"""Held-out share of the position error that an effect explains: midpoint and width of the logistic."""
POSITION_RIVAL_SLOPE = 400.0
"""Weight of a rival: exp(-slope · difference of the held-out shares)."""
MIN_POSTERIOR_BESIDE_POSITION, MIN_LLR_BESIDE_POSITION = 0.6, 60.0
"""Where the stage has position errors, motion errors mimic small force effects: posterior > 0.6 and Δχ²/2 > 60 are
required for an effect on the force."""
MIN_LEFT_OVER_EXCESS, MAX_EXPLAINED_SHARE = 0.15, 0.9
"""A residual remains beside named effects with a smaller explained share, above this excess chi-square per block."""
PARSIMONY_RATIO = 1.2
"""A subset of the most likely hypothesis is preferred unless the latter is more likely by this factor."""
CONFUSABLE_RATIO = 0.1
"""Hypotheses with at least this fraction of the highest probability count as confusable with it."""
MIN_PROBABILITY, MAX_PROBABILITY = 0.003, 0.985
"""Limits of all probabilities: simulated campaigns cannot confirm more extreme ones."""


@dataclass(frozen=True, slots=True)
class Classification:
    """A verdict with the probabilities of all relevant hypotheses, and what is confusable with it."""

    verdict: Verdict
    effects: tuple[str, ...]
    probabilities: Mapping[str, float]
    confusable_with: tuple[str, ...]
    residual_unknown: bool

    def marginal(self, effect: str) -> float:
        """Return the probability of all hypotheses with an effect."""
        return marginal_probability(effect, self.probabilities)


def marginal_probability(effect: str, probabilities: Mapping[str, float]) -> float:
    """Return the probability of all hypotheses, several effects joined with `+`, that contain an effect."""
    return sum(value for names, value in probabilities.items() if effect in names.split("+"))


def classify(inputs: DecisionInputs, tolerance_mN: float, calibration: Calibration | None = None) -> Classification:
    """Return the verdict on a campaign; `calibration` defaults to the shipped one."""
    weights = calibration or shipped_calibration()
    force = _force_posterior(inputs, tolerance_mN, weights)
    classification = (
        _classify_with_position(inputs, force)
        if inputs.position or inputs.has_position_error
        else _classify_with_lines(inputs, force)
    )
    aliases = {name for effect in classification.effects for name in confusable_effects(effect)}
    excluded = [effect for effect in inputs.excluded if effect in aliases]
    return replace(classification, confusable_with=(*classification.confusable_with, *excluded))


@dataclass(frozen=True, slots=True)
class _ForcePosterior:
    """Probabilities of the hypotheses on the force; the remainder to 1 is `no_gap`."""

    unknown: float
    probabilities: Mapping[tuple[str, ...], float]
    left_over: frozenset[tuple[str, ...]]

    @property
    def effects(self) -> tuple[str, ...]:
        """Effects of all hypotheses, those of the most likely first."""
        ordered = sorted(self.probabilities, key=lambda names: -self.probabilities[names])
        return tuple(dict.fromkeys(name for names in ordered for name in names))

    def marginal(self, name: str) -> float:
        """Return the probability that an effect is present."""
        return sum(value for names, value in self.probabilities.items() if name in names)

    @property
    def total(self) -> float:
        """Probability of all named hypotheses together."""
        return sum(self.probabilities.values())


def _force_posterior(inputs: DecisionInputs, tolerance_mN: float, weights: Calibration) -> _ForcePosterior:
    hypotheses = hypothesis_features(inputs, tolerance_mN)
    gate = weights.gate
    excess_per_block = inputs.excess / max(inputs.block_count, 1)
    llr = largest_llr(inputs, tolerance_mN)
    gap_by_excess = _logistic((excess_per_block - gate.least_left) / gate.left_width)
    gap = max(_logistic((llr - gate.least_gain) / gate.gain_width), gap_by_excess)
    if not hypotheses:
        # All explanations of the gap are too small to matter, and so is the gap.
        negligible = max((hypothesis.share for hypothesis in hypothesis_features(inputs, 0.0)), default=0.0)
        gap *= 1.0 - negligible
    gap = min(max(gap, MIN_PROBABILITY), 1.0 - MIN_PROBABILITY)
    shares = _softmax([weights.utility(hypothesis.features) for hypothesis in hypotheses])
    lookalikes = {summary.effects: summary.lookalikes for summary in inputs.hypotheses}
    posteriors = _among_lookalikes(hypotheses, shares, [lookalikes[hypothesis.effects] for hypothesis in hypotheses])
    probabilities = {
        hypothesis.effects: gap * posterior for hypothesis, posterior in zip(hypotheses, posteriors, strict=True)
    }
    return _ForcePosterior(
        gap - sum(probabilities.values()), probabilities, frozenset(_leaving_residual(inputs, hypotheses))
    )


def _among_lookalikes(
    hypotheses: Sequence[HypothesisFeatures], shares: Sequence[float], lookalikes: Sequence[int]
) -> list[float]:
    """Return probabilities of the hypotheses, each no likelier than the other causes that look like it.

    What it loses goes to hypotheses without lookalikes that explain as much, and to `unknown`, as these are likely.

    Parameters
    ----------
    shares
        Probabilities of the hypotheses, and last of `unknown`.
    lookalikes
        Number of other causes that look like each hypothesis.
    """
    result = [share / (1 + number) for share, number in zip(shares[:-1], lookalikes, strict=True)]
    for hypothesis, share, number in zip(hypotheses, shares[:-1], lookalikes, strict=True):
        rivals = [
            index
            for index, rival in enumerate(hypotheses)
            if not lookalikes[index] and rival.share > hypothesis.share - EQUAL_SHARE
        ]
        total = sum(shares[index] for index in rivals) + shares[-1]
        for index in rivals if number else ():
            result[index] += (share - share / (1 + number)) * shares[index] / total
    return result


def _leaving_residual(inputs: DecisionInputs, features: Sequence[HypothesisFeatures]) -> list[tuple[str, ...]]:
    """Return the hypotheses that leave an excess which no other hypothesis explains."""
    excess_per_block = {
        hypothesis.effects: (hypothesis.chi2_with_form_error - inputs.block_count) / max(inputs.block_count, 1)
        for hypothesis in inputs.hypotheses
    }
    return [
        candidate.effects
        for candidate in features
        if excess_per_block[candidate.effects] > MIN_LEFT_OVER_EXCESS and candidate.share < MAX_EXPLAINED_SHARE
    ]


def _softmax(utilities: Sequence[float]) -> list[float]:
    """Return probabilities of the hypotheses, and last of `unknown`, whose utility is 0."""
    highest = max((*utilities, 0.0))
    weights = [exp(value - highest) for value in (*utilities, 0.0)]
    limited = [min(max(value / sum(weights), MIN_PROBABILITY / len(weights)), MAX_PROBABILITY) for value in weights]
    return [value / sum(limited) for value in limited]


def mains_hum_present(mains_llr: float, line_llr: float) -> bool:
    """Whether there is mains hum, given the strongest lines at the mains frequency and elsewhere."""
    return mains_llr > MIN_MAINS_LLR and _mains_dominates(mains_llr, line_llr)


def _mains_dominates(mains_llr: float, line_llr: float) -> bool:
    """Whether the mains line exceeds all others clearly: if all frequencies are loud, it is no finding."""
    return line_llr <= 0.5 * mains_llr


def _classify_with_lines(inputs: DecisionInputs, force: _ForcePosterior) -> Classification:
    line_probability = _logistic((inputs.mains_llr - MIN_MAINS_LLR) / MAINS_LLR_WIDTH)
    hum_id = hum_effect().id
    hum_probability = 0.0 if hum_id in inputs.excluded else line_probability
    if not _mains_dominates(inputs.mains_llr, inputs.line_llr):
        hum_probability = min(hum_probability, 0.2)
    other_line = _other_line_probability(inputs)
    if hum_id in inputs.excluded:
        other_line = max(other_line, line_probability)
    if hum_probability > 0.5:
        with_force = force.total > 0.5
        combinations = {(*names, hum_id): value for names, value in force.probabilities.items()} if with_force else {}
        hum_alone = min(hum_probability, MAX_PROBABILITY) * (1.0 - force.total if with_force else 1.0)
        return _classification(
            {**combinations, (hum_id,): hum_alone}, 1.0 - min(hum_probability, MAX_PROBABILITY), 0.0, force
        )
    if other_line > 0.5 and other_line > force.total:
        return _classification({}, other_line, 1.0 - other_line, force)
    return _classification(force.probabilities, force.unknown, 1.0 - force.unknown - force.total, force)


def _has_clear_llr(name: str, inputs: DecisionInputs) -> bool:
    """Whether an effect has a clear log likelihood ratio, alone or beside effects selected before it."""
    return (
        max((hypothesis.llr for hypothesis in inputs.hypotheses if hypothesis.effects[-1] == name), default=0.0)
        > MIN_LLR_BESIDE_POSITION
    )


def _other_line_probability(inputs: DecisionInputs) -> float:
    """Return the probability of a spectral line that is not the mains'."""
    return _logistic((inputs.line_llr - 0.02 * inputs.mains_llr - MIN_OTHER_LINE_LLR) / OTHER_LINE_LLR_WIDTH)


def unknown_because_of_line(inputs: DecisionInputs, classification: Classification) -> bool:
    """Whether the verdict is `unknown` because of a spectral line that no effect explains."""
    return (
        classification.verdict is Verdict.UNKNOWN
        and not inputs.has_position_error
        and _other_line_probability(inputs) > 0.5
    )


def unknown_by_excess_alone(
    inputs: DecisionInputs, classification: Classification, tolerance_mN: float, calibration: Calibration | None = None
) -> bool:
    """Whether the verdict is `unknown` because blocks differ by more than noise, and nothing predicts by how much."""
    gate = (calibration or shipped_calibration()).gate
    return (
        classification.verdict is Verdict.UNKNOWN
        and not inputs.has_position_error
        and not unknown_because_of_line(inputs, classification)
        and largest_llr(inputs, tolerance_mN) < gate.least_gain
    )


def as_misjudged_noise(classification: Classification) -> Classification:
    """Return the verdict `no_gap` in place of `unknown`, with its probability."""
    probabilities = dict(classification.probabilities)
    probabilities[NO_GAP], probabilities[UNKNOWN] = probabilities[UNKNOWN], probabilities[NO_GAP]
    return replace(classification, verdict=Verdict.NO_GAP, probabilities=probabilities)


def _classify_with_position(inputs: DecisionInputs, force: _ForcePosterior) -> Classification:
    force_effects = tuple(
        name
        for name in force.effects
        if _has_clear_llr(name, inputs) and force.marginal(name) > MIN_POSTERIOR_BESIDE_POSITION
    )
    force_probability = min((force.marginal(name) for name in force_effects), default=1.0)
    alternatives = {force_effects: force_probability} if force_effects else _confusable_group(inputs, force)
    position_alone = 1.0 - sum(alternatives.values()) if alternatives else 1.0
    hum_id = hum_effect().id
    hum = (hum_id,) if inputs.mains_llr > MIN_MAINS_LLR and hum_id not in inputs.excluded else ()
    share = inputs.position[0][1] if inputs.position else 0.0
    known_probability = min(
        max(_logistic((share - MIN_POSITION_SHARE) / POSITION_SHARE_WIDTH), MIN_PROBABILITY), MAX_PROBABILITY
    )
    weights = {name: exp(-POSITION_RIVAL_SLOPE * max(share - value, 0.0)) for name, value in inputs.position}
    total = sum(weights.values())
    combinations = {
        (*name.split("+"), *hum): position_alone * known_probability * weight / total
        for name, weight in weights.items()
        if position_alone > 0.0
    }
    for effects, value in alternatives.items():
        combinations |= {
            (*name.split("+"), *effects, *hum): value * known_probability * weight / total
            for name, weight in weights.items()
        }
    return _classification(combinations, 1.0 - known_probability if combinations else 1.0, 0.0, force)


def _confusable_group(inputs: DecisionInputs, force: _ForcePosterior) -> dict[tuple[str, ...], float]:
    """Return confusable effects, one of which acts, with their probabilities; empty for none."""
    for name in force.effects:
        group = [name, *sorted(confusable_effects(name) & set(force.effects))]
        shares: dict[tuple[str, ...], float] = {
            (member,): force.marginal(member) for member in group if _has_clear_llr(member, inputs)
        }
        if len(shares) > 1 and MIN_POSTERIOR_BESIDE_POSITION < sum(shares.values()) <= 1.0:
            return shares
    return {}


def _classification(
    named: Mapping[tuple[str, ...], float], unknown: float, no_gap: float, force: _ForcePosterior
) -> Classification:
    """Return the most likely hypothesis as verdict if it is more likely than `unknown` and `no_gap`."""
    named = _prefer_subset(named)
    total = sum(named.values()) + unknown + no_gap
    probabilities = {NO_GAP: no_gap / total, UNKNOWN: unknown / total}
    probabilities |= {"+".join(names): value / total for names, value in named.items()}
    effects = max(named, key=lambda names: named[names], default=())
    if not effects or named[effects] < max(unknown, no_gap):
        verdict = Verdict.NO_GAP if no_gap >= unknown else Verdict.UNKNOWN
        return Classification(verdict, (), probabilities, (), residual_unknown=False)
    threshold = CONFUSABLE_RATIO * named[effects]
    rivals = [names for names, value in named.items() if value > threshold and not set(effects) <= set(names)]
    confusable = tuple(dict.fromkeys(name for names in rivals for name in names if name not in effects))
    verdict = Verdict.SEVERAL if len(effects) > 1 else Verdict.EFFECT
    return Classification(verdict, effects, probabilities, confusable, effects in force.left_over)


def _prefer_subset(named: Mapping[tuple[str, ...], float]) -> Mapping[tuple[str, ...], float]:
    """Prefer a subset of the most likely hypothesis that is nearly as likely alone."""
    best = max(named, key=lambda names: named[names], default=())
    subsets = [names for names in named if set(names) < set(best) and named[names] * PARSIMONY_RATIO > named[best]]
    if not subsets:
        return named
    subset, transferred = max(subsets, key=lambda names: named[names]), named[best] * (1.0 - 1.0 / PARSIMONY_RATIO)
    return {**named, best: named[best] - transferred, subset: named[subset] + transferred}


def _logistic(value: float) -> float:
    return 1.0 / (1.0 + exp(-min(max(value, -40.0), 40.0)))


FEATURE_RIDGE, EFFECT_RIDGE = 0.02, 0.5
"""Prior precisions of a feature's weight, and of a single effect's, for which there are few campaigns."""
PRIOR_GATE = GapGate(least_gain=18.0, gain_width=3.0, least_left=0.075, left_width=0.012)
"""Prior of the thresholds: the best variant reaches Δχ²/2 of 8 in noise alone, and rarely more than 15 where the
nominal model is slightly wrong."""
GATE_PRIOR_SD = 0.03
"""Relative prior standard deviation of the thresholds."""
MIN_TRAINING_LLR = 11.0
"""A campaign trains the choice of effects only if a hypothesis reaches this log likelihood ratio."""

POSITIVE_FEATURES = ("plain", "flexible", "further: share", "further: over", "further: gain", "further: worse")
NEGATIVE_FEATURES = ("known, in", "behind", "left", "nameless", "further: alike", "third")
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


@dataclass(frozen=True, slots=True, eq=False)
class _LabelledChoice:
    """Features of one campaign's hypotheses, shape `(H, F)`, and the index of the correct one (H for none)."""

    features: FloatArray
    correct: int


def fit_weights(cases: Sequence[TrainingCase], tolerance_mN: float) -> dict[str, float]:
    """Return the weights that maximise the penalised likelihood of the correct choices.

    Raises `ValueError` when no case is informative.
    """
    from scipy.optimize import minimize

    informative = [
        (case, hypothesis_features(case.inputs, tolerance_mN)) for case in cases if _is_informative(case, tolerance_mN)
    ]
    labelled = [(case, hypotheses) for case, hypotheses in informative if hypotheses]
    if not labelled:
        raise ValueError("No campaign among these has a force from which effects can be learnt")
    names = sorted({name for _, hypotheses in labelled for hypothesis in hypotheses for name in hypothesis.features})
    choices = []
    for labelled_case, hypotheses in labelled:
        rows = [[hypothesis.features.get(name, 0.0) for name in names] for hypothesis in hypotheses]
        choices.append(
            _LabelledChoice(
                np.array(rows), _correct_choice(labelled_case, [hypothesis.effects for hypothesis in hypotheses])
            )
        )
    ridge = np.array([EFFECT_RIDGE if name.startswith(EFFECT_FEATURE) else FEATURE_RIDGE for name in names])

    def loss(weights: FloatArray) -> tuple[float, FloatArray]:
        total, slope = 0.5 * float(np.sum(ridge * weights**2)), ridge * weights
        for choice in choices:
            utilities = np.append(choice.features @ weights, 0.0)
            shares = np.exp(utilities - utilities.max())
            shares /= shares.sum()
            total -= float(np.log(shares[choice.correct] + 1e-300))
            residuals = shares[:-1].copy()
            if choice.correct < len(residuals):
                residuals[choice.correct] -= 1.0
            slope = slope + choice.features.T @ residuals
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
            _logistic_array((llr - gate.least_gain) / gate.gain_width),
            _logistic_array((excess - gate.least_left) / gate.left_width),
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


def _logistic_array(values: FloatArray) -> FloatArray:
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(values, -40.0, 40.0))))


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


CROSS_VALIDATION_FOLDS = 10


def cross_validate(
    cases: Sequence[TrainingCase], tolerance_mN: float, folds: int = CROSS_VALIDATION_FOLDS
) -> tuple[Classification, ...]:
    """Classify each campaign with gate and weights fitted to the other folds.

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
    calibrations = [
        _trained([case for index, case in enumerate(cases) if index % folds != fold], tolerance_mN)
        for fold in range(folds)
    ]
    return tuple(classify(case.inputs, tolerance_mN, calibrations[index % folds]) for index, case in enumerate(cases))


def _trained(cases: Sequence[TrainingCase], tolerance_mN: float) -> Calibration:
    gate, weights = fit_gate(cases, tolerance_mN), fit_weights(cases, tolerance_mN)
    return Calibration(version=0, command="", seeds=(), cases=len(cases), gate=gate, weights=weights)
