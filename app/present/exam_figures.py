"""Figures of an exam: rates, confusion matrix, detection curve, reliability diagram, promised shrink."""

from collections.abc import Sequence
from math import isfinite, sqrt

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from dragrig.present import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PALE,
    PAPER,
    SMALL_PT,
    TEXT_PT,
    VERMILLION,
    LineStyle,
    PanelBox,
    add_panel,
    figure_style,
    new_figure,
    set_log_x,
    text_width_in,
    write_legend,
    write_title,
)
from dragrig.scoring import ConfusionMatrix, DetectionBin, ProbabilityCalibration, PromiseScore, Rate

RATES_WIDTH_IN, RATES_ROW_IN, RATES_HEAD_IN, RATES_FOOT_IN, RATES_LEFT_IN, RATES_RIGHT_IN = (
    13.0,
    0.36,
    1.25,
    0.8,
    0.4,
    1.9,
)


def exam_rates_figure(rates: Sequence[Rate]) -> Figure:
    """Draw every rate that has cases: its share, its 95 % interval, and from how many campaigns it is."""
    shown = [one for one in rates if one.count]
    with figure_style():
        left = RATES_LEFT_IN + max((text_width_in(one.name, TEXT_PT) for one in shown), default=1.0) + 0.25
        tall = RATES_ROW_IN * max(len(shown), 1)
        figure = new_figure(RATES_WIDTH_IN, RATES_HEAD_IN + tall + RATES_FOOT_IN)
        write_title(
            figure, RATES_LEFT_IN, "How often the diagnosis is right", "Share of campaigns, with 95 % interval (Wilson)"
        )
        axes = add_panel(figure, PanelBox(left, RATES_FOOT_IN, RATES_WIDTH_IN - left - RATES_RIGHT_IN, tall))
        for row, one in enumerate(shown):
            axes.plot([one.low, one.high], [row, row], color=BLUE, linewidth=3.0, alpha=0.45, solid_capstyle="butt")
            axes.plot(one.share, row, "o", color=BLUE, markersize=8, clip_on=False)
            text = f"{one.share:.2f}   {one.held} of {one.count}"
            axes.annotate(
                text, (1.0, row), (14, 0), xycoords=("axes fraction", "data"), textcoords="offset points",
                va="center", fontsize=SMALL_PT, color=BLACK,
            )  # fmt: skip
        axes.set_yticks(range(len(shown)), [one.name for one in shown], fontsize=TEXT_PT)
        axes.set_ylim(max(len(shown), 1) - 0.5, -0.5)
        axes.set_xlim(0.0, 1.0)
        axes.set_xlabel("Share")
        axes.tick_params(axis="y", length=0, pad=10)
        axes.spines["left"].set_color(GREY)
        return figure


CONFUSION_CELL_IN, CONFUSION_HEAD_IN, CONFUSION_LEFT_IN, CONFUSION_FOOT_IN, CONFUSION_LEAST_WIDE_IN = (
    0.40,
    1.3,
    0.4,
    0.45,
    9.0,
)

_SHARE_COLOURS = LinearSegmentedColormap.from_list("shares", [PAPER, BLUE])


