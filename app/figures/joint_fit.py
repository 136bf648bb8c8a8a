"""The joint fit in one picture: what was assumed of each parameter, what the runs made of it, how each run is left."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.analysis.identification.results import Identified, JointFit, Quantity, RunResidual
from dragrig.figures.header import headline
from dragrig.figures.panels import Place, add_panel
from dragrig.figures.style import (
    BLACK,
    BLUE,
    GREY,
    PALE,
    PURPLE,
    SMALL_PT,
    TEXT_PT,
    VERMILLION,
    drawing,
    new_figure,
    text_width_in,
)

ROW_IN = 0.36
NARROW_IN, WIDE_IN, GAP_IN, RIGHT_IN, NUMBERS_IN = 3.7, 5.4, 0.35, 0.4, 2.1
HEAD_IN, FOOT_IN, TITLE_IN = 1.25, 0.8, 0.5
WIDEST_PERCENT = 60.0


def joint_figure(fit: JointFit) -> Figure:
    """Draw a joint fit.

    Left, each parameter and combination relative to its value with 95 % intervals, the prior's behind; right, the
    squares that each run leaves for each degree of freedom, 1 where nothing but noise and repeatability is left.
    """
    rows: list[Quantity] = [*fit.parameters, *fit.combinations]
    height = max(len(rows), len(fit.runs)) * ROW_IN
    names_in = max(text_width_in(one.name, TEXT_PT) for one in rows) + 0.4
    files_in = max(text_width_in(one.file, SMALL_PT) for one in fit.runs) + 0.3
    left_in = names_in + WIDE_IN + NUMBERS_IN
    with drawing():
        figure = new_figure(left_in + files_in + NARROW_IN + RIGHT_IN, height + HEAD_IN + TITLE_IN + FOOT_IN)
        headline(figure, 0.3, f"Joint fit of the {fit.nominal} model", _subtitle(fit))
        intervals = add_panel(figure, Place(names_in, FOOT_IN, WIDE_IN, height))
        _intervals(intervals, rows)
        runs = add_panel(figure, Place(left_in + files_in, FOOT_IN, NARROW_IN, height))
        _left_over(runs, fit.runs)
        return figure


def _subtitle(fit: JointFit) -> str:
    if not fit.converged:
        return "DID NOT CONVERGE: no interval holds"
    return f"{fit.chi2 / fit.degrees:.2f} squares for each of {fit.degrees} degrees of freedom, {len(fit.runs)} runs"


def _intervals(axes: Axes, rows: Sequence[Quantity]) -> None:
    for place, one in enumerate(rows):
        middle, scale = one.value, _scale(one)
        if isinstance(one, Identified):
            low, high = ((end - middle) / scale for end in one.prior)
            axes.barh(place, high - low, left=low, height=0.62, color="#E3E7EC", linewidth=0)
        low, high = ((end - middle) / scale for end in one.interval)
        colour = BLUE if isinstance(one, Identified) else PURPLE
        axes.plot([low, high], [place, place], color=colour, linewidth=3.0)
        axes.plot(0, place, "o", color=colour, markersize=6, markeredgecolor="white")
        text = f"{one.value:.4g} ± {one.standard_error:.2g}" + ("" if one.unit == "1" else f" {one.unit}")
        axes.text(1.02, place, text, transform=axes.get_yaxis_transform(), va="center", fontsize=SMALL_PT)
    axes.set_yticks(range(len(rows)), [one.name for one in rows], fontsize=TEXT_PT)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    furthest = max(abs(end) for end in axes.get_xlim())
    axes.set_xlim(-min(furthest, WIDEST_PERCENT), min(furthest, WIDEST_PERCENT))
    axes.set_xlabel("Difference from the value (%; of an angle, ° × 10)")
    axes.set_title("95 % intervals, before (grey) and after the runs", loc="left", fontsize=TEXT_PT)
    axes.grid(visible=False, axis="y")


def _scale(one: Quantity) -> float:
    return 0.1 if one.unit == "deg" or not one.value else abs(one.value) / 100


def _left_over(axes: Axes, runs: Sequence[RunResidual]) -> None:
    for place, one in enumerate(runs):
        spread = 2 * float(np.sqrt(2 / one.blocks))
        colour = VERMILLION if one.chi2 > 1 + 2 * spread else BLACK
        axes.plot([1 - spread, 1 + spread], [place, place], color=PALE, linewidth=6.0, solid_capstyle="butt")
        axes.plot(one.chi2, place, "o", color=colour, markersize=6.5)
    axes.axvline(1.0, color=GREY, linewidth=1.0, linestyle=(0, (4, 3)))
    axes.set_yticks(range(len(runs)), [one.file for one in runs], fontsize=SMALL_PT)
    axes.set_ylim(len(runs) - 0.4, -0.6)
    if max(one.chi2 for one in runs) > 10:
        axes.set_xscale("log")
    else:
        axes.set_xlim(left=0.0)
    axes.set_xlabel("Squares per degree of freedom")
    axes.set_title("What each run leaves", loc="left", fontsize=TEXT_PT)
    axes.grid(visible=False, axis="y")
