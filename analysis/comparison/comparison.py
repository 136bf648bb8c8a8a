"""Two runs aligned on one clock, and everything that a comparison says, as values.

A difference is always B − A; forces in mN.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from math import hypot, nan
from typing import TYPE_CHECKING

import numpy as np

from dragrig.analysis import (
    NORMAL_95,
    Estimate,
    Exclusion,
    Experiment,
    Mask,
    SavgolSettings,
    attribute_number,
    default_filter_settings,
    in_phase,
    printable,
    smooth_channel,
)
from dragrig.config import AnalysisError
from dragrig.rig import AnyFloatArray, FloatArray, Phase, PhaseArray, Run, RunInfo, Trace, as_html

if TYPE_CHECKING:
    import pandas as pd


ALIGNMENT_LEAD_S = 0.05
ALIGNMENT_TRAVEL_MM = 2.0
"""The start of the motion, over which two positions are aligned."""
MAX_ALIGNMENT_S = 0.5
MAX_REFINEMENT_SAMPLES = 3.0
"""The recorded rest ends within this many samples of the start of motion."""
ITERATIONS = 8
SAME_RATE_TOLERANCE = 0.05
"""Rates that differ by a smaller part of a sample over the whole run are equal."""


def start_of_motion(run: Run) -> float | None:
    """Return the time in the file [s] at which the recorded position leaves its first rest; None where it never does.

    Where the positions cannot be used, or show no rest, it is the end of the rest phase.
    """
    trace = run.trace
    if not trace.time.size:
        return None
    try:
        motion = Experiment(run).motion
    except AnalysisError:
        pass  # an unusable position; the phases remain
    else:
        moving = np.flatnonzero(motion.signs)
        if moving.size and moving[0] > 0:
            first = np.isfinite(trace.position).argmax()
            return float(trace.time[first] + motion.breaks_s[moving[0]])
        if not moving.size:
            return None
    in_motion = np.flatnonzero((trace.phase > Phase.REST) & (trace.phase < Phase.HOLD))
    return float(trace.time[in_motion[0]]) if in_motion.size else None


def time_shift(a: Run, b: Run) -> float | None:
    """Return the shift of B's times so that both start to move at the same time; None where either never moves.

    The starts are found to about a sample each; aligning the first millimetres of the two positions by least squares
    reduces that to a small part of a sample.
    """
    start_a, start_b = start_of_motion(a), start_of_motion(b)
    if start_a is None or start_b is None:
        return None
    shift = start_a - start_b
    limit = MAX_REFINEMENT_SAMPLES / min(a.trace.sample_rate_hz, b.trace.sample_rate_hz)
    return shift + _refine_shift(a, b, start_a, shift, limit)


def _refine_shift(a: Run, b: Run, start_s: float, shift_s: float, limit_s: float) -> float:
    time_a, position_a = _finite_positions(a)
    time_b, position_b = _finite_positions(b)
    if position_a.size < 2 or position_b.size < 2:
        return 0.0
    travel = np.abs(position_a - position_a[np.searchsorted(time_a, start_s).clip(0, time_a.size - 1)])
    beyond = time_a[(time_a > start_s) & (travel > ALIGNMENT_TRAVEL_MM)]
    until = min(start_s + MAX_ALIGNMENT_S, float(beyond[0]) if beyond.size else np.inf)
    window = (time_a >= start_s - ALIGNMENT_LEAD_S) & (time_a <= until)
    if np.count_nonzero(window) < 4:
        return 0.0
    time, reference = time_a[window], position_a[window] - position_a[window][0]
    refinement = 0.0
    for _ in range(ITERATIONS):
        shifted = np.interp(time - shift_s - refinement, time_b, position_b)
        slope = np.gradient(shifted, time)
        squared_slope = float(slope @ slope)
        if squared_slope == 0:
            return 0.0
        # A constant between the two positions is no shift.
        difference = (shifted - shifted[0]) - reference
        refinement += float(slope @ difference) / squared_slope
    return refinement if abs(refinement) <= limit_s else 0.0


def _finite_positions(run: Run) -> tuple[FloatArray, FloatArray]:
    position = np.asarray(run.trace.position, dtype=np.float64)
    finite = np.isfinite(position)
    return run.trace.time[finite], position[finite]


@dataclass(frozen=True, slots=True, eq=False)
class AlignedRuns:
    """Two runs on one clock, which counts from the start of A's motion."""

    a: Run
    b: Run
    """`a`, `b`: the runs as read."""
    start_a_s: float
    start_b_s: float
    """`start_a_s`, `start_b_s`: times in the files that are 0 on the clock."""
    shift_s: float | None
    """Added to the times of B; None where no motion shows, and the files' own times are used."""
    time_s: FloatArray
    """The clock at the samples of the slower run that both cover, shape `(N,)`."""
    force_a: FloatArray
    force_b: FloatArray
    """`force_a`, `force_b`: filtered signals [mN] as recorded, shape `(N,)`; NaN where samples are missing."""
    position_a: FloatArray
    position_b: FloatArray
    """`position_a`, `position_b`: recorded positions [mm], shape `(N,)`."""
    phase_a: PhaseArray
    phase_b: PhaseArray
    """`phase_a`, `phase_b`: phases of both, shape `(N,)`."""
    remarks: tuple[str, ...] = ()
    """What was interpolated, and onto what."""

    @property
    def together(self) -> Mask:
        """Where both runs are in the same phase, shape `(N,)`."""
        return np.asarray(self.phase_a == self.phase_b)