def exam_confusion_figure(confusion: ConfusionMatrix) -> Figure:
    """Draw counts of campaigns: a row for what was hidden, a column for what was said, framed where they agree."""
    hidden, said = (
        [_hypothesis_text(one) for one in confusion.hidden],
        [_hypothesis_text(one) for one in confusion.said],
    )
    counts = np.array(confusion.counts, dtype=np.float64).reshape(len(hidden), len(said))
    with figure_style():
        left = CONFUSION_LEFT_IN + max((text_width_in(one, SMALL_PT) for one in hidden), default=1.0) + 0.65
        above = max((text_width_in(one, SMALL_PT) for one in said), default=1.0) + 0.55
        wide, tall = CONFUSION_CELL_IN * max(len(said), 1), CONFUSION_CELL_IN * max(len(hidden), 1)
        figure = new_figure(
            max(left + wide + CONFUSION_LEFT_IN, CONFUSION_LEAST_WIDE_IN),
            CONFUSION_HEAD_IN + above + tall + CONFUSION_FOOT_IN,
        )
        write_title(
            figure, CONFUSION_LEFT_IN, "What was said of what was hidden",
            "Campaigns of all sizes; shaded by the share of the row, framed where both agree",
        )  # fmt: skip
        axes = add_panel(figure, PanelBox(left, CONFUSION_FOOT_IN, wide, tall))
        totals = np.maximum(counts.sum(axis=1, keepdims=True), 1.0)
        axes.imshow(counts / totals, cmap=_SHARE_COLOURS, vmin=0.0, vmax=1.15, aspect="auto", interpolation="nearest")
        for row, name in enumerate(confusion.hidden):
            for column, other in enumerate(confusion.said):
                if counts[row, column]:
                    ink = PAPER if counts[row, column] > 0.6 * totals[row, 0] else BLACK
                    axes.text(column, row, f"{counts[row, column]:.0f}", ha="center", va="center", color=ink,
                              fontsize=SMALL_PT)  # fmt: skip
                if name == other:
                    axes.add_patch(_agreement_frame(column, row))
        axes.xaxis.tick_top()
        axes.xaxis.set_label_position("top")
        axes.set_xticks(range(len(said)), said, rotation=90, fontsize=SMALL_PT)
        axes.set_yticks(range(len(hidden)), hidden, fontsize=SMALL_PT)
        axes.set_xlabel("said")
        axes.set_ylabel("hidden")
        axes.tick_params(length=0)
        axes.grid(visible=False)
        axes.set_xticks(np.arange(-0.5, len(said)), minor=True)
        axes.set_yticks(np.arange(-0.5, len(hidden)), minor=True)
        axes.grid(visible=True, which="minor", linewidth=0.6)
        axes.tick_params(which="minor", length=0)
        return figure


def _agreement_frame(column: int, row: int) -> Rectangle:
    return Rectangle((column - 0.5, row - 0.5), 1.0, 1.0, fill=False, edgecolor=GREY, linewidth=1.6)


def _hypothesis_text(name: str) -> str:
    return {"several": "several at once", "unknown": "unknown", "no_gap": "no gap"}.get(name, name.replace("_", " "))


DETECTION_WIDTH_IN, DETECTION_HEIGHT_IN = 13.0, 5.6

MIN_D_PRIME, RATE_OFFSET = 1.0, 0.035
"""d′ where the picture begins, and how far the three rates of a bin stand apart, as a power of ten."""

INVISIBLE_D_PRIME = 3.0

SEEN_LINE = LineStyle("a gap is seen", GREEN, 2.0)

NAMED_LINE = LineStyle("the right name", BLUE, 2.0)

MISLED_LINE = LineStyle("a wrong name", VERMILLION, 2.0)


def exam_detection_figure(bins: Sequence[DetectionBin]) -> Figure:
    """Draw how often single effects are seen, named rightly and named wrongly, against their d′."""
    with figure_style():
        figure = new_figure(DETECTION_WIDTH_IN, DETECTION_HEIGHT_IN)
        write_title(
            figure, 0.4, "Detection against size",
            "Single effects by d′: what they change beyond what specimens and runs may differ in, over the noise",
        )  # fmt: skip
        axes = add_panel(figure, PanelBox(1.1, 0.85, DETECTION_WIDTH_IN - 1.6, DETECTION_HEIGHT_IN - 2.15))
        middles = [_bin_middle(one) for one in bins]
        for pen, step, rates in (
            (SEEN_LINE, -1, [one.seen for one in bins]),
            (NAMED_LINE, 0, [one.named for one in bins]),
            (MISLED_LINE, 1, [one.misled for one in bins]),
        ):
            _draw_rates(axes, [one * 10 ** (RATE_OFFSET * step) for one in middles], rates, pen.colour)
        axes.axvspan(MIN_D_PRIME, INVISIBLE_D_PRIME, color="#F0F1F3", linewidth=0)
        axes.set_ylim(-0.04, 1.28)
        axes.set_yticks([0.0, 0.25, 0.5, 0.75, 1.0])
        axes.set_ylabel("Share of campaigns")
        set_log_x(axes, MIN_D_PRIME, max([1000.0, *(3 * one for one in middles)]))
        axes.set_xlabel("d′ of the hidden effect (below 3 nobody can see it)")
        for one, middle in zip(bins, middles, strict=True):
            axes.annotate(str(one.seen.count), (middle, 1.08), ha="center", fontsize=SMALL_PT, color=GREY)
        write_legend(axes, (SEEN_LINE, NAMED_LINE, MISLED_LINE))
        return figure


