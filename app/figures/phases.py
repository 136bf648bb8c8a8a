"""The phases of a run: shaded behind its traces, named above them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes

from dragrig.figures.panels import height_in, width_in
from dragrig.figures.placement import spread
from dragrig.figures.style import GREY, SMALL_PT, text_width_in
from dragrig.rig.arrays import FloatArray, PhaseArray
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import PHASE_NAMES

TINTS = ("#F5F6F7", "#FCEED3", "#EAF4FB", "#FBE4D6", "#F3EEF7")
"""One per phase, in the file's order."""
STRONG = ("#B9BFC7", "#E69F00", "#56B4E9", "#D55E00", "#B38FC4")
"""The same, for the band above the panel."""

MOST_NAMES = 8
RAMP = "ramp"
_MOVING = (Phase.ACCELERATE, Phase.STEADY, Phase.DECELERATE)


@dataclass(frozen=True, slots=True)
class Stretch:
    """Consecutive samples of one phase, and what to call them."""

    phase: int
    start_s: float
    end_s: float
    name: str


def stretches(time: FloatArray, phase: PhaseArray) -> tuple[Stretch, ...]:
    """Cut a run into stretches of one phase; each ends where the next begins."""
    if time.size == 0:
        return ()
    firsts = np.concatenate(([0], np.flatnonzero(np.diff(phase)) + 1))
    ends = np.append(time[firsts[1:]], time[-1])
    return tuple(
        Stretch(int(number), float(start), float(end), PHASE_NAMES[number])
        for number, start, end in zip(phase[firsts], time[firsts], ends, strict=True)
    )


def with_ramp(parts: Sequence[Stretch]) -> tuple[Stretch, ...]:
    """Take neighbouring phases in motion together and call them the ramp."""
    merged: list[Stretch] = []
    for part in parts:
        moving = part.phase in _MOVING
        if moving and merged and merged[-1].name == RAMP:
            merged[-1] = replace(merged[-1], end_s=part.end_s)
        else:
            merged.append(replace(part, name=RAMP, phase=Phase.STEADY) if moving else part)
    return tuple(merged)


def shade(axes: Axes, parts: Sequence[Stretch], tints: Sequence[str] = TINTS) -> None:
    """Shade each stretch over the axes' whole height."""
    for number, tint in enumerate(tints):
        bars = [(part.start_s, part.end_s - part.start_s) for part in parts if part.phase == number]
        if bars:
            axes.broken_barh(
                bars, (0, 1), transform=axes.get_xaxis_transform(), facecolor=tint, edgecolor="none", zorder=0
            )


def name_above(axes: Axes, parts: Sequence[Stretch]) -> None:
    """Draw a band of the phases' colours along the axes' upper edge and their names above it.

    Names that do not fit over their stretch move aside and keep a thin line to it. Of many
    stretches only the longest of each phase is named.
    """
    wide, tall = width_in(axes), height_in(axes)
    band = 0.07 / tall
    inside = axes.inset_axes((0.0, 1.0, 1.0, band), sharex=axes)
    inside.set_axis_off()
    shade(inside, parts, STRONG)
    named = _worth_naming(parts, axes.get_xlim())
    low, high = axes.get_xlim()
    centres = [(_middle(part, low, high) - low) / (high - low) * wide for part in named]
    names = [part.name for part in named]
    widths = [text_width_in(name, SMALL_PT) + 0.14 for name in names]
    for name, centre, place in zip(names, centres, spread(centres, widths, 0.0, wide), strict=True):
        moved = abs(place - centre) > 0.02
        axes.annotate(
            name,
            xy=(centre / wide, 1.0 + band),
            xytext=(place / wide, 1.0 + 0.27 / tall),
            xycoords="axes fraction",
            ha="center",
            va="bottom",
            fontsize=SMALL_PT,
            color=GREY,
            arrowprops={"arrowstyle": "-", "color": GREY, "linewidth": 0.7, "shrinkA": 0, "shrinkB": 0}
            if moved
            else None,
        )


def _worth_naming(parts: Sequence[Stretch], limits: tuple[float, float]) -> list[Stretch]:
    shown = [part for part in parts if part.end_s > limits[0] and part.start_s < limits[1]]
    if len(shown) <= MOST_NAMES:
        return shown
    longest = {part.phase: part for part in sorted(shown, key=lambda part: part.end_s - part.start_s)}
    return sorted(longest.values(), key=lambda part: part.start_s)


def _middle(part: Stretch, low: float, high: float) -> float:
    return (max(part.start_s, low) + min(part.end_s, high)) / 2
