"""Candidate runs for the next experiment: grid, greedy search per minute, the plan to carry out, and its words."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Protocol, Self, TypeVar

import numpy as np

from dragrig.analysis import Experiment, capitalise, percent_text, prepare_channels, significant_text
from dragrig.analysis.gap.design import Study
from dragrig.analysis.gap.diagnosis import ModelPair, NextExperiment, NextRun, display_name
from dragrig.analysis.gap.run_data import MAX_BLOCK_MM, RunData
from dragrig.config import Fixture, Plan, PlanStep, ReturnMode, RunOrder, Specimen
from dragrig.rig import (
    AnyFloatArray,
    PlannedRun,
    Programme,
    RecordedChannel,
    Run,
    RunHeader,
    RunInfo,
    RunStatus,
    Trace,
    build_programme,
)

START_MM = 0.0
STROKE_MM, SHORT_STROKE_MM = 40.0, 20.0
SLOW_MM_S = 2.0
"""Up to this speed a shorter stroke is also a candidate, which takes half the time."""
DRAG_SPEEDS_MM_S = (0.5, 1.0, 2.0, 3.5, 7.0, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0, 50.0, 60.0)
COULOMB_SPEEDS_MM_S = (0.5, 1.0, 2.0, 5.0, 15.0, 40.0)
STRAINS = (0.5, 1.0, 1.5, 2.0)
HOLDS_S = (20.0, 60.0)
BLANK_MOTIONS = ((5.0, 400.0), (40.0, 100.0), (40.0, 400.0), (40.0, 2000.0))
DWELLS_S = (10.0, 300.0)
DWELL_SPEEDS_MM_S = (2.0, 20.0)
REVERSAL_SPEEDS_MM_S = (2.0, 20.0)
LONG_STROKE_MM, MOTION_REPEATS = 80.0, 2
SHORT_MOTION_GRID = ((2.0, 400.0), (20.0, 400.0), (60.0, 400.0), (20.0, 2000.0), (60.0, 2000.0), (40.0, 100.0))
MOTION_SPEEDS_MM_S, MOTION_ACCELERATIONS_MM_S2, MOTION_TRAVELS_MM = (
    (2.0, 20.0, 60.0),
    (100.0, 400.0, 2000.0),
    (STROKE_MM, LONG_STROKE_MM),
)


@dataclass(frozen=True, eq=False)
class CandidateRun:
    """A step of a plan: one run with its return, or repeats of it."""

    step: PlanStep
    specimen: Specimen

    @cached_property
    def programme(self) -> Programme:
        """Programme of the step."""
        plan = Plan(name="next", steps=(self.step,))
        return build_programme(plan, self.specimen, START_MM, "the run that is tried")

    @property
    def run(self) -> PlannedRun:
        """The run, the first of its repeats."""
        return self.programme.runs[0]

    @property
    def minutes(self) -> float:
        """Rig time with the rest before it and the return."""
        return self.programme.duration_s / 60


@dataclass(frozen=True, slots=True)
class RigLimits:
    """Limits of the rig; strokes go up from their start."""

    travel_mm: float = STROKE_MM
    speed_mm_s: float = 60.0
    accel_mm_s2: float = 2000.0
    kinds: tuple[str, ...] = ()
    """Kinds of run that can be made; empty for all."""

    def allow(self, candidate: CandidateRun) -> bool:
        """Whether a candidate is within the limits."""
        extremes = candidate.run.profile.extremes()
        return (
            extremes.highest_mm <= self.travel_mm + 1e-6
            and extremes.lowest_mm >= -1e-6
            and extremes.speed_mm_s <= self.speed_mm_s * (1 + 1e-9)
            and extremes.acceleration_mm_s2 <= self.accel_mm_s2 * (1 + 1e-9)
            and (not self.kinds or candidate.step.kind in self.kinds)
        )


def short_grid(specimen: Specimen) -> tuple[CandidateRun, ...]:
    """Return about ten runs that differ strongly from each other."""
    steps = [
        _stroke("drag", 1.0, SHORT_STROKE_MM),
        *(_stroke("drag", speed, STROKE_MM) for speed in (5.0, 20.0, 60.0)),
        _stroke("coulomb", 1.0, SHORT_STROKE_MM),
        _stroke("coulomb", 15.0, STROKE_MM),
        _relaxation(2.0, 20.0),
        _stroke("blank", 40.0, STROKE_MM, accel_mm_s2=2000.0),
        _reversal(20.0),
    ]
    return _candidate_runs(steps, specimen)


def full_grid(specimen: Specimen) -> tuple[CandidateRun, ...]:
    """Return the full grid: speed, travel, strain, hold, rest before the run, acceleration and reversal."""
    steps = [
        *(_stroke("drag", speed, STROKE_MM) for speed in DRAG_SPEEDS_MM_S),
        *(_stroke("drag", speed, SHORT_STROKE_MM) for speed in DRAG_SPEEDS_MM_S if speed <= SLOW_MM_S),
        *(_stroke("drag", speed, STROKE_MM, wait_s=wait) for speed in DWELL_SPEEDS_MM_S for wait in DWELLS_S),
        *(
            _stroke("coulomb", speed, SHORT_STROKE_MM if speed <= SLOW_MM_S else STROKE_MM)
            for speed in COULOMB_SPEEDS_MM_S
        ),
        *(_relaxation(strain, hold) for hold in HOLDS_S for strain in STRAINS),
        *(_stroke("blank", speed, STROKE_MM, accel_mm_s2=accel) for speed, accel in BLANK_MOTIONS),
        *(_reversal(speed) for speed in REVERSAL_SPEEDS_MM_S),
    ]
    return _candidate_runs(steps, specimen)


def motion_grid(specimen: Specimen, *, whole: bool = False) -> tuple[CandidateRun, ...]:
    """Return runs that differ in the motion of the stage: blanks, without rest or specimen, and a reversal.

    Eight runs, or the full grid of speed, acceleration and travel. Each is made twice, for a held-out score needs
    repeats.
    """
    if whole:
        combinations = product(MOTION_SPEEDS_MM_S, MOTION_ACCELERATIONS_MM_S2, MOTION_TRAVELS_MM)
        grid = [motion for motion in combinations if motion[0] ** 2 / motion[1] < motion[2]]
    else:
        grid = [*((*motion, STROKE_MM) for motion in SHORT_MOTION_GRID), (20.0, 400.0, SHORT_STROKE_MM)]
    steps = [_stroke("blank", speed, travel, accel_mm_s2=accel) for speed, accel, travel in grid]
    return _candidate_runs(
        [step.model_copy(update={"repeats": MOTION_REPEATS}) for step in (*steps, _reversal(20.0))], specimen
    )


def _candidate_runs(steps: Iterable[PlanStep], specimen: Specimen) -> tuple[CandidateRun, ...]:
    return tuple(CandidateRun(step, specimen) for step in steps)


def _stroke(
    kind: str, speed_mm_s: float, travel_mm: float, *, wait_s: float | None = None, accel_mm_s2: float = 400.0
) -> PlanStep:
    default_wait_s = {"drag": 60.0, "coulomb": 30.0, "blank": 5.0}[kind]
    settings = {"speed_mm_s": speed_mm_s, "travel_mm": travel_mm, "accel_mm_s2": accel_mm_s2}
    return PlanStep(kind=kind, wait_s=default_wait_s if wait_s is None else wait_s, parameters=settings)


def _relaxation(strain: float, hold_s: float) -> PlanStep:
    return PlanStep(kind="relaxation", wait_s=60.0, parameters={"shear_strain": strain, "hold_s": hold_s})


def _reversal(speed_mm_s: float) -> PlanStep:
    """Return a stroke there and back in one record, with a pause at the turn."""
    there: Mapping[str, float] = {"travel_mm": STROKE_MM, "speed_mm_s": speed_mm_s, "pause_s": 1.0}
    back: Mapping[str, float] = {"travel_mm": -STROKE_MM, "speed_mm_s": speed_mm_s}
    return PlanStep(kind="motion", way_back=ReturnMode.STAY, wait_s=60.0, parameters={"strokes": [there, back]})


DECIDED_LOG_ODDS = 12.0
"""Log odds above which a pair counts as decided."""
MIN_LOG_ODDS_GAIN = 1e-3
"""Smaller gains in log odds count as none."""
UNBOUNDED = float("inf")
FIXTURE_CHANGE_MIN = 2.0
"""Additional cost of a change of fixture, in minutes of rig time."""

SeenT_contra = TypeVar("SeenT_contra", contravariant=True)


@dataclass(frozen=True, slots=True)
class PairSeparation:
    """Expected log odds of a diagnosis between an assumed effect and its rival, with a weight."""

    pair: ModelPair
    log_odds: float
    weight: float

    def value(self, decided: float) -> float:
        """Return the weighted log odds, limited to the decided ones."""
        return self.weight * min(self.log_odds, decided)


class SeparationModel(Protocol[SeenT_contra]):
    """What a set of runs says about pairs of hypotheses; `SeenT_contra` is what it needs of a run."""

    def with_run(self, observation: SeenT_contra) -> Self:
        """Add a run."""
        ...

    def separations(self) -> Sequence[PairSeparation]:
        """Return the separation of each pair, in order."""
        ...


@dataclass(frozen=True, slots=True)
class ExperimentBudget:
    """Limits of an experiment: rig time, number of runs, and when a pair counts as decided."""

    minutes: float = float("inf")
    runs: int = 1
    decided_log_odds: float = DECIDED_LOG_ODDS
    """Log odds above which a pair counts as decided."""
    use_all_time: bool = False
    """Whether to use remaining time for higher log odds once all pairs are decided."""
    limits: RigLimits | None = None
    """Limits of the rig; default: the range of the campaign's runs."""


