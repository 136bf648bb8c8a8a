"""From a plan to the runs of a session, in order, and the checks before anything moves.

Every run is checked against the stage's limits with its run-up and run-down, and for run time, file size and free
disk; the settings of the rig are checked against each other, and the calibrations for their age and their sensor.
"""

import os
import random
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import cache
from pathlib import Path

from dragrig.config import (
    UNSTATED,
    Calibration,
    Capsule,
    Fixture,
    Plan,
    PlanError,
    PlannedKind,
    PlanStep,
    ReturnMode,
    RigCheck,
    RigSettings,
    RunOrder,
    SentinelSettings,
    SettingsError,
    Specimen,
    find_settings,
)
from dragrig.rig.devices import (
    MAX_BLOCK_S,
    Contact,
    StageLimits,
    limit_violations,
)
from dragrig.rig.profile import MotionProfile
from dragrig.rig.protocols import MAX_RUNS, RunProtocol, expand_sweep
from dragrig.rig.protocols.kinds import ReturnProtocol
from dragrig.rig.runfile import existing_folder, free_bytes
from dragrig.rig.stops import RunOn, Stops, run_on_remark

_MAX_RETURN_ACCEL_MM_S2 = 400.0
_SENTINEL_RETURN_MM_S = 20.0
CapsuleFinder = Callable[[str], Capsule]

_BY_HAND_PROMPT = "Return the capsule to its start by hand, outside the gut"


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """One run of a session."""

    index: int
    """Place in the programme, from 0; a resumed session identifies finished runs by it."""
    step: int
    protocol: RunProtocol
    profile: MotionProfile
    capsule: Capsule
    specimen: Specimen
    fixture: Fixture
    contact: Contact
    start_mm: float
    """Absolute position where the run begins."""
    wait_s: float
    tare_s: float = 0.0
    prompt: str = ""
    """Prompt to the operator before the run; empty for none."""
    by_hand: bool = False
    sheared_from: float = 0.0
    """Shear strain of a sticking contact at the first sample."""
    shear_strain: float = 0.0
    note: str = ""
    follows: int = -1
    """Index of the run whose return stroke this is; -1 for any other run."""
    sentinel: bool = False
    """Whether it shows how far the specimen has drifted."""

    @property
    def summary(self) -> str:
        """A few words that distinguish this run from the others of its plan."""
        return f"sentinel {self.protocol.summary()}" if self.sentinel else self.protocol.summary()

    @property
    def end_mm(self) -> float:
        """Absolute position where the run ends."""
        return self.start_mm + float(self.profile.position(self.profile.duration_s))

    @property
    def duration_s(self) -> float:
        """Recorded duration."""
        return self.profile.duration_s

    @property
    def mounting(self) -> str:
        """Capsule and fixture that must be mounted, in words."""
        if self.fixture is Fixture.NONE:
            return f"capsule {self.capsule.name}, clear of the gut"
        holder = "on foam" if self.fixture is Fixture.FOAM else "in the vacuum fixture"
        return f"capsule {self.capsule.name}, gut {holder}"


@dataclass(frozen=True, slots=True)
class Programme:
    """All runs of a session, in order."""

    plan: Plan
    runs: tuple[PlannedRun, ...]

    @property
    def duration_s(self) -> float:
        """Duration from the first wait to the last sample, without manual steps."""
        return sum(run.wait_s + run.tare_s + run.duration_s for run in self.runs)

    def pending(self, done: Collection[int]) -> tuple[PlannedRun, ...]:
        """Return the runs still to make.

        A return stroke belongs to the run that it follows: it is repeated with that run, and made alone only where it
        alone is missing.
        """
        pending = {run.index for run in self.runs}.difference(done)
        return tuple(run for run in self.runs if run.index in pending or run.follows in pending)


