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
    Calibration,
    DecisionInputs,
    GapGate,
    HypothesisFeatures,
    hypothesis_features,
    largest_llr,
    shipped_calibration,
)
from dragrig.analysis.gap.spectral_lines import hum_effect
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import catalogue, confusable_effects

NO_GAP, UNKNOWN = "no_gap", "unknown"

MIN_MAINS_LLR, MIN_OTHER_LINE_LLR = 14.0, 60.0
MAINS_LLR_WIDTH, OTHER_LINE_LLR_WIDTH = 1.5, 8.0
MIN_POSITION_SHARE, POSITION_SHARE_WIDTH = 0.7, 0.04
"""Share of the position's errors that an effect explains on runs that took no part."""
POSITION_RIVAL_SLOPE = 400.0
"""Weight of a rival: e to the minus this times by how much less of the errors it explains."""
MIN_POSTERIOR_BESIDE_POSITION, MIN_LLR_BESIDE_POSITION = 0.6, 60.0
"""Beside an effect on the position, one on the force is named from this probability and this gain on, whatever other
effects of the force may be there too: where a stage strays, what is uncertain of its motion passes for small effects.
"""
MIN_LEFT_OVER_EXCESS, MAX_EXPLAINED_SHARE = 0.15, 0.9
"""Something is left beside named effects that have less than this share, from so many squares over blocks on."""
PARSIMONY_RATIO = 1.2
"""An explanation that is a part of another is named unless the other is so much likelier."""
CONFUSABLE_RATIO = 0.1
"""A rival with this share of the probability cannot be told apart."""
MIN_PROBABILITY, MAX_PROBABILITY = 0.003, 0.985
"""No probability is closer to 0 or 1 than simulated campaigns can show."""


@dataclass(frozen=True, slots=True)
class Classification:
    """A verdict, the probabilities of all hypotheses that matter, and what cannot be told apart."""

    verdict: Verdict
    effects: tuple[str, ...]
    probabilities: Mapping[str, float]
    confusable_with: tuple[str, ...]
    residual_unknown: bool


def classify(inputs: DecisionInputs, tolerance_mN: float, calibration: Calibration | None = None) -> Classification:
    """Weigh the hypotheses and name what earns its place."""
    weights = calibration or shipped_calibration()
    force = _force_posterior(inputs, tolerance_mN, weights)
    classification = (
        _classify_with_position(inputs, force)
        if inputs.position or inputs.has_position_error
        else _classify_with_lines(inputs, force)
    )
    return replace(
        classification,
        confusable_with=(*classification.confusable_with, *_excluded_aliases(classification.effects, inputs.excluded)),
    )


def _excluded_aliases(effects: Sequence[str], without: Sequence[str]) -> tuple[str, ...]:
    """Return what was left out of the search although it is hardly told from what was found."""
    alike = {name for label in effects for name in confusable_effects(label)}
    return tuple(label for label in without if label in alike)


@dataclass(frozen=True, slots=True)
class _ForcePosterior:
    """Probabilities of the force's explanations; what is missing to 1 is `no_gap`."""

    unknown: float
    probabilities: Mapping[tuple[str, ...], float]
    left_over: frozenset[tuple[str, ...]]

    @property
    def most_likely(self) -> tuple[str, ...]:
        """The likeliest explanation."""
        return max(self.probabilities, key=lambda names: self.probabilities[names], default=())

    @property
    def effects(self) -> tuple[str, ...]:
        """All effects of the explanations, those of the likeliest first."""
        ordered = sorted(self.probabilities, key=lambda names: -self.probabilities[names])
        return tuple(dict.fromkeys(name for names in ordered for name in names))

    def marginal(self, name: str) -> float:
        """Probability of all explanations that an effect is a part of."""
        return sum(value for names, value in self.probabilities.items() if name in names)

    @property
    def total(self) -> float:
        """Probability of all explanations together."""
        return sum(self.probabilities.values())


