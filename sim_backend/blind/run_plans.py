"""The runs of a campaign: which are made in which order and when, and the commanded motion of each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import sqrt

import numpy as np
import numpy.typing as npt

RATE_HZ = 500.0
PAUSE_S = 90.0
"""Pause between the last sample of a run and the first of the next."""
PLANT_WALL_MM = 2.5
DRAG_SPEEDS_MM_S = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0)
FRESH_DRAG_SPEEDS_MM_S = (3.0, 7.0, 15.0, 25.0, 35.0, 50.0)
PROGRAMMES = ("practice", "fresh")
NOTED_DWELL_S = 60.0
"""Noted age of the contact at the first sample; a list of runs may set another."""


@dataclass(frozen=True, slots=True)
class RunPlan:
    """One commanded run; only a relaxation has a strain."""

    kind: str
    order: int
    start_s: float
    speed_mm_s: float
    travel_mm: float
    accel_mm_s2: float
    rest_s: float
    hold_s: float
    strain: float | None = None
    dwell_s: float = NOTED_DWELL_S

    @property
    def bounds_s(self) -> tuple[float, float, float, float]:
        """Begin of acceleration, steady motion, deceleration and hold [s]."""
        ramp = self.peak_mm_s / self.accel_mm_s2
        steady = self.travel_mm / self.peak_mm_s - ramp
        start = self.rest_s
        return start, start + ramp, start + ramp + steady, start + 2 * ramp + steady

    @property
    def peak_mm_s(self) -> float:
        """Highest speed that the travel allows."""
        return min(self.speed_mm_s, sqrt(self.travel_mm * self.accel_mm_s2))

    @property
    def samples(self) -> int:
        """Number of samples of the record."""
        return round((self.bounds_s[3] + self.hold_s) * RATE_HZ)


def draw_programme(name: str, random: np.random.Generator) -> tuple[RunPlan, ...]:
    """Return the runs of a programme, drags in random order.

    Parameters
    ----------
    name
        `practice`: relaxations, blanks, Coulomb runs, and every speed of drag twice, 27 to 31 runs. `fresh`: other
        strains and speeds.

    Raises
    ------
    ValueError
        For any other name.
    """
    if name == "practice":
        strains, coulomb, speeds = [0.5, 1.0, 1.5, 2.0], [0.5, 5.0, 40.0], [*DRAG_SPEEDS_MM_S, *DRAG_SPEEDS_MM_S]
        blanks = [5.0, 40.0, 20.0][: 2 + int(random.random() < 0.3)]
        speeds += random.choice(DRAG_SPEEDS_MM_S, int(random.choice([0, 0, 0, 1, 2, 3])), replace=False).tolist()
    elif name == "fresh":
        strains, coulomb, speeds = [0.75, 1.25], [1.0, 15.0], [*FRESH_DRAG_SPEEDS_MM_S, *FRESH_DRAG_SPEEDS_MM_S]
        blanks = [10.0, 50.0]
    else:
        raise ValueError(f"{name!r} is not a programme; choose one of {', '.join(PROGRAMMES)}")
    drags = random.permutation(np.array(speeds)).tolist()
    moves = [("blank", v) for v in blanks] + [("coulomb", v) for v in coulomb] + [("drag", v) for v in drags]
    relaxations = [
        RunPlan("relaxation", 0, 0.0, 20.0, strain * PLANT_WALL_MM, 2000.0, 1.0, 20.0, strain) for strain in strains
    ]
    strokes = [RunPlan(kind, 0, 0.0, speed, 40.0, 400.0, 1.0, 3.0) for kind, speed in moves]
    plans, start_s = [], 0.0
    for order, run in enumerate(relaxations + strokes):
        plans.append(replace(run, order=order, start_s=round(start_s, 6)))
        start_s += (run.samples - 1) / RATE_HZ + PAUSE_S
    return tuple(plans)


@dataclass(frozen=True, slots=True)
class RunList:
    """A user's programme: its name and its commanded runs."""

    name: str
    runs: tuple[RunPlan, ...]

    @classmethod
    def of(cls, name: str, runs: Sequence[Mapping[str, str | float]]) -> "RunList":
        """Read a list of runs.

        Parameters
        ----------
        runs
            One table a run, in their order: `kind`, `start_s` of its first sample on the session's clock, `rest_s`,
            `hold_s`, `dwell_s`; of a relaxation `shear_strain`, `ramp_speed_mm_s` and `ramp_accel_mm_s2`, of any other
            run `speed_mm_s`, `travel_mm` and `accel_mm_s2`.

        Raises
        ------
        ValueError
            For a kind that the plant does not have, or a return stroke.
        """
        return cls(name, tuple(_run_plan(order, run) for order, run in enumerate(runs)))


