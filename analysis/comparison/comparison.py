"""Everything that a comparison says, as values. A difference is always B − A; forces in mN."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from math import hypot, isfinite, nan
from typing import TYPE_CHECKING

import numpy as np

from dragrig.analysis.comparison.overlay import AlignedRuns, align_runs
from dragrig.analysis.estimates import NORMAL_95, Estimate, Exclusion
from dragrig.analysis.segments import in_phase
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Attribute, Run, RunInfo

if TYPE_CHECKING:
    import pandas as pd


SAME_SETTING_TOLERANCE = 0.01
"""Settings that differ by a smaller share are the same."""
SAME_MEASURED_TOLERANCE = 0.03
"""The same of speeds and ways that no protocol names and that are taken from the recorded positions."""
CAPSULE_SIZES = {
    "diameter_mm": "mm in diameter",
    "length_mm": "mm long",
    "mass_g": "g",
    "contact_angle_deg": "° contact angle",
}
SECONDARY_SETTINGS = {
    "accel_mm_s2": "acceleration",
    "ramp_accel_mm_s2": "acceleration of the ramp",
    "rest_s": "rest",
    "hold_s": "hold",
}
"""Settings that may differ between runs that are compared, but are told of."""


@dataclass(frozen=True, slots=True)
class RunCondition:
    """Kind, speed, strain, way, capsule and fixture of a run; None where the run does not say.

    Attributes
    ----------
    speed_mm_s
        Without sign; `measured` where no protocol names it.
    travel_mm
        With the sign of its direction.
    capsule
        Diameter [mm], length [mm], mass [g] and contact angle [deg].
    """

    kind: str
    signal: str
    fixture: str
    speed_mm_s: float | None
    shear_strain: float | None
    travel_mm: float | None
    capsule: tuple[float | None, ...]
    measured: bool = False

    def __str__(self) -> str:
        """In words: drag at 5 mm/s, relaxation at 50 %."""
        if self.shear_strain is not None:
            return f"{self.kind} at {100 * self.shear_strain:.3g} %"
        back = " back" if (self.travel_mm or 0.0) < 0 else ""
        return self.kind if self.speed_mm_s is None else f"{self.kind} at {self.speed_mm_s:.3g} mm/s{back}"

    def differs_from(self, other: "RunCondition") -> tuple[str, ...]:
        """Say in words in what two conditions differ; empty where the runs may be compared."""
        return tuple(_condition_differences(self, other))


def run_condition(run: Run) -> RunCondition:
    """Gather what was done in a run; what no protocol names comes from the recorded positions."""
    header = run.info.header
    protocol = header.protocol
    speed = _finite_attribute(protocol, "speed_mm_s", "ramp_speed_mm_s")
    travel, strain = _finite_attribute(protocol, "travel_mm"), _finite_attribute(protocol, "shear_strain")
    measured = strain is None and (speed is None or travel is None)
    if measured:
        seen_speed, seen_travel = _recorded_motion(run)
        speed, travel = speed or seen_speed, travel or seen_travel
    return RunCondition(
        kind=header.kind,
        signal=run.trace.signal,
        fixture=str(header.specimen.get("fixture", "")),
        speed_mm_s=None if speed is None else abs(speed),
        shear_strain=strain,
        travel_mm=travel,
        capsule=tuple(_finite_attribute(header.capsule, key) for key in CAPSULE_SIZES),
        measured=measured,
    )


def secondary_differences(a: RunInfo, b: RunInfo) -> tuple[str, ...]:
    """Say in which further settings two runs differ that are compared all the same."""
    found = []
    for key, word in SECONDARY_SETTINGS.items():
        values = _finite_attribute(a.header.protocol, key), _finite_attribute(b.header.protocol, key)
        if not _agree(*values, SAME_SETTING_TOLERANCE):
            found.append(f"{word} {_value_text(values[0])} against {_value_text(values[1])} {key.rsplit('_', 1)[-1]}")
    return tuple(one.replace("mm_s2", "mm/s²").replace(" s2", " mm/s²") for one in found)


def _condition_differences(one: RunCondition, other: RunCondition) -> Iterator[str]:
    for word, mine, theirs in (
        ("kind", one.kind, other.kind),
        ("signal", one.signal, other.signal),
        ("fixture", one.fixture, other.fixture),
    ):
        if mine != theirs:
            yield f"{word} {mine or 'not said'} against {theirs or 'not said'}"
    share = SAME_MEASURED_TOLERANCE if one.measured or other.measured else SAME_SETTING_TOLERANCE
    for mine_, theirs_, factor, unit in (
        (one.speed_mm_s, other.speed_mm_s, 1.0, "mm/s"),
        (one.shear_strain, other.shear_strain, 100.0, "% strain"),
        (one.travel_mm, other.travel_mm, 1.0, "mm of travel"),
        *((m, t, 1.0, unit) for m, t, unit in zip(one.capsule, other.capsule, CAPSULE_SIZES.values(), strict=True)),
    ):
        if not _agree(mine_, theirs_, share):
            yield f"{_value_text(mine_, factor)} against {_value_text(theirs_, factor)} {unit}"


def _agree(one: float | None, other: float | None, share: float) -> bool:
    if one is None or other is None:
        return one is other
    return abs(one - other) <= share * max(abs(one), abs(other))


def _value_text(value: float | None, factor: float = 1.0) -> str:
    return "not said" if value is None else f"{factor * value:.4g}"


def _recorded_motion(run: Run) -> tuple[float | None, float | None]:
    """Speed of the steady phase and way of the whole run, both signed."""
    position, time = np.asarray(run.trace.position, dtype=np.float64), run.trace.time
    seen = np.isfinite(position)
    if np.count_nonzero(seen) < 2:
        return None, None
    travel = float(position[seen][-1] - position[seen][0])
    steady = seen & in_phase(run.trace, Phase.STEADY)
    if np.count_nonzero(steady) < 2:
        return None, travel
    took = float(time[steady][-1] - time[steady][0])
    return float(position[steady][-1] - position[steady][0]) / took if took > 0 else None, travel


def _finite_attribute(attributes: Mapping[str, Attribute], *keys: str) -> float | None:
    for key in keys:
        value = attributes.get(key)
        if isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value):
            return float(value)
    return None


STEADY_FORCE, ABOVE_REST, REST_FORCE, PEAK_FORCE, HOLD_FORCE, STEADY_SPEED = (
    "steady force",
    "above rest",
    "rest",
    "peak",
    "hold",
    "speed",
)


class DifferenceVerdict(StrEnum):
    """How a difference stands beside what differs anyway; each limit holds 95 % of equal runs."""

    NOISE = "within noise"
    SCATTER = "within scatter"
    BEYOND = "differs"
    UNKNOWN = "cannot be told"


@dataclass(frozen=True, slots=True)
class MeasureDifference:
    """One measure of two runs.

    Attributes
    ----------
    measure, unit
        As in `analysis.measures`, in words.
    a, b
        As recorded.
    zeros
        What the rest before the motion shows of both, taken off before they were subtracted; None where it was not.
    value
        B − A; None where one is missing, with the `reason`.
    noise
        Its standard error by the noise of both runs.
    spread
        Standard deviation by which it differs between repeats on one specimen, unknown zeros included.
    """

    measure: str
    unit: str
    a: Estimate
    b: Estimate
    zeros: tuple[float, float] | None = None
    value: float | None = None
    noise: float | None = None
    spread: float = 0.0
    reason: str = ""

    @property
    def compared(self) -> tuple[float | None, float | None]:
        """Values of both that were subtracted, zeros taken off."""
        zeros = self.zeros or (0.0, 0.0)
        a, b = (
            None if one.value is None else one.value - zero for one, zero in zip((self.a, self.b), zeros, strict=True)
        )
        return a, b

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


def main_measures(kind: str) -> tuple[str, ...]:
    """Return the measures that a kind of run is made for."""
    return (PEAK_FORCE, HOLD_FORCE) if kind == "relaxation" else (STEADY_FORCE,)


@dataclass(frozen=True, slots=True, eq=False)
class ComparedRun:
    """A run of one side: its attributes, and how to get at its samples, which are not kept."""

    info: RunInfo
    read: Callable[[], Run]
    remark: str = ""

    @property
    def file(self) -> str:
        """Name of the run's file."""
        return self.info.path.name


