"""Detection against size."""

from collections.abc import Sequence
from math import isfinite, sqrt

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.figures.header import headline
from dragrig.figures.panels import Pen, Place, add_panel, plain_log_x, write_words
from dragrig.figures.style import BLUE, GREEN, GREY, SMALL_PT, VERMILLION, drawing, new_figure
from dragrig.gap_scoring.detection import Detection
from dragrig.gap_scoring.rates import Rate

WIDTH_IN, HEIGHT_IN = 13.0, 5.6
LOWEST, SPREAD = 1.0, 0.035
"""d′ where the picture begins, and how far the three rates of a bin stand apart, as a power of ten."""
INVISIBLE = 3.0
SEEN, NAMED, MISLED = Pen("a gap is seen", GREEN, 2.0), Pen("the right name", BLUE, 2.0), Pen(
    "a wrong name", VERMILLION, 2.0
)  # fmt: skip


def exam_detection_figure(bins: Sequence[Detection]) -> Figure:
    """Draw how often single effects are seen, named rightly and named wrongly, against their d′."""
    with drawing():
        figure = new_figure(WIDTH_IN, HEIGHT_IN)
        headline(
            figure, 0.4, "Detection against size",
            "Single effects by d′: what they change beyond what specimens and runs may differ in, over the noise",
        )  # fmt: skip
        axes = add_panel(figure, Place(1.1, 0.85, WIDTH_IN - 1.6, HEIGHT_IN - 2.15))
        middles = [_middle(one) for one in bins]
        for pen, step, rates in (
            (SEEN, -1, [one.seen for one in bins]),
            (NAMED, 0, [one.named for one in bins]),
            (MISLED, 1, [one.misled for one in bins]),
        ):
            _draw(axes, [one * 10 ** (SPREAD * step) for one in middles], rates, pen.colour)
        axes.axvspan(LOWEST, INVISIBLE, color="#F0F1F3", linewidth=0)
        axes.set_ylim(-0.04, 1.28)
        axes.set_yticks([0.0, 0.25, 0.5, 0.75, 1.0])
        axes.set_ylabel("Share of campaigns")
        plain_log_x(axes, LOWEST, max([1000.0, *(3 * one for one in middles)]))
        axes.set_xlabel("d′ of the hidden effect (below 3 nobody can see it)")
        for one, middle in zip(bins, middles, strict=True):
            axes.annotate(str(one.seen.count), (middle, 1.08), ha="center", fontsize=SMALL_PT, color=GREY)
        write_words(axes, (SEEN, NAMED, MISLED))
        return figure


def _draw(axes: Axes, at: Sequence[float], rates: Sequence[Rate], colour: str) -> None:
    axes.plot(at, [one.share for one in rates], color=colour, linewidth=1.6, alpha=0.6)
    for x, one in zip(at, rates, strict=True):
        axes.plot([x, x], [one.low, one.high], color=colour, linewidth=2.4, alpha=0.45)
        axes.plot(x, one.share, "o", color=colour, markersize=7)


def _middle(one: Detection) -> float:
    low = max(one.low, LOWEST)
    return sqrt(low * one.high) if isfinite(one.high) else 2.0 * low
