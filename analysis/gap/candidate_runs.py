"""Candidate runs for the next experiment: grid, greedy search per minute, the plan to carry out, and its words."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import cached_property
from itertools import product
from math import isfinite
from pathlib import Path
from typing import Protocol, Self, TypeVar

import numpy as np

from dragrig.analysis import Experiment, capitalise, join_names, percent_text, prepare_channels
from dragrig.analysis.gap.design import Study
from dragrig.analysis.gap.diagnosis import NextExperiment, NextRun, display_name
from dragrig.analysis.gap.run_data import MAX_BLOCK_MM, RunData, run_noun
from dragrig.config import Plan, PlanStep, ReturnMode, RunOrder, SettingsError, Specimen
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


MIN_GAIN_BITS = 0.001
"""A run that is expected to tell less is not chosen: a thousandth of whether an effect is there."""
HORIZON_RUNS = 12
"""Runs that are looked ahead: many that tell little each may change an answer together."""
MIN_CHANCE = 0.05
"""Runs are worth their time where they may change the answer with this probability, as significant as all else here.

It is at most their expected information over that of any outcome that changes the answer, by Markov's inequality: 0.04
bit may change an answer that is 0.96 sure, for which it takes 2 bits, with a probability of at most 0.02.
"""


DEFAULT_HANDS_MIN = 2.0
"""Time of a person's hands at a change of fixture or capsule, in minutes."""


def require_hands(hands_min: float) -> None:
    """Refuse a value that is no time of a person's hands; raises `SettingsError`."""
    if not (isfinite(hands_min) and hands_min >= 0):
        raise SettingsError(
            f"hands {hands_min:g}: a person's time at a change of fixture or capsule is a number of minutes from 0."
        )


def mounting(kind: str) -> str:
    """Return which fixture and capsule a kind of run needs, by the name of a kind that needs them too."""
    return "drag" if kind == "motion" else kind


SeenT_contra = TypeVar("SeenT_contra", contravariant=True)


class OpenQuestion(Protocol[SeenT_contra]):
    """The open question, and the expected information of runs on it; `SeenT_contra` is its need of a run."""

    @property
    def open_bits(self) -> float:
        """Entropy of the answer before the chosen runs."""

    @property
    def bits_to_change(self) -> float:
        """Least information of an outcome that makes another answer the likeliest."""
        ...

    @property
    def bits(self) -> float:
        """Information that the chosen runs are expected to give."""

    def with_run(self, observation: SeenT_contra) -> Self:
        """Choose a further run."""

    def about(self, before: Self) -> tuple[str, ...]:
        """Return the effects of which it tells most beyond a question with fewer runs."""


@dataclass(frozen=True, slots=True)
class ExperimentBudget:
    """Limits of an experiment: rig time, number of runs, the rig's range, and the cost of hands."""

    minutes: float = float("inf")
    runs: int = 1
    limits: RigLimits | None = None
    """Limits of the rig; default: the range of the campaign's runs."""
    mounted: str = ""
    """What is mounted on the rig, as `mounting` names it, and needs no hands; default: that of the last run."""
    hands_min: float = DEFAULT_HANDS_MIN
    """Minutes of a person at a change of fixture or capsule: a run that needs one must tell so much more."""


