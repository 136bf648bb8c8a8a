"""The numbers that a verdict is made of, gathered from all that was tried."""

from collections.abc import Sequence
from dataclasses import replace

from dragrig.analysis.gap.evidence import Evidence, Tried
from dragrig.analysis.gap.explanation import Explanation, in_time
from dragrig.analysis.gap.findings import Findings, Step
from dragrig.analysis.gap.lines import Lines
from dragrig.analysis.gap.nameless import nameless
from dragrig.analysis.gap.position.finding import PositionFinding

KEPT = 3
"""Laws without a name that are kept of those tried in the place of a further effect."""


def evidence_of(found: Findings, position: PositionFinding, lines: Lines, without: tuple[str, ...]) -> Evidence:
    """Return what a verdict is made of; `without` are the effects that were not to be considered."""
    untold = found.study.untold
    tried = [replace(_single(one, found.squares), untold=untold(one.design)) for one in found.singles]
    joint = [(one, one.together) for one in found.steps if one.together is not None]
    tried += [replace(_joint(*one), untold=untold(one[1].design)) for one in joint]
    return Evidence(
        blocks=found.blocks,
        squares=found.squares,
        tried=tuple(tried),
        mains_gain=lines.mains.gain,
        line_gain=lines.other.gain,
        position=tuple((one.effect, one.held_out) for one in position.families) if position.present else (),
        strays=position.present,
        without=without,
        nameless=nameless(found.nominal, found.study.sights, _period_s(found.singles)),
    )


def _period_s(singles: Sequence[Explanation]) -> float:
    """Return the period of what swings on the session's clock; 0 where nothing does."""
    swinging = (each for one in singles for each in one.point.candidates if in_time(each.effect))
    return next((value for each in swinging for name, value in each.values.items() if name.startswith("period")), 0.0)


def _single(one: Explanation, squares: float) -> Tried:
    gain = 0.5 * (squares - (one.flexible if _periodic(one) else one.plain))
    return replace(_tried(one), gain=gain, left=squares)


def _joint(step: Step, one: Explanation) -> Tried:
    return replace(_tried(one), gain=step.gain, left=step.left, rival_gain=step.rival_gain, laws=step.laws[:KEPT])


def _tried(one: Explanation) -> Tried:
    return Tried(
        effects=one.effects,
        plain=one.plain,
        flexible=one.flexible,
        changed_mN=one.changed_mN,
        periodic=_periodic(one),
        elsewhere=one.elsewhere,
        at_limit=any(each.at_limit for each in one.point.candidates),
    )


def _periodic(one: Explanation) -> bool:
    return any(in_time(each.effect) for each in one.point.candidates)
