"""What was said against what was hidden."""

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from dragrig.figures.header import headline
from dragrig.figures.panels import Place, add_panel
from dragrig.figures.style import BLACK, BLUE, GREY, PAPER, SMALL_PT, drawing, new_figure, text_width_in
from dragrig.gap_scoring.confusion import Confusion

CELL_IN, HEAD_IN, LEFT_IN, FOOT_IN, LEAST_WIDE_IN = 0.40, 1.3, 0.4, 0.45, 9.0
_SHADES = LinearSegmentedColormap.from_list("shares", [PAPER, BLUE])


def exam_confusion_figure(confusion: Confusion) -> Figure:
    """Draw counts of campaigns: a row for what was hidden, a column for what was said, framed where they agree."""
    hidden, said = [_spelled(one) for one in confusion.hidden], [_spelled(one) for one in confusion.said]
    counts = np.array(confusion.counts, dtype=np.float64).reshape(len(hidden), len(said))
    with drawing():
        left = LEFT_IN + max((text_width_in(one, SMALL_PT) for one in hidden), default=1.0) + 0.65
        above = max((text_width_in(one, SMALL_PT) for one in said), default=1.0) + 0.55
        wide, tall = CELL_IN * max(len(said), 1), CELL_IN * max(len(hidden), 1)
        figure = new_figure(max(left + wide + LEFT_IN, LEAST_WIDE_IN), HEAD_IN + above + tall + FOOT_IN)
        headline(
            figure, LEFT_IN, "What was said of what was hidden",
            "Campaigns of all sizes; shaded by the share of the row, framed where both agree",
        )  # fmt: skip
        axes = add_panel(figure, Place(left, FOOT_IN, wide, tall))
        totals = np.maximum(counts.sum(axis=1, keepdims=True), 1.0)
        axes.imshow(counts / totals, cmap=_SHADES, vmin=0.0, vmax=1.15, aspect="auto", interpolation="nearest")
        for row, name in enumerate(confusion.hidden):
            for column, other in enumerate(confusion.said):
                if counts[row, column]:
                    ink = PAPER if counts[row, column] > 0.6 * totals[row, 0] else BLACK
                    axes.text(column, row, f"{counts[row, column]:.0f}", ha="center", va="center", color=ink,
                              fontsize=SMALL_PT)  # fmt: skip
                if name == other:
                    axes.add_patch(_frame(column, row))
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


def _frame(column: int, row: int) -> Rectangle:
    return Rectangle((column - 0.5, row - 0.5), 1.0, 1.0, fill=False, edgecolor=GREY, linewidth=1.6)


def _spelled(name: str) -> str:
    return {"several": "several at once", "unknown": "unknown", "no_gap": "no gap"}.get(name, name.replace("_", " "))