def greedy_search(
    question: OpenQuestion[SeenT_contra],
    candidates: Sequence[tuple[CandidateRun, SeenT_contra]],
    budget: ExperimentBudget,
    horizon: int = HORIZON_RUNS,
) -> tuple[NextRun, ...]:
    """Return the runs that are expected to tell most per minute, each given those before; none where none helps.

    None helps where so many runs as are looked ahead leave the answer as it is, but for a chance of `MIN_CHANCE`.

    Parameters
    ----------
    question
        The question that the campaign so far leaves open.
    candidates
        Candidate runs, each with the need of the question.
    horizon
        Number of runs that are looked ahead, if the budget has fewer.
    """
    needed_bits = MIN_CHANCE * question.bits_to_change
    chosen: list[NextRun] = []
    mounted, spent = {budget.mounted}, 0.0
    # The gain of a run rarely grows with the runs chosen before it, so that old gains tell which to compute anew
    # first (Minoux 1978, accelerated greedy algorithms).
    gains = [float("inf")] * len(candidates)
    while len(chosen) < max(budget.runs, horizon):
        fresh: dict[int, OpenQuestion[SeenT_contra]] = {}

        def rate(index: int, known: Sequence[float] = gains) -> float:
            candidate = candidates[index][0]
            hands = 0.0 if mounting(candidate.step.kind) in mounted else budget.hands_min
            return known[index] / (candidate.minutes + hands)

        affordable = [index for index, (run, _) in enumerate(candidates) if spent + run.minutes <= budget.minutes]
        best = max(affordable, key=rate, default=None)
        while best is not None and best not in fresh:
            fresh[best] = question.with_run(candidates[best][1])
            gains[best] = fresh[best].bits - question.bits
            best = max(affordable, key=rate, default=None)
        if best is None or gains[best] < MIN_GAIN_BITS:
            break
        candidate, updated = candidates[best][0], fresh[best]
        chosen.append(NextRun(candidate.step, candidate.minutes, gains[best], updated.about(question)))
        question, spent = updated, spent + candidate.minutes
        mounted.add(mounting(candidate.step.kind))
    told_bits = sum(run.gain_bits or 0.0 for run in chosen)
    return _merged_repeats(chosen[: budget.runs]) if told_bits >= needed_bits else ()


def _merged_repeats(chosen: Sequence[NextRun]) -> tuple[NextRun, ...]:
    """Merge runs that were chosen several times into repeats."""
    merged: dict[int, NextRun] = {}
    for run in chosen:
        known = merged.get(id(run.step))
        if known is not None:
            step = known.step.model_copy(update={"repeats": known.step.repeats + run.step.repeats})
            gain_bits = (known.gain_bits or 0.0) + (run.gain_bits or 0.0)
            known = replace(known, step=step, minutes=known.minutes + run.minutes, gain_bits=gain_bits)
        merged[id(run.step)] = known or run
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


def plan_of_next_runs(next_experiment: NextExperiment, name: str = "next", mounted: str = "") -> Plan:
    """Return a plan of the runs, grouped by fixture so that hands are needed rarely.

    Strokes that differ only in speed become one step with its speeds in random order.

    Parameters
    ----------
    mounted
        The parts on the rig, as `mounting` names them: their runs come first, and ask for no hands.
    """

    def order(step: PlanStep) -> tuple[bool, int]:
        return mounting(step.kind) != mounted, KIND_ORDER.index(step.kind)

    steps = tuple(_with_prompts(_merged_sweeps(sorted((run.step for run in next_experiment.runs), key=order)), mounted))
    return Plan(name=name, description=next_experiment.reason, seed=1, steps=steps)


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


def _with_prompts(steps: Iterator[PlanStep], mounted: str) -> Iterator[PlanStep]:
    for step in steps:
        needed = mounting(step.kind)
        yield step if needed == mounted else step.model_copy(update={"prompt": PROMPTS[needed]})
        mounted = needed


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
            text = f"{run_noun(kind)} at {settings['speed_mm_s']:g} mm/s over {settings['travel_mm']:g} mm"
            if settings.get("accel_mm_s2", 400.0) != 400.0:
                text += f", accelerated with {settings['accel_mm_s2']:g} mm/s²"
    if step.kind == "drag" and step.wait_s != 60.0:
        text += f" after {step.wait_s:g} s of rest"
    if step.repeats == 1:
        return text
    return f"{text}, twice" if step.repeats == 2 else f"{text}, {step.repeats} times"


def recommendation_reason(run: NextRun, open_bits: float, compared: int, subject: str) -> str:
    """Say why a run is recommended: what it best shows or tells, how much of that, and its time."""
    most = f", above all {join_names([display_name(name) for name in run.about])}" if run.about else ""
    settled = min((run.gain_bits or 0.0) / open_bits, 1.0) if open_bits > 0 else 0.0
    return (
        f"{run_subject(run.step)} best {subject}{most}: in {run.minutes:.1f} min of rig time it is expected to settle "
        f"{percent_text(settled)} of what is open, the most per minute of {compared} candidate runs."
    )


def run_subject(step: PlanStep) -> str:
    """Return a run as the begin of a sentence."""
    return capitalise(run_text(step)) + ("," if step.repeats > 1 else "")