def _force_posterior(inputs: DecisionInputs, tolerance_mN: float, weights: Calibration) -> _ForcePosterior:
    tried = hypothesis_features(inputs, tolerance_mN)
    gate = weights.gate
    over = inputs.excess / max(inputs.block_count, 1)
    gain = largest_llr(inputs, tolerance_mN)
    left_alone = _logistic((over - gate.least_left) / gate.left_width)
    gap = max(_logistic((gain - gate.least_gain) / gate.gain_width), left_alone)
    if not tried:
        # What explains the gap is too small to matter, and so is the gap.
        small = max((hypothesis.share for hypothesis in hypothesis_features(inputs, 0.0)), default=0.0)
        gap *= 1.0 - small
    gap = min(max(gap, MIN_PROBABILITY), 1.0 - MIN_PROBABILITY)
    shares = _softmax([weights.utility(hypothesis.features) for hypothesis in tried])
    # What was not tried and looks the same is as likely, each of it.
    kept = {summary.effects: 1.0 / (1 + summary.untried_lookalikes) for summary in inputs.hypotheses}
    named = {
        hypothesis.effects: gap * value * kept[hypothesis.effects]
        for hypothesis, value in zip(tried, shares[:-1], strict=True)
    }
    return _ForcePosterior(gap - sum(named.values()), named, frozenset(_leaving_residual(inputs, tried)))


def _leaving_residual(inputs: DecisionInputs, tried: Sequence[HypothesisFeatures]) -> list[tuple[str, ...]]:
    """Return the explanations that leave something that no other one named would leave."""
    left = {
        hypothesis.effects: (hypothesis.chi2_with_form_error - inputs.block_count) / max(inputs.block_count, 1)
        for hypothesis in inputs.hypotheses
    }
    return [
        one.effects for one in tried if left[one.effects] > MIN_LEFT_OVER_EXCESS and one.share < MAX_EXPLAINED_SHARE
    ]


def _softmax(utilities: Sequence[float]) -> list[float]:
    """Return probabilities of hypotheses, and last that of the unknown, whose utility is 0."""
    highest = max((*utilities, 0.0))
    weights = [exp(value - highest) for value in (*utilities, 0.0)]
    within = [min(max(value / sum(weights), MIN_PROBABILITY / len(weights)), MAX_PROBABILITY) for value in weights]
    return [value / sum(within) for value in within]


def mains_hum_present(mains_llr: float, line_llr: float) -> bool:
    """Return whether a line at the mains' frequency is one of the mains, the strongest elsewhere being what it is."""
    return mains_llr > MIN_MAINS_LLR and _mains_dominates(mains_llr, line_llr)


def _mains_dominates(mains_llr: float, line_llr: float) -> bool:
    """Return whether the mains' frequency is louder than others: where all are loud, it is no finding."""
    return line_llr <= 0.5 * mains_llr


def _classify_with_lines(inputs: DecisionInputs, force: _ForcePosterior) -> Classification:
    seen = _logistic((inputs.mains_llr - MIN_MAINS_LLR) / MAINS_LLR_WIDTH)
    hum_id = hum_effect().id
    hum = 0.0 if hum_id in inputs.excluded else seen
    if not _mains_dominates(inputs.mains_llr, inputs.line_llr):
        hum = min(hum, 0.2)
    foreign = _other_line_probability(inputs)
    if hum_id in inputs.excluded:
        foreign = max(foreign, seen)
    if hum > 0.5:
        beside = force.total > 0.5
        named = {(*names, hum_id): value for names, value in force.probabilities.items()} if beside else {}
        alone = min(hum, MAX_PROBABILITY) * (1.0 - force.total if beside else 1.0)
        return _classification({**named, (hum_id,): alone}, 1.0 - min(hum, MAX_PROBABILITY), 0.0, force)
    if foreign > 0.5 and foreign > force.total:
        return _classification({}, foreign, 1.0 - foreign, force)
    return _classification(force.probabilities, force.unknown, 1.0 - force.unknown - force.total, force)


def _has_clear_llr(name: str, inputs: DecisionInputs) -> bool:
    """Return whether an effect takes much away, alone or beside those taken up before it."""
    return (
        max((hypothesis.llr for hypothesis in inputs.hypotheses if hypothesis.effects[-1] == name), default=0.0)
        > MIN_LLR_BESIDE_POSITION
    )


def _other_line_probability(inputs: DecisionInputs) -> float:
    """Return how likely a line is that is not the mains'."""
    return _logistic((inputs.line_llr - 0.02 * inputs.mains_llr - MIN_OTHER_LINE_LLR) / OTHER_LINE_LLR_WIDTH)


