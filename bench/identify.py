"""How long a campaign of 31 runs at 500 Hz takes to identify, beside plain least squares on all of its samples.

    python bench/identify.py [--rounds 3] [--most 12] [--seed 7]

One campaign of a drawn specimen is simulated: 4 relaxations, 2 blanks, 3 Coulomb runs, 11 drag speeds twice. Each round
times in turn `dragrig.identify` from folder to result, the command as a process of its own, and
`scipy.optimize.least_squares` with the same friction model on every sample: the model's parameters and a zero for
each run, derivatives by differences, no noise model, no priors, nothing that differs from run to run. CPU time is that
of the process and its children: more than the wall's where several threads run, less where other programs do.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

import dragrig
from dragrig.analysis.estimates import NORMAL_95, EstimatedQuantity
from dragrig.analysis.identification.identification import JointFit, ParameterEstimate
from dragrig.analysis.models.capsule_model import MODEL, acquisition_of
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.selection import select_runs
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.plan import Plan
from dragrig.rig.devices import Contact
from dragrig.rig.profile import FloatArray
from dragrig.sim_backend.devices.variability import draw_specimen_model
from dragrig.sim_backend.friction import prepare

BAR_S = 3.0
LEAST = 1e-5
"""A narrower interval is that of a parameter on which no sample depends."""
NAMES = tuple(parameter.name for parameter in MODEL.parameters)
STEPS = (
    {"kind": "relaxation", "shear_strain": [0.5, 1.0, 1.5, 2.0]},
    {"kind": "blank", "speed_mm_s": [5.0, 40.0], "travel_mm": 40.0},
    {"kind": "coulomb", "speed_mm_s": [0.5, 5.0, 40.0], "travel_mm": 40.0},
    {
        "kind": "drag",
        "speed_mm_s": [0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 60.0],
        "travel_mm": 40.0,
        "repeats": 2,
    },
)


@dataclass(frozen=True, slots=True)
class Spent:
    """Wall time and user CPU time [s], children included."""

    wall: float
    user: float


@dataclass(frozen=True, slots=True, eq=False)
class Plain:
    """What plain least squares came to: the model's parameters, their covariance by its own lights, and whether."""

    values: FloatArray
    covariance: FloatArray
    finished: bool
    evaluations: int
    samples: int


def simulate(folder: Path, seed: int) -> None:
    """Make the campaign; a person takes the capsule back, so that no way back is recorded."""
    plan = Plan.model_validate({"name": "bench", "steps": [{**step, "way_back": "by_hand"} for step in STEPS]})
    drawn = ("rig.sampling.rate_hz=500", f"rig.simulated.seed={seed}", "rig.simulated.variation.specimen=true")
    dragrig.simulate(plan, out=folder, assignments=drawn)


def timed(action: Callable[[], object]) -> Spent:
    """Time an action."""
    before, begin = os.times(), time.perf_counter()
    action()
    wall, after = time.perf_counter() - begin, os.times()
    return Spent(wall, after.user - before.user + after.children_user - before.children_user)


def plain_fit(folder: Path, maximum: int) -> Plain:
    """Fit every sample of every run with the friction model, as one would write it down."""
    runs = [experiment for experiment in select_runs(folder).experiments if experiment.contact is not Contact.NONE]
    measured = [np.asarray(run.run.trace.force, dtype=np.float64) for run in runs]
    evaluations = 0

    def residual(unknown: FloatArray) -> FloatArray:
        nonlocal evaluations
        evaluations += 1
        settings = MODEL.settings.model_copy(update=dict(zip(NAMES, unknown[: len(NAMES)].tolist(), strict=True)))
        zeros = unknown[len(NAMES) :]
        parts = zip(runs, measured, zeros, strict=True)
        return np.concatenate([force_of(entry, settings) + zero - force for entry, force, zero in parts])

    start = np.concatenate(([parameter.nominal for parameter in MODEL.parameters], np.zeros(len(runs))))
    low = [1e-3 if parameter.positive else -20.0 for parameter in MODEL.parameters] + [-np.inf] * len(runs)
    high = [10.0 if parameter.positive else 20.0 for parameter in MODEL.parameters] + [np.inf] * len(runs)
    result = least_squares(residual, start, bounds=(low, high), max_nfev=maximum)
    samples = sum(map(len, measured))
    return Plain(result.x[: len(NAMES)], own_covariance(result, samples), result.status > 0, evaluations, samples)


def force_of(experiment: Experiment, settings: FrictionModelSettings) -> FloatArray:
    """Predict all samples of a run, from its measured motion."""
    motion = experiment.unsmoothed_motion if experiment.contact is Contact.STICKING else experiment.motion
    return prepare(acquisition_of(experiment), settings, motion).force(experiment.time_s)


