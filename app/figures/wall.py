"""Where the paper's two sets of wall parameters, Eq. 14 and Table 1, part."""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.analysis.identification.results import Quantity
from dragrig.figures.header import headline
from dragrig.figures.panels import Place, add_panel, fit_y, label_y
from dragrig.figures.style import BLACK, BLUE, GREEN, GREY, SMALL_PT, TEXT_PT, VERMILLION, drawing, new_figure
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction import Disagreement, WallKind, disagreement, wall_parameters

UNITS = {"E1": "kPa", "E2": "kPa", "E3": "kPa", "eta1": "kPa·s", "eta2": "kPa·s"}
"""Unit of each parameter."""
_SYMBOLS = {"E1": "$E_1$", "E2": "$E_2$", "E3": "$E_3$", "eta1": r"$\eta_1$", "eta2": r"$\eta_2$"}

LEFT_IN, FOOT_IN = 1.15, 0.8
WIDE_IN, TALL_IN = 2.7, 2.55
STEP_X_IN, STEP_Y_IN = 3.85, 3.6
DASHES = (0, (4, 2))


def wall_figure(identified: Mapping[str, Sequence[tuple[float, Quantity]]] | None = None) -> Figure:
    """Draw each wall parameter against strain: Table 1, Eq. 14, and the quadratic through Table 1.

    Parameters
    ----------
    identified
        What relaxations gave, by parameter: strain and value, drawn with its interval.
    """
    entries, found = disagreement(), identified or {}
    with drawing():
        figure = new_figure(12.0, 8.3)
        headline(
            figure,
            LEFT_IN,
            "Wall parameters: Eq. 14 does not follow Table 1",
            "of the five-element wall; in each panel the largest differences from Table 1",
        )
        for number, name in enumerate(UNITS):
            place = _cell(number)
            axes = add_panel(figure, place)
            _parameter(axes, name, [entry for entry in entries if entry.parameter == name], found.get(name, ()))
        _key(add_panel(figure, _cell(len(UNITS))), with_identified=bool(found))
        return figure


def _cell(number: int) -> Place:
    column, row = number % 3, number // 3
    return Place(LEFT_IN + STEP_X_IN * column, FOOT_IN + STEP_Y_IN * (1 - row), WIDE_IN, TALL_IN)


def _parameter(
    axes: Axes, name: str, entries: list[Disagreement], identified: Sequence[tuple[float, Quantity]]
) -> None:
    strain = np.linspace(0.0, 2.2, 200)
    curves = {kind: _values(kind, name, strain) for kind in ("eq14", "table1")}
    points = np.array([entry.table1 for entry in entries])
    axes.plot(100 * strain, curves["eq14"], color=BLUE)
    axes.plot(100 * strain, curves["table1"], color=VERMILLION, linestyle=DASHES)
    axes.plot(
        [100 * entry.strain for entry in entries], points, "o", color=BLACK, markersize=8, markeredgecolor="white"
    )
    for strain_of, one in identified:
        axes.plot([100 * strain_of] * 2, one.interval, color=GREEN, linewidth=1.8)
        axes.plot([100 * strain_of], [one.value], "D", color=GREEN, markersize=7, markeredgecolor="white")
    ends = [np.array(one.interval) for _, one in identified]
    fit_y(axes, [np.zeros(1), points, *curves.values(), *ends], 0.01, 0.0)
    axes.set_xlim(0, 220)
    axes.set_xticks([0, 50, 100, 150, 200])
    axes.set_xlabel("Strain (%)")
    label_y(axes, f"{_SYMBOLS[name]} ({UNITS[name]})")
    axes.yaxis.label.set_parse_math(True)
    eq14 = max((entry.eq14_difference for entry in entries), key=abs)
    fitted = max((entry.quadratic_difference for entry in entries), key=abs)
    _above(axes, 0.0, "left", f"Eq. 14 {percent(eq14)}", BLUE)
    _above(axes, 1.0, "right", f"fit {percent(fitted)}", VERMILLION)


def _above(axes: Axes, x: float, side: Literal["left", "right"], text: str, colour: str) -> None:
    axes.text(x, 1.02, text, transform=axes.transAxes, fontsize=SMALL_PT, color=colour, ha=side, va="bottom")


def _key(axes: Axes, with_identified: bool) -> None:
    axes.set_axis_off()
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1)
    rows: list[tuple[str, str, str | tuple[int, tuple[int, int]]]] = [
        ("Table 1", BLACK, "o"),
        ("Eq. 14, as printed", BLUE, "-"),
        ("least-squares fit\nof a quadratic", VERMILLION, DASHES),
    ]
    if with_identified:
        rows.append(("identified,\nsimulated runs", GREEN, "D"))
    for y, (text, colour, mark) in zip(np.linspace(0.92, 0.3, len(rows)), rows, strict=True):
        if isinstance(mark, str) and mark != "-":
            axes.plot([0.09], [y], mark, color=colour, markersize=8)
        else:
            axes.plot([0.0, 0.18], [y, y], color=colour, linestyle=mark)
        axes.text(0.25, y, text, va="center", fontsize=TEXT_PT, color=colour)
    axes.text(0.0, 0.05, "Table 1 prints η in kPa; it is kPa·s.", fontsize=SMALL_PT, color=GREY, va="center")


def percent(difference: float) -> str:
    """Spell a relative difference: +20 %, −0.4 %."""
    text = f"{100 * difference:+.0f}" if abs(difference) >= 0.095 else f"{100 * difference:+.1f}"
    return text.replace("-", "−") + " %"


def _values(kind: WallKind, name: str, strain: FloatArray) -> FloatArray:
    wall = wall_parameters(kind, strain)
    return {"E1": wall.E1, "E2": wall.E2, "E3": wall.E3, "eta1": wall.eta1, "eta2": wall.eta2}[name]
