"""Whether probabilities mean what they say, and whether promises were kept."""

from matplotlib.figure import Figure

from dragrig.figures.header import headline
from dragrig.figures.panels import Place, add_panel
from dragrig.figures.style import BLUE, GREY, ORANGE, PALE, SMALL_PT, drawing, new_figure
from dragrig.gap_scoring.calibration import Calibration
from dragrig.gap_scoring.promises import Promises

WIDTH_IN, HEIGHT_IN, SIDE_IN = 9.0, 7.4, 5.6


def exam_reliability_figure(calibration: Calibration) -> Figure:
    """Draw the share of right verdicts against their stated probability, with what chance alone would do to it."""
    with drawing():
        figure = new_figure(WIDTH_IN, HEIGHT_IN)
        headline(
            figure, 0.4, "What a probability is worth",
            "Verdicts by their probability; bands hold 95 % if every probability were true (binomial)",
        )  # fmt: skip
        axes = add_panel(figure, Place(1.1, 0.8, WIDTH_IN - 1.6, SIDE_IN - 0.3))
        axes.plot([0, 1], [0, 1], color=GREY, linewidth=1.2, linestyle=(0, (5, 3)))
        for one in calibration.bins:
            axes.plot([one.probability] * 2, one.band, color=PALE, linewidth=11, alpha=0.6, solid_capstyle="butt")
            axes.plot(one.probability, one.share, "o", color=BLUE, markersize=9, clip_on=False)
            words = f"{one.right} of {one.count}"
            axes.text(one.probability, 0.02, words, rotation=90, ha="center", fontsize=SMALL_PT, color=GREY)
        axes.set_xlim(0.0, 1.02)
        axes.set_ylim(0.0, 1.04)
        axes.set_xlabel("Stated probability of the verdict, mean of the bin")
        axes.set_ylabel("Share that is right")
        return figure


def exam_promises_figure(promises: Promises) -> Figure:
    """Draw the share of the gap that closes on fresh runs against the one that was promised."""
    with drawing():
        figure = new_figure(WIDTH_IN, HEIGHT_IN)
        headline(
            figure, 0.4, "What was promised, and what fresh runs show",
            "Share of the gap that closes; fresh runs: the same specimen at other speeds and strains",
        )  # fmt: skip
        axes = add_panel(figure, Place(1.1, 0.8, WIDTH_IN - 1.6, SIDE_IN - 0.3))
        low = max(min([0.6, *(min(one.promised, one.achieved) for one in promises.kept)]) - 0.05, -1.0)
        axes.plot([low, 1.05], [low, 1.05], color=GREY, linewidth=1.2, linestyle=(0, (5, 3)))
        for right, colour, marker, word in ((True, BLUE, "o", "right name"), (False, ORANGE, "s", "wrong name")):
            there = [one for one in promises.kept if one.right is right]
            for one in there:
                if one.interval is not None:
                    axes.plot([max(one.interval[0], low), one.interval[1]], [max(one.achieved, low)] * 2, color=colour,
                              linewidth=1.4, alpha=0.4)  # fmt: skip
            axes.plot([max(one.promised, low) for one in there], [max(one.achieved, low) for one in there], marker,
                      color=colour, markersize=7, alpha=0.75, linestyle="none", label=f"{word} ({len(there)})",
                      clip_on=False)  # fmt: skip
        axes.set_xlim(low, 1.05)
        axes.set_ylim(low, 1.05)
        axes.set_xlabel("Promised, on runs held out (with 95 % interval)")
        axes.set_ylabel("Achieved on fresh runs")
        axes.legend(loc="upper left", frameon=False)
        return figure
