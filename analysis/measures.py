"""Measures of one run, each with its standard error or the reason why it is missing, and a campaign's table of them."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from datetime import datetime
from math import hypot, log, nan, sqrt
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dragrig.analysis.estimates import MIN_SAMPLES_FOR_MEAN, Estimate, Progress, correlated_mean, missing, no_progress
from dragrig.analysis.savgol import SavgolSettings, smooth_channel
from dragrig.analysis.segments import Mask, attribute_number, clipped_samples, end_of_hold, in_phase, steady_stretch
from dragrig.analysis.wording import printable
from dragrig.config import AnalysisError, RunFileError
from dragrig.rig import SENTINEL_ROLE, Drift, FloatArray, IndexArray, Phase, Run, RunInfo, RunStatus, SteadyForce

if TYPE_CHECKING:
    import pandas as pd

    from dragrig.rig import Campaign


MAX_NOISE_CORRELATION_S = 2.0
"""Largest correlation time allowed for the sensor's slow noise, ten times the typical 0.2 s."""
PEAK_WINDOW_S = 0.01
"""Window of the smoothing before the peak is searched; at least five samples.

A relaxation's peak is a cusp: over the filter's default window of 0.05 s it would come out 2 to 3 % low.
"""
STICKING_KINDS = frozenset({"relaxation"})
SET_VALUE_TOLERANCE = 1e-3
"""Relative difference up to which neighbouring speeds or strains are one set value."""


@dataclass(frozen=True, slots=True)
class RunMeasures:
    """Measures of one run; forces in mN, those of the run's signal as recorded, never filtered or zeroed.

    Each error is one standard error.
    """

    steady_force: Estimate
    """Mean over the steady sliding (see `phases.steady_stretch`), the rest offset included."""
    rest_offset: Estimate
    """Mean while at rest before the motion. Zero offset of the sensor, and in a drag test also the force of the relaxed
    wall on the resting capsule.
    """
    peak_force: Estimate
    """Signed extreme of the lightly smoothed force. The error covers white noise only; being the largest of many
    samples it lies, on average, about one to two such errors too far out.
    """
    peak_time_s: float | None
    """Time of the peak."""
    hold_force: Estimate
    """Mean over the end of the hold."""
    speed: Estimate
    """Slope of the position over the steady phase [mm/s], positive or negative."""
    steady_from: str
    """Stretch over which the steady force was averaged, in words."""

    @property
    def steady_above_rest(self) -> Estimate:
        """The steady force with that at rest taken off."""
        steady, rest = self.steady_force, self.rest_offset
        if steady.value is None or rest.value is None:
            return missing(steady.reason or rest.reason)
        if steady.standard_error is None or rest.standard_error is None:
            return Estimate(steady.value - rest.value, reason=steady.reason or rest.reason)
        return Estimate(steady.value - rest.value, hypot(steady.standard_error, rest.standard_error))


def measure(run: Run) -> RunMeasures:
    """Measure a run; a measure that its data do not support is missing, with the reason, and nothing is raised."""
    trace = run.trace
    clipped = clipped_samples(run)
    steady, chosen_by = steady_force(run, clipped)
    rest, hold = in_phase(trace, Phase.REST), end_of_hold(trace)
    rest_offset, hold_force = missing("the run has no rest phase"), missing("the run has no hold phase")
    if rest.any():
        rest_offset = stretch_mean(run, rest, clipped, "the rest")
    if hold.any():
        hold_force = stretch_mean(run, hold, clipped, "the end of the hold")
    peak, peak_time_s = _peak(run, clipped)
    return RunMeasures(
        steady_force=steady,
        rest_offset=rest_offset,
        peak_force=peak,
        peak_time_s=peak_time_s,
        hold_force=hold_force,
        speed=_speed(run),
        steady_from=chosen_by,
    )


def steady_force(run: Run, clipped: Mask) -> tuple[Estimate, str]:
    """Return the mean force of steady sliding [mN], and in words over which stretch."""
    stretch, chosen_by = steady_stretch(run)
    if run.info.kind in STICKING_KINDS:
        return missing(f"a {run.info.kind} run has no steady sliding"), chosen_by
    if not stretch.any():
        return missing(empty_stretch_reason(chosen_by)), chosen_by
    return stretch_mean(run, stretch, clipped, chosen_by), chosen_by


