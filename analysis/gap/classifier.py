"""The verdict: hypotheses weighed by their features, and what is there by that and the competition of causes.

Which explanation of the force is right, and whether any is, is decided by weights learnt on simulated campaigns with
hidden effects (`calibration.json`, evaluated on other seeds; `training`); the probabilities are calibrated on these.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp, log, prod

from dragrig.analysis.gap.diagnosis import (
    ESTABLISHED,
    MAX_PROBABILITY,
    MIN_PROBABILITY,
    NO_GAP,
    SURE_EXCHANGE,
    UNKNOWN,
    Classification,
    Verdict,
    marginal_probability,
)
from dragrig.analysis.gap.features import (
    EQUAL_SHARE,
    EXCHANGE,
    DecisionInputs,
    HypothesisFeatures,
    PresenceWeights,
    VerdictCalibration,
    hypothesis_features,
    largest_llr,
    shipped_calibration,
)
from dragrig.analysis.gap.position_channel import MIN_POSITION_SHARE, POSITION_RIVAL_SLOPE, POSITION_SHARE_WIDTH
from dragrig.analysis.gap.spectral_lines import MIN_MAINS_LLR
from dragrig.sim_backend.effects import Coordinate, catalogue, confusable_effects, hum_effect

MIN_OTHER_LINE_LLR = 60.0
MAINS_LLR_WIDTH, OTHER_LINE_LLR_WIDTH = 1.5, 8.0
CONFUSABLE_RATIO = 0.1
"""Hypotheses with at least this fraction of the highest probability count as confusable with it."""


def classify(
    inputs: DecisionInputs, tolerance_mN: float, calibration: VerdictCalibration | None = None
) -> Classification:
    """Return the classification of the force alone; `calibration` defaults to the shipped one."""
    force, gap = _force_posterior(inputs, tolerance_mN, calibration or shipped_calibration())
    total = sum(force.values())
    line_probability = _logistic(_mains_log_odds(inputs.mains_llr))
    hum_id = hum_effect().id
    hum_probability = 0.0 if hum_id in inputs.excluded else line_probability
    if not _mains_dominates(inputs.mains_llr, inputs.line_llr):
        hum_probability = min(hum_probability, 0.2)
    other_line = _other_line_probability(inputs)
    if hum_id in inputs.excluded:
        other_line = max(other_line, line_probability)
    if hum_probability > 0.5:
        combinations = {(*names, hum_id): value for names, value in force.items()} if total > 0.5 else {}
        hum_alone = min(hum_probability, MAX_PROBABILITY) * (1.0 - total if total > 0.5 else 1.0)
        return _classification({**combinations, (hum_id,): hum_alone}, 1.0 - min(hum_probability, MAX_PROBABILITY), 0.0)
    if other_line > max(0.5, total):
        return _classification({}, other_line, 1.0 - other_line)
    return _classification(force, gap - total, 1.0 - gap)


def _force_posterior(
    inputs: DecisionInputs, tolerance_mN: float, weights: VerdictCalibration
) -> tuple[Mapping[tuple[str, ...], float], float]:
    """Return the probabilities of the hypotheses on the force, and of a gap."""
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
    return probabilities, gap


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


def hum_log_odds(mains_llr: float, line_llr: float) -> float:
    """Return the log odds of mains hum of any size, given the strongest lines at the mains frequency and elsewhere."""
    return _mains_log_odds(mains_llr if _mains_dominates(mains_llr, line_llr) else 0.0)


def _mains_log_odds(mains_llr: float) -> float:
    return (mains_llr - MIN_MAINS_LLR) / MAINS_LLR_WIDTH


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
    inputs: DecisionInputs,
    classification: Classification,
    tolerance_mN: float,
    calibration: VerdictCalibration | None = None,
) -> bool:
    """Whether the verdict is `unknown` because blocks differ by more than noise, and nothing predicts by how much."""
    gate = (calibration or shipped_calibration()).gate
    return (
        classification.verdict is Verdict.UNKNOWN
        and not inputs.has_position_error
        and not unknown_because_of_line(inputs, classification)
        and largest_llr(inputs, tolerance_mN) < gate.least_gain
    )


def with_verdict(classification: Classification, verdict: Verdict) -> Classification:
    """Return the verdict `no_gap` in place of `unknown`, or the other way round, with its probability."""
    probabilities = dict(classification.probabilities)
    probabilities[NO_GAP], probabilities[UNKNOWN] = probabilities[UNKNOWN], probabilities[NO_GAP]
    return replace(classification, verdict=verdict, probabilities=probabilities)


def _classify_position(inputs: DecisionInputs) -> Classification:
    """Return the classification of the position, beside hum, without any effect on the force."""
    hum_id = hum_effect().id
    hum = (hum_id,) if inputs.mains_llr > MIN_MAINS_LLR and hum_id not in inputs.excluded else ()
    share = inputs.position[0][1] if inputs.position else 0.0
    known = min(max(_logistic((share - MIN_POSITION_SHARE) / POSITION_SHARE_WIDTH), MIN_PROBABILITY), MAX_PROBABILITY)
    weights = {name: exp(-POSITION_RIVAL_SLOPE * max(share - value, 0.0)) for name, value in inputs.position}
    total = sum(weights.values())
    named = {(*name.split("+"), *hum): known * weight / total for name, weight in weights.items()}
    return _classification(named, 1.0 - known if named else 1.0, 0.0)


def _classification(named: Mapping[tuple[str, ...], float], unknown: float, no_gap: float) -> Classification:
    """Return the most likely hypothesis as verdict if it is more likely than `unknown` and `no_gap`."""
    total = sum(named.values()) + unknown + no_gap
    probabilities = {NO_GAP: no_gap / total, UNKNOWN: unknown / total}
    probabilities |= {"+".join(names): value / total for names, value in named.items()}
    effects = max(named, key=lambda names: named[names], default=())
    if not effects or named[effects] < max(unknown, no_gap):
        verdict = Verdict.NO_GAP if no_gap >= unknown else Verdict.UNKNOWN
        return Classification(verdict, (), probabilities, ())
    threshold = CONFUSABLE_RATIO * named[effects]
    rivals = [names for names, value in named.items() if value > threshold and not set(effects) <= set(names)]
    confusable = tuple(dict.fromkeys(name for names in rivals for name in names if name not in effects))
    verdict = Verdict.SEVERAL if len(effects) > 1 else Verdict.EFFECT
    return Classification(verdict, effects, probabilities, confusable)


MIN_COMPETITION = 0.05
"""The competition is surer than its forms allow: log odds beyond these carry no weight."""
MOTION_ERROR_LOG_ODDS = 1.1
"""Log odds by which effects on the force are less likely where the stage strays from its command: of those found in 25
such campaigns a third was none, so that these count three times less."""


@dataclass(frozen=True, slots=True)
class Judgement:
    """The verdict on a campaign, and which effects are in the force."""

    verdict: Classification
    presence: Mapping[str, float]
    """Probability that each effect on the force is there, or the nominal model's own laws in its place."""