def _run_plan(order: int, run: Mapping[str, str | float]) -> RunPlan:
    kind = str(run["kind"])
    if kind not in {"relaxation", "drag", "coulomb", "blank"}:
        raise ValueError(f"the plant has no runs of kind {kind}; leave them out of the list")
    strain = float(run["shear_strain"]) if kind == "relaxation" else None
    ramp = "ramp_" if strain is not None else ""
    travel = float(run["travel_mm"]) if strain is None else strain * PLANT_WALL_MM
    if travel <= 0:
        raise ValueError(f"run {order} travels {travel:g} mm; the plant's strokes must go forward")
    return RunPlan(
        kind=kind,
        order=order,
        start_s=float(run["start_s"]),
        speed_mm_s=float(run[f"{ramp}speed_mm_s"]),
        travel_mm=travel,
        accel_mm_s2=float(run[f"{ramp}accel_mm_s2"]),
        rest_s=float(run["rest_s"]),
        hold_s=float(run["hold_s"]),
        strain=strain,
        dwell_s=float(run["dwell_s"]),
    )


Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SampledMotion:
    """Position [mm], velocity [mm/s] and acceleration [mm/s²] at the times `t` [s], each of shape `(N,)`."""

    t: Floats
    p: Floats
    v: Floats
    a: Floats


def planned_motion(run: RunPlan, t: Floats, blunt_s: float = 0.0) -> SampledMotion:
    """Return the commanded motion of a run.

    Parameters
    ----------
    blunt_s
        Time over which every change of acceleration is spread, centred on it: the mean of the trapezoid over a window
        of that length, hence jerk-limited. 0 for the trapezoid itself.
    """
    from scipy.interpolate import PPoly

    start, steady, brake, stop = run.bounds_s
    knots = np.array([-10.0, start, steady, brake, stop, stop + run.hold_s + 10.0])
    a = PPoly(np.array([[0.0, run.accel_mm_s2, 0.0, -run.accel_mm_s2, 0.0]]), knots)
    v = a.antiderivative()
    p = v.antiderivative()
    if not blunt_s:
        return SampledMotion(t, p(t), _zero_rounding(v(t)), _zero_rounding(a(t)))
    early, late, area = t - blunt_s / 2, t + blunt_s / 2, p.antiderivative()
    return SampledMotion(
        t,
        (area(late) - area(early)) / blunt_s,
        _zero_rounding((p(late) - p(early)) / blunt_s),
        _zero_rounding((v(late) - v(early)) / blunt_s),
    )


def sample_phases(run: RunPlan, t: Floats) -> npt.NDArray[np.uint8]:
    """Return the phase of every sample, 0 rest to 4 hold, by the trapezoid."""
    return np.searchsorted(np.array(run.bounds_s) - 1e-9, t, side="right").astype(np.uint8)


def _zero_rounding(values: Floats) -> Floats:
    """Remove the rounding errors at standstill that sums of pieces leave."""
    return np.where(np.abs(values) < 1e-9, 0.0, values)
