"""All that is known of a gap, or of the rest of one, that no effect of the catalogue explains."""

from collections.abc import Sequence

from dragrig.analysis.gap.evidence import Evidence
from dragrig.analysis.gap.judging import Judgement
from dragrig.analysis.gap.lines import Line
from dragrig.analysis.gap.results import UnknownGap, Verdict
from dragrig.analysis.gap.unknown.any_law import any_law
from dragrig.analysis.gap.unknown.law import find_law
from dragrig.analysis.gap.unknown.part import part_of
from dragrig.analysis.gap.unknown.place import place
from dragrig.analysis.gap.unknown.shape import shape
from dragrig.analysis.gap.unknown.swing import swinging
from dragrig.analysis.gap.where import ResidualBlocks, Where

NOWHERE = "It is too small beside noise and the scatter of repeats to say where it is."
"""Of a gap that many runs show together, and none of its parts alone."""


def unknown_gap(
    where: Where, blocks: Sequence[ResidualBlocks], judged: Judgement, swing: Line | None, evidence: Evidence
) -> UnknownGap | None:
    """Return where it is, what it depends on and a law of it; None where everything is explained.

    Parameters
    ----------
    swing
        The line that made the verdict `unknown`, where one did.
    """
    if judged.verdict is not Verdict.UNKNOWN and not judged.residual_unknown:
        return None
    if swing is not None:
        return UnknownGap(*swinging(swing, blocks[0].channel))
    if where.runs > 1 and not any(where.location("channel").shares.values()):
        return UnknownGap(NOWHERE, any_law(evidence))
    part = part_of(where, blocks)
    law = find_law(part)
    whole = judged.verdict is Verdict.UNKNOWN and not evidence.strays
    said = (shape(where, part), any_law(evidence) if whole else "")
    return UnknownGap(
        lives_in=place(where, blocks),
        shape=" ".join(one for one in said if one),
        expression="" if law is None else law.text,
        held_out=None if law is None else law.held_out,
    )