def build_programme(
    plan: Plan, specimen: Specimen, start_mm: float, source: str, beside: Path | None = None, zero_mm: float = 0.0
) -> Programme:
    """Return the programme of a plan.

    Where capsule or fixture change from one run to the next and the plan asks nothing there, the run gets a prompt.

    Parameters
    ----------
    start_mm
        Default start of a step.
    source
        Origin of the plan, for error messages.
    beside
        Folder that capsule files in the plan are relative to.
    zero_mm
        Absolute position of the reference of `start_mm`, here and in the plan.

    Raises
    ------
    PlanError, SettingsError
        For a kind, key, value or capsule that is not allowed.
    """

    @cache
    def find_capsule(name: str) -> Capsule:
        return find_settings(Capsule, "capsule", name, beside)

    rng = random.Random(plan.seed)  # noqa: S311  # an order of runs is no secret
    templates = [
        template
        for number, step in enumerate(plan.steps)
        for template in _step_runs(step, number, specimen, f"{source}: steps[{number}]", find_capsule, rng.random)
    ]
    sentinel = None
    if plan.sentinel is not None:
        own_start_mm = plan.sentinel.start_mm if plan.sentinel.start_mm is not None else start_mm
        sentinel = _sentinel_run(plan.sentinel, specimen, f"{source}: sentinel", find_capsule)
        sentinel = replace(sentinel, start_mm=zero_mm + own_start_mm)
    places = _sentinel_places(plan, sentinel, templates, source)
    runs: list[PlannedRun] = []
    position_mm = zero_mm + start_mm
    for place, template in enumerate(templates):
        step, run = plan.steps[template.step], template
        if sentinel is not None and place in places:
            mounted, run = _prepared_by(sentinel, run, runs[-1].mounting if runs else "")
            runs += _with_return(mounted, _SENTINEL_RETURN_MM_S, len(runs))
        opens = place == 0 or templates[place - 1].step != template.step
        if opens and (step.way_back is not ReturnMode.STAY or step.start_mm is not None):
            position_mm = zero_mm + (step.start_mm if step.start_mm is not None else start_mm)
        run = replace(run, index=len(runs), start_mm=position_mm, prompt=_whole_prompt(run, runs))
        if step.way_back is ReturnMode.DRIVEN:
            runs += _with_return(run, step.way_back_speed_mm_s, len(runs))
        else:
            runs.append(run)
            position_mm = run.end_mm if step.way_back is ReturnMode.STAY else run.start_mm
    if sentinel is not None and len(templates) in places:
        runs += _with_return(sentinel, _SENTINEL_RETURN_MM_S, len(runs))
    return Programme(plan, tuple(runs))


def _step_runs(
    step: PlanStep, number: int, specimen: Specimen, place: str, find_capsule: CapsuleFinder, draw: Callable[[], float]
) -> Iterator[PlannedRun]:
    protocols = _protocols(step, place)
    if len(protocols) * step.repeats > MAX_RUNS:
        raise PlanError(f"{place}: makes more than {MAX_RUNS} runs; lower repeats or shorten the lists.")
    for count, protocol in enumerate(_in_order(protocols, step, draw)):
        yield replace(
            _planned_run(step, protocol, specimen, place, find_capsule),
            step=number,
            wait_s=step.wait_s,
            tare_s=step.tare_s,
            prompt=step.prompt if count == 0 or step.prompt_each else "",
            by_hand=step.way_back is ReturnMode.BY_HAND and count > 0,
            note=step.note,
        )


def _sentinel_run(
    settings: SentinelSettings, specimen: Specimen, place: str, find_capsule: CapsuleFinder
) -> PlannedRun:
    protocols = _protocols(settings, place)
    if len(protocols) > 1:
        raise PlanError(f"{place}: is {len(protocols)} runs; give each of its keys a single value.")
    run = _planned_run(settings, protocols[0], specimen, place, find_capsule)
    if run.contact is not Contact.SLIDING:
        raise PlanError(
            f"{place}: a {settings.kind} run without sliding has no steady force; use a drag or a coulomb run."
        )
    return replace(run, wait_s=settings.wait_s, sentinel=True)


def _protocols(planned: PlannedKind, place: str) -> tuple[RunProtocol, ...]:
    if planned.kind == ReturnProtocol.kind:
        raise PlanError(f"{place}: a plan has no steps of kind return; set way_back = 'driven' in the step before.")
    return expand_sweep(planned.kind, planned.parameters, place, tuple(type(planned).model_fields))


