"""Candidate runs for the next experiment: grid, greedy search per minute of rig time, and the plan to carry out."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Protocol, Self, TypeVar

import numpy as np

from dragrig.analysis.gap.design import Study
from dragrig.analysis.gap.diagnosis import ModelPair, NextExperiment, NextRun
from dragrig.analysis.gap.run_data import MAX_BLOCK_MM, RunData
from dragrig.analysis.inference.linear_gaussian import prepare_channels
from dragrig.analysis.models.experiment import Experiment
from dragrig.config.plan import Plan, PlanStep, ReturnMode, RunOrder
from dragrig.config.specimen import Fixture, Specimen
from dragrig.rig.arrays import AnyFloatArray
from dragrig.rig.programme import PlannedRun, Programme, build_programme
from dragrig.rig.runfile.model import RecordedChannel, Run, RunHeader, RunInfo, RunStatus, Trace

START_MM = 0.0
STROKE_MM, SHORT_STROKE_MM = 40.0, 20.0
SLOW_MM_S = 2.0
"""Up to this speed a shorter stroke is tried too, which takes half the time."""
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
    """One run with its way back, or some like it, as a step of a plan."""

    step: PlanStep
    specimen: Specimen

    @cached_property
    def programme(self) -> Programme:
        """What is done."""
        plan = Plan(name="next", steps=(self.step,))
        return build_programme(plan, self.specimen, START_MM, "the run that is tried")

    @property
    def run(self) -> PlannedRun:
        """The run itself, the first of some that are alike."""
        return self.programme.runs[0]

    @property
    def minutes(self) -> float:
        """Rig time with the rest before it and the way back."""
        return self.programme.duration_s / 60


@dataclass(frozen=True, slots=True)
class RigLimits:
    """What the rig can do; strokes go up from where they begin."""

    travel_mm: float = STROKE_MM
    speed_mm_s: float = 60.0
    accel_mm_s2: float = 2000.0
    kinds: tuple[str, ...] = ()
    """Kinds of run that can be made; all unless some are named."""

    def allow(self, trial: CandidateRun) -> bool:
        """Whether a trial keeps within them."""
        extremes = trial.run.profile.extremes()
        return (
            extremes.highest_mm <= self.travel_mm + 1e-6
            and extremes.lowest_mm >= -1e-6
            and extremes.speed_mm_s <= self.speed_mm_s * (1 + 1e-9)
            and extremes.acceleration_mm_s2 <= self.accel_mm_s2 * (1 + 1e-9)
            and (not self.kinds or trial.step.kind in self.kinds)
        )


def short_grid(specimen: Specimen) -> tuple[CandidateRun, ...]:
    """Return a dozen runs that differ much from each other."""
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
    """Return the whole grid: speed, travel, strain, hold, rest before the run, acceleration and reversal."""
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
    """Return runs that differ in how the stage moves: blanks, which need no rest and no specimen, and a reversal.

    Eight of them, or the whole grid of speed, acceleration and travel. Each is made twice: what one motion alone shows
    cannot be judged on runs that took no part.
    """
    if whole:
        tried = product(MOTION_SPEEDS_MM_S, MOTION_ACCELERATIONS_MM_S2, MOTION_TRAVELS_MM)
        grid = [pair for pair in tried if pair[0] ** 2 / pair[1] < pair[2]]
    else:
        grid = [*((*pair, STROKE_MM) for pair in SHORT_MOTION_GRID), (20.0, 400.0, SHORT_STROKE_MM)]
    steps = [_stroke("blank", speed, travel, accel_mm_s2=accel) for speed, accel, travel in grid]
    return _candidate_runs(
        [step.model_copy(update={"repeats": MOTION_REPEATS}) for step in (*steps, _reversal(20.0))], specimen
    )


def _candidate_runs(steps: Iterable[PlanStep], specimen: Specimen) -> tuple[CandidateRun, ...]:
    return tuple(CandidateRun(step, specimen) for step in steps)


def _stroke(
    kind: str, speed_mm_s: float, travel_mm: float, *, wait_s: float | None = None, accel_mm_s2: float = 400.0
) -> PlanStep:
    usual = {"drag": 60.0, "coulomb": 30.0, "blank": 5.0}[kind]
    settings = {"speed_mm_s": speed_mm_s, "travel_mm": travel_mm, "accel_mm_s2": accel_mm_s2}
    return PlanStep(kind=kind, wait_s=usual if wait_s is None else wait_s, parameters=settings)


def _relaxation(strain: float, hold_s: float) -> PlanStep:
    return PlanStep(kind="relaxation", wait_s=60.0, parameters={"shear_strain": strain, "hold_s": hold_s})


def _reversal(speed_mm_s: float) -> PlanStep:
    """There and back at one speed, as one record with a pause at the turn."""
    there: Mapping[str, float] = {"travel_mm": STROKE_MM, "speed_mm_s": speed_mm_s, "pause_s": 1.0}
    back: Mapping[str, float] = {"travel_mm": -STROKE_MM, "speed_mm_s": speed_mm_s}
    return PlanStep(kind="motion", way_back=ReturnMode.STAY, wait_s=60.0, parameters={"strokes": [there, back]})


DECIDED_LOG_ODDS = 12.0
"""Log odds beyond which nothing more is wanted."""
MIN_LOG_ODDS_GAIN = 1e-3
"""Less than this, in log odds, is nothing."""
UNBOUNDED = float("inf")
FIXTURE_CHANGE_MIN = 2.0
"""What changing to another fixture counts beside the rig time."""

SeenT_contra = TypeVar("SeenT_contra", contravariant=True)


@dataclass(frozen=True, slots=True)
class PairSeparation:
    """How far a contest is decided: how sure a diagnosis can be of its truth, and how much that matters."""

    pair: ModelPair
    log_odds: float
    weight: float

    def value(self, decided: float) -> float:
        """Return what it counts; what is certain enough counts no further."""
        return self.weight * min(self.log_odds, decided)


class SeparationModel(Protocol[SeenT_contra]):
    """Runs with the questions that are asked of them; `SeenT_contra` is what is seen of a run."""

    def with_run(self, observation: SeenT_contra) -> Self:
        """Add a run."""
        ...

    def separations(self) -> Sequence[PairSeparation]:
        """Return how far each question is answered, in their order."""
        ...


@dataclass(frozen=True, slots=True)
class ExperimentBudget:
    """How much rig time, how many runs, and when nothing more is wanted.

    Attributes
    ----------
    decided_log_odds
        Log odds beyond which a contest is decided.
    use_all_time
        Whether time that is left once all is decided is spent on making it surer.
    limits
        Of the rig; what the campaign's own runs say unless given.
    """

    minutes: float = float("inf")
    runs: int = 1
    decided_log_odds: float = DECIDED_LOG_ODDS
    use_all_time: bool = False
    limits: RigLimits | None = None


def greedy_search(
    field: SeparationModel[SeenT_contra], tried: Sequence[tuple[CandidateRun, SeenT_contra]], budget: ExperimentBudget
) -> tuple[NextRun, ...]:
    """Return the runs that answer most, each the best after those before.

    Parameters
    ----------
    field
        The campaign, with at least one question.
    tried
        Runs that may be made, each with what would be seen of it.
    """
    pairs = _greedy_selection(field, tried, budget)
    if not pairs and all(separation.log_odds >= budget.decided_log_odds for separation in field.separations()):
        # All is answered well enough already; what would make it surer still is told all the same.
        more = _merged_repeats(_greedy_selection(field, tried, replace(budget, decided_log_odds=UNBOUNDED)))
        return tuple(replace(run, optional=True) for run in more)
    return _merged_repeats(pairs)


def _greedy_selection(
    field: SeparationModel[SeenT_contra], tried: Sequence[tuple[CandidateRun, SeenT_contra]], budget: ExperimentBudget
) -> list[tuple[CandidateRun, ModelPair, ModelPair]]:
    chosen: list[tuple[CandidateRun, ModelPair, ModelPair]] = []
    spent, fitted, enough = 0.0, set[Fixture](), budget.decided_log_odds
    now = field.separations()
    while len(chosen) < budget.runs:
        best, most = None, 0.0
        for trial, seen in tried:
            if spent + trial.minutes > budget.minutes:
                continue
            after = field.with_run(seen)
            then = after.separations()
            gain = sum(_log_odds_gains(now, then, enough))
            by_hand = 0.0 if trial.run.fixture in fitted else FIXTURE_CHANGE_MIN
            if gain > MIN_LOG_ODDS_GAIN and gain / (trial.minutes + by_hand) > most:
                best, most = (trial, after, then), gain / (trial.minutes + by_hand)
        if best is None and budget.use_all_time and enough < UNBOUNDED:
            enough = UNBOUNDED
            continue
        if best is None:
            break
        trial, field, then = best
        chosen.append((trial, *_most_improved_pair(now, then, enough)))
        now, spent = then, spent + trial.minutes
        fitted.add(trial.run.fixture)
    return chosen


def _log_odds_gains(before: Sequence[PairSeparation], after: Sequence[PairSeparation], enough: float) -> list[float]:
    return [then.value(enough) - now.value(enough) for now, then in zip(before, after, strict=True)]


def _most_improved_pair(
    before: Sequence[PairSeparation], after: Sequence[PairSeparation], enough: float
) -> tuple[ModelPair, ModelPair]:
    """Return the contest that a run decides most, before and after."""
    gains = _log_odds_gains(before, after, enough)
    place = gains.index(max(gains))
    return before[place].pair, after[place].pair


def _merged_repeats(chosen: Sequence[tuple[CandidateRun, ModelPair, ModelPair]]) -> tuple[NextRun, ...]:
    """Make repeats of what was chosen several times."""
    merged: dict[int, NextRun] = {}
    for trial, before, after in chosen:
        known = merged.get(id(trial))
        if known is None:
            merged[id(trial)] = NextRun(trial.step, trial.minutes, before, after)
            continue
        step = known.step.model_copy(update={"repeats": known.step.repeats + trial.step.repeats})
        merged[id(trial)] = replace(known, step=step, minutes=known.minutes + trial.minutes, after=after)
    return tuple(merged.values())


TIME_TO_NEXT_RUN_S = 120.0
"""From the campaign's last sample to the next run."""
ENCODER_COUNT_MM = 0.001
MAX_SAMPLE_RATE_HZ = 1000.0
"""Faster sampling costs time and tells nothing more here."""