def unknown_because_of_line(inputs: DecisionInputs, classification: Classification) -> bool:
    """Return whether it is a line that no effect of the catalogue explains which made a verdict `unknown`."""
    return (
        classification.verdict is Verdict.UNKNOWN
        and not inputs.has_position_error
        and _other_line_probability(inputs) > 0.5
    )


def _classify_with_position(inputs: DecisionInputs, force: _ForcePosterior) -> Classification:
    beside = tuple(
        name
        for name in force.effects
        if _has_clear_llr(name, inputs) and force.marginal(name) > MIN_POSTERIOR_BESIDE_POSITION
    )
    sure = min((force.marginal(name) for name in beside), default=1.0)
    alternatives = {beside: sure} if beside else _confusable_group(inputs, force)
    alone = 1.0 - sum(alternatives.values()) if alternatives else 1.0
    hum_id = hum_effect().id
    hum = (hum_id,) if inputs.mains_llr > MIN_MAINS_LLR and hum_id not in inputs.excluded else ()
    share = inputs.position[0][1] if inputs.position else 0.0
    named = min(max(_logistic((share - MIN_POSITION_SHARE) / POSITION_SHARE_WIDTH), MIN_PROBABILITY), MAX_PROBABILITY)
    rivals = {name: exp(-POSITION_RIVAL_SLOPE * max(share - value, 0.0)) for name, value in inputs.position}
    whole = sum(rivals.values())
    families = {(name, *hum): alone * named * weight / whole for name, weight in rivals.items() if alone > 0.0}
    for others, value in alternatives.items():
        families |= {(name, *others, *hum): value * named * weight / whole for name, weight in rivals.items()}
    return _classification(families, 1.0 - named if families else 1.0, 0.0, force)


def _confusable_group(inputs: DecisionInputs, force: _ForcePosterior) -> dict[tuple[str, ...], float]:
    """Return effects that are hardly told from each other, one of which acts, with their probabilities; else none."""
    for name in force.effects:
        group = [name, *sorted(confusable_effects(name) & set(force.effects))]
        shares: dict[tuple[str, ...], float] = {
            (label,): force.marginal(label) for label in group if _has_clear_llr(label, inputs)
        }
        if len(shares) > 1 and MIN_POSTERIOR_BESIDE_POSITION < sum(shares.values()) <= 1.0:
            return shares
    return {}


def _classification(
    named: Mapping[tuple[str, ...], float], unknown: float, no_gap: float, force: _ForcePosterior
) -> Classification:
    """Name the likeliest explanation where it is likelier than `unknown` and than `no_gap`."""
    named = _prefer_subset(named)
    whole = sum(named.values()) + unknown + no_gap
    probabilities = {NO_GAP: no_gap / whole, UNKNOWN: unknown / whole}
    probabilities |= {"+".join(names): value / whole for names, value in named.items()}
    effects = max(named, key=lambda names: named[names], default=())
    if not effects or named[effects] < max(unknown, no_gap):
        verdict = Verdict.NO_GAP if no_gap >= unknown else Verdict.UNKNOWN
        return Classification(verdict, (), probabilities, (), residual_unknown=False)
    least = CONFUSABLE_RATIO * named[effects]
    others = [names for names, value in named.items() if value > least and not set(effects) <= set(names)]
    confusable = tuple(dict.fromkeys(name for names in others for name in names if name not in effects))
    verdict = Verdict.SEVERAL if len(effects) > 1 else Verdict.EFFECT
    return Classification(verdict, effects, probabilities, confusable, effects in force.left_over)


def _prefer_subset(named: Mapping[tuple[str, ...], float]) -> Mapping[tuple[str, ...], float]:
    """Let a part of the likeliest explanation that is nearly as likely on its own be the likelier one."""
    best = max(named, key=lambda names: named[names], default=())
    parts = [names for names in named if set(names) < set(best) and named[names] * PARSIMONY_RATIO > named[best]]
    if not parts:
        return named
    part, moved = max(parts, key=lambda names: named[names]), named[best] * (1.0 - 1.0 / PARSIMONY_RATIO)
    return {**named, best: named[best] - moved, part: named[part] + moved}


def _logistic(value: float) -> float:
    return 1.0 / (1.0 + exp(-min(max(value, -40.0), 40.0)))