def judge(inputs: DecisionInputs, tolerance_mN: float, calibration: VerdictCalibration | None = None) -> Judgement:
    """Return the verdict on a campaign, from classifier and competition of causes.

    Without a competition, as in inputs of a synthetic campaign, the classifier alone decides.
    """
    learnt = calibration or shipped_calibration()
    on_force = classify(inputs, tolerance_mN, learnt)
    verdict = on_force
    if inputs.position or inputs.has_position_error:
        verdict = _classify_position(inputs)
        verdict = replace(verdict, confusable_with=(*verdict.confusable_with, *on_force.confusable_with))
    if not inputs.competition:
        return Judgement(_with_excluded(verdict, inputs), {})
    joint = {name: value + inputs.by_model.get(name, 0.0) for name, value in inputs.competition.items()}
    limits = dict(_limits_by_exchange(on_force, joint))
    # The competition does not know why runs do not establish an effect, and so cannot make it likelier.
    unestablished = {name for tried in inputs.hypotheses if tried.lookalikes for name in tried.effects}
    limits |= {name: on_force.marginal(name) for name in unestablished}
    combined = (
        combined_presence(on_force, competition, learnt.presence, stage_strays=inputs.moves_astray)
        for competition in (inputs.competition, joint)
    )
    gap = 1.0 - on_force.probabilities.get(NO_GAP, 0.0)
    alone, presence = ({name: min(value, limits.get(name, gap), gap) for name, value in of.items()} for of in combined)
    for name in _beside_likelier(presence):
        alone[name], presence[name] = (min(of[name], joint[name]) for of in (alone, presence))
    in_position = {name for name, _ in inputs.position}
    named = [name for name, value in presence.items() if value > ESTABLISHED and name not in in_position]
    verdict = restate(verdict, {name: value for name, value in alone.items() if name not in in_position}, named)
    return Judgement(_with_excluded(verdict, inputs), presence)


def _with_excluded(verdict: Classification, inputs: DecisionInputs) -> Classification:
    """Count effects left out of the search among those confusable with the verdict."""
    aliases = {name for effect in verdict.effects for name in confusable_effects(effect)}
    excluded = [effect for effect in inputs.excluded if effect in aliases]
    return replace(verdict, confusable_with=(*verdict.confusable_with, *excluded))


