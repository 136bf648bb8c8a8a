"""Campaigns of simulated specimens whose values are known, identified, and compared with them; for `coverage.py`."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import inf, log, prod
from random import Random

import dragrig
from dragrig.analysis.estimates import NORMAL_95, Estimate, EstimatedQuantity
from dragrig.analysis.identification.identification import (
    CoulombResult,
    DragResult,
    Identification,
    JointFit,
    RelaxationResult,
)
from dragrig.analysis.identification.identify import fit_jointly, identify_specimen
from dragrig.analysis.models.capsule_model import CAPSULE_COMBINATIONS, CapsuleModel
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.selection import RunSelection, select_loaded_runs
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.plan import Plan
from dragrig.config.rig import RigSettings
from dragrig.rig.runfile.model import Run
from dragrig.setup import resolve
from dragrig.sim_backend.devices.variability import RandomStream, draw_run_model, draw_specimen_model, random_generator
from dragrig.sim_backend.friction.friction_force import GRAVITY_M_S2, SteadyFriction, steady_forces
from dragrig.sim_backend.friction.wall import model_wall

SPEEDS_MM_S = (0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 60.0)
ELEMENTS = ("E1", "E2", "E3", "eta1", "eta2")
WHITE_MN = (1.0, 2.0)
"""Range of the white noise from campaign to campaign; slow noise is a third of it."""


@dataclass(frozen=True, slots=True)
class Kind:
    """What campaigns are like: wall and sample rate, and the share of drags that was recorded."""

    name: str
    wall: str = "eq14"
    rate_hz: float = 500.0
    drags: float = 1.0


KINDS = {
    entry.name: entry
    for entry in (Kind("usual"), Kind("table1", wall="table1"), Kind("half", drags=0.5), Kind("1khz", rate_hz=1000.0))
}


@dataclass(frozen=True, slots=True)
class Score:
    """An interval beside the true value; `deviation` is in standard errors of the interval."""

    group: str
    name: str
    value: float
    true: float
    deviation: float
    half_width: float
    learnt: float = 1.0

    @property
    def covered(self) -> bool:
        """Whether the 95 % interval holds the true value."""
        return abs(self.deviation) <= NORMAL_95


@dataclass(frozen=True, slots=True)
class Outcome:
    """One campaign, identified."""

    seed: int
    white_mN: float
    converged: bool
    chi2: float
    p_value: float
    simulated_s: float
    identified_s: float
    scores: tuple[Score, ...]
    remarks: tuple[str, ...] = field(default=())


@dataclass(frozen=True, slots=True)
class Known:
    """A simulated campaign with the settings that made it."""

    runs: tuple[Run, ...]
    rig: RigSettings
    specimen: FrictionModelSettings

    def order(self, file: str) -> int:
        """Return a run's place in the session, which its random numbers hang on."""
        return next(run.info.header.order for run in self.runs if run.info.path.name == file)

    def model_of(self, file: str) -> FrictionModelSettings:
        """Return the true model of one run."""
        simulated = self.rig.simulated
        return draw_run_model(self.specimen, simulated.variation, simulated.seed, self.order(file))

    def zero_mN(self, file: str) -> float:
        """Return the true zero of one run."""
        simulated = self.rig.simulated
        normal = random_generator(simulated.seed, RandomStream.ZERO, self.order(file)).standard_normal()
        return simulated.noise.zero_mN * float(normal)


def plan(seed: int) -> Plan:
    """Return the 31 runs, the drags of each repeat in an order of the seed's own."""
    steps = (
        {"kind": "relaxation", "shear_strain": [0.5, 1.0, 1.5, 2.0], "hold_s": 20.0},
        {"kind": "blank", "speed_mm_s": [5.0, 40.0], "travel_mm": 40.0},
        {"kind": "coulomb", "speed_mm_s": [0.5, 5.0, 40.0], "travel_mm": 40.0},
        {"kind": "drag", "speed_mm_s": list(SPEEDS_MM_S), "travel_mm": 40.0, "repeats": 2,
         "order": "random_within_repeat"},
    )  # fmt: skip
    return Plan.model_validate(
        {"name": "known", "seed": seed, "steps": [{"way_back": "by_hand", **step} for step in steps]}
    )


def simulate(kind: Kind, seed: int) -> Known:
    """Make a campaign on a specimen of its own, in memory."""
    draw = Random(seed)
    white = draw.uniform(*WHITE_MN)
    changes = [
        f"rig.sampling.rate_hz={kind.rate_hz}", f"rig.simulated.seed={seed}", "rig.simulated.variation.specimen=true",
        f"rig.simulated.noise.white_mN={white}", f"rig.simulated.noise.slow_mN={white / 3}",
        "rig.sampling.motor_force=false", f"model.wall={kind.wall}",
    ]  # fmt: skip
    runs = list(dragrig.simulate(plan(seed), assignments=changes))
    drags = [run for run in runs if run.info.kind == "drag"]
    lost = draw.sample(drags, round((1.0 - kind.drags) * len(drags)))
    setup = resolve(plan(seed), assignments=changes)
    return Known(tuple(run for run in runs if run not in lost), setup.rig, draw_specimen_model(setup.model, seed))