def greedy_search(
    model: SeparationModel[SeenT_contra],
    candidates: Sequence[tuple[CandidateRun, SeenT_contra]],
    budget: ExperimentBudget,
) -> tuple[NextRun, ...]:
    """Return the runs with the largest gain per minute, each given those before.

    Parameters
    ----------
    field
        Separation by the campaign so far, with at least one pair.
    tried
        Candidate runs, each with what the model needs of it.
    """
    selected = _greedy_selection(model, candidates, budget)
    if not selected and all(separation.log_odds >= budget.decided_log_odds for separation in model.separations()):
        # All pairs are decided already; the best further runs are optional.
        optional_runs = _merged_repeats(
            _greedy_selection(model, candidates, replace(budget, decided_log_odds=UNBOUNDED))
        )
        return tuple(replace(run, optional=True) for run in optional_runs)
    return _merged_repeats(selected)


def _greedy_selection(
    model: SeparationModel[SeenT_contra],
    candidates: Sequence[tuple[CandidateRun, SeenT_contra]],
    budget: ExperimentBudget,
) -> list[tuple[CandidateRun, ModelPair, ModelPair]]:
    selected: list[tuple[CandidateRun, ModelPair, ModelPair]] = []
    spent, fixtures, decided = 0.0, set[Fixture](), budget.decided_log_odds
    current = model.separations()
    while len(selected) < budget.runs:
        best, best_rate = None, 0.0
        for candidate, observation in candidates:
            if spent + candidate.minutes > budget.minutes:
                continue
            with_run = model.with_run(observation)
            updated = with_run.separations()
            gain = sum(_log_odds_gains(current, updated, decided))
            fixture_change = 0.0 if candidate.run.fixture in fixtures else FIXTURE_CHANGE_MIN
            if gain > MIN_LOG_ODDS_GAIN and gain / (candidate.minutes + fixture_change) > best_rate:
                best, best_rate = (candidate, with_run, updated), gain / (candidate.minutes + fixture_change)
        if best is None and budget.use_all_time and decided < UNBOUNDED:
            decided = UNBOUNDED
            continue
        if best is None:
            break
        candidate, model, updated = best
        selected.append((candidate, *_most_improved_pair(current, updated, decided)))
        current, spent = updated, spent + candidate.minutes
        fixtures.add(candidate.run.fixture)
    return selected