@dataclass(frozen=True, slots=True, eq=False)
class ComparedSide:
    """One of the two that are compared: its runs in order, and what is left out with the reason."""

    name: str
    runs: tuple[ComparedRun, ...]
    left_out: tuple[Exclusion, ...] = ()
    specimens: tuple[str, ...] = ()
    is_model: bool = False


@dataclass(frozen=True, slots=True)
class PhaseDifference:
    """The difference of the filtered traces while both runs are in one phase; `at_s` counts from the start of motion.

    `phase` is `all` for the whole run.
    """

    phase: str
    samples: int
    mean_mN: float
    rms_mN: float
    largest_mN: float
    at_s: float


@dataclass(frozen=True, slots=True)
class FollowingError:
    """Position minus command of one run in motion; `lag_s` is by how long steady motion comes late."""

    rms_mm: float
    largest_mm: float
    lag_s: float | None


@dataclass(frozen=True, slots=True)
class MotionDifference:
    """Position against command of both runs, None where no command was recorded, and position B − A on one clock."""

    a: FollowingError | None
    b: FollowingError | None
    rms_mm: float | None
    largest_mm: float | None


@dataclass(frozen=True, slots=True, eq=False)
class RunPair:
    """Two runs in which the same was done.

    Attributes
    ----------
    shift_s
        What was added to the times of B so that both begin to move together; None where that cannot be told.
    differences
        The measures side by side.
    phases
        The filtered traces by phase; empty where they cannot be laid over each other, with the reason in `remarks`.
    """

    condition: RunCondition
    a: ComparedRun
    b: ComparedRun
    shift_s: float | None
    differences: tuple[MeasureDifference, ...]
    phases: tuple[PhaseDifference, ...]
    motion: MotionDifference
    remarks: tuple[str, ...] = ()
    b_is_model: bool = False

    @property
    def main(self) -> tuple[MeasureDifference, ...]:
        """The measures that a run of this kind is made for."""
        wanted = main_measures(self.condition.kind)
        return tuple(one for one in self.differences if one.measure in wanted)

    @property
    def verdict(self) -> DifferenceVerdict:
        """The most serious verdict on a main measure."""
        found = {one.verdict for one in self.main}
        order = (DifferenceVerdict.BEYOND, DifferenceVerdict.SCATTER, DifferenceVerdict.NOISE)
        return next((one for one in order if one in found), DifferenceVerdict.UNKNOWN)

    def overlay(self) -> AlignedRuns:
        """Read both runs and lay their traces over each other; raises `AnalysisError` where that cannot be done."""
        return align_runs(self.a.read(), self.b.read())