def examine(kind: Kind, seed: int, parts: bool) -> Outcome:
    """Simulate, identify and compare; with `parts` what is derived beside the joint fit too."""
    begin = time.perf_counter()
    known = simulate(kind, seed)
    made = time.perf_counter()
    nominal = CapsuleModel(FrictionModelSettings(wall=kind.wall))
    selection = select_loaded_runs(known.runs)
    result = identify_specimen(selection, nominal) if parts else None
    joint = fit_jointly(selection, nominal) if result is None else result.joint
    assert joint is not None
    done = time.perf_counter()
    scores = [*joint_scores(known, joint), *(part_scores(known, selection, result) if result else ())]
    return Outcome(
        seed, known.rig.simulated.noise.white_mN, joint.converged, joint.chi2 / joint.degrees, joint.p_value,
        made - begin, done - made, tuple(scores), joint.remarks,
    )  # fmt: skip


def joint_scores(known: Known, joint: JointFit) -> Iterator[Score]:
    """Compare parameters, combinations, and each run's own zero and factors."""
    true = {parameter.name: float(getattr(known.specimen, parameter.name)) for parameter in joint.parameters}
    for element in joint.parameters:
        yield _quantity_score("parameter", element, true[element.name], element.learnt)
    for combination, quantity in zip(CAPSULE_COMBINATIONS, joint.combinations, strict=True):
        yield _quantity_score("combination", quantity, prod(true[name] ** n for name, n in combination.powers.items()))
    for run in joint.runs:
        drawn = known.model_of(run.file)
        yield _estimate_score("run", f"zero {run.kind}", run.zero, known.zero_mN(run.file))
        if run.kind in {"relaxation", "drag"}:
            stiffness = drawn.stiffness_scale / known.specimen.stiffness_scale
            yield _estimate_score("run", f"stiffness {run.kind}", run.factors["stiffness"], stiffness)
        if run.kind in {"coulomb", "drag"}:
            friction = drawn.friction_coefficient / known.specimen.friction_coefficient
            yield _estimate_score("run", f"friction {run.kind}", run.factors["friction"], friction)


def part_scores(known: Known, selection: RunSelection, result: Identification) -> Iterator[Score]:
    """Compare what is derived from relaxations, Coulomb runs and drags on their own."""
    if result.relaxation:
        yield from _of_relaxation(known, result.relaxation)
    if result.coulomb:
        yield from _of_coulomb(known, selection, result.coulomb)
    if result.drag:
        yield from _of_drag(known, selection, result.drag)


def _of_relaxation(known: Known, result: RelaxationResult) -> Iterator[Score]:
    for fit in result.fits:
        wall = model_wall(known.model_of(fit.file), fit.shear_strain)
        # Nobody knows the true gain: the elements are those that the force channel shows.
        true = {element: known.specimen.force_gain * float(getattr(wall, element)) for element in ELEMENTS}
        true |= {"tau1": true["eta1"] / true["E1"], "tau2": true["eta2"] / true["E2"]}
        for one in (*fit.elements, *fit.times):
            yield _quantity_score("relaxation", one, true[one.name])


def _of_coulomb(known: Known, selection: RunSelection, result: CoulombResult) -> Iterator[Score]:
    mu = known.specimen.friction_coefficient
    yield _estimate_score("coulomb", "mu_without_viscous", result.mu_without_viscous, mu)
    slowest = _steady(known, selection.of_kind("coulomb")[0], SPEEDS_MM_S[0])
    weight = selection.of_kind("coulomb")[0].capsule.mass_g * GRAVITY_M_S2
    yield _estimate_score("coulomb", "mu", result.mu, mu + float(slowest.f_v[0]) / weight)


def _of_drag(known: Known, selection: RunSelection, result: DragResult) -> Iterator[Score]:
    for point in result.points:
        steady = _steady(known, selection.of_kind("drag")[0], point.speed_mm_s)
        true = known.specimen.force_gain * float(steady.total[0])
        yield _estimate_score("drag", f"{point.speed_mm_s:4.1f} mm/s", point.force, true)


def _steady(known: Known, experiment: Experiment, speed_mm_s: float) -> SteadyFriction:
    return steady_forces([speed_mm_s], known.specimen, experiment.capsule, experiment.wall_thickness_mm)


def _quantity_score(group: str, quantity: EstimatedQuantity, true: float, learnt: float = 1.0) -> Score:
    # A positive quantity is lognormal.
    scale = log if quantity.interval[0] > 0 else float
    low, value, high = map(scale, (quantity.interval[0], quantity.value, quantity.interval[1]))
    deviation = 2 * NORMAL_95 * (value - scale(true)) / (high - low)
    return Score(group, quantity.name, quantity.value, true, deviation, quantity.half_width, learnt)


def _estimate_score(group: str, name: str, estimate: Estimate, true: float) -> Score:
    if estimate.value is None or not estimate.standard_error:
        return Score(group, name, float("nan"), true, float("nan"), float("nan"))
    half = NORMAL_95 * estimate.standard_error / abs(estimate.value or inf)
    return Score(group, name, estimate.value, true, (estimate.value - true) / estimate.standard_error, half)