def _log_odds_gains(before: Sequence[PairSeparation], after: Sequence[PairSeparation], decided: float) -> list[float]:
    return [updated.value(decided) - current.value(decided) for current, updated in zip(before, after, strict=True)]


def _most_improved_pair(
    before: Sequence[PairSeparation], after: Sequence[PairSeparation], decided: float
) -> tuple[ModelPair, ModelPair]:
    """Return the pair with the largest gain, before and after."""
    gains = _log_odds_gains(before, after, decided)
    index = gains.index(max(gains))
    return before[index].pair, after[index].pair


def _merged_repeats(selected: Sequence[tuple[CandidateRun, ModelPair, ModelPair]]) -> tuple[NextRun, ...]:
    """Merge runs that were selected several times into repeats."""
    merged: dict[int, NextRun] = {}
    for candidate, before, after in selected:
        known = merged.get(id(candidate))
        if known is None:
            merged[id(candidate)] = NextRun(candidate.step, candidate.minutes, before, after)
            continue
        step = known.step.model_copy(update={"repeats": known.step.repeats + candidate.step.repeats})
        merged[id(candidate)] = replace(known, step=step, minutes=known.minutes + candidate.minutes, after=after)
    return tuple(merged.values())


TIME_TO_NEXT_RUN_S = 120.0
"""Time from the campaign's last sample to the next run."""
ENCODER_COUNT_MM = 0.001
MAX_SAMPLE_RATE_HZ = 1000.0
"""Faster sampling costs time and adds no information here."""