def align_runs(a: Run, b: Run) -> AlignedRuns:
    """Align two runs by the start of their motion.

    Raises
    ------
    AnalysisError
        One sentence, where a run is too short for the filter or the two have no time in common.
    """
    shift = time_shift(a, b)
    start_a = (start_of_motion(a) if shift is not None else None) or 0.0
    start_b = start_a - (shift or 0.0)
    a_is_slower = a.trace.sample_rate_hz <= b.trace.sample_rate_hz * (
        1 + SAME_RATE_TOLERANCE / max(len(b.trace.time), 1)
    )
    slow, start = (a.trace, start_a) if a_is_slower else (b.trace, start_b)
    clock = np.asarray(slow.time - start, dtype=np.float64)
    begin = max(float(a.trace.time[0]) - start_a, float(b.trace.time[0]) - start_b)
    end = min(float(a.trace.time[-1]) - start_a, float(b.trace.time[-1]) - start_b)
    half_step = 0.5 / slow.sample_rate_hz
    clock = clock[(clock >= begin - half_step) & (clock <= end + half_step)]
    if clock.size < 2:
        raise AnalysisError(f"{a.info.path.name} and {b.info.path.name}: the two runs have no time in common")
    settings = default_filter_settings(slow.sample_rate_hz)
    window = SavgolSettings(window_s=settings.samples(slow.sample_rate_hz) / slow.sample_rate_hz)
    return AlignedRuns(
        a=a,
        b=b,
        start_a_s=start_a,
        start_b_s=start_b,
        shift_s=shift,
        time_s=clock,
        force_a=_interpolated(a.trace, _filtered_force(a, window), clock + start_a),
        force_b=_interpolated(b.trace, _filtered_force(b, window), clock + start_b),
        position_a=_interpolated(a.trace, a.trace.position, clock + start_a),
        position_b=_interpolated(b.trace, b.trace.position, clock + start_b),
        phase_a=_phase_at(a.trace, clock + start_a),
        phase_b=_phase_at(b.trace, clock + start_b),
        remarks=tuple(_alignment_remarks(a, b, a_is_slower=a_is_slower, aligned=shift is not None)),
    )


def _filtered_force(run: Run, window: SavgolSettings) -> FloatArray:
    try:
        return smooth_channel(run.trace, run.trace.force, window).values
    except AnalysisError as error:
        raise AnalysisError(f"{run.info.path.name}: {error}") from error


