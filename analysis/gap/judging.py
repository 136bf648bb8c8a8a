"""From what was found to a verdict with probabilities.

The constants below are learnt on simulated campaigns with hidden effects (`bench/blind.py`, seeds that no figure of
accuracy uses); probabilities are to be read as calibrated on these.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, sqrt

from dragrig.analysis.gap.results import Verdict

NO_GAP, UNKNOWN = "no_gap", "unknown"

LEAST_GAIN = 11.0
"""Half the squares that an effect must take away; the best of all shapes reaches 8 without any."""
GAIN_WIDTH = 1.6
CHANCE, NOISE_SHARE = 2.5, 0.06
"""Squares above noise that are chance: standard deviations of χ², and the share to which noise is known at all."""
LEAST_LEFT = 0.075
"""Squares over blocks, less 1, from which on something is left that no effect explains."""
LEFT_WIDTH = 0.012
LEAST_SHARE, SHARE_WIDTH = 0.55, 0.07
"""Share of the excess that an effect of the catalogue explains, a foreign form allowed."""
STRICT: Mapping[str, float] = {"force_nonlinearity": 0.95, "force_drift": 0.95, "tissue_ageing": 0.7}
"""Effects that resemble many that the catalogue does not have need a greater one."""
RIVAL = 14.0
"""Weight of a rival: e to the minus this times by how much less of the excess it explains."""
LEAST_BESIDE, LEAST_CLEAR, CLEAR_GAIN = 0.012, 0.005, 500.0
"""Share of the whole excess that a further effect must take away, and the smaller one where that is a clear gain."""
FURTHER_GAIN, FURTHER_SHARE = 14.0, 0.25
"""What a further effect must take away, and its share of what those before leave."""
LEAST_LINE, LEAST_OTHER_LINE = 14.0, 60.0
LEAST_POSITION = 0.9
"""Share of the position's errors that an effect explains on runs that took no part."""
FORM = 0.12
"""How much less, relative, the right effect may take away than a wrong one because its form is another."""
LEAST_SEVERAL = 0.5
"""Several effects are named only if they are more probable than not."""
LEAST_TOGETHER = 0.75
"""Share of the excess that several effects must explain together."""
CONFUSABLE = 0.1
"""A rival with this share of the probability cannot be told apart."""


@dataclass(frozen=True, slots=True)
class Score:
    """An explanation in numbers: whitened squares that remain as it is and with a foreign form, and its size."""

    effects: tuple[str, ...]
    plain: float
    flexible: float
    added_mN: float
    periodic: bool = False


@dataclass(frozen=True, slots=True)
class Further:
    """A further effect that was tried: what it takes away, what was left before, and what remains with it."""

    effect: str
    gain: float
    left: float
    rival: str
    rival_gain: float
    together: Score | None


@dataclass(frozen=True, slots=True)
class Findings:
    """All that a verdict is made of.

    Attributes
    ----------
    blocks, squares
        Of the force: number of blocks, and whitened squares that the nominal model leaves.
    singles, further
        Explanations of the force, the best first.
    mains_gain, line_gain
        Log likelihood ratios of lines at the mains' frequency and elsewhere.
    position
        Families of position errors with the share each explains, the best first.
    strays
        Whether there are such errors at all.
    without
        Effects that were not to be considered.
    """

    blocks: int
    squares: float
    singles: tuple[Score, ...]
    further: tuple[Further, ...]
    mains_gain: float = 0.0
    line_gain: float = 0.0
    position: tuple[tuple[str, float], ...] = ()
    strays: bool = False
    without: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Judgement:
    """A verdict, the probabilities of all hypotheses that matter, and what cannot be told apart."""

    verdict: Verdict
    effects: tuple[str, ...]
    probabilities: Mapping[str, float]
    confusable_with: tuple[str, ...]
    residual_unknown: bool


def judge(found: Findings, tolerance_mN: float) -> Judgement:
    """Weigh the hypotheses and name what earns its place."""
    force = _of_force(found, tolerance_mN)
    if found.position or found.strays:
        return _with_position(found, force)
    return _with_lines(found, force)


@dataclass(frozen=True, slots=True)
class _Force:
    gap: float
    named: float
    effects: tuple[str, ...]
    rivals: Mapping[str, float]
    left_over: bool
    unexplained: bool


def _of_force(found: Findings, tolerance_mN: float) -> _Force:
    chance = max(CHANCE * sqrt(2.0 * found.blocks), NOISE_SHARE * found.blocks)
    excess = found.squares - found.blocks
    unexplained = excess / found.blocks > LEAST_LEFT
    left_alone = _logistic((excess / found.blocks - LEAST_LEFT) / LEFT_WIDTH)
    shares = {one.effects[0]: _share(one, found, chance) for one in found.singles}
    scores = [one for one in found.singles if one.added_mN >= tolerance_mN]
    small = [shares[one.effects[0]] for one in found.singles if one.added_mN < tolerance_mN]
    if not scores:
        # What explains the gap is too small to matter, and so is the gap.
        return _Force(left_alone * (1.0 - max(small, default=0.0)), 0.0, (), {}, False, unexplained)
    best = max(scores, key=lambda one: shares[one.effects[0]])
    gain = _gain(best, found)
    seen = _logistic((gain - LEAST_GAIN) / GAIN_WIDTH)
    effects, last = best.effects, best
    for one in found.further if best is found.singles[0] else ():
        left = max(one.left - found.blocks - chance, 0.0)
        earns = one.gain > FURTHER_GAIN and 2 * one.gain > FURTHER_SHARE * left and one.left > found.blocks
        least = LEAST_BESIDE if one.gain < CLEAR_GAIN else LEAST_CLEAR
        if one.together is None or not earns or 2 * one.gain < least * max(excess, 1.0):
            break
        effects, last = (*effects, one.effect), one.together
    share = _share(last, found, chance)
    needed = STRICT.get(effects[0], LEAST_SHARE) if len(effects) == 1 else LEAST_TOGETHER
    named = _logistic((share - needed) / SHARE_WIDTH)
    top = shares[best.effects[0]]
    rivals = {
        one.effects[0]: exp(-RIVAL * (top - shares[one.effects[0]])) * _closeness(one, best, found) for one in scores
    }
    left_over = (last.flexible - found.blocks) / found.blocks > 2 * LEAST_LEFT and share < 0.9
    return _Force(max(seen, left_alone), named * seen, effects, rivals, left_over, unexplained)


