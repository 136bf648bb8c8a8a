"""What further runs say of effects of the force."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

from dragrig.analysis.gap.design import Design, lay_out
from dragrig.analysis.gap.planning.contests import Ground, Question, columns_of, contest, log_odds
from dragrig.analysis.gap.planning.imagined import imagined
from dragrig.analysis.gap.planning.results import NextRun
from dragrig.analysis.gap.planning.search import Answer, Budget, search
from dragrig.analysis.gap.planning.trials import Trial
from dragrig.analysis.gap.study import Study
from dragrig.rig.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ForceField:
    """What runs say of the shapes of effects, and what is asked."""

    ground: Ground
    questions: tuple[Question, ...]

    def with_run(self, seen: FloatArray) -> Self:
        """Add a run by its Gram matrix."""
        return replace(self, ground=self.ground.with_run(seen))

    def answers(self) -> tuple[Answer, ...]:
        """Return how far each question is answered."""
        gram = self.ground.projected()
        decided = [contest(self.ground, gram, one) for one in self.questions]
        return tuple(
            Answer(one, log_odds(one), asked.weight) for one, asked in zip(decided, self.questions, strict=True)
        )


def search_in_force(
    study: Study, design: Design, questions: Sequence[Question], trials: Sequence[Trial], budget: Budget
) -> tuple[NextRun, ...]:
    """Return the runs that answer most of what is asked of the force, each the best after those before.

    Parameters
    ----------
    study, design
        The campaign, and its design with the dictionary around the point that nominal parameters came to.
    questions
        Contests with their weights; at least one.
    """
    effects = _effects(study, questions)
    grams = _grams(replace(study, effects=tuple(one for one in study.effects if one.id in effects)), design, trials)
    field = ForceField(Ground.of(design, effects), tuple(questions))
    return search(field, list(zip(trials, grams, strict=True)), budget)


def _effects(study: Study, questions: Sequence[Question]) -> list[str]:
    named = {one.truth.effect for one in questions} | {one.rival for one in questions}
    return [one.id for one in study.effects if one.id in named]


def _grams(study: Study, design: Design, trials: Sequence[Trial]) -> list[FloatArray]:
    laid_out = lay_out(imagined(study, trials), design.z, dictionary=True)
    rows = columns_of(laid_out, [one.id for one in study.effects]).tolist()
    return [one[rows][:, rows] for one in laid_out.grams]
