"""The identified elements against strain, beside the paper's Table 1 and Eq. 14."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.analysis.identification.results import RelaxationFit, StrainLaw
from dragrig.analysis.identification.strain_law import NAMES, evaluate
from dragrig.figures.panels import Place, add_panel, fit_y
from dragrig.figures.style import BLACK, BLUE, SMALL_PT, TEXT_PT, VERMILLION
from dragrig.figures.wall import DASHES
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.wall import EQ14, TABLE1, TABLE1_STRAIN

TITLES = ("E₁ (kPa)", "E₂ (kPa)", "E₃ (kPa)", "η₁ (kPa·s)", "η₂ (kPa·s)")
GAP_IN = 0.72


def draw_laws(figure: Figure, place: Place, fits: Sequence[RelaxationFit], laws: Sequence[StrainLaw]) -> None:
    """Draw the five elements side by side within a place."""
    width = (place.width - (len(NAMES) - 1) * GAP_IN) / len(NAMES)
    usable = [fit for fit in fits if fit.elements]
    strain = np.array([fit.shear_strain for fit in usable])
    furthest = max([TABLE1_STRAIN[-1], *strain.tolist()])
    for index, name in enumerate(NAMES):
        cell = Place(place.left + index * (width + GAP_IN), place.bottom, width, place.height)
        axes = add_panel(figure, cell)
        shown = [*_published(axes, index), np.zeros(1)]
        shown += [_law(axes, law) for law in laws if law.element == name]
        points = [fit.elements[index] for fit in usable]
        if points:
            value = np.array([one.value for one in points])
            ends = np.abs(np.array([one.interval for one in points]).T - value)
            axes.errorbar(
                100 * strain, value, ends, fmt="s", color=VERMILLION, markersize=7, markeredgecolor="white", capsize=4
            )
            shown.append(value + ends[1])
        fit_y(axes, shown, 0.01, 0.0)
        axes.set_xlim(0, 110 * furthest)
        axes.set_xlabel("Strain (%)")
        axes.set_title(TITLES[index], loc="left", fontsize=TEXT_PT)
    _key(figure, place, bool(usable), bool(laws))


def _published(axes: Axes, index: int) -> list[FloatArray]:
    strain = np.linspace(TABLE1_STRAIN[0], TABLE1_STRAIN[-1], 100)
    eq14, table1 = np.polyval(EQ14[index], strain), np.array(TABLE1[index])
    axes.plot(100 * strain, eq14, color=BLUE, linestyle=DASHES, linewidth=1.8)
    axes.plot(100 * np.array(TABLE1_STRAIN), table1, "o", color=BLACK, markersize=6.5, markerfacecolor="white")
    return [eq14, table1]


def _law(axes: Axes, law: StrainLaw) -> FloatArray:
    strain = np.linspace(min(law.strains), max(law.strains), 100)
    value, error = evaluate(law, strain)
    axes.fill_between(
        100 * strain, value - 1.96 * error, value + 1.96 * error, color=VERMILLION, alpha=0.18, linewidth=0
    )
    axes.plot(100 * strain, value, color=VERMILLION)
    return np.concatenate((value - 1.96 * error, value + 1.96 * error))


def _key(figure: Figure, place: Place, identified: bool, laws: bool) -> None:
    """Name points and lines in one row above the panels."""
    key = add_panel(figure, Place(place.left, place.bottom + place.height + 0.42, place.width, 0.3))
    key.set_axis_off()
    key.set_xlim(0, place.width)
    key.set_ylim(0, 1)
    x = 0.0
    rows = [("Table 1", BLACK, "o", "none", 1.15), ("Eq. 14, as printed", BLUE, "", DASHES, 2.1)]
    if identified:
        rows.append(("this specimen, each run", VERMILLION, "s", "none", 2.6))
    if laws:
        rows.append(("its law over strain, 95 % band", VERMILLION, "", "-", 3.2))
    for text, colour, marker, dashes, room in rows:
        face = "white" if marker == "o" else colour
        key.plot([x, x + 0.3] if not marker else [x + 0.15], [0.5] * (1 if marker else 2), marker=marker,
                 color=colour, markerfacecolor=face, markersize=7, linestyle=dashes)  # fmt: skip
        key.text(x + 0.42, 0.5, text, va="center", fontsize=SMALL_PT, color=colour)
        x += room + 0.35
