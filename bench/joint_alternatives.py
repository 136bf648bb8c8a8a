"""What the joint fit's way with what differs from run to run buys, beside the ways that it does not go.

    python bench/joint_alternatives.py [--campaigns 6]

On simulated campaigns of drawn specimens, 31 runs at 500 Hz each, whose truth is known:

* `as it is`: runs' own zeros and factors are integrated out, each covariance laid out around the prediction and kept
  while the parameters are fitted, then laid out anew;
* `no factors`: zeros only, as if runs on one specimen did not differ;
* `following`: the covariance follows the parameters within the fit, as a weighted sum of squares invites to.

Printed for each combination that the force channel shows: its mean deviation from the truth and the spread of that,
both in standard errors, and how many 95 % intervals hold it. Then what sampling the same posterior would take and
change: the time of one evaluation, and how evenly draws from the joint fit's normal approximation weigh under the
posterior itself, in percent (100: the two are the same).
"""

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares
from what_runs_tell import BLANKS, COULOMB, DRAGS, RELAXATIONS, simulate

from dragrig.analysis.estimates import NORMAL_95
from dragrig.analysis.identification.joint.evidence import Whitening
from dragrig.analysis.identification.joint.problem import Problem
from dragrig.analysis.identification.joint.solve import Solution, solve
from dragrig.analysis.identification.selection import select_from
from dragrig.analysis.nominal.capsule import MODEL
from dragrig.analysis.nominal.protocol import Prediction
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.devices.variation import draw_specimen

DRAWS = 200
STEP = 0.02
SHOWN = [one for one in MODEL.combinations if one.name.endswith("_shown")]
POWERS = np.array([[one.powers.get(parameter.name, 0.0) for parameter in MODEL.parameters] for one in SHOWN])


Covariances = Callable[[Sequence[Prediction]], Sequence[Whitening]]


def whitened(problem: Problem, z: FloatArray, covariances: Covariances) -> FloatArray:
    """Return the runs' whitened residuals and the priors'."""
    predictions = problem.predictions(z)
    parts = zip(problem.evidence, predictions, covariances(predictions), strict=True)
    return np.concatenate([*(white.whole(at.total - one.blocks.mean) for one, at, white in parts), z])


def following(problem: Problem, start: Solution) -> tuple[FloatArray, FloatArray]:
    """Fit with a covariance that follows the parameters; return them and their covariance."""
    uncertainties = problem.uncertainties(start.z)

    def residuals(z: FloatArray) -> FloatArray:
        return whitened(problem, z, lambda predictions: problem.whitenings(predictions, uncertainties))

    def slopes(z: FloatArray) -> FloatArray:
        here = residuals(z)
        return np.array([(residuals(z + turn) - here) / STEP for turn in STEP * np.eye(len(z))]).T

    found = least_squares(residuals, start.z, slopes, xtol=1e-3, ftol=1e-6, max_nfev=8)
    return found.x, np.asarray(np.linalg.inv(found.jac.T @ found.jac))


def deviations(problem: Problem, z: FloatArray, covariance: FloatArray, true: FrictionModelSettings) -> FloatArray:
    """How far the combinations lie from the truth, in standard errors."""
    truth = np.array([float(getattr(true, one.name)) for one in MODEL.parameters])
    positive = problem.scales.positive
    off = POWERS[:, positive] @ np.log(problem.scales.values(z)[positive] / truth[positive])
    along = POWERS * problem.scales.sd
    return np.asarray(off / np.sqrt(np.einsum("ij,jk,ik->i", along, covariance, along)))


def evenness(problem: Problem, solution: Solution) -> tuple[float, float]:
    """Return the share of draws from the normal approximation that weigh under the posterior, and time of each [s]."""
    rng = np.random.default_rng(1)
    root = np.linalg.cholesky(solution.covariance)
    best = whitened(problem, solution.z, lambda _: solution.whitenings)
    logs, begin = [], time.perf_counter()
    for _ in range(DRAWS):
        normal = rng.standard_normal(len(solution.z))
        squares = whitened(problem, solution.z + root @ normal, lambda _: solution.whitenings)
        logs.append(0.5 * (normal @ normal - squares @ squares + best @ best))
    spent = (time.perf_counter() - begin) / DRAWS
    weights = np.exp(np.array(logs) - max(logs))
    return float(weights.sum() ** 2 / (weights**2).sum() / DRAWS), spent


def report(name: str, found: FloatArray) -> None:
    """Print one way: deviations of shape `(campaigns, combinations)`."""
    print(f"\n{name:24}{'mean':>8}{'spread':>8}{'held':>10}")
    for one, column in zip(SHOWN, found.T, strict=True):
        held = int(np.count_nonzero(np.abs(column) < NORMAL_95))
        print(f"{one.name:24}{column.mean():8.1f}{column.std():8.1f}{held:6d} of {len(column)}")


def main() -> None:
    """Go all three ways on the same campaigns."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--campaigns", type=int, default=6)
    ways: Mapping[str, list[FloatArray]] = {"as it is": [], "no factors": [], "following": []}
    even: list[tuple[float, float]] = []
    for seed in range(parser.parse_args().campaigns):
        true = draw_specimen(FrictionModelSettings(), seed)
        problem = Problem.of(select_from(simulate((RELAXATIONS, BLANKS, COULOMB, DRAGS), seed)), MODEL)
        solution = solve(problem)
        plain = replace(problem, sds=np.full_like(problem.sds, 1e-9))
        alike = solve(plain)
        ways["as it is"].append(deviations(problem, solution.z, solution.covariance, true))
        ways["no factors"].append(deviations(problem, alike.z, alike.covariance, true))
        ways["following"].append(deviations(problem, *following(problem, solution), true))
        even.append(evenness(problem, solution))
    for name, found in ways.items():
        report(name, np.array(found))
    shares, spent = np.array(even).T
    print(
        f"\none evaluation {1e3 * np.median(spent):.0f} ms; 50 000, as sampling takes: {50 * np.median(spent):.1f} ks"
    )
    print(f"evenness of {DRAWS} draws: {', '.join(f'{100 * one:.0f}' for one in shares)} %")


if __name__ == "__main__":
    main()