@dataclass(frozen=True, slots=True)
class GroupDifference:
    """What the pairs of one condition say together of one measure.

    Attributes
    ----------
    a, b
        Means of both sides, zeros taken off where the pairs' are.
    value, noise, error
        Mean of B − A, its standard error by noise alone, and by noise and scatter.
    relative
        The difference over A; None where A is hardly a force at all.
    rms_mN
        Of the difference of the filtered traces, over all pairs.
    """

    condition: RunCondition
    measure: str
    pairs: int
    a: float
    b: float
    value: float
    noise: float
    error: float
    relative: float | None
    rms_mN: float | None

    @property
    def verdict(self) -> DifferenceVerdict:
        """As of a pair."""
        return judge_difference(self.value, self.noise, self.error)

    @property
    def times_error(self) -> float:
        """The difference in standard errors; infinite where runs without any error differ."""
        if self.error > 0:
            return abs(self.value) / self.error
        return float("inf") if self.value else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """All that was compared.

    Attributes
    ----------
    pairs
        In the order of A's runs.
    alone_a, alone_b
        Runs without a partner, and why.
    zero_mN
        Standard deviation of a sensor's unknown zero that is allowed for where the rest does not show it.
    groups
        The largest differences first.
    sentences
        What a person at the rig needs to know.
    """

    a: ComparedSide
    b: ComparedSide
    pairs: tuple[RunPair, ...]
    alone_a: tuple[Exclusion, ...]
    alone_b: tuple[Exclusion, ...]
    zero_mN: float
    groups: tuple[GroupDifference, ...]
    remarks: tuple[str, ...] = ()
    sentences: tuple[str, ...] = field(default=())


Cell = str | float | bool
"""NaN for a number that is not there."""


def comparison_rows(comparison: Comparison) -> Iterator[dict[str, Cell]]:
    """Yield the rows, all with the same keys; forces in mN, speeds in mm/s, as `unit` says."""
    for pair in comparison.pairs:
        for one in pair.differences:
            yield _comparison_row(pair, one)


def comparison_frame(comparison: Comparison) -> "pd.DataFrame":
    """Return a data frame of the rows of `comparison_rows`."""
    import pandas as pd

    return pd.DataFrame(list(comparison_rows(comparison)))


def _comparison_row(pair: RunPair, one: MeasureDifference) -> dict[str, Cell]:
    condition = pair.condition
    whole = next((each for each in pair.phases if each.phase == "all"), None)
    return {
        "kind": condition.kind,
        "speed_mm_s": _value_or_nan(condition.speed_mm_s),
        "shear_strain": _value_or_nan(condition.shear_strain),
        "travel_mm": _value_or_nan(condition.travel_mm),
        "a_file": pair.a.file,
        "b_file": pair.b.file,
        "shift_s": _value_or_nan(pair.shift_s),
        "measure": one.measure,
        "unit": one.unit,
        "a": _value_or_nan(one.a.value),
        "a_error": _value_or_nan(one.a.standard_error),
        "b": _value_or_nan(one.b.value),
        "b_error": _value_or_nan(one.b.standard_error),
        "zeros_taken_off": one.zeros is not None,
        "b_minus_a": _value_or_nan(one.value),
        "noise_error": _value_or_nan(one.noise),
        "error_with_scatter": _value_or_nan(one.error),
        "half_width_95": nan if one.error is None else NORMAL_95 * one.error,
        "verdict": one.verdict.value,
        "reason": one.reason,
        "trace_rms_mN": nan if whole is None else whole.rms_mN,
        "trace_largest_mN": nan if whole is None else whole.largest_mN,
        "trace_largest_at_s": nan if whole is None else whole.at_s,
        "remarks": "; ".join(pair.remarks),
    }


def _value_or_nan(value: float | None) -> float:
    return nan if value is None else value