def empty_stretch_reason(chosen_by: str) -> str:
    """Why no sample shows steady sliding, by the words of `steady_stretch`."""
    return f"no sample is left in {chosen_by}" if "phase after" in chosen_by else chosen_by


def stretch_mean(run: Run, stretch: Mask, clipped: Mask, name: str) -> Estimate:
    """Mean force [mN] over a stretch; missing where samples in it are clipped or NaN."""
    if lost := int(np.count_nonzero(stretch & clipped)):
        return missing(f"{lost} samples in {name} are clipped at the end of the sensor's range")
    mean = correlated_mean(run.trace.force[stretch], MAX_NOISE_CORRELATION_S * run.trace.sample_rate_hz)
    return missing(f"{name}: {mean.reason}") if mean.reason else mean


def _peak(run: Run, clipped: Mask) -> tuple[Estimate, float | None]:
    trace = run.trace
    if clipped.any():
        return missing(f"{int(clipped.sum())} samples are clipped at the end of the sensor's range"), None
    settings = SavgolSettings(window_samples=max(5, 2 * int(PEAK_WINDOW_S * trace.sample_rate_hz / 2) + 1), order=2)
    force = np.asarray(trace.force, dtype=np.float64)
    try:
        smoothed = smooth_channel(trace, force, settings).values
    except AnalysisError:
        return missing(f"only {len(force)} samples"), None
    smoothed = np.where(np.isnan(smoothed), force, smoothed)
    if np.isnan(smoothed).any():
        return missing("samples are missing (NaN), and the peak may be among them"), None
    kernel = settings.kernel(trace.sample_rate_hz)
    own_weight = float(kernel.weights[kernel.half])
    at = int(np.abs(smoothed).argmax())
    noise = 1.4826 * float(np.median(np.abs(force - smoothed))) / sqrt(1 - own_weight)
    return Estimate(float(smoothed[at]), noise * sqrt(own_weight)), float(trace.time[at])


def _speed(run: Run) -> Estimate:
    trace = run.trace
    steady = in_phase(trace, Phase.STEADY)
    if np.count_nonzero(steady) < MIN_SAMPLES_FOR_MEAN:
        return missing(f"the steady phase holds fewer than {MIN_SAMPLES_FOR_MEAN} samples")
    position, time = np.asarray(trace.position[steady], dtype=np.float64), trace.time[steady]
    if not np.isfinite(position).all():
        return missing("positions are missing (NaN)")
    centred = time - time.mean()
    spread = float(centred @ centred)
    slope = float(centred @ (position - position.mean())) / spread
    deviation = position - position.mean() - slope * centred
    # The error of a least-squares slope, with as many independent deviations as their correlation leaves.
    effective = correlated_mean(deviation).effective_samples or float(len(position))
    error = sqrt(float(deviation @ deviation) / spread / max(effective - 2, 1.0))
    return Estimate(slope, error, effective)


UNREADABLE = "unreadable"
"""Status in the table of a file that cannot be read as a run."""
COMPLETE_STATUSES = frozenset({RunStatus.COMPLETE.value})
"""Runs that ended otherwise are shown but never averaged."""