def own_covariance(result: OptimizeResult, samples: int) -> FloatArray:
    """Return the textbook's covariance of the parameters, s² (JᵀJ)⁻¹, directions that nothing determines left out."""
    free = samples - len(result.x)
    inverse = np.linalg.pinv(result.jac.T @ result.jac, rcond=1e-10, hermitian=True)
    return np.asarray(2 * result.cost / free * inverse)[: len(NAMES), : len(NAMES)]


def report(true: FrictionModelSettings, joint: JointFit, plain: Plain) -> None:
    """Print how far parameters and combinations lie from the truth, in half widths of the joint fit's interval."""
    print("\nOff counts half widths of a 95 % interval, of the joint fit's unless said: beyond 1 is outside.")
    ours = f"{'':26}{'true':>9}{'joint fit':>11}{'± 95 %':>9}{'off':>7}"
    print(f"{ours}{'plain':>10}{'off':>8}{'its own ± 95 %':>17}{'off':>8}")
    values = {name: float(getattr(true, name)) for name in NAMES}
    plainly = dict(zip(NAMES, plain.values.tolist(), strict=True))
    for entry in joint.parameters:
        place = NAMES.index(entry.name)
        line(entry, values[entry.name], plainly[entry.name], float(plain.covariance[place, place]) ** 0.5)
    for combination, entry in zip(MODEL.combinations, joint.combinations, strict=True):
        powers = np.array([combination.powers.get(name, 0.0) for name in NAMES])
        at = float(np.prod(plain.values**powers))
        along = at * powers / plain.values
        line(entry, product(values, powers), at, float(along @ plain.covariance @ along) ** 0.5)


def product(values: dict[str, float], powers: FloatArray) -> float:
    """Return a product of powers of the parameters; those that it does not hold may have any sign."""
    return float(np.prod([values[name] ** power for name, power in zip(NAMES, powers, strict=True) if power]))


def line(first: ParameterEstimate | EstimatedQuantity, true: float, plain: float, error: float) -> None:
    """Print one quantity."""
    half, own = 0.5 * (first.interval[1] - first.interval[0]), NORMAL_95 * error
    print(
        f"{first.name:26}{true:9.4f}{first.value:11.4f}{half:9.4f}{abs(first.value - true) / half:7.2f}{plain:10.4f}"
        f"{abs(plain - true) / half:8.2f}"
        + (f"{own:17.5f}{abs(plain - true) / own:8.1f}" if own > LEAST * abs(true) else f"{'none':>17}{'-':>8}")
    )


def show(name: str, spent: list[Spent]) -> None:
    """Print the times of one way."""
    walls = ", ".join(f"{entry.wall:.2f}" for entry in spent)
    print(
        f"{name:42}{median(entry.wall for entry in spent):9.2f} s wall"
        f"{median(entry.user for entry in spent):9.2f} s user CPU   ({walls})"
    )


def main() -> None:
    """Time the three ways side by side, and compare what they find."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--most", type=int, default=12, help="steps that plain least squares may take")
    parser.add_argument("--seed", type=int, default=7)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "campaign"
        simulate(folder, chosen.seed)
        command = (sys.executable, "-m", "dragrig", "identify", str(folder), "--json")
        results: list[JointFit | None] = []
        plains: list[Plain] = []
        ways: dict[str, Callable[[], object]] = {
            "dragrig.identify(folder)": lambda: results.append(dragrig.identify(folder).result.joint),
            "dragrig identify FOLDER --json": lambda: subprocess.run(command, check=True, capture_output=True),
            "least_squares on every sample": lambda: plains.append(plain_fit(folder, chosen.most)),
        }
        spent: dict[str, list[Spent]] = {name: [] for name in ways}
        for _ in range(chosen.rounds):
            for name, way in ways.items():
                spent[name].append(timed(way))
        runs = len(list(folder.glob("*.h5")))
    joint, plain = results[-1], plains[-1]
    print(f"{runs} runs, {plain.samples} samples of force with a capsule; {os.cpu_count()} cores, median of rounds")
    for name, times in spent.items():
        show(name, times)
    ours, theirs = (spent[name] for name in (*ways,)[::2])
    ratio = median(their.wall for their in theirs) / median(our.wall for our in ours)
    done = "" if plain.finished else f" AND did not converge within {chosen.most} steps"
    print(
        f"plain least squares takes {ratio:.0f} times as long{done} ({plain.evaluations} evaluations of the campaign)"
    )
    print(f"asked for: dragrig.identify(folder) under {BAR_S:g} s on 2 cores")
    if joint is not None:
        report(draw_specimen_model(FrictionModelSettings(), chosen.seed), joint, plain)


if __name__ == "__main__":
    main()
