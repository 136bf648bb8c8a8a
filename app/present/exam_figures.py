"""Figures of what a diagnosis tells apart: the isolability matrix of given runs, and the results of an exam.

Of an exam: rates, confusion matrix, detection curve, reliability diagram, promised shrink.
"""

from collections.abc import Sequence
from math import isfinite, sqrt
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from dragrig.analysis.gap import (
    CONFUSED_SIN2,
    DETECTABLE_D_PRIME,
    EffectPair,
    Isolability,
    display_name,
    isolability_sentences,
)
from dragrig.present import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    GRID,
    ORANGE,
    PALE,
    PAPER,
    SMALL_PT,
    TEXT_PT,
    VERMILLION,
    figure_style,
    new_figure,
    set_log_x,
)
from dragrig.scoring import ConfusionMatrix, DetectionBin, ProbabilityCalibration, PromiseScore

WHITE_TEXT_SHARE = 0.6
"""Cells with more than this share of a row have white numbers."""

_SHARE_COLOURS = LinearSegmentedColormap.from_list("shares", [PAPER, BLUE])


def exam_confusion_figure(confusion: ConfusionMatrix) -> Figure:
    """Draw counts of campaigns: a row for each hidden effect, a column for each diagnosis, framed where they agree."""
    hidden, predicted = (
        [_hypothesis_text(name) for name in names] for names in (confusion.hidden, confusion.predicted)
    )
    counts = np.array(confusion.counts, dtype=np.float64).reshape(len(hidden), len(predicted))
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1.0)
    with figure_style():
        figure = new_figure(
            max(0.4 * len(predicted) + 4.0, 9.0),
            0.4 * len(hidden) + 2.6,
            "Diagnosis against hidden effect",
            "Campaigns of all sizes; shaded by the share of the row, framed where both agree",
        )
        axes = figure.add_subplot()
        axes.imshow(shares, cmap=_SHARE_COLOURS, vmin=0.0, vmax=1.15, interpolation="nearest", aspect="equal")
        for row, column in np.argwhere(counts > 0).tolist():
            ink = PAPER if shares[row, column] > WHITE_TEXT_SHARE else BLACK
            axes.text(column, row, f"{counts[row, column]:.0f}", ha="center", va="center", color=ink, fontsize=SMALL_PT)
        for row, name in enumerate(confusion.hidden):
            if name in confusion.predicted:
                corner = confusion.predicted.index(name) - 0.5, row - 0.5
                axes.add_patch(Rectangle(corner, 1.0, 1.0, fill=False, edgecolor=GREY, linewidth=1.6))
        axes.set_xticks(range(len(predicted)), predicted, rotation=90)
        axes.set_yticks(range(len(hidden)), hidden)
        axes.set_xticks(np.arange(-0.5, len(predicted)), minor=True)
        axes.set_yticks(np.arange(-0.5, len(hidden)), minor=True)
        axes.xaxis.tick_top()
        axes.xaxis.set_label_position("top")
        axes.set_xlabel("diagnosis")
        axes.set_ylabel("hidden effect")
        axes.grid(visible=False)
        axes.grid(visible=True, which="minor", linewidth=0.6)
        axes.tick_params(which="both", length=0)
        return figure


def _hypothesis_text(name: str) -> str:
    return {"several": "several at once", "unknown": "unknown", "no_gap": "no gap"}.get(name, name.replace("_", " "))


MIN_D_PRIME, RATE_OFFSET = 1.0, 0.035
"""Lower end of the d′ axis, and distance of a bin's three rates on it, as a power of ten."""

INVISIBLE_D_PRIME = 3.0