def study_of_candidates(study: Study, candidates: Sequence[CandidateRun]) -> Study:
    """Return the study of candidate runs, each as the first run after the campaign.

    Raises `AnalysisError` where the nominal model cannot be prepared for them.
    """
    last = max(study.runs, key=lambda run: run.session_start_s)
    experiments = candidate_experiments(last.experiment, candidates)
    channels = tuple(prepare_channels(experiments, study.problem.nominal, MAX_BLOCK_MM))
    count = len(channels)
    first = last.session_start_s + float(last.experiment.time_s[-1]) + TIME_TO_NEXT_RUN_S
    starts = [first + candidate.step.wait_s for candidate in candidates]
    problem = replace(
        study.problem,
        channels=channels,
        noises=(study.problem.noises[0],) * count,
        zero_sds=(max(study.problem.zero_sds),) * count,
    )
    return replace(study, problem=problem, runs=tuple(map(RunData, channels, starts)))


def candidate_experiments(last: Experiment, candidates: Sequence[CandidateRun]) -> list[Experiment]:
    """Return candidate runs as experiments after the last run of a campaign, with zero force."""
    return [_candidate_experiment(candidate, last, number) for number, candidate in enumerate(candidates)]


def campaign_specimen(study: Study) -> Specimen:
    """Return the specimen from the header of a campaign's runs."""
    experiment = study.runs[0].experiment
    name = str(experiment.run.info.header.specimen.get("name") or "specimen")
    return Specimen(name=name, wall_thickness_mm=experiment.wall_thickness_mm)


def _candidate_experiment(candidate: CandidateRun, last_experiment: Experiment, number: int) -> Experiment:
    run, last_header = candidate.run, last_experiment.run.info.header
    rate = min(last_header.sample_rate_hz, MAX_SAMPLE_RATE_HZ)
    time = np.arange(max(run.profile.samples(rate), 2)) / rate
    command = run.profile.position(time)
    channels: dict[str, AnyFloatArray] = {
        "force": np.zeros_like(time),
        "position": np.round(command / ENCODER_COUNT_MM) * ENCODER_COUNT_MM,
    }
    header = RunHeader(
        run_id=f"next-{number}",
        start_time=last_header.start_time + timedelta(seconds=float(last_experiment.time_s[-1]) + TIME_TO_NEXT_RUN_S),
        order=last_header.order + 1,
        backend=last_header.backend,
        kind=run.protocol.kind,
        sample_rate_hz=rate,
        channels=(RecordedChannel("force", "mN"), RecordedChannel("position", "mm")),
        entry={"insertion_dwell_s": run.wait_s},
        protocol=run.protocol.attributes(),
        capsule=run.capsule.model_dump(mode="json", exclude_none=True),
        specimen={**run.specimen.model_dump(mode="json", exclude_none=True), "fixture": run.fixture.value},
    )
    info = RunInfo(Path(f"{header.run_id}.h5"), 1, RunStatus.COMPLETE, header, len(time))
    phase = run.profile.phase_at(time)
    return Experiment(
        Run(info, Trace(rate, "force", time, command, phase, channels, {"force": "mN", "position": "mm"}))
    )


KIND_ORDER = ("relaxation", "blank", "coulomb", "drag", "motion")
PROMPTS = {
    "relaxation": "Fit the specimen in the vacuum fixture and insert the rough capsule",
    "blank": "Take the capsule off the sensor",
    "coulomb": "Open the gut to 13 mm in the vacuum fixture and insert the smooth capsule",
    "drag": "Lay the gut on the foam, fix one side and the mesentery, and insert the capsule",
}
SWEPT_SETTING = "speed_mm_s"


def plan_of_next_runs(next_experiment: NextExperiment, name: str = "next") -> Plan:
    """Return a plan of the runs, grouped by fixture to minimise manual work.

    Strokes that differ only in speed become one step with its speeds in random order.
    """
    steps = sorted((run.step for run in next_experiment.runs), key=lambda step: KIND_ORDER.index(step.kind))
    return Plan(
        name=name, description=next_experiment.reason, seed=1, steps=tuple(_with_prompts(_merged_sweeps(steps)))
    )


