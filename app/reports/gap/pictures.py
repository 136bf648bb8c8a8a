"""The figures of a gap report."""

from dragrig.analysis.gap.results import Diagnosis
from dragrig.figures.gap_before_after import gap_before_after_figure, representative
from dragrig.figures.gap_ranking import gap_ranking_figure
from dragrig.figures.gap_where import where_figure
from dragrig.reports.embedding import Picture, embedded


def pictures(diagnosis: Diagnosis) -> dict[str, Picture]:
    """Draw all figures; runs are missing where the diagnosis has no views of them."""
    drawn = {
        "where": embedded(
            where_figure(diagnosis.where),
            "A map of channels, protocols and phases; below it, shares of the excess along speed, position, session, "
            "strain and frequency.",
            "Above, how far each channel exceeds what is expected of it, in standard deviations, and how much of the "
            "residual each domain accounts for. Below, shares of the excess, in colour where they stand out.",
        ),
        "ranking": embedded(
            gap_ranking_figure(diagnosis),
            "Horizontal bars: the probability of each hypothesis, the most probable first.",
            "Probability of each hypothesis that is not next to impossible.",
        ),
    }
    views = representative(diagnosis.views)
    if views:
        floor = None if diagnosis.shrink is None else diagnosis.shrink.noise_floor_mN
        drawn["before-after"] = embedded(
            gap_before_after_figure(views, floor, named=bool(diagnosis.effects)),
            "A row for each run: left, the measurement and what the model says; right, what is left of it.",
            "Drags at the lowest, a middle and the highest speed, and of each other kind the run that the model "
            "without an effect explains worst. The grey band is noise and scatter of repeats.",
        )
    return drawn
