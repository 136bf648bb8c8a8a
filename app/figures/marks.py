"""What happened during a run, marked over its traces: missing samples, trips, stops."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes

from dragrig.figures.panels import height_in, width_in
from dragrig.figures.placement import spread
from dragrig.figures.style import GREY, PALE, PAPER, SMALL_PT, VERMILLION, text_width_in
from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.rig.runfile.model import Event

ORDINARY = frozenset({"start", "phase", "end", "import", "filter"})
"""Kinds of events that are no alarm: phases are shaded, what an import or the filter remarks is told by `info`."""

GAP = "gap"
MOST_LABELS = 6
MOST_GAPS = 40
_NARROW = 0.004
"""A gap of a smaller share of the time shown is a line; a longer one is hatched."""


@dataclass(frozen=True, slots=True, order=True)
class Mark:
    """A time, the word that stands beside it, and for how long it lasted."""

    time_s: float
    word: str
    lasted_s: float = 0.0

    @property
    def colour(self) -> str:
        """Colour of line and word: missing samples are no alarm."""
        return GREY if self.lasted_s else VERMILLION


def marks_of(events: Sequence[Event], time: FloatArray, gap: BoolArray, sample_rate_hz: float) -> tuple[Mark, ...]:
    """Gather what is out of the ordinary: gaps, as the sample times show them, and events."""
    if time.size == 0:
        return ()
    before = np.flatnonzero(gap)
    starts, ends = time[before], time[before + 1]
    missing = ends - starts - 1 / sample_rate_hz
    marks = [
        Mark(float(start), f"gap {_duration(float(length))}", float(length))
        for start, length in zip(starts, missing, strict=True)
    ]
    for event in events:
        told = event.kind not in ORDINARY and time[0] <= event.time_s <= time[-1]
        seen = event.kind == GAP and bool(((starts <= event.time_s) & (event.time_s <= ends)).any())
        if told and not seen:
            marks.append(Mark(event.time_s, event.kind))
    return tuple(sorted(marks))


def draw_marks(panels: Sequence[Axes], marks: Sequence[Mark]) -> None:
    """Draw a line through all panels at each mark, or hatch the time it lasted, and name it in the first panel.

    Of very many the first are named, and the rest counted; very many gaps are shaded and summed up.
    """
    low, high = panels[0].get_xlim()
    gaps = [mark for mark in marks if mark.lasted_s]
    crowded = len(gaps) > MOST_GAPS
    long = [mark for mark in gaps if crowded or mark.lasted_s > _NARROW * (high - low)]
    short = [mark for mark in marks if mark not in long]
    for axes in panels:
        _shade(axes, long, hatched=not crowded)
        _lines(axes, short)
    seen = [mark for mark in (short if crowded else marks) if low <= mark.time_s <= high]
    named = seen[:MOST_LABELS]
    if len(seen) > MOST_LABELS:
        named[-1] = replace(named[-1], word=f"{named[-1].word} + {len(seen) - MOST_LABELS} more")
    if crowded:
        missing = _duration(sum(gap.lasted_s for gap in gaps))
        named = sorted([Mark(gaps[0].time_s, f"{len(gaps)} gaps, {missing} missing", gaps[0].lasted_s), *named])
    _write(panels[0], named)


def _lines(axes: Axes, marks: Sequence[Mark]) -> None:
    if marks:
        axes.vlines(
            [mark.time_s for mark in marks],
            0,
            1,
            transform=axes.get_xaxis_transform(),
            colors=[mark.colour for mark in marks],
            linewidth=1.3,
            linestyle=(0, (4, 2)),
            zorder=3,
        )


def _shade(axes: Axes, marks: Sequence[Mark], *, hatched: bool) -> None:
    if marks:
        axes.broken_barh(
            [(mark.time_s, mark.lasted_s) for mark in marks],
            (0, 1),
            transform=axes.get_xaxis_transform(),
            facecolor=PAPER if hatched else "#D5DAE0",
            edgecolor=PALE,
            hatch="////" if hatched else None,
            linewidth=0.0,
            zorder=0.5,
        )


def _write(axes: Axes, marks: Sequence[Mark]) -> None:
    low, high = axes.get_xlim()
    wide, tall = width_in(axes), height_in(axes)
    centres = [(mark.time_s + mark.lasted_s / 2 - low) / (high - low) * wide for mark in marks]
    widths = [text_width_in(mark.word, SMALL_PT) + 0.24 for mark in marks]
    for mark, place in zip(marks, spread(centres, widths, 0.0, wide), strict=True):
        axes.text(
            place / wide,
            0.16 / tall,
            mark.word,
            transform=axes.transAxes,
            ha="center",
            va="center",
            fontsize=SMALL_PT,
            color="white",
            zorder=6,
            bbox={"boxstyle": "round,pad=0.22", "facecolor": mark.colour, "edgecolor": "none"},
        )


def _duration(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 0.1 else f"{1e3 * seconds:.3g} ms"