@dataclass(frozen=True, slots=True)
class TableRow:
    """Measures of one run; None where the run has none, with the reason in `remark`."""

    file: str
    specimen: str = ""
    """Its id, or its name where it has none."""
    order: int | None = None
    kind: str = ""
    role: str = ""
    """What it was made for beside the plan's own runs: `sentinel`."""
    start_time: datetime | None = None
    minutes_since_excision: float | None = None
    speed_mm_s: float | None = None
    shear_strain: float | None = None
    travel_mm: float | None = None
    capsule: str = ""
    steady_force_mN: float | None = None
    steady_force_error_mN: float | None = None
    rest_offset_mN: float | None = None
    rest_offset_error_mN: float | None = None
    steady_above_rest_mN: float | None = None
    """Steady force with the mean at rest taken off: the sensor's zero, and what the resting capsule bears."""
    steady_above_rest_error_mN: float | None = None
    drift_percent: float | None = None
    """Of a sentinel: change of its steady force above rest since the first of its campaign and specimen."""
    drift_error_percent: float | None = None
    """Standard error of the drift."""
    peak_force_mN: float | None = None
    hold_force_mN: float | None = None
    measured_speed_mm_s: float | None = None
    status: str = ""
    checks: str = ""
    bad: bool = False
    mark: str = ""
    remark: str = ""
    campaign: str = ""
    """Folder of the campaign, where the rows are of several."""
    run_id: str = ""
    copy_of: str = ""
    """File of the same run in an earlier row."""

    @property
    def counts(self) -> bool:
        """Whether the run may be averaged with others: complete, not marked as bad, and no copy of another row's."""
        return not self.bad and not self.copy_of and self.status in COMPLETE_STATUSES


@dataclass(frozen=True, slots=True)
class SpeedMean:
    """Mean of the steady force, that at rest taken off, over repeats on one specimen: one kind, one speed, one way.

    `half_width_95_mN` is half of the 95 % interval from the scatter of the repeats, as `means_of_repeats` has it; None
    for a single run, which shows no scatter.
    """

    specimen: str
    kind: str
    capsule: str
    speed_mm_s: float
    direction: int
    runs: int
    steady_above_rest_mN: float
    half_width_95_mN: float | None


@dataclass(frozen=True, slots=True)
class SpecimensMean:
    """Mean of the steady force, that at rest taken off, over specimens: each specimen's mean counts once.

    `half_width_95_mN` is half of the 95 % interval by Student's t from the scatter between the specimens, however many
    runs each has; None for fewer than three specimens, of which nobody knows how specimens scatter.
    """

    kind: str
    capsule: str
    speed_mm_s: float
    direction: int
    specimens: int
    runs: int
    steady_above_rest_mN: float
    half_width_95_mN: float | None


MIN_SPECIMENS = 3
"""Specimens whose mean has an interval: of two, t has one degree of freedom, and their scatter is luck."""
MAX_UNEQUAL_P, LEAST_SCATTER = 0.01, 0.01
"""Significance level at which scatters differ, and are not pooled; the least of them, relative to the largest."""


def mean_of_specimens(means: Sequence[float]) -> tuple[float, float | None]:
    """Return the mean over specimens, and half of its 95 % interval by Student's t; None for fewer than three."""
    mean, half = means_of_repeats([means])[0]
    return mean, half if len(means) >= MIN_SPECIMENS else None


def means_of_repeats(repeats: Sequence[Sequence[float]]) -> list[tuple[float, float | None]]:
    """Return the mean at each speed, and half of its 95 % interval by Student's t; None for a single value.

    A specimen's runs scatter by a share of their force, or all by as much. The scatter is pooled over the speeds, as a
    share first, unless Bartlett's test (Proc. R. Soc. A 160 (1937) 268) at 1 % says that it differs: two repeats that
    happen to agree would else have an interval of next to nothing. Differences both ways are each speed's own.

    Parameters
    ----------
    repeats
        Values at each speed.
    """
    from scipy.special import stdtrit

    means = [float(np.mean(values)) for values in repeats]
    counts = np.array([len(values) for values in repeats])
    sds = np.array([float(np.std(values, ddof=1)) if len(values) > 1 else 0.0 for values in repeats])
    degrees = counts - 1
    for scales in (np.abs(means), np.ones(len(means))):
        if scales.min() > 0 and _are_alike(sds[counts > 1] / scales[counts > 1], degrees[counts > 1]):
            pooled = sqrt(float(degrees @ (sds / scales) ** 2) / degrees.sum())
            sds, degrees = pooled * scales, np.full(len(means), degrees.sum())
            break
    halves = (stdtrit(np.maximum(degrees, 1), 0.975) * sds / np.sqrt(counts)).tolist()
    return [(mean, half if n > 1 else None) for mean, half, n in zip(means, halves, counts.tolist(), strict=True)]


