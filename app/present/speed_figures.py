"""Steady force against speed, measured with intervals beside models: the figure of many results."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.analysis import mean_of_specimens, means_of_repeats, set_values
from dragrig.present import (
    BLACK,
    BLUE,
    GREY,
    SMALL_PT,
    VERMILLION,
    CurveLabel,
    figure_style,
    fit_y_range,
    label_curves,
    new_figure,
    set_log_x,
)
from dragrig.rig import FloatArray

KIND_MARKERS = {"drag": (BLUE, "o"), "coulomb": (VERMILLION, "s"), "blank": (GREY, "^")}
"""Colour and marker of each kind of run that has a steady force."""
LEAST_SPAN_MN = 1.0
MARGIN = 1.3
"""How far the speed axis goes beyond the speeds, as a factor."""
LEAST_HALF_RANGE = 10.0**0.5
"""The speed axis is at least a decade long."""


def kind_label(kind: str) -> str:
    """Return a kind of run as it is spelt in a figure."""
    return "Coulomb" if kind == "coulomb" else kind


@dataclass(frozen=True, slots=True, eq=False)
class SteadyForces:
    """Steady forces, or differences of them, measured at `n` speeds."""

    name: str
    colour: str
    speed_mm_s: FloatArray
    force_mN: FloatArray
    half_mN: FloatArray
    """Half of the 95 % interval; NaN for none."""
    marker: str = "o"
    hollow: bool = False
    joined: bool = True
    runs: tuple[tuple[float, float], ...] = ()
    """Speed and force of single runs, drawn small."""

    @classmethod
    def of_runs(
        cls,
        name: str,
        colour: str,
        runs: Iterable[tuple[float, str, float]],
        marker: str = "o",
        *,
        hollow: bool = False,
        beside: float = 1.0,
    ) -> "SteadyForces":
        """Average runs, each a speed, a specimen and a force; `beside` is a factor on the speeds.

        The intervals are by Student's t over specimens or, of one, over its repeats.
        """
        given = tuple(runs)
        forces: dict[float, dict[str, list[float]]] = {}
        for (_, specimen, force), speed in zip(given, set_values(run[0] for run in given), strict=True):
            forces.setdefault(speed, {}).setdefault(specimen, []).append(force)
        rising = dict(sorted(forces.items()))
        if len({specimen for _, specimen, _ in given}) > 1:
            found = [mean_of_specimens([float(np.mean(own)) for own in of.values()]) for of in rising.values()]
        else:
            found = means_of_repeats([next(iter(of.values())) for of in rising.values()])
        means, halves = (np.array(column, dtype=float) for column in zip(*found, strict=True))
        single = tuple((beside * speed, value) for speed, of in rising.items() for own in of.values() for value in own)
        return cls(name, colour, beside * np.array(list(rising)), means, halves, marker, hollow, runs=single)


@dataclass(frozen=True, slots=True, eq=False)
class ModelForces:
    """Forces of a model, or their differences from another, at speeds; a line."""

    name: str
    colour: str
    speed_mm_s: FloatArray
    force_mN: FloatArray
    dash: tuple[int, ...] = ()
    width: float = 2.0


def draw_forces(
    axes: Axes,
    measured: Sequence[SteadyForces],
    models: Sequence[ModelForces] = (),
    quantity: str = "Force (mN)",
    labels: Sequence[CurveLabel] = (),
) -> None:
    """Draw forces against a logarithmic speed axis, and name them, and what `labels` name, at the right edge."""
    for line in models:
        style = (0, line.dash) if line.dash else "-"
        axes.plot(line.speed_mm_s, line.force_mN, color=line.colour, linewidth=line.width, linestyle=style)
    for points in measured:
        if points.runs:
            axes.plot(*zip(*points.runs, strict=True), points.marker, color=points.colour, markersize=4.5, alpha=0.45,
                      markeredgecolor="none")  # fmt: skip
        axes.errorbar(
            points.speed_mm_s, points.force_mN, yerr=points.half_mN, fmt=points.marker, color=points.colour,
            markersize=8, linestyle="" if not points.joined else "--" if points.hollow else "-", linewidth=1.3,
            markerfacecolor="white" if points.hollow else points.colour,
            markeredgecolor=points.colour if points.hollow else "white", zorder=4,
        )  # fmt: skip
    shown = [np.zeros(1), *(line.force_mN for line in models)]
    for points in measured:
        half = np.nan_to_num(points.half_mN)
        shown += [points.force_mN - half, points.force_mN + half, np.array([force for _, force in points.runs])]
    entries: list[SteadyForces | ModelForces] = [*measured, *models]
    speeds = np.concatenate([entry.speed_mm_s for entry in entries])
    middle = float(np.sqrt(speeds.min() * speeds.max()))
    half_range = max(MARGIN * float(speeds.max()) / middle, LEAST_HALF_RANGE)
    set_log_x(axes, middle / half_range, middle * half_range)
    fit_y_range(axes, shown, LEAST_SPAN_MN)
    axes.set_xlabel("Speed (mm/s)")
    axes.set_ylabel(quantity)
    ends = (CurveLabel(float(entry.force_mN[-1]), entry.name, entry.colour) for entry in entries if entry.name)
    label_curves(axes, [*ends, *labels])


@dataclass(frozen=True, slots=True, eq=False)
class Differences:
    """What is drawn below the forces: differences of them, around zero."""

    quantity: str
    measured: Sequence[SteadyForces]
    models: Sequence[ModelForces] = ()
    band_mN: float | None = None
    """Half the height of a grey band around zero."""
    band: str = ""
    """What the band is."""


def speed_figure(
    measured: Sequence[SteadyForces],
    models: Sequence[ModelForces] = (),
    differences: Differences | None = None,
    *,
    title: str = "Steady force against speed",
    subtitle: str = "",
    backend: str = "",
    quantity: str = "Force (mN)",
    labels: Sequence[CurveLabel] = (),
) -> Figure:
    """Draw steady forces against speed, beside models, and below them the differences."""
    with figure_style():
        figure = new_figure(12.4, 5.6 if differences is None else 8.2, title, subtitle, backend=backend, narrow=True)
        if differences is None:
            draw_forces(figure.add_subplot(), measured, models, quantity, labels)
            return figure
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(4.9, 2.6))
        draw_forces(above, measured, models, quantity, labels)
        draw_forces(below, differences.measured, differences.models, differences.quantity)
        above.set_xlabel("")
        below.axhline(0.0, color=BLACK, linewidth=1.2, zorder=1)
        if differences.band_mN is not None and np.isfinite(differences.band_mN):
            half = differences.band_mN
            below.axhspan(-half, half, color="#E8EBEE", linewidth=0, zorder=0)
            low, high = below.get_ylim()
            below.set_ylim(min(low, -1.1 * half), max(high, 1.1 * half))
            label_curves(below, [CurveLabel(0.0, differences.band, GREY)] if differences.band else [], SMALL_PT)
        figure.align_ylabels()
        return figure