def _merged_sweeps(steps: Sequence[PlanStep]) -> Iterator[PlanStep]:
    groups: dict[tuple[object, ...], list[PlanStep]] = {}
    for step in steps:
        other_settings = tuple(
            sorted((key, str(value)) for key, value in step.parameters.items() if key != SWEPT_SETTING)
        )
        groups.setdefault(
            (step.kind, step.repeats, step.wait_s, SWEPT_SETTING in step.parameters, other_settings), []
        ).append(step)
    for group in groups.values():
        first = group[0]
        if len(group) == 1 or SWEPT_SETTING not in first.parameters:
            yield from group
            continue
        speeds = [step.parameters[SWEPT_SETTING] for step in group]
        update = {"parameters": {**first.parameters, SWEPT_SETTING: speeds}, "order": RunOrder.RANDOM_WITHIN_REPEAT}
        yield first.model_copy(update=update)


def _with_prompts(steps: Iterator[PlanStep]) -> Iterator[PlanStep]:
    previous_fixture = ""
    for step in steps:
        fixture = "drag" if step.kind == "motion" else step.kind
        yield step if fixture == previous_fixture else step.model_copy(update={"prompt": PROMPTS[fixture]})
        previous_fixture = fixture


MAX_QUOTED_SHARE = 0.9
"""Shares above this are not quoted: the rival hardly resembles the assumed effect."""


def run_text(step: PlanStep) -> str:
    """Describe a run: a drag at 1 mm/s over 20 mm."""
    settings = step.parameters
    match step.kind:
        case "relaxation":
            strain, hold = settings["shear_strain"], settings["hold_s"]
            assert isinstance(strain, float)  # noqa: S101  # the grid's own
            text = f"a relaxation at {100 * strain:g} % strain with a hold of {hold:g} s"
        case "motion":
            strokes = settings["strokes"]
            assert isinstance(strokes, list | tuple)  # noqa: S101
            first = strokes[0]
            text = f"a drag of {first['travel_mm']:g} mm and back at {first['speed_mm_s']:g} mm/s in one record"
        case kind:
            noun = {"coulomb": "a Coulomb run", "blank": "a blank run"}.get(kind, f"a {kind}")
            text = f"{noun} at {settings['speed_mm_s']:g} mm/s over {settings['travel_mm']:g} mm"
            if settings.get("accel_mm_s2", 400.0) != 400.0:
                text += f", accelerated with {settings['accel_mm_s2']:g} mm/s²"
    if step.kind == "drag" and step.wait_s != 60.0:
        text += f" after {step.wait_s:g} s of rest"
    if step.repeats == 1:
        return text
    return f"{text}, twice" if step.repeats == 2 else f"{text}, {step.repeats} times"


def recommendation_reason(run: NextRun, tried: int) -> str:
    """Say why a run is recommended, with numbers, and whether it is optional."""
    text = f"{run_subject(run.step)} {separation_text(run.before, run.after)}"
    return (
        f"{'The leading hypotheses are already separated well enough. ' if run.optional else ''}{text} "
        f"in {run.minutes:.1f} min of rig time, the largest gain per minute of {tried} candidate runs."
    )


def run_subject(step: PlanStep) -> str:
    """Return a run as the begin of a sentence."""
    return capitalise(run_text(step)) + ("," if step.repeats > 1 else "")


def separation_text(before: ModelPair, after: ModelPair) -> str:
    """Say what a run separates, as the rest of a sentence."""
    change = f"d′ grows {_growth_text(before.d_prime, after.d_prime)}"
    if not after.rival:
        return f"lowers the detection limit of {display_name(after.truth)}: {change}"
    truth, rival = display_name(after.truth), display_name(after.rival)
    text = f"separates {truth} from {rival}: {change}"
    if before.remaining_share > MAX_QUOTED_SHARE:
        return text
    shares = f"from {percent_text(before.remaining_share)} to {percent_text(after.remaining_share)}"
    return f"{text}, and the share of {truth} that {rival} cannot explain {shares}"


def _growth_text(before: float, after: float) -> str:
    """Write both with two digits, or with as many as it takes to tell them apart: `from 0.19 to 0.23`."""
    texts = [(significant_text(before, digits), significant_text(after, digits)) for digits in (2, 3, 4)]
    low, high = next((ends for ends in texts if ends[0] != ends[1]), texts[0])
    return f"from {low} to {high}"