def _beside_likelier(presence: Mapping[str, float]) -> tuple[str, ...]:
    """Return the effects that runs hardly tell from a likelier one that is there, of the same coordinate.

    Each takes up the form error of the other. Only the competition allows for that.
    """
    known = catalogue()
    return tuple(
        name
        for name, value in presence.items()
        if any(
            presence.get(rival, 0.0) > max(value, ESTABLISHED) and known[rival].coordinate is known[name].coordinate
            for rival in confusable_effects(name)
        )
    )


def _limits_by_exchange(on_force: Classification, competition: Mapping[str, float]) -> Iterator[tuple[str, float]]:
    """Yield effects whose probability the competition limits because the specimen was surely exchanged.

    The classifier knows no exchange and takes one for a function of the session. None is there that the competition
    does not find beside it, nor an effect that the classifier finds mostly beside such a function.
    """
    if competition.get(EXCHANGE, 0.0) <= SURE_EXCHANGE:
        return
    of_session = {name for name, effect in catalogue().items() if effect.coordinate is Coordinate.SESSION}
    beside = {names: value for names, value in on_force.probabilities.items() if of_session & set(names.split("+"))}
    for name, value in competition.items():
        if name in of_session or marginal_probability(name, beside) > 0.5 * on_force.marginal(name):
            yield name, value


def combined_presence(
    on_force: Classification, competition: Mapping[str, float], weights: PresenceWeights, *, stage_strays: bool = False
) -> dict[str, float]:
    """Return the probability that each effect on the force is there, from classifier and competition together.

    Parameters
    ----------
    on_force
        Classification of the force alone.
    competition
        Probability that each cause is there by the competition of causes.
    stage_strays
        Whether the stage strays from its command, so that motion errors mimic effects on the force.
    """
    known = catalogue()
    combined = {}
    for name, value in competition.items():
        if name not in known:
            continue
        constant, of_classifier, of_competition = presence_inputs(name, on_force, value)
        log_odds = (
            weights.constant * constant
            + weights.classifier * of_classifier
            + weights.competition * of_competition
            - stage_strays * MOTION_ERROR_LOG_ODDS
        )
        combined[name] = _logistic(log_odds)
    return combined


def presence_inputs(effect: str, on_force: Classification, competition: float) -> tuple[float, float, float]:
    """Return what `PresenceWeights` weigh: 1, and the log odds of an effect by classifier and by competition."""
    return 1.0, _log_odds(on_force.marginal(effect)), _log_odds(competition, MIN_COMPETITION)


def _log_odds(probability: float, least: float = MIN_PROBABILITY) -> float:
    limited = min(max(probability, least), 1.0 - least)
    return log(limited / (1.0 - limited))


def restate(classification: Classification, probabilities: Mapping[str, float], named: Sequence[str]) -> Classification:
    """Return the verdict that names some effects on the force.

    Sets of effects are as likely as their members are present, by these probabilities, and all others absent, beside
    each alternative that the classifier has for spectral lines and the position.
    """
    elsewhere: dict[tuple[str, ...], float] = {}
    sets: set[frozenset[str]] = {frozenset(named), frozenset(), *(frozenset({name}) for name in probabilities)}
    for names, value in classification.probabilities.items():
        if names != NO_GAP:
            parts = () if names == UNKNOWN else tuple(names.split("+"))
            others = tuple(name for name in parts if name not in probabilities)
            elsewhere[others] = elsewhere.get(others, 0.0) + value
            sets.add(frozenset(parts) - set(others))
    weights = {
        names: prod(value if name in names else 1.0 - value for name, value in probabilities.items())
        for names in sorted(sets, key=sorted)
    }
    total = sum(weights.values())
    restated = {NO_GAP: classification.probabilities.get(NO_GAP, 0.0), UNKNOWN: 0.0}
    for others, share in elsewhere.items():
        for members, weight in weights.items():
            ordered = sorted(members, key=lambda name: (-probabilities[name], name))
            hypothesis = "+".join((*ordered, *others)) or UNKNOWN
            restated[hypothesis] = restated.get(hypothesis, 0.0) + share * weight / total
    likely = max(elsewhere, key=lambda others: elsewhere[others], default=())
    effects = (*sorted(named, key=lambda name: (-probabilities[name], name)), *likely)
    if not effects:
        verdict = Verdict.NO_GAP if restated[NO_GAP] >= restated[UNKNOWN] else Verdict.UNKNOWN
    else:
        verdict = Verdict.SEVERAL if len(effects) > 1 else Verdict.EFFECT
    return replace(
        classification,
        verdict=verdict,
        effects=effects,
        probabilities=restated,
        confusable_with=tuple(name for name in classification.confusable_with if effects and name not in effects),
    )


def _logistic(value: float) -> float:
    return 1.0 / (1.0 + exp(-min(max(value, -40.0), 40.0)))
