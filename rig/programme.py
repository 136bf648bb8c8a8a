"""From a plan to the runs of a session, in order, with where each run begins."""

import random
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from dragrig.config.errors import PlanError, SettingsError
from dragrig.config.plan import Plan, PlanStep, ReturnMode, RunOrder
from dragrig.config.settings import find_settings
from dragrig.config.specimen import Capsule, Fixture, Specimen
from dragrig.rig.devices import Contact
from dragrig.rig.profile import MotionProfile
from dragrig.rig.protocols import MAX_RUNS, RunProtocol, expand_sweep
from dragrig.rig.protocols.return_stroke import ReturnProtocol

_MAX_RETURN_ACCEL_MM_S2 = 400.0


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """One run of a session.

    Attributes
    ----------
    index
        Place in the programme, from 0; a resumed session identifies finished runs by it.
    start_mm
        Absolute position where the run begins.
    sheared_from
        Shear strain of a sticking contact at the first sample.
    prompt
        Prompt to the operator before the run; empty for none.
    follows
        Index of the run whose return stroke this is; -1 for any other run.
    """

    index: int
    step: int
    protocol: RunProtocol
    profile: MotionProfile
    capsule: Capsule
    specimen: Specimen
    fixture: Fixture
    contact: Contact
    start_mm: float
    wait_s: float
    tare_s: float = 0.0
    prompt: str = ""
    by_hand: bool = False
    sheared_from: float = 0.0
    shear_strain: float = 0.0
    note: str = ""
    follows: int = -1

    @property
    def end_mm(self) -> float:
        """Absolute position where the run ends."""
        return self.start_mm + float(self.profile.position(self.profile.duration_s))

    @property
    def duration_s(self) -> float:
        """Recorded duration."""
        return self.profile.duration_s


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

        A return stroke belongs to the run that it follows: it is repeated with that run, and never made alone.
        """
        pending = {run.index for run in self.runs if run.follows < 0}.difference(done)
        return tuple(run for run in self.runs if run.index in pending or run.follows in pending)


def build_programme(
    plan: Plan, specimen: Specimen, start_mm: float, source: str, beside: Path | None = None, zero_mm: float = 0.0
) -> Programme:
    """Return the programme of a plan.

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
    rng = random.Random(plan.seed)  # noqa: S311  # an order of runs is no secret
    runs: list[PlannedRun] = []
    position_mm = zero_mm + start_mm
    for number, step in enumerate(plan.steps):
        place = f"{source}: steps[{number}]"
        if step.way_back is not ReturnMode.STAY or step.start_mm is not None:
            position_mm = zero_mm + (step.start_mm if step.start_mm is not None else start_mm)
        for template in _step_runs(step, number, specimen, place, beside, rng.random):
            run = replace(template, index=len(runs), start_mm=position_mm)
            runs.append(run)
            position_mm = run.end_mm
            if step.way_back is ReturnMode.DRIVEN and position_mm != run.start_mm:
                runs.append(_return_stroke(run, step, len(runs)))
            if step.way_back is not ReturnMode.STAY:
                position_mm = run.start_mm
    return Programme(plan, tuple(runs))


def _step_runs(
    step: PlanStep, number: int, specimen: Specimen, place: str, beside: Path | None, draw: Callable[[], float]
) -> Iterator[PlannedRun]:
    if step.kind == ReturnProtocol.kind:
        raise PlanError(f"{place}: a plan has no steps of kind return; set way_back = 'driven' in the step before.")
    protocols = expand_sweep(step.kind, step.parameters, place, tuple(PlanStep.model_fields))
    if len(protocols) * step.repeats > MAX_RUNS:
        raise PlanError(f"{place}: makes more than {MAX_RUNS} runs; lower repeats or shorten the lists.")
    for count, protocol in enumerate(_in_order(protocols, step, draw)):
        by_hand = step.way_back is ReturnMode.BY_HAND and count > 0
        prompts = (
            "Return the capsule to its start by hand, outside the gut" if by_hand else "",
            step.prompt if count == 0 or step.prompt_each else "",
        )
        name = step.capsule or protocol.capsule
        try:
            capsule = find_settings(Capsule, "capsule", name, beside)
        except SettingsError as error:
            raise SettingsError(f"{place}.capsule: {error}") from error
        yield PlannedRun(
            index=0,
            step=number,
            protocol=protocol,
            profile=protocol.profile(specimen),
            capsule=capsule,
            specimen=specimen,
            fixture=step.fixture or protocol.fixture,
            contact=Contact.NONE if step.fixture is Fixture.NONE else protocol.contact,
            start_mm=0.0,
            wait_s=step.wait_s,
            tare_s=step.tare_s,
            prompt="; ".join(prompt for prompt in prompts if prompt),
            by_hand=by_hand,
            shear_strain=protocol.strain(),
            note=step.note,
        )


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


def _return_stroke(run: PlannedRun, step: PlanStep, index: int) -> PlannedRun:
    accel_mm_s2 = min(run.profile.extremes().acceleration_mm_s2, _MAX_RETURN_ACCEL_MM_S2)
    stroke = ReturnProtocol(
        travel_mm=run.start_mm - run.end_mm, speed_mm_s=step.way_back_speed_mm_s, accel_mm_s2=accel_mm_s2
    )
    return replace(
        run,
        index=index,
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
    )
