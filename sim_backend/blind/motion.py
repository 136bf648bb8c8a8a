"""Where the stage is at every sample."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dragrig.sim_backend.blind.programme import RunPlan

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Motion:
    """Position [mm], velocity [mm/s] and acceleration [mm/s²] at the times `t` [s], each of shape `(N,)`."""

    t: Floats
    p: Floats
    v: Floats
    a: Floats


def commanded(run: RunPlan, t: Floats, blunt_s: float = 0.0) -> Motion:
    """Return the commanded motion of a run.

    Parameters
    ----------
    blunt_s
        Time over which every change of acceleration is spread, centred on it: the mean of the trapezoid over a window
        of that length, hence jerk-limited. 0 for the trapezoid itself.
    """
    from scipy.interpolate import PPoly

    go, steady, brake, stop = run.bounds_s
    knots = np.array([-10.0, go, steady, brake, stop, stop + run.hold_s + 10.0])
    a = PPoly(np.array([[0.0, run.accel_mm_s2, 0.0, -run.accel_mm_s2, 0.0]]), knots)
    v = a.antiderivative()
    p = v.antiderivative()
    if not blunt_s:
        return Motion(t, p(t), _still(v(t)), _still(a(t)))
    early, late, area = t - blunt_s / 2, t + blunt_s / 2, p.antiderivative()
    return Motion(
        t,
        (area(late) - area(early)) / blunt_s,
        _still((p(late) - p(early)) / blunt_s),
        _still((v(late) - v(early)) / blunt_s),
    )


def phases(run: RunPlan, t: Floats) -> npt.NDArray[np.uint8]:
    """Return the phase of every sample, 0 rest to 4 hold, as the trapezoid has them."""
    return np.searchsorted(np.array(run.bounds_s) - 1e-9, t, side="right").astype(np.uint8)


def _still(values: Floats) -> Floats:
    """Round away what sums of pieces leave at standstill."""
    return np.where(np.abs(values) < 1e-9, 0.0, values)