def _interpolated(trace: Trace, values: AnyFloatArray, time_s: FloatArray) -> FloatArray:
    """Interpolate a channel, never across a gap; half a sample beyond the ends the end value is used."""
    own_s = trace.time
    interpolated = np.interp(time_s, own_s, np.asarray(values, dtype=np.float64))
    after = np.clip(np.searchsorted(own_s, time_s), 1, own_s.size - 1)
    is_gap = (own_s[after] - own_s[after - 1]) * trace.sample_rate_hz > 1.5
    between = (time_s > own_s[after - 1]) & (time_s < own_s[after])
    return np.asarray(np.where(is_gap & between, np.nan, interpolated))


def _phase_at(trace: Trace, time_s: FloatArray) -> PhaseArray:
    half_step = 0.5 / trace.sample_rate_hz
    nearest = np.clip(np.searchsorted(trace.time, time_s + half_step, side="right") - 1, 0, trace.time.size - 1)
    return np.asarray(trace.phase[nearest])


def _alignment_remarks(a: Run, b: Run, *, a_is_slower: bool, aligned: bool) -> Iterator[str]:
    rates = a.trace.sample_rate_hz, b.trace.sample_rate_hz
    if abs(rates[0] / rates[1] - 1) * max(len(a.trace.time), len(b.trace.time)) > SAME_RATE_TOLERANCE:
        fast, slow = ("B", "A") if a_is_slower else ("A", "B")
        yield f"A was sampled at {rates[0]:g} Hz and B at {rates[1]:g} Hz: {fast} is interpolated onto {slow}'s samples"
    if not aligned:
        yield "the positions show no start of motion, so that the files' own times are compared"


SAME_SETTING_TOLERANCE = 0.01
"""Relative difference up to which settings count as equal."""
SAME_MEASURED_TOLERANCE = 0.03
"""The same for speeds and travels that no protocol states, measured from the recorded positions."""
CAPSULE_SIZES = {
    "diameter_mm": "mm in diameter",
    "length_mm": "mm long",
    "mass_g": "g",
    "contact_angle_deg": "° contact angle",
}
SECONDARY_SETTINGS = {
    "accel_mm_s2": ("acceleration", "mm/s²"),
    "ramp_accel_mm_s2": ("acceleration of the ramp", "mm/s²"),
    "rest_s": ("rest", "s"),
    "hold_s": ("hold", "s"),
}
"""Settings that may differ between compared runs, with a remark: name and unit."""
STEADY_FORCE, ABOVE_REST, REST_FORCE = "steady force", "above rest", "rest"
PEAK_FORCE, HOLD_FORCE, STEADY_SPEED = "peak", "hold", "speed"


@dataclass(frozen=True, slots=True)
class RunCondition:
    """Kind, speed, strain, travel, capsule and fixture of a run; None where the run does not say."""

    kind: str
    signal: str
    fixture: str
    speed_mm_s: float | None
    """Without sign; `measured` where no protocol states it."""
    shear_strain: float | None
    travel_mm: float | None
    """With the sign of its direction."""
    capsule: tuple[float | None, ...]
    """Diameter [mm], length [mm], mass [g] and contact angle [deg]."""
    measured: bool = False
    strokes: str = ""
    """Of a motion of several strokes, which has no speed and no steady force, as its protocol writes them."""

    @property
    def main_measures(self) -> tuple[str, ...]:
        """Measures that decide the verdict on its runs."""
        if self.strokes:
            return ()
        return (PEAK_FORCE, HOLD_FORCE) if self.kind == "relaxation" else (STEADY_FORCE,)

    @property
    def varied(self) -> tuple[float, str]:
        """Its strain or its speed, with the unit."""
        if self.shear_strain is not None:
            return 100 * self.shear_strain, "%"
        return self.speed_mm_s or 0.0, "mm/s"

    def __str__(self) -> str:
        """In words: drag at 5 mm/s, relaxation at 50 %."""
        if self.shear_strain is None and self.speed_mm_s is None:
            return self.kind
        back = " back" if (self.travel_mm or 0.0) < 0 else ""
        value, unit = self.varied
        return f"{self.kind} at {value:.3g} {unit}{back}"

    def differs_from(self, condition: "RunCondition") -> tuple[str, ...]:
        """Return in words the differences of two conditions; empty where the runs may be compared."""
        differences = [
            f"{name} {own or 'not stated'} against {others or 'not stated'}"
            for name, own, others in (
                ("kind", self.kind, condition.kind),
                ("signal", self.signal, condition.signal),
                ("fixture", self.fixture, condition.fixture),
                ("strokes", self.strokes, condition.strokes),
            )
            if own != others
        ]
        tolerance = SAME_MEASURED_TOLERANCE if self.measured or condition.measured else SAME_SETTING_TOLERANCE
        for a, b, factor, unit in (
            (self.speed_mm_s, condition.speed_mm_s, 1.0, "mm/s"),
            (self.shear_strain, condition.shear_strain, 100.0, "% strain"),
            (self.travel_mm, condition.travel_mm, 1.0, "mm of travel"),
            *(
                (a, b, 1.0, unit)
                for a, b, unit in zip(self.capsule, condition.capsule, CAPSULE_SIZES.values(), strict=True)
            ),
        ):
            if not _agree(a, b, tolerance):
                differences.append(f"{_value_text(a, factor)} against {_value_text(b, factor)} {unit}")
        return tuple(differences)


