"""The search for the runs that answer most per minute: one by one, the best of a grid each time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from dragrig.analysis.gap.design import Design, lay_out
from dragrig.analysis.gap.planning.contests import ENOUGH, Ground, Question, columns_of, contest, log_odds, worth
from dragrig.analysis.gap.planning.imagined import imagined
from dragrig.analysis.gap.planning.results import Contest, NextRun
from dragrig.analysis.gap.planning.trials import Limits, Trial
from dragrig.analysis.gap.study import Study
from dragrig.config.specimen import Fixture
from dragrig.rig.arrays import FloatArray

LEAST_GAIN = 1e-3
"""Less than this, in log odds, is nothing."""
UNBOUNDED = float("inf")
HANDS_MIN = 2.0
"""What changing to another fixture counts beside the rig time."""


@dataclass(frozen=True, slots=True)
class Budget:
    """How much rig time, how many runs, and when nothing more is wanted.

    Attributes
    ----------
    enough
        Log odds beyond which a contest is decided.
    spent_whole
        Whether time that is left once all is decided is spent on making it surer.
    limits
        Of the rig; what the campaign's own runs say unless given.
    """

    minutes: float = float("inf")
    runs: int = 1
    enough: float = ENOUGH
    spent_whole: bool = False
    limits: Limits | None = None


def search(
    study: Study, design: Design, questions: Sequence[Question], trials: Sequence[Trial], budget: Budget
) -> tuple[NextRun, ...]:
    """Return the runs that answer most, each the best after those before.

    Parameters
    ----------
    study, design
        The campaign, and its design with the dictionary around the point that nominal parameters came to.
    questions
        Contests with their weights; at least one.
    """
    effects = _effects(study, questions)
    ground = Ground.of(design, effects)
    grams = _grams(replace(study, effects=tuple(one for one in study.effects if one.id in effects)), design, trials)
    found = _chosen(ground, questions, list(zip(trials, grams, strict=True)), budget)
    if not found and budget.enough < UNBOUNDED:
        # All is answered well enough already; what would make it surer still is told all the same.
        surer = replace(budget, enough=UNBOUNDED)
        more = _gathered(_chosen(ground, questions, list(zip(trials, grams, strict=True)), surer))
        return tuple(replace(one, surer=True) for one in more)
    return _gathered(found)


def _chosen(
    ground: Ground, questions: Sequence[Question], tried: Sequence[tuple[Trial, FloatArray]], budget: Budget
) -> list[tuple[Trial, Contest, Contest]]:
    chosen: list[tuple[Trial, Contest, Contest]] = []
    spent, fitted, enough = 0.0, set[Fixture](), budget.enough
    while len(chosen) < budget.runs:
        now = worth(ground, questions, enough)
        best, most = None, 0.0
        for trial, gram in tried:
            if spent + trial.minutes > budget.minutes:
                continue
            gain = worth(ground.with_run(gram), questions, enough) - now
            by_hand = 0.0 if trial.run.fixture in fitted else HANDS_MIN
            if gain > LEAST_GAIN and gain / (trial.minutes + by_hand) > most:
                best, most = (trial, gram), gain / (trial.minutes + by_hand)
        if best is None and budget.spent_whole and enough < UNBOUNDED:
            enough = UNBOUNDED
            continue
        if best is None:
            break
        trial, gram = best
        after = ground.with_run(gram)
        chosen.append((trial, *_decided(ground, after, questions, enough)))
        ground, spent = after, spent + trial.minutes
        fitted.add(trial.run.fixture)
    return chosen


def _effects(study: Study, questions: Sequence[Question]) -> list[str]:
    named = {one.truth.effect for one in questions} | {one.rival for one in questions}
    return [one.id for one in study.effects if one.id in named]


def _grams(study: Study, design: Design, trials: Sequence[Trial]) -> list[FloatArray]:
    laid_out = lay_out(imagined(study, trials), design.z, dictionary=True)
    rows = columns_of(laid_out, [one.id for one in study.effects]).tolist()
    return [one[rows][:, rows] for one in laid_out.grams]


def _decided(before: Ground, after: Ground, questions: Sequence[Question], enough: float) -> tuple[Contest, Contest]:
    """Return the contest that a run decides most, before and after."""
    earlier, later = before.projected(), after.projected()
    pairs = [(contest(before, earlier, one), contest(after, later, one)) for one in questions]

    def gain(place: int) -> float:
        first, second = pairs[place]
        return questions[place].weight * (min(log_odds(second), enough) - min(log_odds(first), enough))

    return pairs[max(range(len(pairs)), key=gain)]


def _gathered(chosen: Sequence[tuple[Trial, Contest, Contest]]) -> tuple[NextRun, ...]:
    """Make repeats of what was chosen several times."""
    found: dict[int, NextRun] = {}
    for trial, before, after in chosen:
        known = found.get(id(trial))
        if known is None:
            found[id(trial)] = NextRun(trial.step, trial.minutes, before, after)
            continue
        step = known.step.model_copy(update={"repeats": known.step.repeats + 1})
        found[id(trial)] = replace(known, step=step, minutes=known.minutes + trial.minutes, after=after)
    return tuple(found.values())
