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


@dataclass(frozen=True, slots=True, eq=False)
class SpeedPanel:
    """Forces against speed, or differences of them, of one panel."""

    measured: Sequence[SteadyForces]
    models: Sequence[ModelForces] = ()
    quantity: str = "Force (mN)"
    labels: Sequence[CurveLabel] = ()
    """Names at the right edge, beside those of forces and models."""
    band_mN: float | None = None
    """Half the height of a grey band around zero."""


def draw_forces(axes: Axes, panel: SpeedPanel) -> None:
    """Draw forces against a logarithmic speed axis, and name them at the right edge."""
    for line in panel.models:
        style = (0, line.dash) if line.dash else "-"
        axes.plot(line.speed_mm_s, line.force_mN, color=line.colour, linewidth=line.width, linestyle=style)
    shown = [np.zeros(1), *(line.force_mN for line in panel.models)]
    for points in panel.measured:
        if points.runs:
            axes.plot(*zip(*points.runs, strict=True), points.marker, color=points.colour, markersize=4.5, alpha=0.45,
                      markeredgecolor="none")  # fmt: skip
        axes.errorbar(
            points.speed_mm_s, points.force_mN, yerr=points.half_mN, fmt=points.marker, color=points.colour,
            markersize=8, linestyle="" if not points.joined else "--" if points.hollow else "-", linewidth=1.3,
            markerfacecolor="white" if points.hollow else points.colour,
            markeredgecolor=points.colour if points.hollow else "white", zorder=4,
        )  # fmt: skip
        half = np.nan_to_num(points.half_mN)
        shown += [points.force_mN - half, points.force_mN + half, np.array([force for _, force in points.runs])]
    entries: list[SteadyForces | ModelForces] = [*panel.measured, *panel.models]
    speeds = np.concatenate([entry.speed_mm_s for entry in entries])
    middle = float(np.sqrt(speeds.min() * speeds.max()))
    half_range = max(MARGIN * float(speeds.max()) / middle, LEAST_HALF_RANGE)
    set_log_x(axes, middle / half_range, middle * half_range)
    if panel.band_mN is not None and np.isfinite(panel.band_mN):
        axes.axhspan(-panel.band_mN, panel.band_mN, color="#E8EBEE", linewidth=0, zorder=0)
        shown.append(np.array([-panel.band_mN, panel.band_mN]))
    fit_y_range(axes, shown, 1.0)
    axes.set_xlabel("Speed (mm/s)")
    axes.set_ylabel(panel.quantity)
    named = [entry for entry in entries if entry.name]
    ends = (CurveLabel(float(entry.force_mN[-1]), entry.name, entry.colour, "$" in entry.name) for entry in named)
    label_curves(axes, [*ends, *panel.labels])


def speed_figure(
    forces: SpeedPanel,
    differences: SpeedPanel | None = None,
    *,
    title: str = "Steady force against speed",
    subtitle: str = "",
    backend: str = "",
) -> Figure:
    """Draw steady forces against speed, beside models, and below them the differences."""
    with figure_style():
        height_in = 5.6 if differences is None else 8.2
        figure = new_figure(12.4, height_in, title, subtitle, backend=backend, narrow=True)
        if differences is None:
            draw_forces(figure.add_subplot(), forces)
            return figure
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(4.9, 2.6))
        draw_forces(above, forces)
        draw_forces(below, differences)
        above.set_xlabel("")
        below.axhline(0.0, color=BLACK, linewidth=1.2, zorder=1)
        figure.align_ylabels()
        return figure
