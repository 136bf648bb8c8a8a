"""The figures of an exam."""

from dragrig.figures.exam_confusion import exam_confusion_figure
from dragrig.figures.exam_detection import exam_detection_figure
from dragrig.figures.exam_rates import exam_rates_figure
from dragrig.figures.exam_reliability import exam_promises_figure, exam_reliability_figure
from dragrig.gap_scoring import Score
from dragrig.reports.embedding import Picture, embedded


def pictures(score: Score) -> dict[str, Picture]:
    """Draw all figures; those without anything to show are missing."""
    drawn = {
        "rates": embedded(
            exam_rates_figure((*score.rates, *score.withheld)),
            "A row for each rate: its share and its interval.",
            "Of “a name above 0.5” and “wrong above 0.8” less is better; of all others, more.",
        ),
        "confusion": embedded(
            exam_confusion_figure(score.confusion),
            "A table of counts: what was said, by what was hidden.",
            "Of an effect at a tenth of its size, no gap is right too; unknown is right where the catalogue does not "
            "have what is hidden.",
        ),
    }
    if score.detection:
        drawn["detection"] = embedded(
            exam_detection_figure(score.detection),
            "Three curves over the size of an effect: a gap is seen, the right name, a wrong name.",
            "Numbers above: campaigns of the bin. Bars hold 95 % (Wilson). Campaigns whose nominal model is slightly "
            "wrong are left out.",
        )
    if score.calibration.bins:
        drawn["reliability"] = embedded(
            exam_reliability_figure(score.calibration),
            "Points near a diagonal: the share of right verdicts over their probability.",
            "A point above its band: more verdicts are right than was stated; below it, fewer.",
        )
    if score.promises.kept:
        drawn["promises"] = embedded(
            exam_promises_figure(score.promises),
            "Points near a diagonal: the achieved share of the gap over the promised one.",
            "A campaign each. On the line, a promise was kept; below it, it was not.",
        )
    return drawn