def _planned_run(
    planned: PlannedKind, protocol: RunProtocol, specimen: Specimen, place: str, find_capsule: CapsuleFinder
) -> PlannedRun:
    try:
        capsule = find_capsule(planned.capsule or protocol.capsule)
    except SettingsError as error:
        raise SettingsError(f"{place}.capsule: {error}") from error
    return PlannedRun(
        index=0,
        step=-1,
        protocol=protocol,
        profile=protocol.profile(specimen),
        capsule=capsule,
        specimen=specimen,
        fixture=planned.fixture or protocol.fixture,
        contact=Contact.NONE if planned.fixture is Fixture.NONE else protocol.contact,
        start_mm=0.0,
        wait_s=0.0,
        shear_strain=protocol.strain(),
    )


def _sentinel_places(
    plan: Plan, sentinel: PlannedRun | None, templates: Sequence[PlannedRun], source: str
) -> frozenset[int]:
    """Return before which runs a sentinel is made; the number of runs stands for the end.

    Nothing comes between a run and one that begins at its end; no capsule is changed for a sentinel.
    """
    if plan.sentinel is None or sentinel is None:
        return frozenset()
    mounted = [run.mounting == sentinel.mounting for run in templates]
    if not any(mounted):
        raise PlanError(
            f"{source}: sentinel: no step has {sentinel.mounting} mounted; give it the capsule and fixture of a step."
        )

    def is_possible(place: int) -> bool:
        before, after = place > 0 and mounted[place - 1], place < len(templates) and mounted[place]
        return (before or after) and not (before and after and _continues(plan, templates, place))

    possible = [place for place in range(len(templates) + 1) if is_possible(place)]
    places = possible[:1]
    for place in possible[1:-1]:
        if plan.sentinel.every and place - places[-1] >= plan.sentinel.every:
            places.append(place)
    return frozenset((*places, possible[-1]))


def _continues(plan: Plan, templates: Sequence[PlannedRun], place: int) -> bool:
    step = plan.steps[templates[place].step]
    opens = templates[place - 1].step != templates[place].step
    return step.way_back is ReturnMode.STAY and not (opens and step.start_mm is not None)


def _prepared_by(sentinel: PlannedRun, run: PlannedRun, mounting: str) -> tuple[PlannedRun, PlannedRun]:
    """Hand on to a sentinel the manual work before it and the run after it; return both."""
    if run.by_hand:
        return replace(sentinel, by_hand=True, prompt=_BY_HAND_PROMPT), replace(run, by_hand=False)
    if sentinel.mounting == mounting:
        return sentinel, run
    change = f"Change from {mounting} to {sentinel.mounting}" if mounting else ""
    return replace(sentinel, prompt=run.prompt or change), replace(run, prompt="")


def _whole_prompt(run: PlannedRun, earlier: Sequence[PlannedRun]) -> str:
    prompts = (_BY_HAND_PROMPT if run.by_hand else "", run.prompt)
    prompt = "; ".join(filter(None, prompts))
    if prompt or not earlier or run.mounting == earlier[-1].mounting:
        return prompt
    return f"Change from {earlier[-1].mounting} to {run.mounting}"


def _in_order(protocols: tuple[RunProtocol, ...], step: PlanStep, draw: Callable[[], float]) -> list[RunProtocol]:
    repeats = [list(protocols) for _ in range(step.repeats)]
    match step.order:
        case RunOrder.LISTED:
            pass
        case RunOrder.REVERSED:
            repeats = [repeat[::-1] for repeat in repeats]
        case RunOrder.RANDOM:
            repeats = [_shuffled([protocol for repeat in repeats for protocol in repeat], draw)]
        case RunOrder.RANDOM_WITHIN_REPEAT:
            repeats = [_shuffled(repeat, draw) for repeat in repeats]
    return [protocol for repeat in repeats for protocol in repeat]


def _shuffled(items: list[RunProtocol], draw: Callable[[], float]) -> list[RunProtocol]:
    # Sorted by draws of random(), the only method whose stream Python guarantees across versions.
    draws = [draw() for _ in items]
    return [items[index] for index in sorted(range(len(items)), key=draws.__getitem__)]


def _with_return(run: PlannedRun, speed_mm_s: float, index: int) -> Iterator[PlannedRun]:
    """Yield a run with its number and, where it does not end at its start, its return stroke."""
    run = replace(run, index=index)
    yield run
    if run.end_mm == run.start_mm:
        return
    accel_mm_s2 = min(run.profile.extremes().acceleration_mm_s2, _MAX_RETURN_ACCEL_MM_S2)
    stroke = ReturnProtocol(travel_mm=run.start_mm - run.end_mm, speed_mm_s=speed_mm_s, accel_mm_s2=accel_mm_s2)
    yield replace(
        run,
        index=index + 1,
        protocol=stroke,
        profile=stroke.profile(run.specimen),
        start_mm=run.end_mm,
        wait_s=0.0,
        tare_s=0.0,
        prompt="",
        by_hand=False,
        sheared_from=run.shear_strain,
        note="",
        follows=run.index,
        sentinel=False,
    )


