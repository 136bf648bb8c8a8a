"""The picture of two runs on one clock: both forces, their difference, position against command."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.analysis.comparison.measured import Difference
from dragrig.analysis.comparison.overlay import Overlay
from dragrig.analysis.comparison.results import Pair
from dragrig.analysis.estimates import NORMAL_95, Estimate
from dragrig.figures.columns import BETWEEN_IN, FOOT_IN, LEFT_IN, NAMES_IN, RIGHT_IN, WIDTH_IN, column
from dragrig.figures.derived import with_error
from dragrig.figures.envelope import gap_after
from dragrig.figures.header import fitting, header_in, headline, write_badge, write_trouble
from dragrig.figures.panels import Pen, Place
from dragrig.figures.relaxation import ramp_of
from dragrig.figures.style import BLACK, BLUE, GREY, SMALL_PT, VERMILLION, drawing, new_figure
from dragrig.figures.views import LABELS, RAW, Curve, Panel
from dragrig.rig.arrays import FloatArray
from dragrig.rig.runfile.model import Run

RAW_B = "#F0B48C"
FORCE_IN, DIFFERENCE_IN, FOLLOWING_IN = 3.6, 2.0, 1.45
GUTTER_IN = 1.25


def comparison_figure(pair: Pair, names: tuple[str, str] = ("", "")) -> Figure:
    """Draw a pair of runs: forces raw and filtered, B − A below them with what equal runs may differ by, and position.

    A relaxation is drawn twice over: the whole of it, and its ramp magnified.

    Parameters
    ----------
    names
        What the two sides are called; nothing for runs that are told apart by their files alone.

    Raises
    ------
    AnalysisError
        Where the two traces cannot be laid over each other.
    RunFileError
        When a run cannot be read any more.
    """
    overlay = pair.overlay()
    clocked = _on_the_clock(overlay.a, overlay.start_a_s)
    panels, heights = _panels(pair, overlay)
    trouble = "; ".join(pair.remarks)
    ramp = ramp_of(clocked)
    with drawing():
        free = sum(heights) + BETWEEN_IN * (len(heights) - 1)
        figure = new_figure(WIDTH_IN, header_in(trouble) + NAMES_IN + free + FOOT_IN)
        _write_header(figure, pair, names, trouble)
        room = WIDTH_IN - LEFT_IN - RIGHT_IN
        if ramp is None:
            axes = column(figure, clocked, panels, heights, Place(LEFT_IN, FOOT_IN, room, 0.0), _window(overlay))
            _finish(axes, pair)
            return figure
        half = (room - GUTTER_IN) / 2
        left = Place(LEFT_IN, FOOT_IN, half, 0.0)
        _finish(column(figure, clocked, panels, heights, left, _window(overlay), name_ramp=True), pair)
        begin, end = ramp
        window = 1.5 * begin - 0.5 * end, 3.5 * end - 2.5 * begin
        right = Place(LEFT_IN + half + GUTTER_IN, FOOT_IN, half, 0.0)
        magnified = column(figure, clocked, panels, heights, right, window)
        _finish(magnified, pair)
        magnified[-1].set_xlabel("Time (s), the ramp magnified")
        return figure


def _write_header(figure: Figure, pair: Pair, names: tuple[str, str], trouble: str) -> None:
    condition = str(pair.condition)
    a, b = (
        ", ".join(dict.fromkeys(part for part in (name, file) if part))
        for name, file in zip(names, (pair.a.file, pair.b.file), strict=True)
    )
    parts = [f"A: {a}", f"B: {names[1] or 'model'}, on the recorded motion" if pair.b_is_model else f"B: {b}"]
    if pair.shift_s is not None and not pair.b_is_model:
        parts.append(f"B shifted by {_shift(pair.shift_s)}")
    subtitle = fitting("  ·  ".join(parts), SMALL_PT, WIDTH_IN - LEFT_IN - RIGHT_IN)
    headline(figure, LEFT_IN, f"{condition[:1].upper()}{condition[1:]}", subtitle)
    write_trouble(figure, LEFT_IN, trouble)
    other = "model" if pair.b_is_model else pair.b.info.header.backend
    write_badge(figure, " / ".join(dict.fromkeys((pair.a.info.header.backend, other))))


def _shift(shift_s: float) -> str:
    spelt = f"{1e3 * shift_s:+.1f} ms" if abs(shift_s) < 1 else f"{shift_s:+.3f} s"
    return "0 ms" if spelt in {"+0.0 ms", "-0.0 ms"} else spelt.replace("-", "−")


def _on_the_clock(run: Run, start_s: float) -> Run:
    return replace(run, trace=replace(run.trace, time=np.asarray(run.trace.time - start_s)), events=(), filtered=None)


def _window(overlay: Overlay) -> tuple[float, float]:
    return float(overlay.time_s[0]), float(overlay.time_s[-1])


def _panels(pair: Pair, overlay: Overlay) -> tuple[list[Panel], list[float]]:
    a, b = _on_the_clock(overlay.a, overlay.start_a_s), _on_the_clock(overlay.b, overlay.start_b_s)
    panels, heights = [_forces(pair, overlay, a, b), _apart(pair, overlay)], [FORCE_IN, DIFFERENCE_IN]
    followed = [
        _following(name, run, colour)
        for name, run, colour, found in (("A", a, BLUE, pair.motion.a), ("B", b, VERMILLION, pair.motion.b))
        if found is not None
    ]
    if followed:
        panels.append(Panel("Error (µm)", tuple(followed), 20.0, level=0.0))
        heights.append(FOLLOWING_IN)
    return panels, heights


def _forces(pair: Pair, overlay: Overlay, a: Run, b: Run) -> Panel:
    main = pair.main[-1]
    zero_a, zero_b = main.zeros or (0.0, 0.0)
    curves = [_raw("A raw", a, zero_a, RAW)]
    if not pair.b_is_model:
        curves.append(_raw("B raw", b, zero_b, RAW_B))
    curves += [
        _filtered("A", overlay, overlay.force_a - zero_a, BLUE, _level(main, main.a, zero_a)),
        _filtered("B", overlay, overlay.force_b - zero_b, VERMILLION, _level(main, main.b, zero_b)),
    ]
    label = LABELS.get(a.trace.signal, a.trace.signal)
    return Panel(label, tuple(curves), 1.0)


def _apart(pair: Pair, overlay: Overlay) -> Panel:
    main = pair.main[-1]
    zero_a, zero_b = main.zeros or (0.0, 0.0)
    detail = " of the filtered traces" + ("" if main.zeros is None else " less their rests")
    if main.error is not None:
        detail += f"; grey: {main.measure} of equal runs, ± {NORMAL_95 * main.error:.3g} mN"
    apart = _filtered("B − A", overlay, (overlay.force_b - zero_b) - (overlay.force_a - zero_a), BLACK, detail)
    return Panel("B − A (mN)", (apart,), 1.0, level=0.0)


def _raw(word: str, run: Run, zero_mN: float, colour: str) -> Curve:
    trace = run.trace
    force = np.asarray(trace.force, dtype=np.float64) - zero_mN
    return Curve(trace.time, force, gap_after(trace.time, trace.sample_rate_hz), Pen(word, colour, 0.9))


def _filtered(word: str, overlay: Overlay, force: FloatArray, colour: str, detail: str) -> Curve:
    rate = min(overlay.a.trace.sample_rate_hz, overlay.b.trace.sample_rate_hz)
    return Curve(overlay.time_s, force, gap_after(overlay.time_s, rate), Pen(word, colour, 1.8, detail=detail))


def _level(main: Difference, estimate: Estimate, zero_mN: float) -> str:
    if estimate.value is None:
        return ""
    return f", {main.measure} {with_error(estimate.value - zero_mN, estimate.standard_error)} mN"


def _following(name: str, run: Run, colour: str) -> Curve:
    trace = run.trace
    off = 1e3 * (np.asarray(trace.position, dtype=np.float64) - np.asarray(trace.command, dtype=np.float64))
    pen = Pen(name, colour, 1.4, detail=" position − command")
    return Curve(trace.time, off, gap_after(trace.time, trace.sample_rate_hz), pen)


def _finish(axes: Sequence[Axes], pair: Pair) -> None:
    """Mark what equal runs may differ by, and say what the time counts from."""
    main = pair.main[-1]
    apart = axes[1]
    apart.axhline(0.0, color=GREY, linewidth=0.9, zorder=1)
    if main.error is not None:
        half = NORMAL_95 * main.error
        apart.axhspan(-half, half, facecolor=GREY, alpha=0.18, linewidth=0.0, zorder=0.6)
        low, high = apart.get_ylim()
        apart.set_ylim(min(low, -1.15 * half), max(high, 1.15 * half))
    axes[-1].set_xlabel("Time since the start of motion (s)")
