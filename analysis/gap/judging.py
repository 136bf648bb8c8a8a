"""From what was found to a verdict with probabilities.

Which explanation of the force is the right one, and whether any is, is a choice whose weights are learnt on simulated
campaigns with hidden effects (`calibration.json`, judged on other seeds); its probabilities are calibrated on these.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp

from dragrig.analysis.gap.calibration import Calibration, shipped_calibration
from dragrig.analysis.gap.evidence import Evidence
from dragrig.analysis.gap.results import Verdict
from dragrig.analysis.gap.weighing import Hypothesis, hypotheses, largest_gain
from dragrig.sim_backend.effects.catalogue import near_aliases

NO_GAP, UNKNOWN = "no_gap", "unknown"

LEAST_LINE, LEAST_OTHER_LINE = 14.0, 60.0
LINE_WIDTH, OTHER_LINE_WIDTH = 1.5, 8.0
LEAST_POSITION, POSITION_WIDTH = 0.7, 0.04
"""Share of the position's errors that an effect explains on runs that took no part."""
POSITION_RIVAL = 400.0
"""Weight of a rival: e to the minus this times by how much less of the errors it explains."""
SURE_BESIDE, CLEAR_BESIDE = 0.6, 60.0
"""Beside an effect on the position, one on the force is named from this probability and this gain on, whatever other
effects of the force may be there too: where a stage strays, what is uncertain of its motion passes for small effects.
"""
LEFT_OVER, LEFT_SHARE = 0.15, 0.9
"""Something is left beside named effects that have less than this share, from so many squares over blocks on."""
NEARLY = 1.2
"""An explanation that is a part of another is named unless the other is so much likelier."""
CONFUSABLE = 0.1
"""A rival with this share of the probability cannot be told apart."""
LEAST, MOST = 0.003, 0.985
"""No probability is closer to 0 or 1 than simulated campaigns can show."""


@dataclass(frozen=True, slots=True)
class Judgement:
    """A verdict, the probabilities of all hypotheses that matter, and what cannot be told apart."""

    verdict: Verdict
    effects: tuple[str, ...]
    probabilities: Mapping[str, float]
    confusable_with: tuple[str, ...]
    residual_unknown: bool


def judge(found: Evidence, tolerance_mN: float, calibration: Calibration | None = None) -> Judgement:
    """Weigh the hypotheses and name what earns its place."""
    weights = calibration or shipped_calibration()
    force = _of_force(found, tolerance_mN, weights)
    judged = _with_position(found, force) if found.position or found.strays else _with_lines(found, force)
    return replace(judged, confusable_with=(*judged.confusable_with, *_not_tried(judged.effects, found.without)))


def _not_tried(effects: Sequence[str], without: Sequence[str]) -> tuple[str, ...]:
    """Return what was left out of the search although it is hardly told from what was found."""
    alike = {other for one in effects for other in near_aliases(one)}
    return tuple(one for one in without if one in alike)


@dataclass(frozen=True, slots=True)
class _Force:
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


def _of_force(found: Evidence, tolerance_mN: float, weights: Calibration) -> _Force:
    tried = hypotheses(found, tolerance_mN)
    gate = weights.gate
    over = found.excess / max(found.blocks, 1)
    gain = largest_gain(found, tolerance_mN)
    left_alone = _logistic((over - gate.least_left) / gate.left_width)
    gap = max(_logistic((gain - gate.least_gain) / gate.gain_width), left_alone)
    if not tried:
        # What explains the gap is too small to matter, and so is the gap.
        small = max((one.share for one in hypotheses(found, 0.0)), default=0.0)
        gap *= 1.0 - small
    gap = min(max(gap, LEAST), 1.0 - LEAST)
    shares = _softmax([weights.utility(one.features) for one in tried])
    # What was not tried and looks the same is as likely, each of it.
    kept = {one.effects: 1.0 / (1 + one.untold) for one in found.tried}
    named = {one.effects: gap * each * kept[one.effects] for one, each in zip(tried, shares[:-1], strict=True)}
    return _Force(gap - sum(named.values()), named, frozenset(_with_rest(found, tried)))


def _with_rest(found: Evidence, tried: Sequence[Hypothesis]) -> list[tuple[str, ...]]:
    """Return the explanations that leave something that no other one named would leave."""
    left = {one.effects: (one.flexible - found.blocks) / max(found.blocks, 1) for one in found.tried}
    return [one.effects for one in tried if left[one.effects] > LEFT_OVER and one.share < LEFT_SHARE]


def _softmax(utilities: Sequence[float]) -> list[float]:
    """Return probabilities of hypotheses, and last that of the unknown, whose utility is 0."""
    highest = max((*utilities, 0.0))
    weights = [exp(one - highest) for one in (*utilities, 0.0)]
    within = [min(max(one / sum(weights), LEAST / len(weights)), MOST) for one in weights]
    return [one / sum(within) for one in within]


def hears_hum(mains_gain: float, line_gain: float) -> bool:
    """Return whether a line at the mains' frequency is one of the mains, the strongest elsewhere being what it is."""
    return mains_gain > LEAST_LINE and _stands_out(mains_gain, line_gain)


def _stands_out(mains_gain: float, line_gain: float) -> bool:
    """Return whether the mains' frequency is louder than others: where all are loud, it is no finding."""
    return line_gain <= 0.5 * mains_gain


