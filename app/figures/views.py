"""What of a run is drawn: its quantities as curves against time, ready for any axes."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from dragrig.figures.derived import SteadyLevel
from dragrig.figures.envelope import envelope, gap_after
from dragrig.figures.panels import Pen, draw, fit_y, label_y, write_words
from dragrig.figures.style import BLACK, BLUE, GREEN, GREY, PURPLE
from dragrig.rig.arrays import AnyFloatArray, BoolArray, FloatArray
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Attribute, FilteredTrace, Run

RAW = "#7DB3DA"
RAW_MOTOR = "#CFA3BC"
LABELS = {"force": "Force (mN)", "motor_force": "Motor force (mN)"}


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A line of a panel: times and values of one shape, where samples are missing, and how it is drawn."""

    time: FloatArray
    value: AnyFloatArray
    gap: BoolArray
    pen: Pen


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One quantity against time; its range is at least `smallest_span` wide and holds `level`, if there is one."""

    label: str
    curves: tuple[Curve, ...]
    smallest_span: float
    level: float = np.nan


def force_panel(
    run: Run, filtered: FilteredTrace | None, gap: BoolArray, channel: str = "", steady: SteadyLevel | None = None
) -> Panel:
    """Measured force, thin and light, with the filtered one over it and the level of steady sliding.

    `channel` names another than the run's signal.
    """
    name = channel or run.trace.signal
    motor = name == "motor_force"
    strong, light = (PURPLE, RAW_MOTOR) if motor else (BLUE, RAW)
    smooth = filtered.channels.get(name) if filtered is not None else None
    time = run.trace.time
    if filtered is None or smooth is None:
        curves = [Curve(time, run.trace.channels[name], gap, Pen("raw", strong, 1.0))]
    else:
        smooth_gap = gap_after(filtered.time, run.trace.sample_rate_hz)
        curves = [
            Curve(time, run.trace.channels[name], gap, Pen("raw", light, 1.0)),
            Curve(filtered.time, smooth, smooth_gap, Pen("filtered", strong, 2.0, detail=_how(filtered.parameters))),
        ]
    if steady is not None:
        ends, level = np.array([steady.begin_s, steady.end_s]), np.full(2, steady.force_mN)
        curves.append(Curve(ends, level, np.zeros(1, dtype=np.bool_), Pen(steady.text, BLACK, 1.2, dashed=True)))
    return Panel(LABELS.get(name, name), tuple(curves), 1.0)


def position_panel(run: Run, gap: BoolArray) -> Panel:
    """Where the encoder was, and where it was told to be, if anybody told it."""
    time, trace = run.trace.time, run.trace
    curves = [Curve(time, trace.position, gap, Pen("encoder", "#59BFA0", 3.2))]
    # Of a foreign measurement without a command the position stands for it.
    if run.info.header.backend != "external" or not np.array_equal(trace.command, trace.position):
        curves.append(Curve(time, trace.command, gap, Pen("command", BLACK, 1.0, dashed=True)))
    return Panel("Position (mm)", tuple(curves), 2e-3)


def speed_panel(run: Run, speed: FloatArray, gap: BoolArray) -> Panel:
    """Measured speed; the speed that was asked for, where the protocol names one."""
    curves = [Curve(run.trace.time, speed, gap, Pen("measured", GREEN, 1.8))]
    wanted, steady = _wanted_speed(run), run.trace.phase == Phase.STEADY
    if wanted is not None and steady.any():
        level = np.where(steady, wanted, np.nan)
        curves.append(
            Curve(run.trace.time, level, gap, Pen(f"set {wanted:g} mm/s".replace("-", "−"), BLACK, 1.0, dashed=True))
        )
    return Panel("Speed (mm/s)", tuple(curves), 2e-3, level=0.0)


def draw_panel(axes: Axes, panel: Panel, below_in: float = 0.1, window: tuple[float, float] | None = None) -> None:
    """Draw a panel's curves, or the part of them inside a window of time, and label it."""
    shown = []
    for curve in panel.curves:
        time, value, gap = _cropped(curve, window)
        shown.append(value)
        draw(axes, *envelope(time, value, gap), curve.pen)
    fit_y(axes, [*shown, np.array([panel.level])], panel.smallest_span, below_in)
    if not any(np.isfinite(value).any() for value in shown):
        axes.text(0.5, 0.5, "no samples", transform=axes.transAxes, ha="center", va="center", color=GREY)
    label_y(axes, panel.label)
    write_words(axes, [curve.pen for curve in panel.curves])


def _cropped(curve: Curve, window: tuple[float, float] | None) -> tuple[FloatArray, AnyFloatArray, BoolArray]:
    if window is None or curve.time.size <= 2:
        return curve.time, curve.value, curve.gap
    first, last = np.searchsorted(curve.time, window)
    first, last = max(int(first) - 1, 0), min(int(last) + 1, curve.time.size)
    return curve.time[first:last], curve.value[first:last], curve.gap[first : max(last - 1, first)]


def _how(parameters: Mapping[str, Attribute]) -> str:
    window, order = parameters.get("window_s"), parameters.get("order")
    if not isinstance(window, int | float) or not isinstance(order, int | float):
        return ""
    length = f"{window:g} s" if window >= 0.1 else f"{1e3 * window:g} ms"
    return f" by Savitzky–Golay, {length}, order {order:g}"


def _wanted_speed(run: Run) -> float | None:
    parameters = run.info.header.protocol
    speed = parameters.get("speed_mm_s", parameters.get("ramp_speed_mm_s"))
    travel = parameters.get("travel_mm", 1.0)
    if not isinstance(speed, int | float) or not isinstance(travel, int | float):
        return None
    return float(np.copysign(speed, travel))
