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


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """One run of a session.

    Attributes
    ----------
    index
        Place in the programme, from 0; a resumed session tells done runs by it.
    start_mm
        Absolute position where the run begins.
    sheared_from
        Shear strain of a sticking contact at the first sample.
    prompt
        What a person is asked to do before; empty when nothing.
    follows
        Index of the run that this one is the way back of; -1 for a run that stands for itself.
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
        """Recorded time."""
        return self.profile.duration_s


@dataclass(frozen=True, slots=True)
class Programme:
    """All runs of a session, in order."""

    plan: Plan
    runs: tuple[PlannedRun, ...]

    @property
    def duration_s(self) -> float:
        """Time from the first wait to the last sample, people's hands not counted."""
        return sum(run.wait_s + run.tare_s + run.duration_s for run in self.runs)

    def pending(self, done: Collection[int]) -> tuple[PlannedRun, ...]:
        """Return the runs to make when those with some indices are done.

        A way back goes with the run that it follows: it is made again with that run, and never on its own.
        """
        ahead = {run.index for run in self.runs if run.follows < 0}.difference(done)
        return tuple(run for run in self.runs if run.index in ahead or run.follows in ahead)


def build_programme(
    plan: Plan, specimen: Specimen, start_mm: float, source: str, beside: Path | None = None, zero_mm: float = 0.0
) -> Programme:
    """Lay out a plan's runs.

    Parameters
    ----------
    start_mm
        Where steps begin that name no position.
    source
        Where the plan comes from, for error messages.
    beside
        Folder that capsule files in the plan are relative to.
    zero_mm
        Absolute position that `start_mm`, here and in the plan, counts from.

    Raises
    ------
    PlanError, SettingsError
        For a kind, key, value or capsule that is not allowed.
    """
    rng = random.Random(plan.seed)  # noqa: S311  # an order of runs is no secret
    runs: list[PlannedRun] = []
    position = zero_mm + start_mm
    for number, step in enumerate(plan.steps):
        where = f"{source}: steps[{number}]"
        home = zero_mm + (step.start_mm if step.start_mm is not None else start_mm)
        if step.way_back is not ReturnMode.STAY or step.start_mm is not None:
            position = home
        for template in _step_runs(step, number, specimen, where, beside, rng.random):
            run = replace(template, index=len(runs), start_mm=position)
            runs.append(run)
            position = run.end_mm
            if step.way_back is ReturnMode.DRIVEN and position != run.start_mm:
                runs.append(_return_stroke(run, step, len(runs)))
            if step.way_back is not ReturnMode.STAY:
                position = run.start_mm
    return Programme(plan, tuple(runs))


def _step_runs(
    step: PlanStep, number: int, specimen: Specimen, where: str, beside: Path | None, draw: Callable[[], float]
) -> Iterator[PlannedRun]:
    if step.kind == ReturnProtocol.kind:
        raise PlanError(f"{where}: a plan has no steps of kind return; say way_back = 'driven' in the step before.")
    protocols = expand_sweep(step.kind, step.parameters, where, tuple(PlanStep.model_fields))
    if len(protocols) * step.repeats > MAX_RUNS:
        raise PlanError(f"{where}: makes more than {MAX_RUNS} runs; lower repeats or shorten the lists.")
    for count, protocol in enumerate(_in_order(protocols, step, draw)):
        by_hand = step.way_back is ReturnMode.BY_HAND and count > 0
        asks = step.prompt if count == 0 or step.prompt_each else ""
        back = "Bring the capsule back to its start by hand, outside of the gut" if by_hand else ""
        yield PlannedRun(
            index=0,
            step=number,
            protocol=protocol,
            profile=protocol.profile(specimen),
            capsule=_find_capsule(step.capsule or protocol.capsule, where, beside),
            specimen=specimen,
            fixture=step.fixture or protocol.fixture,
            contact=Contact.NONE if step.fixture is Fixture.NONE else protocol.contact,
            start_mm=0.0,
            wait_s=step.wait_s,
            tare_s=step.tare_s,
            prompt="; ".join(part for part in (back, asks) if part),
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
            repeats = [one[::-1] for one in repeats]
        case RunOrder.RANDOM:
            repeats = [_shuffled([protocol for one in repeats for protocol in one], draw)]
        case RunOrder.RANDOM_WITHIN_REPEAT:
            repeats = [_shuffled(one, draw) for one in repeats]
    return [protocol for one in repeats for protocol in one]


def _shuffled(items: list[RunProtocol], draw: Callable[[], float]) -> list[RunProtocol]:
    # Sorting by draws of random(), the one method whose stream Python promises to keep.
    keyed = [(draw(), place, item) for place, item in enumerate(items)]
    return [item for _, _, item in sorted(keyed, key=lambda one: one[:2])]


def _return_stroke(run: PlannedRun, step: PlanStep, index: int) -> PlannedRun:
    back = ReturnProtocol(
        travel_mm=run.start_mm - run.end_mm, speed_mm_s=step.way_back_speed_mm_s, accel_mm_s2=_return_acceleration(run)
    )
    return replace(
        run,
        index=index,
        protocol=back,
        profile=back.profile(run.specimen),
        start_mm=run.end_mm,
        wait_s=0.0,
        tare_s=0.0,
        prompt="",
        by_hand=False,
        sheared_from=run.shear_strain,
        note="",
        follows=run.index,
    )


def _return_acceleration(run: PlannedRun) -> float:
    return min(run.profile.extremes().acceleration_mm_s2, 400.0)


def _find_capsule(name: str, where: str, beside: Path | None) -> Capsule:
    try:
        return find_settings(Capsule, "capsule", name, beside)
    except SettingsError as error:
        raise SettingsError(f"{where}.capsule: {error}") from error