FEATURE_RIDGE, EFFECT_RIDGE = 0.02, 0.5
"""Prior precisions of a weight: of a feature, and of a single effect's, of which there are few campaigns each."""
PRIOR_GATE = GapGate(least_gain=18.0, gain_width=3.0, least_left=0.075, left_width=0.012)
"""What is thought of the thresholds beforehand: the best of all shapes reaches a gain of 8 in noise alone, and seldom
more than 15 where the nominal model is a little wrong."""
GATE_PRIOR_SD = 0.03
"""How well that is known, relative."""
MIN_TRAINING_LLR = 11.0
"""A campaign teaches which effect it is if any takes away so many half squares."""

POSITIVE_FEATURES = ("plain", "flexible", "further: share", "further: over", "further: gain", "further: worse")
NEGATIVE_FEATURES = ("known, in", "behind", "left", "nameless", "further: alike", "third")
"""How features begin whose sense is known beforehand: what explains more is never the less likely for it."""


@dataclass(frozen=True, slots=True)
class TrainingCase:
    """What was found in a campaign, and what was hidden in it.

    Attributes
    ----------
    effects
        Hidden effects of the catalogue.
    outside
        Whether an effect was hidden that the catalogue does not have.
    size
        The smallest size of the hidden effects; small ones teach nothing about when a gap is seen.
    """

    inputs: DecisionInputs
    effects: frozenset[str]
    outside: bool = False
    size: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class _LabelledChoice:
    """Features of the hypotheses of one campaign, shape `(H, F)`, and which is right (H where none is)."""

    features: FloatArray
    correct: int


def fit_weights(cases: Sequence[TrainingCase], tolerance_mN: float) -> dict[str, float]:
    """Return the weights that make the right choices most probable: penalised maximum likelihood.

    Raises
    ------
    ValueError
        When no lesson teaches a choice.
    """
    from scipy.optimize import minimize

    weighed = [
        (case, hypothesis_features(case.inputs, tolerance_mN)) for case in cases if _is_informative(case, tolerance_mN)
    ]
    tried = [(case, hypotheses) for case, hypotheses in weighed if hypotheses]
    if not tried:
        raise ValueError("There is no campaign among these whose force teaches which effect it is")
    names = sorted({name for _, hypotheses in tried for hypothesis in hypotheses for name in hypothesis.features})
    choices = []
    for lesson, hypotheses in tried:
        rows = [[hypothesis.features.get(name, 0.0) for name in names] for hypothesis in hypotheses]
        choices.append(
            _LabelledChoice(np.array(rows), _correct_choice(lesson, [hypothesis.effects for hypothesis in hypotheses]))
        )
    ridge = np.array([EFFECT_RIDGE if name.startswith(EFFECT_FEATURE) else FEATURE_RIDGE for name in names])

    def loss(weights: FloatArray) -> tuple[float, FloatArray]:
        total, slope = 0.5 * float(np.sum(ridge * weights**2)), ridge * weights
        for choice in choices:
            utilities = np.append(choice.features @ weights, 0.0)
            shares = np.exp(utilities - utilities.max())
            shares /= shares.sum()
            total -= float(np.log(shares[choice.correct] + 1e-300))
            pulled = shares[:-1].copy()
            if choice.correct < len(pulled):
                pulled[choice.correct] -= 1.0
            slope = slope + choice.features.T @ pulled
        return total, slope

    bounds = [_weight_bounds(name) for name in names]
    best = minimize(loss, np.zeros(len(names)), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 2000})
    return {name: round(float(weight), 4) for name, weight in zip(names, best.x, strict=True)}


def _weight_bounds(feature: str) -> tuple[float | None, float | None]:
    """Return between what the weight of a feature may be."""
    return 0.0 if feature.startswith(POSITIVE_FEATURES) else None, 0.0 if feature.startswith(
        NEGATIVE_FEATURES
    ) else None