def _draw_rates(axes: Axes, at: Sequence[float], rates: Sequence[Rate], colour: str) -> None:
    axes.plot(at, [one.share for one in rates], color=colour, linewidth=1.6, alpha=0.6)
    for x, one in zip(at, rates, strict=True):
        axes.plot([x, x], [one.low, one.high], color=colour, linewidth=2.4, alpha=0.45)
        axes.plot(x, one.share, "o", color=colour, markersize=7)


def _bin_middle(one: DetectionBin) -> float:
    low = max(one.low, MIN_D_PRIME)
    return sqrt(low * one.high) if isfinite(one.high) else 2.0 * low


RELIABILITY_WIDTH_IN, RELIABILITY_HEIGHT_IN, RELIABILITY_SIDE_IN = 9.0, 7.4, 5.6


def exam_reliability_figure(calibration: ProbabilityCalibration) -> Figure:
    """Draw the share of right verdicts against their stated probability, with what chance alone would do to it."""
    with figure_style():
        figure = new_figure(RELIABILITY_WIDTH_IN, RELIABILITY_HEIGHT_IN)
        write_title(
            figure, 0.4, "What a probability is worth",
            "Verdicts by their probability; bands hold 95 % if every probability were true (binomial)",
        )  # fmt: skip
        axes = add_panel(figure, PanelBox(1.1, 0.8, RELIABILITY_WIDTH_IN - 1.6, RELIABILITY_SIDE_IN - 0.3))
        axes.plot([0, 1], [0, 1], color=GREY, linewidth=1.2, linestyle=(0, (5, 3)))
        for one in calibration.reliability:
            axes.plot([one.probability] * 2, one.band, color=PALE, linewidth=11, alpha=0.6, solid_capstyle="butt")
            axes.plot(one.probability, one.share, "o", color=BLUE, markersize=9, clip_on=False)
            words = f"{one.right} of {one.count}"
            axes.text(one.probability, 0.02, words, rotation=90, ha="center", fontsize=SMALL_PT, color=GREY)
        axes.set_xlim(0.0, 1.02)
        axes.set_ylim(0.0, 1.04)
        axes.set_xlabel("Stated probability of the verdict, mean of the bin")
        axes.set_ylabel("Share that is right")
        return figure


def exam_promises_figure(promises: PromiseScore) -> Figure:
    """Draw the share of the gap that closes on fresh runs against the one that was promised."""
    with figure_style():
        figure = new_figure(RELIABILITY_WIDTH_IN, RELIABILITY_HEIGHT_IN)
        write_title(
            figure, 0.4, "What was promised, and what fresh runs show",
            "Share of the gap that closes; fresh runs: the same specimen at other speeds and strains",
        )  # fmt: skip
        axes = add_panel(figure, PanelBox(1.1, 0.8, RELIABILITY_WIDTH_IN - 1.6, RELIABILITY_SIDE_IN - 0.3))
        low = max(min([0.6, *(min(one.promised, one.achieved) for one in promises.outcomes)]) - 0.05, -1.0)
        axes.plot([low, 1.05], [low, 1.05], color=GREY, linewidth=1.2, linestyle=(0, (5, 3)))
        for right, colour, marker, word in ((True, BLUE, "o", "right name"), (False, ORANGE, "s", "wrong name")):
            there = [one for one in promises.outcomes if one.right is right]
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