def _are_alike(sds: FloatArray, degrees: IndexArray) -> bool:
    """Whether several standard deviations may be estimates of one."""
    from scipy.special import chdtrc

    if len(sds) < 2 or sds.max() <= 0:
        return False
    # Repeats that agree to the last digit have still some scatter.
    sds = np.maximum(sds, LEAST_SCATTER * sds.max())
    total = float(degrees.sum())
    excess = total * log(degrees @ sds**2 / total) - float(degrees @ np.log(sds**2))
    correction = 1 + (float((1 / degrees).sum()) - 1 / total) / (3 * (len(sds) - 1))
    return bool(chdtrc(len(sds) - 1, excess / correction) >= MAX_UNEQUAL_P)


def table_rows(folder: "Path | Campaign", progress: Progress = no_progress) -> tuple[TableRow, ...]:
    """Measure every run of a campaign, its folder or its listing; a file that cannot be read has a row with the reason.

    Raises `RunFileError` when there is no such folder.
    """
    from threadpoolctl import threadpool_limits

    from dragrig.rig import read_campaign, read_run

    campaign = read_campaign(folder) if isinstance(folder, Path) else folder
    rows: list[TableRow] = []
    # Of vectors as long as a run, further threads only wait, each on a core of its own.
    with threadpool_limits(limits=1, user_api="blas"):
        for done, info in enumerate(campaign.runs):
            progress(done, len(campaign.runs))
            mark = campaign.marks.get(info.path)
            try:
                rows.append(table_row(read_run(info.path, info), mark.reason if mark else None))
            except RunFileError as error:
                rows.append(unreadable_row(info.path, error))
    progress(len(campaign.runs), len(campaign.runs))
    return campaign_rows(campaign, rows)


def campaign_rows(campaign: "Campaign", rows: Sequence[TableRow]) -> tuple[TableRow, ...]:
    """Return the table of a campaign, from the rows of its runs in order."""
    complete = _with_drifts(_with_copies(rows))
    complete.extend(unreadable_row(path, error) for path, error in campaign.unreadable)
    complete.extend(TableRow(path.name, status=RunStatus.RECORDING.value) for path in campaign.recordings)
    return tuple(complete)


def pooled_rows(folders: Sequence[Path], progress: Progress = no_progress) -> tuple[TableRow, ...]:
    """Measure every run of several campaigns, each row with its campaign; a folder named twice counts once.

    Raises `RunFileError` when one of the folders is missing.
    """
    distinct = tuple({folder.resolve(): folder for folder in folders}.values())
    if len(distinct) == 1:
        return table_rows(distinct[0], progress)
    rows = (replace(row, campaign=str(folder)) for folder in distinct for row in table_rows(folder, progress))
    return tuple(_with_copies(rows))


def _with_copies(rows: Iterable[TableRow]) -> Iterator[TableRow]:
    """Say of a run that lies twice that it counts once."""
    files: dict[str, str] = {}
    for row in rows:
        if row.run_id in files and not row.copy_of:
            first = files[row.run_id]
            remark = "; ".join(filter(None, (row.remark, f"the same run as {first}, which counts once")))
            yield replace(row, copy_of=first, remark=remark)
        else:
            if row.run_id:
                files.setdefault(row.run_id, row.file)
            yield row


def _with_drifts(rows: Iterable[TableRow]) -> list[TableRow]:
    """Compare each sentinel with the first of its specimen, capsule and settings that counts."""
    first: dict[tuple[object, ...], SteadyForce] = {}
    compared: list[TableRow] = []
    for row in rows:
        if row.role != SENTINEL_ROLE or not row.counts or row.order is None:
            compared.append(row)
            continue
        force = SteadyForce(row.order, row.steady_above_rest_mN, row.steady_above_rest_error_mN)
        settings = (row.specimen, row.capsule, row.kind, row.speed_mm_s, row.shear_strain, row.travel_mm)
        drift = Drift(force, first.get(settings))
        if force.value_mN is not None:
            first.setdefault(settings, force)
        compared.append(replace(row, drift_percent=drift.percent, drift_error_percent=drift.error_percent))
    return compared