def fit_gate(cases: Sequence[TrainingCase], tolerance_mN: float, min_size: float = 0.2) -> GapGate:
    """Return the thresholds that tell campaigns with a gap from those without most probably."""
    from scipy.optimize import minimize

    rows = [
        (*_gate_inputs(case.inputs, tolerance_mN), bool(case.effects or case.outside))
        for case in cases
        if not case.inputs.has_position_error
        and _force_effects(case) == case.effects
        and (not case.effects or case.size >= min_size)
    ]
    gain, left, there = (np.array(column) for column in zip(*rows, strict=True))

    def loss(steps: FloatArray) -> float:
        gate = _gate_at(steps)
        seen = np.maximum(
            _logistic_array((gain - gate.least_gain) / gate.gain_width),
            _logistic_array((left - gate.least_left) / gate.left_width),
        )
        within = np.clip(seen, 1e-3, 1.0 - 1e-3)
        return -float(np.sum(np.log(np.where(there, within, 1.0 - within)))) + 0.5 * float(np.sum(steps**2))

    solution = minimize(loss, np.zeros(4), method="Nelder-Mead", options={"maxiter": 2000})
    return _gate_at(np.asarray(solution.x, dtype=np.float64))


def _gate_at(steps: FloatArray) -> GapGate:
    values = [
        value * float(np.exp(GATE_PRIOR_SD * step)) for value, step in zip(_gate_values(PRIOR_GATE), steps, strict=True)
    ]
    gain, width, left, left_width = (round(value, 4) for value in values)
    return GapGate(least_gain=gain, gain_width=width, least_left=left, left_width=left_width)


def _gate_values(gate: GapGate) -> tuple[float, ...]:
    return gate.least_gain, gate.gain_width, gate.least_left, gate.left_width


def _gate_inputs(inputs: DecisionInputs, tolerance_mN: float) -> tuple[float, float]:
    return largest_llr(inputs, tolerance_mN), inputs.excess / max(inputs.block_count, 1)


def _logistic_array(values: FloatArray) -> FloatArray:
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(values, -40.0, 40.0))))


def _force_effects(case: TrainingCase) -> frozenset[str]:
    """Return the hidden effects that the weights concern: not those found in the position or as a line."""
    known = catalogue()
    return frozenset(name for name in case.effects if name not in known or known[name].has_force_signature)


def _is_informative(case: TrainingCase, tolerance_mN: float) -> bool:
    """Whether it is the force that is to be explained, and anything explains some of it."""
    of_force = _force_effects(case)
    tried = [hypothesis.llr for hypothesis in case.inputs.hypotheses if hypothesis.change_mN >= tolerance_mN]
    return (bool(of_force) or (case.outside and not case.inputs.has_position_error)) and max(
        tried, default=0.0
    ) > MIN_TRAINING_LLR


def _correct_choice(case: TrainingCase, hypotheses: Sequence[tuple[str, ...]]) -> int:
    """Return which explanation has just the hidden effects, else the most of them and no other, else none."""
    hidden = _force_effects(case)
    if case.outside:
        return len(hypotheses)
    fitting = [number for number, names in enumerate(hypotheses) if set(names) <= hidden]
    return max(fitting, key=lambda number: len(hypotheses[number]), default=len(hypotheses))


CROSS_VALIDATION_FOLDS = 10


def cross_validate(
    cases: Sequence[TrainingCase], tolerance_mN: float, folds: int = CROSS_VALIDATION_FOLDS
) -> tuple[Classification, ...]:
    """Judge each campaign with thresholds and weights that all but its own part of them teach.

    Parameters
    ----------
    cases
        Campaigns whose hidden effects are known.
    tolerance_mN
        What an effect must change to matter.
    folds
        Into so many parts they are divided: with 10, the first, eleventh, … campaign are one.

    Raises
    ------
    ValueError
        When there are fewer campaigns than parts, fewer than two parts, or the others teach nothing.
    """
    if not 2 <= folds <= len(cases):
        raise ValueError(f"{len(cases)} campaigns cannot be divided into {folds} parts")
    learnt = [
        _trained([case for at, case in enumerate(cases) if at % folds != fold], tolerance_mN) for fold in range(folds)
    ]
    return tuple(classify(case.inputs, tolerance_mN, learnt[at % folds]) for at, case in enumerate(cases))


def _trained(cases: Sequence[TrainingCase], tolerance_mN: float) -> Calibration:
    gate, weights = fit_gate(cases, tolerance_mN), fit_weights(cases, tolerance_mN)
    return Calibration(version=0, command="", seeds=(), cases=len(cases), gate=gate, weights=weights)
