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
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import confusable_effects

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


def classify(found: DecisionInputs, tolerance_mN: float, calibration: Calibration | None = None) -> Classification:
    """Weigh the hypotheses and name what earns its place."""
    weights = calibration or shipped_calibration()
    force = _force_posterior(found, tolerance_mN, weights)
    judged = (
        _classify_with_position(found, force) if found.position or found.strays else _classify_with_lines(found, force)
    )
    return replace(judged, confusable_with=(*judged.confusable_with, *_excluded_aliases(judged.effects, found.without)))


def _excluded_aliases(effects: Sequence[str], without: Sequence[str]) -> tuple[str, ...]:
    """Return what was left out of the search although it is hardly told from what was found."""
    alike = {other for one in effects for other in confusable_effects(one)}
    return tuple(one for one in without if one in alike)


@dataclass(frozen=True, slots=True)
class _ForcePosterior:
    """Probabilities of the force's explanations; what is missing to 1 is `no_gap`."""

    unknown: float
    named: Mapping[tuple[str, ...], float]
    left_over: frozenset[tuple[str, ...]]

    @property
    def best(self) -> tuple[str, ...]:
        """The likeliest explanation."""
        return max(self.named, key=lambda one: self.named[one], default=())

    @property
    def members(self) -> tuple[str, ...]:
        """All effects of the explanations, those of the likeliest first."""
        ordered = sorted(self.named, key=lambda one: -self.named[one])
        return tuple(dict.fromkeys(name for one in ordered for name in one))

    def marginal(self, name: str) -> float:
        """Probability of all explanations that an effect is a part of."""
        return sum(each for one, each in self.named.items() if name in one)

    @property
    def all_named(self) -> float:
        """Probability of all explanations together."""
        return sum(self.named.values())


def _force_posterior(found: DecisionInputs, tolerance_mN: float, weights: Calibration) -> _ForcePosterior:
    tried = hypothesis_features(found, tolerance_mN)
    gate = weights.gate
    over = found.excess / max(found.blocks, 1)
    gain = largest_llr(found, tolerance_mN)
    left_alone = _logistic((over - gate.least_left) / gate.left_width)
    gap = max(_logistic((gain - gate.least_gain) / gate.gain_width), left_alone)
    if not tried:
        # What explains the gap is too small to matter, and so is the gap.
        small = max((one.share for one in hypothesis_features(found, 0.0)), default=0.0)
        gap *= 1.0 - small
    gap = min(max(gap, MIN_PROBABILITY), 1.0 - MIN_PROBABILITY)
    shares = _softmax([weights.utility(one.features) for one in tried])
    # What was not tried and looks the same is as likely, each of it.
    kept = {one.effects: 1.0 / (1 + one.untold) for one in found.tried}
    named = {one.effects: gap * each * kept[one.effects] for one, each in zip(tried, shares[:-1], strict=True)}
    return _ForcePosterior(gap - sum(named.values()), named, frozenset(_leaving_residual(found, tried)))


def _leaving_residual(found: DecisionInputs, tried: Sequence[HypothesisFeatures]) -> list[tuple[str, ...]]:
    """Return the explanations that leave something that no other one named would leave."""
    left = {one.effects: (one.flexible - found.blocks) / max(found.blocks, 1) for one in found.tried}
    return [
        one.effects for one in tried if left[one.effects] > MIN_LEFT_OVER_EXCESS and one.share < MAX_EXPLAINED_SHARE
    ]


def _softmax(utilities: Sequence[float]) -> list[float]:
    """Return probabilities of hypotheses, and last that of the unknown, whose utility is 0."""
    highest = max((*utilities, 0.0))
    weights = [exp(one - highest) for one in (*utilities, 0.0)]
    within = [min(max(one / sum(weights), MIN_PROBABILITY / len(weights)), MAX_PROBABILITY) for one in weights]
    return [one / sum(within) for one in within]