def table_row(run: Run, bad: str | None = None, measures: RunMeasures | None = None) -> TableRow:
    """Measure one run, unless its measures are given; `bad` is the reason of its mark, if it has one."""
    from dragrig.rig import specimen_key

    info, measured = run.info, measures or measure(run)
    header, protocol = info.header, info.header.protocol
    named = {"steady force": measured.steady_force, "rest offset": measured.rest_offset, "peak": measured.peak_force,
             "hold force": measured.hold_force, "speed": measured.speed}  # fmt: skip
    return TableRow(
        file=info.path.name,
        specimen=specimen_key(info),
        order=header.order,
        kind=header.kind,
        role=SENTINEL_ROLE if info.is_sentinel else "",
        start_time=header.start_time,
        minutes_since_excision=minutes_since_excision(info),
        speed_mm_s=attribute_number(protocol, "speed_mm_s", "ramp_speed_mm_s"),
        shear_strain=attribute_number(protocol, "shear_strain"),
        travel_mm=attribute_number(protocol, "travel_mm"),
        capsule=_capsule_label(info),
        steady_force_mN=measured.steady_force.value,
        steady_force_error_mN=measured.steady_force.standard_error,
        rest_offset_mN=measured.rest_offset.value,
        rest_offset_error_mN=measured.rest_offset.standard_error,
        steady_above_rest_mN=measured.steady_above_rest.value,
        steady_above_rest_error_mN=measured.steady_above_rest.standard_error,
        peak_force_mN=measured.peak_force.value,
        hold_force_mN=measured.hold_force.value,
        measured_speed_mm_s=measured.speed.value,
        status=info.status.value,
        checks=_check_summary(info),
        bad=bad is not None,
        mark=bad or "",
        remark="; ".join(f"no {name}: {estimate.reason}" for name, estimate in named.items() if estimate.reason),
        run_id=header.run_id,
    )


def steady_force_of(run: Run) -> SteadyForce:
    """Return a run's steady force with its force at rest taken off, which sentinels are compared by."""
    measured = measure(run)
    above = measured.steady_above_rest
    return SteadyForce(run.info.header.order, above.value, above.standard_error, above.reason)


def minutes_since_excision(info: RunInfo) -> float | None:
    """Return how long before a run its specimen was excised [min]; None where that is not known."""
    try:
        excised_at = datetime.fromisoformat(str(info.header.specimen.get("excised_at")))
        return (info.header.start_time - excised_at).total_seconds() / 60
    except (TypeError, ValueError):  # nobody stated it, or without its offset from UTC
        return None


def _capsule_label(info: RunInfo) -> str:
    """Return the capsule's name, or its sizes where it has none."""
    capsule = info.header.capsule
    if name := capsule.get("name"):
        return str(name)
    diameter, length, mass = (attribute_number(capsule, key) for key in ("diameter_mm", "length_mm", "mass_g"))
    if diameter is None or length is None:
        return ""
    return f"{diameter:g} × {length:g} mm" + ("" if mass is None else f", {mass:g} g")


FORCE_RESPONSE_FINDINGS = {
    "none": "force dead",
    "along the motion": "force inverted",
    "none to a stop": "force does not follow",
}
"""What a run's `force_response` says, where the force is not as it has to be."""


def _check_summary(info: RunInfo) -> str:
    """Results of the run's own checks; empty where nothing was checked."""
    checks = info.checks
    if not checks:
        return ""
    counted = {"lost_samples": "lost", "clipped_samples": "clipped"}
    findings = [f"{checks[key]} {word}" for key, word in counted.items() if checks.get(key)]
    off_mm, allowed_mm = (attribute_number(checks, f"encoder_mismatch_{key}") for key in ("mm", "allowed_mm"))
    if off_mm is not None and allowed_mm is not None and abs(off_mm) > allowed_mm:
        findings.append(f"encoder {off_mm:+.2f} mm off")
    if (response := checks.get("force_response")) in FORCE_RESPONSE_FINDINGS:
        findings.append(FORCE_RESPONSE_FINDINGS[str(response)])
    noise_mN, quiet_mN = (attribute_number(checks, f"noise_after_{key}") for key in ("mN", "allowed_mN"))
    if noise_mN is not None and quiet_mN is not None and noise_mN > quiet_mN:
        findings.append(f"noise of {noise_mN:.1f} mN began")
    slip_s = attribute_number(checks, "slip_time_s")
    if slip_s is not None and slip_s >= 0:
        findings.append(f"slip at {slip_s:.1f} s")
    return ", ".join(findings) or "ok"


