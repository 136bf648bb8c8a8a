"""The rates of an exam, each with its interval."""

from collections.abc import Sequence

from matplotlib.figure import Figure

from dragrig.figures.header import headline
from dragrig.figures.panels import Place, add_panel
from dragrig.figures.style import BLACK, BLUE, GREY, SMALL_PT, TEXT_PT, drawing, new_figure, text_width_in
from dragrig.gap_scoring.rates import Rate

WIDTH_IN, ROW_IN, HEAD_IN, FOOT_IN, LEFT_IN, RIGHT_IN = 13.0, 0.36, 1.25, 0.8, 0.4, 1.9


def exam_rates_figure(rates: Sequence[Rate]) -> Figure:
    """Draw every rate that has cases: its share, its 95 % interval, and from how many campaigns it is."""
    shown = [one for one in rates if one.count]
    with drawing():
        left = LEFT_IN + max((text_width_in(one.name, TEXT_PT) for one in shown), default=1.0) + 0.25
        tall = ROW_IN * max(len(shown), 1)
        figure = new_figure(WIDTH_IN, HEAD_IN + tall + FOOT_IN)
        headline(figure, LEFT_IN, "How often the diagnosis is right", "Share of campaigns, with 95 % interval (Wilson)")
        axes = add_panel(figure, Place(left, FOOT_IN, WIDTH_IN - left - RIGHT_IN, tall))
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
