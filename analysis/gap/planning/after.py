"""The next run after a diagnosis: for what it leaves open of the force, or of the position where this strays."""

from collections.abc import Iterator

from dragrig.analysis.gap.capsule_study import CapsuleStudy
from dragrig.analysis.gap.findings import Findings
from dragrig.analysis.gap.judging import Judgement
from dragrig.analysis.gap.known import HUM
from dragrig.analysis.gap.planning.coverage import NOTHING_FURTHER
from dragrig.analysis.gap.planning.position import recommend_in_position
from dragrig.analysis.gap.planning.recommend import recommend
from dragrig.analysis.gap.planning.results import NextExperiment
from dragrig.analysis.gap.planning.search import Budget
from dragrig.analysis.gap.position.finding import PositionFinding
from dragrig.analysis.gap.results import Verdict
from dragrig.analysis.gap.sentences import name_of
from dragrig.analysis.gap.study import Study


def next_after(
    study: Study, found: Findings, position: PositionFinding, judged: Judgement, of_force: Judgement, budget: Budget
) -> NextExperiment | None:
    """Recommend the run to make next; `of_force` is the verdict as if only the force had been looked at.

    Where an effect of the force is named beside one of the position, the run is for the more doubtful one.
    """
    if position.present:
        beside = set(judged.effects) & set(of_force.effects) - {HUM}
        if not beside or 1.0 - of_force.probabilities["+".join(of_force.effects)] <= _doubt(judged, position):
            return recommend_in_position(study, position, judged.probabilities, budget)
        judged = of_force
    gap = judged.verdict is not Verdict.NO_GAP
    return recommend(study, found.nominal, found.ranked, judged.probabilities, budget, gap=gap)


def nothing_further(
    study: Study, position: PositionFinding, judged: Judgement, found: NextExperiment | None
) -> Iterator[str]:
    """Say why no run is recommended where the position strays and what it is is in doubt."""
    if not position.present or found is not None or not isinstance(study, CapsuleStudy):
        return
    families = {one.effect for one in position.families}
    rivals = [one for one in judged.confusable_with if one in families]
    if judged.verdict is Verdict.UNKNOWN:
        yield NOTHING_FURTHER
    elif rivals:
        named = [one for one in judged.effects if one in families]
        yield f"No run that was compared would tell {name_of('+'.join(named))} from {name_of('+'.join(rivals))} either."


def _doubt(judged: Judgement, position: PositionFinding) -> float:
    """Return how doubtful the effect of the position is that was named, whatever is named beside it."""
    families = {one.effect for one in position.families}
    named = {one for one in judged.effects if one in families}
    return 1.0 - sum(each for one, each in judged.probabilities.items() if named & set(one.split("+")))