def exam_detection_figure(bins: Sequence[DetectionBin]) -> Figure:
    """Draw how often single effects are seen, named rightly and named wrongly, against their d′."""
    with figure_style():
        figure = new_figure(
            13.0,
            4.6,
            "Detection against size",
            "Single effects by d′: their change beyond the differences of specimens and runs, over the noise",
        )
        axes = figure.add_subplot()
        middles = [_bin_middle(size) for size in bins]
        for word, colour, step, rates in (
            ("a gap is seen", GREEN, -1, [size.seen for size in bins]),
            ("the right name", BLUE, 0, [size.named for size in bins]),
            ("a wrong name", VERMILLION, 1, [size.misled for size in bins]),
        ):
            at = [middle * 10 ** (RATE_OFFSET * step) for middle in middles]
            axes.vlines(
                at, [rate.low for rate in rates], [rate.high for rate in rates], colour, linewidth=2.4, alpha=0.45
            )
            axes.plot(at, [rate.share for rate in rates], "o-", color=colour, linewidth=1.6, markersize=7, label=word)
        axes.axvspan(MIN_D_PRIME, INVISIBLE_D_PRIME, color="#F0F1F3", linewidth=0)
        axes.set_ylim(-0.04, 1.15)
        axes.set_yticks([0.0, 0.25, 0.5, 0.75, 1.0])
        axes.set_ylabel("Share of campaigns")
        set_log_x(axes, MIN_D_PRIME, max([1000.0, *(3 * middle for middle in middles)]))
        axes.set_xlabel("d′ of the hidden effect (below 3 not detectable)")
        for size, middle in zip(bins, middles, strict=True):
            axes.annotate(str(size.seen.count), (middle, 1.08), ha="center", fontsize=SMALL_PT, color=GREY)
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
        return figure


def _bin_middle(size: DetectionBin) -> float:
    low = max(size.low, MIN_D_PRIME)
    return sqrt(low * size.high) if isfinite(size.high) else 2.0 * low


def exam_reliability_figure(calibration: ProbabilityCalibration) -> Figure:
    """Draw the share of right verdicts against their stated probability, with its scatter by chance."""
    with figure_style():
        figure = new_figure(
            9.0,
            6.4,
            "Calibration of the stated probability",
            "Verdicts by their probability; bands hold 95 % if every probability were true (binomial)",
        )
        axes = _diagonal_panel(figure, 0.0, 1.03)
        for verdicts in calibration.reliability:
            axes.vlines(verdicts.probability, *verdicts.band, PALE, linewidth=11, alpha=0.6)
            axes.plot(verdicts.probability, verdicts.share, "o", color=BLUE, markersize=9, clip_on=False)
        counts = axes.secondary_xaxis("top")
        at = [verdicts.probability for verdicts in calibration.reliability]
        words = [f"{verdicts.right} of {verdicts.count}" for verdicts in calibration.reliability]
        counts.set_xticks(at, words, rotation=90, color=GREY)
        counts.tick_params(length=0)
        counts.spines["top"].set_visible(False)
        axes.set_xlabel("Stated probability of the verdict, mean of the bin")
        axes.set_ylabel("Share that is right")
        return figure


def exam_promises_figure(promises: PromiseScore) -> Figure:
    """Draw the share of the gap that closes on fresh runs against the predicted one."""
    outcomes = promises.outcomes
    low = max(min([0.6, *(min(outcome.promised, outcome.achieved) for outcome in outcomes)]) - 0.05, -1.0)
    with figure_style():
        figure = new_figure(
            9.0,
            6.4,
            "Gap closure: predicted, and on fresh runs",
            "Share of the gap that closes; fresh runs: the same specimen at other speeds and strains",
        )
        axes = _diagonal_panel(figure, low, 1.05)
        for right, colour, marker, word in ((True, BLUE, "o", "right name"), (False, ORANGE, "s", "wrong name")):
            alike = [outcome for outcome in outcomes if outcome.right is right]
            x = [max(outcome.promised, low) for outcome in alike]
            y = [max(outcome.achieved, low) for outcome in alike]
            for outcome, achieved in zip(alike, y, strict=True):
                if outcome.interval is not None:
                    ends = max(outcome.interval[0], low), outcome.interval[1]
                    axes.hlines(achieved, *ends, colour, linewidth=1.4, alpha=0.4)
            words = f"{word} ({len(alike)})"
            axes.plot(x, y, marker, color=colour, markersize=7, alpha=0.75, label=words, clip_on=False)
        axes.set_xlabel("Predicted, on held-out runs (with 95 % interval)")
        axes.set_ylabel("Achieved on fresh runs")
        axes.legend(fontsize=TEXT_PT)
        return figure