BYTES_PER_SAMPLE = 8 + 4 + 8 + 4 + 1
"""time, force, position, command and phase, before compression."""
BYTES_PER_EXTRA_CHANNEL = 4
BYTES_PER_FILE = 60_000


@dataclass(frozen=True, slots=True)
class RunPreview:
    """Extremes and size of a run, before it is made."""

    run: PlannedRun
    lowest_mm: float
    highest_mm: float
    speed_mm_s: float
    accel_mm_s2: float
    samples: int
    size_bytes: int


@dataclass(frozen=True, slots=True)
class Preflight:
    """Runs, duration and size of a session, before it is made, and every finding that forbids it."""

    previews: tuple[RunPreview, ...]
    duration_s: float
    size_bytes: int
    free_bytes: int
    findings: tuple[str, ...]
    remarks: tuple[str, ...] = ()
    """What should be known before the session and does not forbid it."""

    def require(self) -> None:
        """Raise `PlanError` with the first finding and the number of others."""
        if self.findings:
            more = f" (and {len(self.findings) - 1} more)" if len(self.findings) > 1 else ""
            raise PlanError(self.findings[0] + more + ".")


def specimen_remark(specimen: Specimen) -> str:
    """Say which facts of the specimen nobody stated on a real rig, and how they are stated; empty where all are."""
    if not specimen.not_stated:
        return ""
    first = specimen.not_stated[0]
    return (
        f"specimen {specimen.name} is not described: wall thickness taken as {specimen.wall_thickness_mm:g} mm; "
        f"{', '.join(specimen.not_stated)} recorded as {UNSTATED}; state them in the window's form, with "
        f"--specimen FILE or --set specimen.{first}=…"
    )


def preflight(
    programme: Programme,
    rig: RigSettings,
    limits: StageLimits,
    folder: Path,
    source: str,
    extra_channels: int | None = None,
    stops: Stops | None = None,
) -> Preflight:
    """Check every run of a programme without motion.

    Parameters
    ----------
    extra_channels
        Channels besides force and position; None for those of the simulated rig.
    stops
        The stops that end a motion when the program fails or its link; None for a stage without a drive.
    """
    if extra_channels is None:
        extra_channels = 1 if rig.sampling.motor_force else 0
    sample_bytes = BYTES_PER_SAMPLE + BYTES_PER_EXTRA_CHANNEL * extra_channels
    previews: list[RunPreview] = []
    findings: list[str] = []
    furthest: dict[str, RunOn] = {}
    for run in programme.runs:
        extremes, samples = run.profile.extremes(), run.profile.samples(rig.sampling.rate_hz)
        name = f"{source}: run {run.index} ({run.summary})"
        findings += [f"{name} {violation}" for violation in limit_violations(extremes, run.start_mm, limits)]
        run_ons = {failure: RunOn.of(run.profile, rig, stop) for failure, stop in stops or ()}
        for failure, on in run_ons.items():
            furthest[failure] = max(furthest.get(failure, on), on, key=lambda on: on.distance_mm)
        # Of two failures that carry it beyond, the worse one is said.
        worst_first = sorted(run_ons.items(), key=lambda item: -item[1].stop.after_s)
        beyond = (list(on.violations(failure, extremes, run.start_mm, limits)) for failure, on in worst_first)
        findings += [f"{name} {violation}" for violation in next(filter(None, beyond), [])]
        previews.append(
            RunPreview(
                run=run,
                lowest_mm=run.start_mm + extremes.lowest_mm,
                highest_mm=run.start_mm + extremes.highest_mm,
                speed_mm_s=extremes.speed_mm_s,
                accel_mm_s2=extremes.acceleration_mm_s2,
                samples=samples,
                size_bytes=samples * sample_bytes + BYTES_PER_FILE,
            )
        )
    free = free_bytes(folder)
    total = sum(preview.size_bytes for preview in previews)
    largest = max((preview.size_bytes for preview in previews), default=0)
    reserve = round(rig.recording.reserve_mb * 1e6)
    needed = total + largest + reserve
    if not os.access(existing_folder(folder), os.W_OK):
        findings.insert(0, f"{folder}: no runs can be written here; name another folder with --out")
    if needed > free:
        findings.append(
            f"{folder}: {free / 1e6:.0f} MB free, {needed / 1e6:.0f} MB needed: {(needed - reserve) / 1e6:.1f} MB for "
            f"the runs and {reserve / 1e6:g} MB in reserve (recording.reserve_mb); make room or name another folder"
        )
    fastest_mm_s = max((preview.speed_mm_s for preview in previews), default=0.0)
    remarks = [run_on_remark(failure, on, fastest_mm_s) for failure, on in furthest.items() if on.distance_mm]
    if (days := programme.duration_s / 86_400) > 1:
        until = datetime.now().astimezone() + timedelta(days=days)
        remarks.append(f"the session takes {days:.1f} days, until {until:%Y-%m-%d %H:%M}")
    return Preflight(tuple(previews), programme.duration_s, total, free, tuple(findings), tuple(remarks))


