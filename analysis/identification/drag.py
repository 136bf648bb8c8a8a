"""Steady drag against speed beside the model: its parts, its logarithmic law, its R², and where it parts ways."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cache

import numpy as np

from dragrig.analysis.estimates import Estimate
from dragrig.analysis.identification.boundary import Deviation, find_boundary
from dragrig.analysis.identification.determination import determinations
from dragrig.analysis.identification.drag_runs import AtSpeed, DragRun, at_speeds, drag_runs
from dragrig.analysis.identification.noise import estimate_noise
from dragrig.analysis.identification.nominal_drag import freedom, parts, resting_force
from dragrig.analysis.identification.results import Boundary, Drag, LogLaw, SpeedPoint
from dragrig.analysis.identification.selection import Selection
from dragrig.analysis.identification.speed_law import log_law
from dragrig.analysis.identification.threads import one_thread
from dragrig.analysis.nominal.capsule_parameters import CHANNEL
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray

SIGNIFICANT = 0.05


@one_thread()
def identify_drag(
    selection: Selection, model: FrictionModelSettings, zeros: Mapping[str, Estimate] | None = None
) -> Drag:
    """Compare the steady drag of a specimen with the model.

    Forces are those that the channel shows, counted along the motion; backward speeds are negative. Law, boundary
    and R² are those of the direction with more speeds; R² of the other one follows.

    Parameters
    ----------
    zeros
        The sensor's zero by the name of the run's file. A run without one has it taken from its rest, less the
        force with which the model's relaxed wall presses on the capsule there.
    """
    experiments = selection.of_kind("drag")
    if not experiments:
        return Drag((), None, None, remarks=("the campaign has no usable drag run",))
    known = {file: zero for file, zero in (zeros or {}).items() if zero.standard_error is not None}
    noise = cache(lambda: estimate_noise(selection.experiments, CHANNEL))
    measured, left_out = drag_runs(experiments, model, known, noise)
    runs, others = _of_one_setup(measured)
    remarks = [f"{one.what} is left out of the drag: {one.reason}" for one in left_out]
    remarks += [
        f"{one.file} is left out of the drag: its capsule or wall differs from that of most runs" for one in others
    ]
    if not runs:
        return Drag((), None, None, remarks=tuple(remarks))
    speeds, factor = at_speeds(runs, model)
    ways = _by_direction(speeds)
    main = [one.point for one in ways[0]]
    law = log_law(main)
    boundary = find_boundary(_deviation(ways[0], model))
    compared = determinations(main, boundary)
    for way in ways[1:]:
        name = "backward, " if way[0].point.speed_mm_s < 0 else "forward, "
        compared += determinations([one.point for one in way], None, name)
    remarks += [*_on_runs(runs, factor), *_on_directions(ways), *_on_law(main, law)]
    return Drag(tuple(one.point for one in speeds), law, boundary, compared, tuple(remarks))


def _of_one_setup(runs: Sequence[DragRun]) -> tuple[list[DragRun], list[DragRun]]:
    """Divide runs into those with the capsule and wall that most have, and the others."""
    if not runs:
        return [], []
    usual, _ = Counter(run.setup for run in runs).most_common(1)[0]
    return [run for run in runs if run.setup == usual], [run for run in runs if run.setup != usual]


def _by_direction(speeds: Sequence[AtSpeed]) -> list[list[AtSpeed]]:
    """Return the speeds of each direction, the one with more of them first."""
    forward = [one for one in speeds if one.point.speed_mm_s > 0]
    backward = [one for one in speeds if one.point.speed_mm_s < 0]
    return sorted((way for way in (forward, backward) if way), key=len, reverse=True)


def _deviation(speeds: Sequence[AtSpeed], model: FrictionModelSettings) -> Deviation:
    """Measured minus model, and what another specimen would make of it."""
    setup = speeds[0].runs[0].setup
    at = np.array([abs(one.point.speed_mm_s) for one in speeds])
    ages = [[run.rest_age_s for run in one.runs if run.rest_age_s is not None] for one in speeds]
    shares = np.array([len(known) / len(one.runs) for known, one in zip(ages, speeds, strict=True)])
    known = [age for some in ages for age in some]
    age = float(np.mean(known)) if known else None

    def expected(varied: FrictionModelSettings) -> FloatArray:
        # What goes off with the rest goes off here as well.
        held = 0.0 if age is None else resting_force(setup, varied, age)
        return parts(setup, varied, at).total - shares * held

    measured = np.array([one.point.force.value for one in speeds], dtype=float)
    errors = np.array([one.point.force.standard_error for one in speeds], dtype=float)
    by_model = np.array([one.point.model_mN for one in speeds])
    return Deviation(at, measured - by_model, errors, freedom(model, expected))


def _on_runs(runs: Sequence[DragRun], factor: float) -> Iterator[str]:
    at_rest = sum(run.rest_age_s is not None for run in runs)
    if at_rest:
        yield (
            f"in {at_rest} of {len(runs)} runs the zero is the mean at rest less the model's resting force: a wall "
            "stiffer than the model's shifts these forces alike"
        )
    if factor > 1.5:
        yield f"repeats scatter {factor:.2g} times as much as noise and 2 % of stiffness explain; the errors hold that"


def _on_directions(ways: Sequence[Sequence[AtSpeed]]) -> Iterator[str]:
    if len(ways) > 1:
        name = "forward" if ways[0][0].point.speed_mm_s > 0 else "backward"
        yield f"law and boundary are those of the {len(ways[0])} {name} speeds"


def _on_law(points: Sequence[SpeedPoint], law: LogLaw | None) -> Iterator[str]:
    if law is None:
        yield f"a law in ln v takes at least three speeds; these are {len(points)}"
    elif law.lack_of_fit_p is not None and law.lack_of_fit_p < SIGNIFICANT:
        bend = _bend(points, law)
        where = "" if bend is None or bend.speed_mm_s is None else f"; they bend away at {bend.speed_mm_s:.3g} mm/s"
        if bend is not None and bend.interval is not None:
            where += f" (95 %: {bend.interval[0]:.3g} to {bend.interval[1]:.3g})"
        yield f"the forces do not lie on a straight line in ln v (p = {law.lack_of_fit_p:.2g}){where}"


def _bend(points: Sequence[SpeedPoint], law: LogLaw) -> Boundary | None:
    at = np.array([abs(point.speed_mm_s) for point in points])
    force = np.array([point.force.value for point in points], dtype=float)
    error = np.array([point.force.standard_error for point in points], dtype=float)
    line = law.intercept.value + law.slope.value * np.log(at)
    return find_boundary(Deviation(at, force - line, error, np.empty((0, len(at)))), "measurement and law")