def unreadable_row(path: Path, error: RunFileError) -> TableRow:
    """Return the row of a file that cannot be read, with the reason."""
    return TableRow(path.name, status=UNREADABLE, remark=str(error).removeprefix(f"{path}: "))


def set_values(values: Iterable[float], tolerance: float = SET_VALUE_TOLERANCE) -> tuple[float, ...]:
    """Return the set value that each of some speeds or strains belongs to: of alike ones, that with the fewest digits.

    A value that is converted between units, or read back from a drive, is off by rounding: 0.49999999 was set as 0.5.
    """
    given = tuple(map(float, values))
    groups: list[list[float]] = []
    for value in sorted(set(given)):
        if groups and value - groups[-1][-1] <= tolerance * abs(value):
            groups[-1].append(value)
        else:
            groups.append([value])
    shared = {value: min(group, key=lambda alike: len(repr(alike))) for group in groups for value in group}
    return tuple(shared[value] for value in given)


def mean_per_speed(rows: Sequence[TableRow]) -> tuple[SpeedMean, ...]:
    """Average the steady force above rest over repeats: complete, not marked as bad, and no sentinels.

    Rows of several campaigns are pooled: a specimen is identified by its id, or by its name where it has none.
    """
    groups: dict[tuple[str, str, str, int], dict[float, list[float]]] = {}
    used = [
        (row, row.steady_above_rest_mN, row.speed_mm_s)
        for row in rows
        if row.counts and not row.role and row.steady_above_rest_mN is not None and row.speed_mm_s is not None
    ]
    for (row, force_mN, _), speed_mm_s in zip(used, set_values(speed for *_, speed in used), strict=True):
        direction = -1 if (row.measured_speed_mm_s or row.travel_mm or 1.0) < 0 else 1
        at_speeds = groups.setdefault((row.specimen, row.kind, row.capsule, direction), {})
        at_speeds.setdefault(speed_mm_s, []).append(force_mN)
    means = [
        SpeedMean(specimen, kind, capsule, speed_mm_s, direction, len(forces), *mean)
        for (specimen, kind, capsule, direction), at_speeds in groups.items()
        for (speed_mm_s, forces), mean in zip(at_speeds.items(), means_of_repeats([*at_speeds.values()]), strict=True)
    ]
    return tuple(
        sorted(means, key=lambda mean: (mean.specimen, mean.kind, mean.capsule, mean.speed_mm_s, mean.direction))
    )


def mean_over_specimens(means: Sequence[SpeedMean]) -> tuple[SpecimensMean, ...]:
    """Average specimens' means, each with the same weight; nothing where all are of one specimen."""
    if len({mean.specimen for mean in means}) < 2:
        return ()
    groups: dict[tuple[str, str, float, int], list[SpeedMean]] = {}
    for mean in means:
        groups.setdefault((mean.kind, mean.capsule, mean.speed_mm_s, mean.direction), []).append(mean)
    return tuple(
        SpecimensMean(
            *key,
            len(group),
            sum(mean.runs for mean in group),
            *mean_of_specimens([mean.steady_above_rest_mN for mean in group]),
        )
        for key, group in sorted(groups.items())
    )


def as_frame(rows: Sequence[TableRow] | Sequence[SpeedMean] | Sequence[SpecimensMean]) -> "pd.DataFrame":
    """Return rows as a data frame whose columns are the rows' fields; a missing number is NaN."""
    import pandas as pd

    columns: dict[str, list[object]] = {}
    for column in fields(type(rows[0]) if rows else TableRow):
        values = [getattr(row, column.name) for row in rows]
        if "float" in str(column.type):
            values = [nan if value is None else value for value in values]
        values = [printable(value) if isinstance(value, str) else value for value in values]
        columns[column.name] = values
    return pd.DataFrame(columns)