def mains_hum_present(mains_gain: float, line_gain: float) -> bool:
    """Return whether a line at the mains' frequency is one of the mains, the strongest elsewhere being what it is."""
    return mains_gain > MIN_MAINS_LLR and _mains_dominates(mains_gain, line_gain)


def _mains_dominates(mains_gain: float, line_gain: float) -> bool:
    """Return whether the mains' frequency is louder than others: where all are loud, it is no finding."""
    return line_gain <= 0.5 * mains_gain


def _classify_with_lines(found: DecisionInputs, force: _ForcePosterior) -> Classification:
    seen = _logistic((found.mains_gain - MIN_MAINS_LLR) / MAINS_LLR_WIDTH)
    hum = 0.0 if "mains_hum" in found.without else seen
    if not _mains_dominates(found.mains_gain, found.line_gain):
        hum = min(hum, 0.2)
    foreign = _other_line_probability(found)
    if "mains_hum" in found.without:
        foreign = max(foreign, seen)
    if hum > 0.5:
        beside = force.all_named > 0.5
        named = {(*one, "mains_hum"): each for one, each in force.named.items()} if beside else {}
        alone = min(hum, MAX_PROBABILITY) * (1.0 - force.all_named if beside else 1.0)
        return _classification({**named, ("mains_hum",): alone}, 1.0 - min(hum, MAX_PROBABILITY), 0.0, force)
    if foreign > 0.5 and foreign > force.all_named:
        return _classification({}, foreign, 1.0 - foreign, force)
    return _classification(force.named, force.unknown, 1.0 - force.unknown - force.all_named, force)


def _has_clear_llr(name: str, found: DecisionInputs) -> bool:
    """Return whether an effect takes much away, alone or beside those taken up before it."""
    return max((one.gain for one in found.tried if one.effects[-1] == name), default=0.0) > MIN_LLR_BESIDE_POSITION


def _other_line_probability(found: DecisionInputs) -> float:
    """Return how likely a line is that is not the mains'."""
    return _logistic((found.line_gain - 0.02 * found.mains_gain - MIN_OTHER_LINE_LLR) / OTHER_LINE_LLR_WIDTH)


def unknown_because_of_line(found: DecisionInputs, judged: Classification) -> bool:
    """Return whether it is a line that no effect of the catalogue explains which made a verdict `unknown`."""
    return judged.verdict is Verdict.UNKNOWN and not found.strays and _other_line_probability(found) > 0.5


def _classify_with_position(found: DecisionInputs, force: _ForcePosterior) -> Classification:
    beside = tuple(
        name
        for name in force.members
        if _has_clear_llr(name, found) and force.marginal(name) > MIN_POSTERIOR_BESIDE_POSITION
    )
    sure = min((force.marginal(name) for name in beside), default=1.0)
    alternatives = {beside: sure} if beside else _confusable_group(found, force)
    alone = 1.0 - sum(alternatives.values()) if alternatives else 1.0
    hum = ("mains_hum",) if found.mains_gain > MIN_MAINS_LLR and "mains_hum" not in found.without else ()
    share = found.position[0][1] if found.position else 0.0
    named = min(max(_logistic((share - MIN_POSITION_SHARE) / POSITION_SHARE_WIDTH), MIN_PROBABILITY), MAX_PROBABILITY)
    rivals = {name: exp(-POSITION_RIVAL_SLOPE * max(share - each, 0.0)) for name, each in found.position}
    whole = sum(rivals.values())
    families = {(name, *hum): alone * named * weight / whole for name, weight in rivals.items() if alone > 0.0}
    for others, each in alternatives.items():
        families |= {(name, *others, *hum): each * named * weight / whole for name, weight in rivals.items()}
    return _classification(families, 1.0 - named if families else 1.0, 0.0, force)