def check_limits(rig: RigSettings) -> RigCheck:
    """Check the limits of stage and guard: whether a stop from full speed fits into half of the travel."""
    stage = rig.stage
    travel_mm = stage.highest_mm - stage.lowest_mm
    delay_mm = stage.max_speed_mm_s * MAX_BLOCK_S
    stop_mm = delay_mm + stage.max_speed_mm_s**2 / (2 * stage.stop_accel_mm_s2)
    detail = (
        f"{stage.lowest_mm:g} to {stage.highest_mm:g} mm, up to {stage.max_speed_mm_s:g} mm/s, from which the guard's "
        f"stop takes {stop_mm:.1f} mm; force up to {rig.guard.force_limit_mN:g} mN"
    )
    if stop_mm < travel_mm / 2:
        return RigCheck("limits", True, detail)
    return RigCheck("limits", False, f"{detail}: lower stage.max_speed_mm_s, or widen the travel")


def check_wiring(rig: RigSettings, calibrations: Mapping[str, Calibration]) -> Iterator[RigCheck]:
    """Check whether the ranges of the real rig's converter and counter cover its limits."""
    force, encoder = rig.hardware.card.force, rig.hardware.card.encoder
    calibrated = calibrations.get("force")
    per_V = calibrated.gain if calibrated is not None else force.per_V
    range_mN = abs(per_V) * (force.overload_V - abs(force.zero_V))
    yield RigCheck(
        "force limit",
        rig.guard.force_limit_mN <= range_mN,
        f"guard.force_limit_mN is {rig.guard.force_limit_mN:g} mN, the force input's range is {range_mN:.0f} mN",
    )
    if encoder.filter_ns:
        # A pulse of A or B lasts two counts.
        max_speed = 2e-3 * rig.encoder.resolution_um / (1e-9 * encoder.filter_ns)
        yield RigCheck(
            "encoder filter",
            rig.stage.max_speed_mm_s <= max_speed,
            f"the filter of {encoder.filter_ns} ns passes up to {max_speed:.0f} mm/s, and stage.max_speed_mm_s is "
            f"{rig.stage.max_speed_mm_s:g}",
        )


def check_calibration(quantity: str, entry: Calibration | None, rig: RigSettings, now: datetime) -> RigCheck:
    """Check the latest calibration of a quantity: whether there is one, its age, and its sensor."""
    name, max_days = f"calibration of {quantity}", rig.hardware.calibration_days
    command = f"dragrig calibrate {quantity}"
    if entry is None:
        return RigCheck(name, False, f"missing; make it with {command}")
    age_days = (now - entry.made_at) / timedelta(days=1)
    detail = f"{entry.id}, {max(age_days, 0):.0f} days old"
    if age_days > max_days:
        return RigCheck(name, False, f"{detail}, more than {max_days:g}: repeat it with {command}")
    if quantity == "force" and rig.force_sensor.serial and entry.sensor_serial != rig.force_sensor.serial:
        sensor = entry.sensor_serial or "a sensor without a serial number"
        return RigCheck(name, False, f"{detail}, made with {sensor}, and the rig has {rig.force_sensor.serial}")
    return RigCheck(name, True, detail)
