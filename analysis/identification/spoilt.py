"""What makes a run useless to an identification, before any model is asked."""

from collections.abc import Callable, Iterator

import numpy as np

from dragrig.analysis.nominal.experiment import Experiment
from dragrig.analysis.phases import at_rest
from dragrig.config.errors import AnalysisError
from dragrig.rig.devices import Contact

WORST_SHARE = 0.2
"""A run more of whose samples are clipped or missing is left out; fewer are left out of the run."""
LARGEST_BRIDGE_MM = 0.05
"""Where samples are missing the motion is taken for straight; it may be wrong by this."""
BESIDE_S = 0.03
"""So long before and after missing samples the speed is looked at."""
WRONG_WAY_MN = 10.0
"""A force along the motion by more than this is no noise and no zero, but a wrong sign."""
BLANK = "blank"
TOUCHED_MN = 20.0
"""A capsule that nothing touches does not take as much, whatever the stage does."""
MOVING_MM_S = 0.05
SHEARED_SHARE = 0.5
FORCE = "force"


def spoilt(experiment: Experiment) -> str | None:
    """Return why a run cannot be used, None where it can."""
    if not experiment.valid.size:
        return "it has no samples"
    bad = 1.0 - float(np.mean(experiment.valid))
    if bad > WORST_SHARE:
        return f"{bad:.0%} of its samples are clipped or missing (NaN)"
    if not np.isfinite(experiment.run.trace.position).any():
        return "its positions are missing (NaN), so that its motion is not known"
    try:
        _ = experiment.motion, experiment.fixture
    except AnalysisError as fault:
        return str(fault).removeprefix(f"{experiment.file}: ")
    checks: tuple[Callable[[Experiment], str | None], ...] = (_unchanging, _moved_unseen, _wrong_way)
    return next((reason for reason in (check(experiment) for check in checks) if reason), None)


def spoilt_in_part(experiment: Experiment) -> Iterator[str]:
    """Yield what of a run is not used."""
    bad = int(np.count_nonzero(~experiment.valid))
    if bad:
        yield f"{experiment.file}: {bad} samples are clipped or missing (NaN) and were left out"


def _unchanging(experiment: Experiment) -> str | None:
    values = experiment.run.trace.force[experiment.valid]
    if experiment.contact is not Contact.NONE and float(np.ptp(values)) == 0.0:
        return "its force never changes, so that nothing was measured; check the sensor's cable and channel"
    return None


def _moved_unseen(experiment: Experiment) -> str | None:
    """Say so where the stage speeds up or slows down while samples are missing: what it did then is not known."""
    position = np.asarray(experiment.run.trace.position, dtype=np.float64)
    seen = np.isfinite(position)
    time, position = experiment.time_s[seen], position[seen]
    steps = np.diff(time)
    for at in np.flatnonzero(steps > 1.5 / experiment.run.trace.sample_rate_hz).tolist():
        before = np.searchsorted(time, time[at] - BESIDE_S)
        after = np.searchsorted(time, time[at + 1] + BESIDE_S) - 1
        if at == before or after == at + 1:
            continue
        chord = (position[at + 1] - position[at]) / steps[at]
        entering = (position[at] - position[before]) / (time[at] - time[before])
        leaving = (position[after] - position[at + 1]) / (time[after] - time[at + 1])
        # A parabola with these slopes at its ends strays from its chord by a quarter of this.
        unknown = 0.25 * steps[at] * max(abs(entering - chord), abs(leaving - chord))
        if unknown > LARGEST_BRIDGE_MM:
            return (
                f"samples are missing for {steps[at]:.3g} s at {time[at]:.3g} s while its stage changes speed, so "
                "that its motion is not known"
            )
    return None


def _wrong_way(experiment: Experiment) -> str | None:
    """Say so where the force cannot be friction on what the run says was there."""
    against = _against_motion(experiment)
    if against is None:
        return None
    if experiment.contact is Contact.NONE:
        if experiment.kind == BLANK or abs(against) < TOUCHED_MN:
            return None
        return f"its fixture is none, yet moving takes {against:.0f} mN: something held the capsule"
    if against > -WRONG_WAY_MN:
        return None
    return (
        f"its force points along the motion ({-against:.0f} mN) instead of against it: force or position has the "
        "wrong sign"
    )


def _against_motion(experiment: Experiment) -> float | None:
    """Return the mean force [mN] against the motion, that at rest taken off."""
    trace = experiment.run.trace
    rest = at_rest(trace) & experiment.valid
    if FORCE not in trace.channels or not rest.any():
        return None
    force = np.asarray(trace.channels[FORCE], dtype=np.float64)
    usable = experiment.valid & np.isfinite(force)
    if experiment.contact is Contact.STICKING:
        shear = experiment.position(experiment.time_s)
        way = np.where(np.abs(shear) > SHEARED_SHARE * np.abs(shear).max(), np.sign(shear), 0.0)
    else:
        velocity = experiment.velocity(experiment.time_s)
        way = np.where(np.abs(velocity) > MOVING_MM_S, np.sign(velocity), 0.0)
    moving = usable & (way != 0)
    if not moving.any():
        return None
    return float(np.mean((force[moving] - float(np.mean(force[rest & usable]))) * way[moving]))