def _with_lines(found: Evidence, force: _Force) -> Judgement:
    seen = _logistic((found.mains_gain - LEAST_LINE) / LINE_WIDTH)
    hum = 0.0 if "mains_hum" in found.without else seen
    if not _stands_out(found.mains_gain, found.line_gain):
        hum = min(hum, 0.2)
    foreign = _foreign(found)
    if "mains_hum" in found.without:
        foreign = max(foreign, seen)
    if hum > 0.5:
        beside = force.all_named > 0.5
        named = {(*one, "mains_hum"): each for one, each in force.named.items()} if beside else {}
        alone = min(hum, MOST) * (1.0 - force.all_named if beside else 1.0)
        return _judged({**named, ("mains_hum",): alone}, 1.0 - min(hum, MOST), 0.0, force)
    if foreign > 0.5 and foreign > force.all_named:
        return _judged({}, foreign, 1.0 - foreign, force)
    return _judged(force.named, force.unknown, 1.0 - force.unknown - force.all_named, force)


def _clear(name: str, found: Evidence) -> bool:
    """Return whether an effect takes much away, alone or beside those taken up before it."""
    return max((one.gain for one in found.tried if one.effects[-1] == name), default=0.0) > CLEAR_BESIDE


def _foreign(found: Evidence) -> float:
    """Return how likely a line is that is not the mains'."""
    return _logistic((found.line_gain - 0.02 * found.mains_gain - LEAST_OTHER_LINE) / OTHER_LINE_WIDTH)


def tells_unknown(found: Evidence, judged: Judgement) -> bool:
    """Return whether it is a line that no effect of the catalogue explains which made a verdict `unknown`."""
    return judged.verdict is Verdict.UNKNOWN and not found.strays and _foreign(found) > 0.5


def _with_position(found: Evidence, force: _Force) -> Judgement:
    beside = tuple(name for name in force.members if _clear(name, found) and force.marginal(name) > SURE_BESIDE)
    sure = min((force.marginal(name) for name in beside), default=1.0)
    alternatives = {beside: sure} if beside else _alike(found, force)
    alone = 1.0 - sum(alternatives.values()) if alternatives else 1.0
    hum = ("mains_hum",) if found.mains_gain > LEAST_LINE and "mains_hum" not in found.without else ()
    share = found.position[0][1] if found.position else 0.0
    named = min(max(_logistic((share - LEAST_POSITION) / POSITION_WIDTH), LEAST), MOST)
    rivals = {name: exp(-POSITION_RIVAL * max(share - each, 0.0)) for name, each in found.position}
    whole = sum(rivals.values())
    families = {(name, *hum): alone * named * weight / whole for name, weight in rivals.items() if alone > 0.0}
    for others, each in alternatives.items():
        families |= {(name, *others, *hum): each * named * weight / whole for name, weight in rivals.items()}
    return _judged(families, 1.0 - named if families else 1.0, 0.0, force)


def _alike(found: Evidence, force: _Force) -> dict[tuple[str, ...], float]:
    """Return effects that are hardly told from each other, one of which acts, with their probabilities; else none."""
    for name in force.members:
        group = [name, *sorted(near_aliases(name) & set(force.members))]
        shares: dict[tuple[str, ...], float] = {(one,): force.marginal(one) for one in group if _clear(one, found)}
        if len(shares) > 1 and SURE_BESIDE < sum(shares.values()) <= 1.0:
            return shares
    return {}


def _judged(named: Mapping[tuple[str, ...], float], unknown: float, no_gap: float, force: _Force) -> Judgement:
    """Name the likeliest explanation where it is likelier than `unknown` and than `no_gap`."""
    named = _parsimonious(named)
    whole = sum(named.values()) + unknown + no_gap
    probabilities = {NO_GAP: no_gap / whole, UNKNOWN: unknown / whole}
    probabilities |= {"+".join(one): each / whole for one, each in named.items()}
    effects = max(named, key=lambda one: named[one], default=())
    if not effects or named[effects] < max(unknown, no_gap):
        verdict = Verdict.NO_GAP if no_gap >= unknown else Verdict.UNKNOWN
        return Judgement(verdict, (), probabilities, (), residual_unknown=False)
    least = CONFUSABLE * named[effects]
    others = [one for one, each in named.items() if each > least and not set(effects) <= set(one)]
    confusable = tuple(dict.fromkeys(name for one in others for name in one if name not in effects))
    verdict = Verdict.SEVERAL if len(effects) > 1 else Verdict.EFFECT
    return Judgement(verdict, effects, probabilities, confusable, effects in force.left_over)


def _parsimonious(named: Mapping[tuple[str, ...], float]) -> Mapping[tuple[str, ...], float]:
    """Let a part of the likeliest explanation that is nearly as likely on its own be the likelier one."""
    best = max(named, key=lambda one: named[one], default=())
    parts = [one for one in named if set(one) < set(best) and named[one] * NEARLY > named[best]]
    if not parts:
        return named
    part, moved = max(parts, key=lambda one: named[one]), named[best] * (1.0 - 1.0 / NEARLY)
    return {**named, best: named[best] - moved, part: named[part] + moved}


def _logistic(value: float) -> float:
    return 1.0 / (1.0 + exp(-min(max(value, -40.0), 40.0)))