def _diagonal_panel(figure: Figure, low: float, high: float) -> Axes:
    """Return axes with the same limits both ways and their diagonal."""
    axes = figure.add_subplot(xlim=(low, high), ylim=(low, high))
    axes.axline((low, low), slope=1.0, color=GREY, linewidth=1.2, linestyle=(0, (5, 3)))
    return axes


CELL_PT = 10.5

FAINTEST_D_PRIME = 1000.0
"""d′ at which a cell is white."""

WHITE_TEXT_SHADE = 0.55
"""Shades darker than this have white text."""

_SIMILARITY_COLOURS = LinearSegmentedColormap.from_list("near", [PAPER, "#BFD9EA", BLUE, "#002B45"])


def isolability_figure(isolability: Isolability) -> Figure:
    """Draw every pair of effects of the force: sin² below the diagonal, d′ above it.

    Dark cells are similar; a thick frame marks pairs that the runs hardly distinguish.
    """
    names = [visibility.effect for visibility in isolability.visible_in("force")]
    legend = (
        f"Below the diagonal: 100 sin² of the angle, 0 for indistinguishable effects. Framed: below "
        f"{100 * CONFUSED_SIN2:.0f}, or d′ below {DETECTABLE_D_PRIME:g}.\n"
        "Above: d′ between the two at their default sizes. Dark: similar. The catalogue's effects of the force only."
    )
    with figure_style():
        side = 0.56 * max(len(names), 1) + 3.2
        title = f"Effects that {Path(isolability.source).absolute().name} can distinguish"
        figure = new_figure(max(side, 10.0), side + 0.7, title, isolability_sentences(isolability)[0])
        axes = figure.add_subplot(aspect="equal")
        for row, effect in enumerate(names):
            axes.add_patch(Rectangle((row - 0.5, row - 0.5), 1, 1, facecolor=PALE, edgecolor=GRID))
            axes.text(row, row, str(row + 1), ha="center", va="center", fontsize=CELL_PT, weight="bold")
            for column, column_effect in enumerate(names[:row]):
                pair = isolability.pair(effect, column_effect)
                if pair is not None:
                    _draw_pair_cells(axes, row, column, pair)
        _set_effect_ticks(axes, [f"{number} {display_name(effect)}" for number, effect in enumerate(names, 1)])
        figure.supxlabel(legend, x=0.03, ha="left", fontsize=SMALL_PT, color=GREY)
        return figure


def _draw_pair_cells(axes: Axes, row: int, column: int, pair: EffectPair) -> None:
    near = 1.0 - float(np.sqrt(max(pair.sin2, 0.0)))
    _draw_cell(axes, column, row, near, f"{100 * pair.sin2:.0f}", framed=pair.confused)
    shade = Normalize(np.log(DETECTABLE_D_PRIME), np.log(FAINTEST_D_PRIME), clip=True)
    weak = 1.0 - float(shade(np.log(max(pair.separation, 1e-3))))
    _draw_cell(axes, row, column, weak, f"{pair.separation:.0f}", framed=pair.confused)


def _draw_cell(axes: Axes, x: int, y: int, shade: float, text: str, *, framed: bool) -> None:
    axes.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=_SIMILARITY_COLOURS(shade), edgecolor=GRID))
    if framed:
        frame = Rectangle((x - 0.46, y - 0.46), 0.92, 0.92, fill=False, edgecolor=BLACK, linewidth=2.4, zorder=3)
        axes.add_patch(frame)
    colour = "white" if shade > WHITE_TEXT_SHADE else BLACK if shade > 0.05 else GREY
    axes.text(x, y, text, ha="center", va="center", fontsize=CELL_PT, color=colour, zorder=4)


def _set_effect_ticks(axes: Axes, words: list[str]) -> None:
    axes.set_xlim(-0.5, max(len(words), 1) - 0.5)
    axes.set_ylim(max(len(words), 1) - 0.5, -0.5)
    axes.set_yticks(range(len(words)), words, fontsize=TEXT_PT)
    axes.xaxis.tick_top()
    axes.set_xticks(range(len(words)), words, fontsize=TEXT_PT, rotation=90)
    axes.tick_params(length=0)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
