"""The picture of a campaign: steady force against speed, relaxations, and drags along their way."""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.analysis.estimates import NORMAL_95, Estimate
from dragrig.figures.columns import FOOT_IN, LEFT_IN, RIGHT_IN
from dragrig.figures.digest import RunDigest, digest
from dragrig.figures.header import header_in, headline, write_badge, write_trouble
from dragrig.figures.labels import EndLabel, label_ends
from dragrig.figures.model import few_of
from dragrig.figures.panels import Place, add_panel, fit_y, height_in, label_y, plain_log_x, time_axis, width_in
from dragrig.figures.style import (
    BLUE,
    GREY,
    SMALL_PT,
    TEXT_PT,
    VERMILLION,
    drawing,
    new_figure,
    sequence,
    text_width_in,
)
from dragrig.rig.arrays import FloatArray
from dragrig.rig.runfile.model import Run

WIDTH_IN, TALL_IN = 14.0, 7.0
HEADING_IN = 0.5
LABELS_IN = 1.25
"""Room right of a panel for the names of its curves."""
LOOKS = {"drag": (BLUE, "o"), "coulomb": (VERMILLION, "s"), "blank": (GREY, "^")}
"""Colour and marker of each kind."""


def campaign_figure(runs: Iterable[Run], name: str = "", bad: Collection[Path] = ()) -> Figure:
    """Draw an overview of a campaign.

    Parameters
    ----------
    runs
        Read one after the other and not kept.
    name
        What to call the campaign.
    bad
        Files of runs that were marked bad; they are counted and not drawn, as are those that ended early.
    """
    digests = [digest(run, bad) for run in runs]
    with drawing():
        figure = new_figure(WIDTH_IN, header_in(_trouble(digests)) + HEADING_IN + TALL_IN + FOOT_IN)
        headline(figure, LEFT_IN, " · ".join(part for part in ("Campaign", name) if part), _subtitle(digests))
        write_trouble(figure, LEFT_IN, _trouble(digests))
        write_badge(figure, ", ".join(sorted({one.backend for one in digests})))
        drawn = [(draw, found) for draw, chosen in _PANELS if (found := [one for one in digests if chosen(one)])]
        for (draw, found), place in zip(drawn, _places(len(drawn)), strict=True):
            draw(add_panel(figure, place), found)
        if not drawn:
            figure.text(0.5, 0.45, "no complete drag, Coulomb, blank or relaxation run", ha="center", color=GREY)
        return figure


def _places(count: int) -> tuple[Place, ...]:
    room = WIDTH_IN - LEFT_IN - RIGHT_IN - LABELS_IN
    if count <= 1:
        return (Place(LEFT_IN, FOOT_IN, room, TALL_IN),)[:count]
    half = (room - LABELS_IN - LEFT_IN) / 2
    right = LEFT_IN + half + LABELS_IN + LEFT_IN
    low = (TALL_IN - FOOT_IN - HEADING_IN) / 2
    left_place = Place(LEFT_IN, FOOT_IN, half, TALL_IN)
    if count == 2:
        return left_place, Place(right, FOOT_IN, half, TALL_IN)
    return left_place, Place(right, FOOT_IN + TALL_IN - low, half, low), Place(right, FOOT_IN, half, low)


def _steady(axes: Axes, digests: Sequence[RunDigest]) -> None:
    labels: list[EndLabel] = []
    shown: list[FloatArray] = []
    for kind, (colour, marker) in LOOKS.items():
        steady = [(one.speed_mm_s, one.steady) for one in digests if one.kind == kind and one.steady is not None]
        for points, way in _by_way(kind, steady):
            speed = np.array([speed for speed, _ in points])
            force = np.array([estimate.value for _, estimate in points], dtype=float)
            half = np.array([NORMAL_95 * (estimate.standard_error or 0.0) for _, estimate in points])
            if way:
                force = np.abs(force)
            shown += [force - half, force + half]
            rounded = np.array([_rounded(one) for one in speed])
            levels = np.unique(rounded)
            means = [float(force[rounded == level].mean()) for level in levels]
            axes.plot(levels, means, color=colour, linewidth=1.2, alpha=0.5, linestyle="--" if way else "-")
            axes.errorbar(
                speed,
                force,
                yerr=half,
                fmt=marker,
                color=colour,
                markersize=8,
                markerfacecolor="white" if way else colour,
                markeredgecolor=colour if way else "white",
                capsize=3,
            )
            labels.append(EndLabel(means[-1], (kind if kind != "coulomb" else "Coulomb") + way, colour))
    speeds = [one.speed_mm_s for one in digests]
    plain_log_x(axes, *_decade(speeds))
    fit_y(axes, [*shown, np.zeros(1)], 1.0)
    axes.set_xlabel("Speed (mm/s)")
    label_y(axes, "Force (mN)")
    _heading(axes, "Steady force", "zero offsets included, bars 95 %")
    label_ends(axes, labels)