def _confusable_group(found: DecisionInputs, force: _ForcePosterior) -> dict[tuple[str, ...], float]:
    """Return effects that are hardly told from each other, one of which acts, with their probabilities; else none."""
    for name in force.members:
        group = [name, *sorted(confusable_effects(name) & set(force.members))]
        shares: dict[tuple[str, ...], float] = {
            (one,): force.marginal(one) for one in group if _has_clear_llr(one, found)
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
    probabilities |= {"+".join(one): each / whole for one, each in named.items()}
    effects = max(named, key=lambda one: named[one], default=())
    if not effects or named[effects] < max(unknown, no_gap):
        verdict = Verdict.NO_GAP if no_gap >= unknown else Verdict.UNKNOWN
        return Classification(verdict, (), probabilities, (), residual_unknown=False)
    least = CONFUSABLE_RATIO * named[effects]
    others = [one for one, each in named.items() if each > least and not set(effects) <= set(one)]
    confusable = tuple(dict.fromkeys(name for one in others for name in one if name not in effects))
    verdict = Verdict.SEVERAL if len(effects) > 1 else Verdict.EFFECT
    return Classification(verdict, effects, probabilities, confusable, effects in force.left_over)


def _prefer_subset(named: Mapping[tuple[str, ...], float]) -> Mapping[tuple[str, ...], float]:
    """Let a part of the likeliest explanation that is nearly as likely on its own be the likelier one."""
    best = max(named, key=lambda one: named[one], default=())
    parts = [one for one in named if set(one) < set(best) and named[one] * PARSIMONY_RATIO > named[best]]
    if not parts:
        return named
    part, moved = max(parts, key=lambda one: named[one]), named[best] * (1.0 - 1.0 / PARSIMONY_RATIO)
    return {**named, best: named[best] - moved, part: named[part] + moved}


def _logistic(value: float) -> float:
    return 1.0 / (1.0 + exp(-min(max(value, -40.0), 40.0)))


EFFECTS_OUTSIDE_FORCE = frozenset({"servo_lag", "velocity_ripple", "encoder_scale", "mains_hum"})
"""Effects that the weights know nothing of: they are found on the position, or as a line."""
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

    evidence: DecisionInputs
    effects: frozenset[str]
    outside: bool = False
    size: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class _LabelledChoice:
    """Features of the hypotheses of one campaign, shape `(H, F)`, and which is right (H where none is)."""

    features: FloatArray
    right: int


def fit_weights(lessons: Sequence[TrainingCase], tolerance_mN: float) -> dict[str, float]:
    """Return the weights that make the right choices most probable: penalised maximum likelihood.

    Raises
    ------
    ValueError
        When no lesson teaches a choice.
    """
    from scipy.optimize import minimize

    weighed = [
        (one, hypothesis_features(one.evidence, tolerance_mN)) for one in lessons if _is_informative(one, tolerance_mN)
    ]
    tried = [(one, found) for one, found in weighed if found]
    if not tried:
        raise ValueError("There is no campaign among these whose force teaches which effect it is")
    names = sorted({name for _, found in tried for one in found for name in one.features})
    choices = []
    for lesson, found in tried:
        rows = [[one.features.get(name, 0.0) for name in names] for one in found]
        choices.append(_LabelledChoice(np.array(rows), _correct_choice(lesson, [one.effects for one in found])))
    ridge = np.array([EFFECT_RIDGE if name.startswith(EFFECT_FEATURE) else FEATURE_RIDGE for name in names])

    def loss(weights: FloatArray) -> tuple[float, FloatArray]:
        total, slope = 0.5 * float(np.sum(ridge * weights**2)), ridge * weights
        for one in choices:
            utilities = np.append(one.features @ weights, 0.0)
            shares = np.exp(utilities - utilities.max())
            shares /= shares.sum()
            total -= float(np.log(shares[one.right] + 1e-300))
            pulled = shares[:-1].copy()
            if one.right < len(pulled):
                pulled[one.right] -= 1.0
            slope = slope + one.features.T @ pulled
        return total, slope

    bounds = [_weight_bounds(name) for name in names]
    best = minimize(loss, np.zeros(len(names)), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 2000})
    return {name: round(float(weight), 4) for name, weight in zip(names, best.x, strict=True)}


