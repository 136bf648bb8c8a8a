"""The joint fit in one picture: what was known of each parameter, what the runs made of it, how each run is left."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dragrig.analysis.estimates import NORMAL_95
from dragrig.analysis.identification.results import Identified, JointFit, Quantity, RunResidual
from dragrig.figures.derived import with_error
from dragrig.figures.header import headline, write_trouble
from dragrig.figures.panels import Place, add_panel, plain_log_x
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

ROW_IN, TIGHT_ROW_IN = 0.36, 0.23
ROOMY_RUNS, MOST_RUNS = 32, 60
PANEL_IN, RUNS_IN, BETWEEN_IN, RIGHT_IN, NUMBERS_IN, ABOVE_IN = 4.4, 3.7, 0.5, 0.4, 0.12, 0.3
HEAD_IN, FOOT_IN, COMBINED_HEAD_IN, TROUBLE_IN = 1.55, 0.8, 1.25, 0.3
LONGEST_IN = 3.6
"""Room for a name or a file; longer ones are cut off."""
LEAST_SD, MOST_SD = 3.0, 10.0
"""How far the axis of the parameters goes at least and at most."""
LEAST_PERCENT, MOST_PERCENT = 2.0, 100.0
LARGE_CHI2 = 5.0
"""From here on the axis of the runs is logarithmic."""
STANDS_OUT = 4.0
PRIOR = "#E3E7EC"


def joint_figure(fit: JointFit) -> Figure:
    """Draw a joint fit.

    Left, each parameter with its 95 % interval, on a scale on which what was known before is the same for all; below,
    the intervals of what they combine to. Right, χ² per degree of freedom of each run, 1 where nothing but noise and
    repeatability is left; of more than 60 runs those with the largest.
    """
    runs = _shown(fit.runs)
    sheet = _Sheet.of(fit, runs)
    with drawing():
        figure = new_figure(sheet.wide, sheet.tall)
        headline(figure, ABOVE_IN, f"Joint fit of the {fit.nominal} model", _subtitle(fit, len(runs)))
        write_trouble(figure, ABOVE_IN, _trouble(fit))
        parameters, combined, left = sheet.places
        _parameters(add_panel(figure, parameters), fit)
        if fit.combinations:
            _combined(add_panel(figure, combined), fit)
        _left_over(add_panel(figure, left), runs)
        return figure


@dataclass(frozen=True, slots=True)
class _Sheet:
    """Size of the picture and where its panels stand [inch]."""

    wide: float
    tall: float
    places: tuple[Place, Place, Place]

    @classmethod
    def of(cls, fit: JointFit, runs: Sequence[RunResidual]) -> "_Sheet":
        """Make room for names, numbers and rows."""
        rows = [*fit.parameters, *fit.combinations]
        names = ABOVE_IN + max(_width(one.name, TEXT_PT) for one in rows) + 0.15
        numbers = NUMBERS_IN + max(text_width_in(_number(one, fit), SMALL_PT) for one in rows)
        files = max(_width(one, SMALL_PT) for one in _files(runs)) + 0.15
        upper, lower = ROW_IN * len(fit.parameters), ROW_IN * len(fit.combinations)
        right = len(runs) * (ROW_IN if len(runs) <= ROOMY_RUNS else TIGHT_ROW_IN)
        left = upper + (lower + COMBINED_HEAD_IN if fit.combinations else 0.0)
        top = FOOT_IN + max(left, right)
        runs_at = names + PANEL_IN + numbers + BETWEEN_IN + files
        places = (
            Place(names, top - upper, PANEL_IN, upper),
            Place(names, top - left, PANEL_IN, lower),
            Place(runs_at, top - right, RUNS_IN, right),
        )
        tall = top + HEAD_IN + (TROUBLE_IN if _trouble(fit) else 0.0)
        return cls(runs_at + RUNS_IN + RIGHT_IN, tall, places)


def _width(text: str, size_pt: float) -> float:
    return min(text_width_in(text, size_pt), LONGEST_IN)


def _cut(text: str, size_pt: float) -> str:
    """Leave out the middle of a long name: what tells runs apart stands at its ends."""
    wide = text_width_in(text, size_pt)
    if wide <= LONGEST_IN:
        return text
    half = int(0.47 * len(text) * LONGEST_IN / wide)
    return f"{text[:half]}…{text[-half:]}"


def _shown(runs: Sequence[RunResidual]) -> list[RunResidual]:
    if len(runs) <= MOST_RUNS:
        return list(runs)
    least = sorted((one.chi2 for one in runs), reverse=True)[MOST_RUNS - 1]
    return [one for one in runs if one.chi2 >= least][:MOST_RUNS]


def _subtitle(fit: JointFit, shown: int) -> str:
    total = len({one.file for one in fit.runs})
    runs = f"{total} run{'' if total == 1 else 's'}"
    if shown < len(fit.runs):
        runs += f", the {shown} that are left worst shown"
    return f"χ² {_plain(fit.chi2 / max(fit.degrees, 1))} per degree of freedom ({fit.degrees})  ·  {runs}"


def _trouble(fit: JointFit) -> str:
    if not fit.converged:
        return "did not converge: no interval holds"
    return "the model leaves more than noise: the intervals need not hold" if not fit.holds else ""


def _plain(value: float) -> str:
    return f"{value:.2f}" if value < 100 else f"{value:.0f}"


def _number(one: Identified, fit: JointFit) -> str:
    """Spell a value: none that the runs do not determine, no error of a fit that did not converge."""
    if not one.determined:
        return "not determined"
    error = one.standard_error if fit.converged else None
    return with_error(one.value, error) + ("" if one.unit == "1" else f" {one.unit}")


def _files(runs: Sequence[RunResidual]) -> list[str]:
    several = len({one.channel for one in runs}) > 1
    return [f"{one.file} {one.channel}" if several else one.file for one in runs]


def _parameters(axes: Axes, fit: JointFit) -> None:
    places = [_in_sd(one) for one in fit.parameters]
    reach = _reach(places, LEAST_SD, MOST_SD)
    axes.axvspan(-NORMAL_95, NORMAL_95, color=PRIOR, linewidth=0)
    axes.axvline(0.0, color=PALE, linewidth=1.0)
    _intervals(axes, fit, fit.parameters, places, reach, BLUE)
    axes.set_xlabel("Standard deviations from what was known before")
    axes.set_title("95 % intervals, before (grey) and after the runs", loc="left", fontsize=TEXT_PT)


def _in_sd(one: Identified) -> tuple[float, float, float]:
    """Return low end, value and high end in standard deviations of the prior, logarithmically where it is positive."""
    ends = np.array([*one.prior, one.interval[0], one.value, one.interval[1]])
    known = np.log(ends) if (ends > 0).all() else ends
    middle, half = (known[0] + known[1]) / 2, (known[1] - known[0]) / 2
    low, value, high = (NORMAL_95 * (known[2:] - middle) / half).tolist() if half > 0 else (0.0, 0.0, 0.0)
    return low, value, high


def _combined(axes: Axes, fit: JointFit) -> None:
    places = [(_percent(one, one.interval[0]), 0.0, _percent(one, one.interval[1])) for one in fit.combinations]
    reach = _reach([place for place, one in zip(places, fit.combinations, strict=True) if one.determined],
                   LEAST_PERCENT, MOST_PERCENT)  # fmt: skip
    axes.axvline(0.0, color=PALE, linewidth=1.0)
    _intervals(axes, fit, fit.combinations, places, reach, PURPLE)
    axes.set_xlabel("Difference from the value (%)")
    axes.set_title("95 % intervals of what they combine to", loc="left", fontsize=TEXT_PT)


def _percent(one: Quantity, end: float) -> float:
    return 100 * (end - one.value) / (abs(one.value) or 1.0)


def _reach(places: Sequence[tuple[float, float, float]], least: float, most: float) -> float:
    return min(max([least, *(1.08 * abs(end) for ends in places for end in ends)]), most)


def _intervals(
    axes: Axes,
    fit: JointFit,
    rows: Sequence[Identified],
    places: Sequence[tuple[float, float, float]],
    reach: float,
    colour: str,
) -> None:
    """Draw what is determined, name the rows at the left, and write their numbers at the right."""
    for row, (one, (low, value, high)) in enumerate(zip(rows, places, strict=True)):
        if one.determined:
            _interval(axes, row, (low, value, high) if fit.converged else (value, value, value), reach, colour)
    axes.set_yticks(range(len(rows)), [_cut(one.name, TEXT_PT) for one in rows], fontsize=TEXT_PT)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlim(-reach, reach)
    axes.grid(visible=False, axis="y")
    x = 1 + NUMBERS_IN / PANEL_IN
    for row, one in enumerate(rows):
        words, colour = _number(one, fit), BLACK if one.determined else GREY
        place = axes.get_yaxis_transform()
        axes.text(x, row, words, transform=place, va="center_baseline", fontsize=SMALL_PT, color=colour)


def _interval(axes: Axes, row: int, ends: tuple[float, float, float], reach: float, colour: str) -> None:
    """Draw value and interval; an arrow points to what lies beyond the axis."""
    low, value, high = (min(max(end, -reach), reach) for end in ends)
    axes.plot([low, high], [row, row], color=colour, linewidth=3.0, solid_capstyle="butt")
    for end, edge, marker in ((ends[0], -reach, "<"), (ends[2], reach, ">")):
        if abs(end) > reach and np.sign(end) == np.sign(edge):
            axes.plot(edge, row, marker, color=colour, markersize=9, clip_on=False)
    if abs(ends[1]) <= reach:
        axes.plot(value, row, "o", color=colour, markersize=7, markeredgecolor="white")


def _left_over(axes: Axes, runs: Sequence[RunResidual]) -> None:
    most = max(one.chi2 for one in runs)
    if most > LARGE_CHI2:
        plain_log_x(axes, 0.3, 1.3 * most)
    else:
        axes.set_xlim(0.0, max(2.0, 1.08 * most))
        axes.xaxis.set_major_locator(MaxNLocator(nbins=5))
    for row, one in enumerate(runs):
        error = float(np.sqrt(2 / max(one.blocks, 1)))
        low, high = max(1 - NORMAL_95 * error, 0.0), 1 + NORMAL_95 * error
        colour = VERMILLION if one.chi2 > 1 + STANDS_OUT * error else BLACK
        axes.barh(row, high - low, left=low, height=0.5, color=PRIOR, linewidth=0)
        axes.plot(max(one.chi2, axes.get_xlim()[0]), row, "o", color=colour, markersize=6.5, clip_on=False)
    axes.axvline(1.0, color=GREY, linewidth=1.0, linestyle=(0, (4, 3)))
    axes.set_yticks(range(len(runs)), [_cut(one, SMALL_PT) for one in _files(runs)], fontsize=SMALL_PT)
    axes.set_ylim(len(runs) - 0.5, -0.5)
    axes.set_xlabel("χ² per degree of freedom")
    axes.set_title("What each run leaves (grey: noise)", loc="left", fontsize=TEXT_PT)
    axes.grid(visible=False, axis="y")