def study_of_candidates(study: Study, trials: Sequence[CandidateRun]) -> Study:
    """Return the study of runs that are yet to be made, each as the first one after the campaign.

    Raises `AnalysisError` where the nominal model cannot be prepared for them.
    """
    last = max(study.runs, key=lambda run: run.session_start_s)
    experiments = candidate_experiments(last.experiment, trials)
    evidence = tuple(prepare_channels(experiments, study.problem.nominal, MAX_BLOCK_MM))
    count = len(evidence)
    first = last.session_start_s + float(last.experiment.time_s[-1]) + TIME_TO_NEXT_RUN_S
    starts = [first + trial.step.wait_s for trial in trials]
    problem = replace(
        study.problem,
        channels=evidence,
        noises=(study.problem.noises[0],) * count,
        zero_sds=(max(study.problem.zero_sds),) * count,
    )
    return replace(study, problem=problem, runs=tuple(map(RunData, evidence, starts)))


def candidate_experiments(last: Experiment, trials: Sequence[CandidateRun]) -> list[Experiment]:
    """Return runs that are yet to be made, each as the next one after the last of a campaign, at rest in force."""
    return [_candidate_experiment(trial, last, number) for number, trial in enumerate(trials)]


def campaign_specimen(study: Study) -> Specimen:
    """Return the specimen as the campaign's runs note it."""
    experiment = study.runs[0].experiment
    name = str(experiment.run.info.header.specimen.get("name") or "specimen")
    return Specimen(name=name, wall_thickness_mm=experiment.wall_thickness_mm)