def _by_way(
    kind: str, points: Sequence[tuple[float, Estimate]]
) -> Iterator[tuple[Sequence[tuple[float, Estimate]], str]]:
    """Keep the two ways of a capsule apart: a force of the other sign is that of a run backward."""
    backward = [one for one in points if kind != "blank" and (one[1].value or 0.0) < 0]
    forward = [one for one in points if one not in backward]
    if forward:
        yield forward, ""
    if backward:
        yield backward, " back"


def _relaxations(axes: Axes, digests: Sequence[RunDigest]) -> None:
    rising = sorted(digests, key=lambda one: one.strain)
    strains = sorted({one.strain for one in rising})
    colours = dict(zip(strains, sequence(len(strains)), strict=True))
    ends: dict[float, float] = {}
    for one in rising:
        axes.plot(one.x, one.force_mN, color=colours[one.strain], linewidth=1.8)
        ends[one.strain] = float(one.force_mN[np.isfinite(one.force_mN)][-1])
    plain_log_x(axes, min(float(one.x[0]) for one in rising), max(float(one.x[-1]) for one in rising))
    fit_y(axes, [one.force_mN for one in rising], 1.0)
    axes.set_xlabel("Time since the end of the ramp (s)")
    label_y(axes, "Force (mN)")
    _heading(axes, "Relaxation", "at each shear strain")
    label_ends(axes, [EndLabel(end, f"{100 * strain:g} %", colours[strain]) for strain, end in ends.items()])


def _drags(axes: Axes, digests: Sequence[RunDigest]) -> None:
    first_of = {_rounded(one.speed_mm_s): one for one in reversed(digests)}
    speeds = few_of(list(first_of))
    labels = []
    for speed, colour in zip(speeds, sequence(len(speeds)), strict=True):
        one = first_of[speed]
        axes.plot(one.x, one.force_mN, color=colour, linewidth=1.8)
        middle = one.force_mN[one.force_mN.size // 2 :]
        labels.append(EndLabel(float(np.median(middle)), f"{speed:g} mm/s", colour))
    shown = [first_of[speed] for speed in speeds]
    time_axis(axes, min(0.0, *(float(one.x.min()) for one in shown)), max(float(one.x.max()) for one in shown))
    fit_y(axes, [one.force_mN for one in shown], 1.0)
    axes.set_xlabel("Position (mm)")
    label_y(axes, "Force (mN)")
    _heading(axes, "Drag along the way", "first run at each speed")
    label_ends(axes, labels)


_PANELS: tuple[tuple[Callable[[Axes, Sequence[RunDigest]], None], Callable[[RunDigest], bool]], ...] = (
    (_steady, lambda one: one.steady is not None and one.speed_mm_s > 0),
    (_relaxations, lambda one: one.kind == "relaxation" and one.x.size > 1),
    (_drags, lambda one: one.kind == "drag" and one.x.size > 1),
)
"""What draws a panel, and which runs it draws."""


def _heading(axes: Axes, text: str, remark: str = "") -> None:
    y = 1 + 0.13 / height_in(axes)
    axes.text(0.0, y, text, transform=axes.transAxes, fontsize=TEXT_PT, fontweight="bold")
    after = 1.1 * text_width_in(text, TEXT_PT) + 0.25
    axes.text(after / width_in(axes), y, remark, transform=axes.transAxes, fontsize=SMALL_PT, color=GREY)


def _decade(speeds: Sequence[float]) -> tuple[float, float]:
    """Range of a logarithmic axis around some speeds, at least a decade."""
    middle = float(np.sqrt(min(speeds) * max(speeds)))
    half = max(1.3 * max(speeds) / middle, float(np.sqrt(10.0)))
    return middle / half, middle * half


def _rounded(speed_mm_s: float) -> float:
    """Where no speed was set, the measured ones of equal runs differ in the fourth digit."""
    return float(f"{speed_mm_s:.3g}")


def _subtitle(digests: Sequence[RunDigest]) -> str:
    if not digests:
        return "no runs"
    counts = Counter(one.kind for one in digests)
    kinds = ", ".join(f"{count} {kind}" for kind, count in counts.most_common())
    begin, end = min(one.started for one in digests), max(one.started for one in digests)
    specimens = ", ".join(sorted({one.specimen for one in digests}))
    until = f"{end:%H:%M}" if end.date() == begin.date() else f"{end:%Y-%m-%d %H:%M}"
    return f"{len(digests)} runs ({kinds})  ·  {specimens}  ·  {begin:%Y-%m-%d %H:%M} – {until}"


def _trouble(digests: Sequence[RunDigest]) -> str:
    left_out = sum(not one.good for one in digests)
    return f"{left_out} of them ended early or are marked bad, and are not drawn" if left_out else ""