def run_condition(run: Run) -> RunCondition:
    """Condition of a run; speed and travel that no protocol states come from the recorded positions."""
    header = run.info.header
    protocol = header.protocol
    speed = attribute_number(protocol, "speed_mm_s", "ramp_speed_mm_s")
    travel, strain = attribute_number(protocol, "travel_mm"), attribute_number(protocol, "shear_strain")
    strokes = str(protocol.get("strokes", ""))
    measured = strain is None and (speed is None or travel is None) and not strokes
    if measured:
        recorded_speed, recorded_travel = _recorded_motion(run)
        speed, travel = speed or recorded_speed, travel or recorded_travel
    return RunCondition(
        kind=header.kind,
        signal=run.trace.signal,
        fixture=str(header.specimen.get("fixture", "")),
        speed_mm_s=None if speed is None else abs(speed),
        shear_strain=strain,
        travel_mm=travel,
        capsule=tuple(attribute_number(header.capsule, key) for key in CAPSULE_SIZES),
        measured=measured,
        strokes=strokes,
    )


def secondary_differences(a: RunInfo, b: RunInfo) -> Iterator[str]:
    """Yield the settings in which two runs differ that may be compared all the same."""
    for key, (name, unit) in SECONDARY_SETTINGS.items():
        setting_a, setting_b = (attribute_number(info.header.protocol, key) for info in (a, b))
        if not _agree(setting_a, setting_b, SAME_SETTING_TOLERANCE):
            yield f"{name} {_value_text(setting_a)} against {_value_text(setting_b)} {unit}"


def _agree(a: float | None, b: float | None, tolerance: float) -> bool:
    if a is None or b is None:
        return a is b
    return abs(a - b) <= tolerance * max(abs(a), abs(b))


def _value_text(value: float | None, factor: float = 1.0) -> str:
    return "not stated" if value is None else f"{factor * value:.4g}"


def _recorded_motion(run: Run) -> tuple[float | None, float | None]:
    """Speed of the steady phase [mm/s] and travel of the whole run [mm], both signed."""
    position, time = np.asarray(run.trace.position, dtype=np.float64), run.trace.time
    finite = np.isfinite(position)
    if np.count_nonzero(finite) < 2:
        return None, None
    travel = float(position[finite][-1] - position[finite][0])
    steady = finite & in_phase(run.trace, Phase.STEADY)
    if np.count_nonzero(steady) < 2:
        return None, travel
    duration = float(time[steady][-1] - time[steady][0])
    return float(position[steady][-1] - position[steady][0]) / duration if duration > 0 else None, travel


class DifferenceVerdict(StrEnum):
    """Whether noise, or run-to-run scatter, explains a difference; each limit holds 95 % of equal runs."""

    NOISE = "within noise"
    SCATTER = "within scatter"
    BEYOND = "differs"
    UNKNOWN = "cannot be told"


