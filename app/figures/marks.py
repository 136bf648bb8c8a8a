"""What happened during a run, marked over its traces: missing samples, trips, stops."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from dragrig.figures.panels import height_in, width_in
from dragrig.figures.placement import spread
from dragrig.figures.style import BLACK, SMALL_PT, VERMILLION, text_width_in
from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.rig.runfile.model import Event

ORDINARY = frozenset({"start", "phase", "end"})
"""Kinds of events that every run has; phases are shaded instead."""

GAP = "gap"
MOST_LABELS = 6


@dataclass(frozen=True, slots=True)
class Mark:
    """A time and the word that stands beside it."""

    time_s: float
    word: str


def mark_gaps(panels: Sequence[Axes], time: FloatArray, gap: BoolArray) -> None:
    """Hatch the times for which samples are missing."""
    before = np.flatnonzero(gap)
    if before.size == 0:
        return
    bars = np.column_stack((time[before], time[before + 1] - time[before])).tolist()
    for axes in panels:
        axes.broken_barh(
            bars,
            (0, 1),
            transform=axes.get_xaxis_transform(),
            facecolor="none",
            edgecolor=BLACK,
            hatch="////",
            linewidth=0.6,
            alpha=0.55,
            zorder=1.5,
        )


def marks_of(events: Sequence[Event], time: FloatArray, gap: BoolArray) -> tuple[Mark, ...]:
    """Gather what is out of the ordinary: gaps, as the sample times show them, and events."""
    if time.size == 0:
        return ()
    before = np.flatnonzero(gap)
    starts, ends = time[before], time[before + 1]
    marks = [
        Mark(float(start), f"gap {_duration(float(end - start))}") for start, end in zip(starts, ends, strict=True)
    ]
    for event in events:
        told = event.kind not in ORDINARY and time[0] <= event.time_s <= time[-1]
        seen = event.kind == GAP and bool(((starts <= event.time_s) & (event.time_s <= ends)).any())
        if told and not seen:
            marks.append(Mark(event.time_s, event.kind))
    return tuple(sorted(marks, key=lambda mark: mark.time_s))


def draw_marks(panels: Sequence[Axes], marks: Sequence[Mark]) -> None:
    """Draw a line through all panels at each mark, and name it at the foot of the first panel.

    Of very many the first are named, and the rest counted.
    """
    if not marks:
        return
    for axes in panels:
        axes.vlines(
            [mark.time_s for mark in marks],
            0,
            1,
            transform=axes.get_xaxis_transform(),
            color=VERMILLION,
            linewidth=1.3,
            linestyle=(0, (4, 2)),
            zorder=3,
        )
    words = [mark.word for mark in marks[:MOST_LABELS]]
    if len(marks) > MOST_LABELS:
        words[-1] += f" + {len(marks) - MOST_LABELS} more"
    _write(panels[0], [mark.time_s for mark in marks[:MOST_LABELS]], words)


def _write(axes: Axes, times: Sequence[float], words: Sequence[str]) -> None:
    low, high = axes.get_xlim()
    wide, tall = width_in(axes), height_in(axes)
    centres = [(time - low) / (high - low) * wide for time in times]
    widths = [text_width_in(word, SMALL_PT) + 0.24 for word in words]
    for word, place in zip(words, spread(centres, widths, 0.0, wide), strict=True):
        axes.text(
            place / wide,
            0.16 / tall,
            word,
            transform=axes.transAxes,
            ha="center",
            va="center",
            fontsize=SMALL_PT,
            color="white",
            zorder=6,
            bbox={"boxstyle": "round,pad=0.22", "facecolor": VERMILLION, "edgecolor": "none"},
        )


def _duration(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 0.1 else f"{1e3 * seconds:.3g} ms"