def _weight_bounds(feature: str) -> tuple[float | None, float | None]:
    """Return between what the weight of a feature may be."""
    return 0.0 if feature.startswith(POSITIVE_FEATURES) else None, 0.0 if feature.startswith(
        NEGATIVE_FEATURES
    ) else None


def fit_gate(lessons: Sequence[TrainingCase], tolerance_mN: float, least_size: float = 0.2) -> GapGate:
    """Return the thresholds that tell campaigns with a gap from those without most probably."""
    from scipy.optimize import minimize

    rows = [
        (*_gate_inputs(one.evidence, tolerance_mN), bool(one.effects or one.outside))
        for one in lessons
        if not one.evidence.strays
        and not one.effects & EFFECTS_OUTSIDE_FORCE
        and (not one.effects or one.size >= least_size)
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

    found = minimize(loss, np.zeros(4), method="Nelder-Mead", options={"maxiter": 2000})
    return _gate_at(np.asarray(found.x, dtype=np.float64))


def _gate_at(steps: FloatArray) -> GapGate:
    values = [
        value * float(np.exp(GATE_PRIOR_SD * step)) for value, step in zip(_gate_values(PRIOR_GATE), steps, strict=True)
    ]
    gain, width, left, left_width = (round(value, 4) for value in values)
    return GapGate(least_gain=gain, gain_width=width, least_left=left, left_width=left_width)


def _gate_values(gate: GapGate) -> tuple[float, ...]:
    return gate.least_gain, gate.gain_width, gate.least_left, gate.left_width


def _gate_inputs(found: DecisionInputs, tolerance_mN: float) -> tuple[float, float]:
    return largest_llr(found, tolerance_mN), found.excess / max(found.blocks, 1)


def _logistic_array(values: FloatArray) -> FloatArray:
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(values, -40.0, 40.0))))


def _is_informative(one: TrainingCase, tolerance_mN: float) -> bool:
    """Whether it is the force that is to be explained, and anything explains some of it."""
    of_force = one.effects - EFFECTS_OUTSIDE_FORCE
    tried = [each.gain for each in one.evidence.tried if each.changed_mN >= tolerance_mN]
    return (bool(of_force) or (one.outside and not one.evidence.strays)) and max(tried, default=0.0) > MIN_TRAINING_LLR


def _correct_choice(lesson: TrainingCase, tried: Sequence[tuple[str, ...]]) -> int:
    """Return which explanation has just the hidden effects, else the most of them and no other, else none."""
    hidden = lesson.effects - EFFECTS_OUTSIDE_FORCE
    if lesson.outside:
        return len(tried)
    fitting = [number for number, one in enumerate(tried) if set(one) <= hidden]
    return max(fitting, key=lambda number: len(tried[number]), default=len(tried))


CROSS_VALIDATION_FOLDS = 10


def cross_validate(
    lessons: Sequence[TrainingCase], tolerance_mN: float, folds: int = CROSS_VALIDATION_FOLDS
) -> tuple[Classification, ...]:
    """Judge each campaign with thresholds and weights that all but its own part of them teach.

    Parameters
    ----------
    lessons
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
    if not 2 <= folds <= len(lessons):
        raise ValueError(f"{len(lessons)} campaigns cannot be divided into {folds} parts")
    learnt = [
        _trained([one for at, one in enumerate(lessons) if at % folds != fold], tolerance_mN) for fold in range(folds)
    ]
    return tuple(classify(one.evidence, tolerance_mN, learnt[at % folds]) for at, one in enumerate(lessons))


def _trained(lessons: Sequence[TrainingCase], tolerance_mN: float) -> Calibration:
    gate, weights = fit_gate(lessons, tolerance_mN), fit_weights(lessons, tolerance_mN)
    return Calibration(version=0, command="", seeds=(), cases=len(lessons), gate=gate, weights=weights)