@dataclass(frozen=True, slots=True)
class MeasureDifference:
    """One measure of two runs."""

    measure: str
    unit: str
    """`measure`, `unit`: as in `analysis.measures`, in words."""
    a: Estimate
    b: Estimate
    """`a`, `b`: as recorded."""
    zeros: tuple[float, float] | None = None
    """Rest offsets that were subtracted from both first; None where none were."""
    value: float | None = None
    """B − A; None where either is missing, with the `reason`."""
    noise: float | None = None
    """Its standard error by the noise of both runs."""
    spread: float = 0.0
    """Its standard deviation between repeats on one specimen, unknown zeros included."""
    reason: str = ""

    @property
    def compared(self) -> tuple[float | None, float | None]:
        """Both values after subtracting the zeros."""
        zero_a, zero_b = self.zeros or (0.0, 0.0)
        return (
            None if self.a.value is None else self.a.value - zero_a,
            None if self.b.value is None else self.b.value - zero_b,
        )

    @property
    def error(self) -> float | None:
        """Standard deviation of the difference of two runs that are equal but for noise and scatter."""
        return None if self.noise is None else hypot(self.noise, self.spread)

    @property
    def verdict(self) -> DifferenceVerdict:
        """Whether noise, or noise and scatter, explain it."""
        return judge_difference(self.value, self.noise, self.error)


def judge_difference(value: float | None, noise: float | None, error: float | None) -> DifferenceVerdict:
    """Judge a difference by the standard errors of noise alone and of noise and scatter together."""
    if value is None or noise is None or error is None:
        return DifferenceVerdict.UNKNOWN
    if abs(value) <= NORMAL_95 * noise:
        return DifferenceVerdict.NOISE
    return DifferenceVerdict.SCATTER if abs(value) <= NORMAL_95 * error else DifferenceVerdict.BEYOND


@dataclass(frozen=True, slots=True, eq=False)
class ComparedRun:
    """A run of one side: its attributes, and a function that reads its samples."""

    info: RunInfo
    read: Callable[[], Run]
    remark: str = ""

    @property
    def file(self) -> str:
        """Name of the run's file."""
        return self.info.path.name


@dataclass(frozen=True, slots=True, eq=False)
class ComparedSide:
    """One side of a comparison: its runs in order, and the excluded ones with the reason."""

    name: str
    runs: tuple[ComparedRun, ...]
    left_out: tuple[Exclusion, ...] = ()
    specimens: tuple[str, ...] = ()
    is_model: bool = False


@dataclass(frozen=True, slots=True)
class PhaseDifference:
    """Difference of the filtered traces while both runs are in one phase, or `all`; `at_s` from the start of motion."""

    phase: str
    samples: int
    mean_mN: float
    rms_mN: float
    largest_mN: float
    at_s: float


@dataclass(frozen=True, slots=True)
class FollowingError:
    """Position minus command of one run in motion; `lag_s` is the delay in steady motion."""

    rms_mm: float
    largest_mm: float
    lag_s: float | None


@dataclass(frozen=True, slots=True)
class MotionDifference:
    """Following errors of both runs, None where no command was recorded, and position B − A on one clock."""

    a: FollowingError | None
    b: FollowingError | None = None
    rms_mm: float | None = None
    largest_mm: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RunPair:
    """Two runs of the same condition."""

    condition: RunCondition
    a: ComparedRun
    b: ComparedRun
    shift_s: float | None
    """Added to the times of B so that both start to move together; None where unknown."""
    differences: tuple[MeasureDifference, ...]
    phases: tuple[PhaseDifference, ...]
    """The filtered traces by phase; empty where they cannot be aligned, with the reason in `remarks`."""
    motion: MotionDifference
    remarks: tuple[str, ...] = ()
    b_is_model: bool = False

    @property
    def main(self) -> tuple[MeasureDifference, ...]:
        """Differences of the main measures of the pair's kind."""
        wanted = self.condition.main_measures
        return tuple(difference for difference in self.differences if difference.measure in wanted)

    @property
    def verdict(self) -> DifferenceVerdict:
        """The most serious verdict on a main measure."""
        verdicts = {difference.verdict for difference in self.main}
        order = (DifferenceVerdict.BEYOND, DifferenceVerdict.SCATTER, DifferenceVerdict.NOISE)
        return next((verdict for verdict in order if verdict in verdicts), DifferenceVerdict.UNKNOWN)

    def overlay(self) -> AlignedRuns:
        """Read both runs and align them; raises `AnalysisError` where that cannot be done."""
        return align_runs(self.a.read(), self.b.read())


