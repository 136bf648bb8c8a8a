"""Judge campaigns by what others teach: how good a calibration is, without an exam of its own."""

from collections.abc import Sequence

from dragrig.analysis.gap.calibration import Calibration
from dragrig.analysis.gap.judging import Judgement, judge
from dragrig.analysis.gap.learning import Lesson, learn_gate, learn_weights

FOLDS = 10


def judged_in_turn(lessons: Sequence[Lesson], tolerance_mN: float, folds: int = FOLDS) -> tuple[Judgement, ...]:
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
        _learnt([one for at, one in enumerate(lessons) if at % folds != fold], tolerance_mN) for fold in range(folds)
    ]
    return tuple(judge(one.evidence, tolerance_mN, learnt[at % folds]) for at, one in enumerate(lessons))


def _learnt(lessons: Sequence[Lesson], tolerance_mN: float) -> Calibration:
    gate, weights = learn_gate(lessons, tolerance_mN), learn_weights(lessons, tolerance_mN)
    return Calibration(version=0, command="", seeds=(), cases=len(lessons), gate=gate, weights=weights)