def _share(one: Score, found: Findings, chance: float) -> float:
    """Return the share of the excess that is explained, what may be chance not counted as left."""
    halves = [one.flexible] if one.periodic else [one.plain, one.flexible]
    shares = []
    for squares in halves:
        gained = max(found.squares - squares, 0.0)
        left = max(squares - found.blocks - chance, 0.0)
        shares.append(gained / max(gained + left, 1.0))
    return sum(shares) / len(shares)


def _gain(one: Score, found: Findings) -> float:
    return 0.5 * (found.squares - (one.flexible if one.periodic else one.plain))


def _closeness(rival: Score, best: Score, found: Findings) -> float:
    """Return how likely noise and a foreign form alone make a rival the worse one."""
    behind = max(_gain(best, found) - _gain(rival, found), 0.0)
    inflation = 1.0 + FORM * max(_gain(best, found), 0.0)
    return exp(-behind / inflation) if rival is not best else 1.0


def _with_lines(found: Findings, force: _Force) -> Judgement:
    hum = 0.0 if "mains_hum" in found.without else _logistic((found.mains_gain - LEAST_LINE) / 1.5)
    if found.line_gain > 0.5 * found.mains_gain:
        # Where all frequencies are loud, those of the mains are no finding.
        hum = min(hum, 0.2)
    foreign = _logistic((max(found.line_gain - 0.02 * found.mains_gain, 0.0) - LEAST_OTHER_LINE) / 8.0)
    if "mains_hum" in found.without:
        foreign = max(foreign, _logistic((found.mains_gain - LEAST_LINE) / 1.5))
    named = {} if force.named < 0.5 else dict(force.rivals)
    if hum > 0.5 and force.named < 0.5:
        return _judged(("mains_hum",), {"mains_hum": 1.0}, hum * 0.98, hum, foreign > 0.5)
    if hum > 0.5:
        return _judged((*force.effects, "mains_hum"), named, force.named, 1.0, left_over=force.left_over)
    if foreign > 0.5 and foreign > force.named:
        return _judged((), {}, 0.03, foreign, left_over=False)
    return _judged(force.effects, force.rivals, force.named, force.gap, force.left_over)


def _with_position(found: Findings, force: _Force) -> Judgement:
    effect, share = found.position[0] if found.position else (UNKNOWN, 0.0)
    known = share >= LEAST_POSITION
    rivals = {name: exp(-400.0 * max(share - each, 0.0)) for name, each in found.position}
    beside = force.effects if force.named > 0.8 and force.effects else ()
    if found.mains_gain > LEAST_LINE and "mains_hum" not in found.without:
        beside = (*beside, "mains_hum")
    named = _logistic((share - LEAST_POSITION) / 0.03)
    if not known:
        return _judged((), rivals, named, 1.0, left_over=False)
    return _judged((effect, *beside), rivals, named, 1.0, left_over=False)


def _judged(
    effects: tuple[str, ...], rivals: Mapping[str, float], named: float, gap: float, left_over: bool
) -> Judgement:
    """Share the probability out: no gap, unknown, and the effects by their weights."""
    gap, named = min(max(gap, 0.003), 0.997), min(max(named, 0.003), 0.985)
    whole = sum(rivals.values())
    named = min(named, gap) if whole > 0 else 0.0
    probabilities = {NO_GAP: 1.0 - gap, UNKNOWN: gap - named}
    joint = "+".join(effects)
    for name, weight in rivals.items():
        label = joint if effects and name == effects[0] else name
        probabilities[label] = named * weight / whole if whole > 0 else 0.0
    best = max(probabilities, key=lambda name: probabilities[name])
    named_best = joint if effects and named >= probabilities[UNKNOWN] and named >= probabilities[NO_GAP] else best
    unsure = len(effects) > 1 and probabilities.get(joint, 0.0) < LEAST_SEVERAL
    if named_best in {NO_GAP, UNKNOWN} or not effects or unsure:
        verdict = Verdict.NO_GAP if probabilities[NO_GAP] >= probabilities[UNKNOWN] else Verdict.UNKNOWN
        return Judgement(verdict, (), probabilities, (), residual_unknown=False)
    verdict = Verdict.SEVERAL if len(effects) > 1 else Verdict.EFFECT
    top = probabilities.get(joint, 0.0)
    close = [name for name, each in probabilities.items() if name not in {joint, NO_GAP, UNKNOWN}]
    confusable = tuple(name for name in close if probabilities[name] > CONFUSABLE * max(top, 1e-9))
    return Judgement(verdict, effects, probabilities, confusable, left_over)


def _logistic(value: float) -> float:
    return 1.0 / (1.0 + exp(-min(max(value, -40.0), 40.0)))