@dataclass(frozen=True, slots=True)
class GroupDifference:
    """One measure over all pairs of one condition."""

    condition: RunCondition
    measure: str
    pairs: int
    a: float
    b: float
    """`a`, `b`: means of both sides, zeros subtracted where the pairs' are."""
    value: float
    noise: float
    error: float
    """`value`, `noise`, `error`: mean of B − A, its standard error by noise alone, and by noise and scatter."""
    relative: float | None
    """The difference over A; None where A is hardly a force at all."""
    rms_mN: float | None
    """Of the difference of the filtered traces, over all pairs."""

    @property
    def verdict(self) -> DifferenceVerdict:
        """As for a pair."""
        return judge_difference(self.value, self.noise, self.error)

    @property
    def times_error(self) -> float:
        """The difference in standard errors; infinite where runs without any error differ."""
        if self.error > 0:
            return abs(self.value) / self.error
        return float("inf") if self.value else 0.0


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Comparison:
    """All results of a comparison."""

    a: ComparedSide
    b: ComparedSide
    pairs: tuple[RunPair, ...]
    """In the order of A's runs."""
    alone_a: tuple[Exclusion, ...]
    alone_b: tuple[Exclusion, ...]
    """`alone_a`, `alone_b`: runs without a partner, and why."""
    zero_mN: float
    """Standard deviation of a sensor's unknown zero, allowed for where the rest does not show it."""
    groups: tuple[GroupDifference, ...]
    """The largest differences first."""
    remarks: tuple[str, ...] = ()
    sentences: tuple[str, ...] = field(default=())
    """The result in words."""

    def __repr__(self) -> str:
        return f"<comparison of {self.a.name} and {self.b.name}: {' '.join(self.sentences[1:2])}>"

    _repr_html_ = as_html

    @property
    def backends(self) -> tuple[str, ...]:
        """Where the paired runs come from, A's first; `model` for runs that the friction model repeats."""
        of_a = [pair.a.info.header.backend for pair in self.pairs]
        of_b = ["model" if pair.b_is_model else pair.b.info.header.backend for pair in self.pairs]
        return tuple(dict.fromkeys((*of_a, *of_b)))


def comparison_rows(comparison: Comparison) -> Iterator[dict[str, str | float | bool]]:
    """Yield a row for each measure of each pair, all with the same keys; a missing number is NaN."""
    for pair in comparison.pairs:
        condition = pair.condition
        trace = next((phase for phase in pair.phases if phase.phase == "all"), None)
        for difference in pair.differences:
            error = difference.error
            row: dict[str, str | float | bool | None] = {
                "kind": condition.kind,
                "speed_mm_s": condition.speed_mm_s,
                "shear_strain": condition.shear_strain,
                "travel_mm": condition.travel_mm,
                "a_file": pair.a.file,
                "b_file": pair.b.file,
                "shift_s": pair.shift_s,
                "measure": difference.measure,
                "unit": difference.unit,
                "a": difference.a.value,
                "a_error": difference.a.standard_error,
                "b": difference.b.value,
                "b_error": difference.b.standard_error,
                "zeros_taken_off": difference.zeros is not None,
                "b_minus_a": difference.value,
                "noise_error": difference.noise,
                "error_with_scatter": error,
                "half_width_95": None if error is None else NORMAL_95 * error,
                "verdict": difference.verdict.value,
                "reason": difference.reason,
                "trace_rms_mN": None if trace is None else trace.rms_mN,
                "trace_largest_mN": None if trace is None else trace.largest_mN,
                "trace_largest_at_s": None if trace is None else trace.at_s,
                "remarks": "; ".join(pair.remarks),
            }
            yield {
                key: nan if value is None else printable(value) if isinstance(value, str) else value
                for key, value in row.items()
            }


def comparison_frame(comparison: Comparison) -> "pd.DataFrame":
    """Return `comparison_rows` as a data frame."""
    import pandas as pd

    return pd.DataFrame(list(comparison_rows(comparison)))