def _candidate_experiment(trial: CandidateRun, after: Experiment, number: int) -> Experiment:
    run, before = trial.run, after.run.info.header
    rate = min(before.sample_rate_hz, MAX_SAMPLE_RATE_HZ)
    time = np.arange(max(run.profile.samples(rate), 2)) / rate
    command = run.profile.position(time)
    channels: dict[str, AnyFloatArray] = {
        "force": np.zeros_like(time),
        "position": np.round(command / ENCODER_COUNT_MM) * ENCODER_COUNT_MM,
    }
    header = RunHeader(
        run_id=f"next-{number}",
        start_time=before.start_time + timedelta(seconds=float(after.time_s[-1]) + TIME_TO_NEXT_RUN_S),
        order=before.order + 1,
        backend=before.backend,
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
    """Return a plan of the runs, those of one fixture together so that hands are needed as seldom as can be.

    Strokes that differ in their speed alone become one step with its speeds in random order.
    """
    steps = sorted((run.step for run in next_experiment.runs), key=lambda step: KIND_ORDER.index(step.kind))
    return Plan(
        name=name, description=next_experiment.reason, seed=1, steps=tuple(_with_prompts(_merged_sweeps(steps)))
    )


def _merged_sweeps(steps: Sequence[PlanStep]) -> Iterator[PlanStep]:
    groups: dict[tuple[object, ...], list[PlanStep]] = {}
    for step in steps:
        rest = tuple(sorted((key, str(value)) for key, value in step.parameters.items() if key != SWEPT_SETTING))
        groups.setdefault((step.kind, step.repeats, step.wait_s, SWEPT_SETTING in step.parameters, rest), []).append(
            step
        )
    for alike in groups.values():
        first = alike[0]
        if len(alike) == 1 or SWEPT_SETTING not in first.parameters:
            yield from alike
            continue
        speeds = [step.parameters[SWEPT_SETTING] for step in alike]
        update = {"parameters": {**first.parameters, SWEPT_SETTING: speeds}, "order": RunOrder.RANDOM_WITHIN_REPEAT}
        yield first.model_copy(update=update)


def _with_prompts(steps: Iterator[PlanStep]) -> Iterator[PlanStep]:
    before = ""
    for step in steps:
        fixture = "drag" if step.kind == "motion" else step.kind
        yield step if fixture == before else step.model_copy(update={"prompt": PROMPTS[fixture]})
        before = fixture
