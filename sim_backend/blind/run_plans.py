"""The runs of a campaign: which are made in which order and when, and the commanded motion of each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil, sqrt, tanh

import numpy as np
import numpy.typing as npt

RATE_HZ = 500.0
PAUSE_S = 90.0
"""Pause between the last sample of a run and the first of the next."""
PLANT_WALL_MM = 2.5
DRAG_SPEEDS_MM_S = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0)
FRESH_DRAG_SPEEDS_MM_S = (3.0, 7.0, 15.0, 25.0, 35.0, 50.0)
PROGRAMMES = ("practice", "fresh", "other")
NOTED_DWELL_S = 60.0
"""Noted age of the contact at the first sample; a list of runs may set another."""


@dataclass(frozen=True, slots=True)
class CapsuleDummy:
    """The capsule of a campaign, as its files describe it."""

    radius_mm: float = 6.45
    length_mm: float = 15.2
    mass_g: float = 50.1
    angle_deg: float = 60.0


@dataclass(frozen=True, slots=True)
class RunPlan:
    """One commanded run; only a relaxation has a strain.

    `specimen` counts the specimens of the session from 0; `order` counts the runs on one, as far as it is recorded when
    the specimen was exchanged; `mounted_s` is when this specimen was, on the session's clock.
    """

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
    rate_hz: float = RATE_HZ
    specimen: int = 0
    mounted_s: float = 0.0

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
        return round((self.bounds_s[3] + self.hold_s) * self.rate_hz)

    @property
    def session_s(self) -> float:
        """Time since its specimen was mounted [s]."""
        return self.start_s - self.mounted_s


def draw_programme(name: str, random: np.random.Generator) -> tuple[RunPlan, ...]:
    """Return the runs of a programme, drags in random order.

    Parameters
    ----------
    name
        `practice`: relaxations, blanks, Coulomb runs, and every speed of drag twice, 27 to 31 runs. `fresh`: other
        strains and speeds. `other`: speeds, strains, strokes, accelerations, holds and pauses drawn at random, the
        relaxations first, midway or last.

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
    elif name == "other":
        return _other_programme(random)
    else:
        raise ValueError(f"{name!r} is not a programme; choose one of {', '.join(PROGRAMMES)}")
    drags = random.permutation(np.array(speeds)).tolist()
    moves = [("blank", v) for v in blanks] + [("coulomb", v) for v in coulomb] + [("drag", v) for v in drags]
    relaxations = [
        RunPlan("relaxation", 0, 0.0, 20.0, strain * PLANT_WALL_MM, 2000.0, 1.0, 20.0, strain) for strain in strains
    ]
    strokes = [RunPlan(kind, 0, 0.0, speed, 40.0, 400.0, 1.0, 3.0) for kind, speed in moves]
    return in_session(relaxations + strokes)


def in_session(runs: Sequence[RunPlan], begin_s: float = 0.0, pause_s: float = PAUSE_S) -> tuple[RunPlan, ...]:
    """Return the runs in their order, numbered from 0, the first at `begin_s` on the session's clock."""
    plans, start_s = [], begin_s
    for order, run in enumerate(runs):
        plans.append(replace(run, order=order, start_s=round(start_s, 6)))
        start_s += (run.samples - 1) / run.rate_hz + pause_s
    return tuple(plans)


def _other_programme(random: np.random.Generator) -> tuple[RunPlan, ...]:
    def between(low: float, high: float, count: int) -> list[float]:
        drawn = low * (high / low) ** ((np.arange(count) + random.random(count)) / count)
        return [float(f"{value:.2g}") for value in drawn.tolist()]

    travel = float(random.choice([20.0, 25.0, 30.0, 50.0, 60.0]))
    accel = float(random.choice([100.0, 200.0, 800.0, 1500.0]))
    rest, hold, long_hold = float(random.uniform(0.5, 2.0)), float(random.uniform(1.0, 8.0)), random.uniform(10.0, 40.0)
    drags = np.repeat(between(0.5, 60.0, int(random.integers(5, 10))), random.integers(1, 4))
    moves = [("blank", v) for v in between(5.0, 60.0, int(random.integers(1, 4)))]
    moves += [("coulomb", v) for v in between(0.5, 50.0, int(random.integers(2, 5)))]
    moves += [("drag", v) for v in random.permutation(drags).tolist()]
    strokes = [RunPlan(kind, 0, 0.0, speed, travel, accel, rest, hold) for kind, speed in moves]
    relaxations = [
        RunPlan("relaxation", 0, 0.0, 20.0, strain * PLANT_WALL_MM, 2000.0, rest, round(float(long_hold), 1), strain)
        for strain in between(0.4, 2.0, int(random.integers(2, 6)))
    ]
    at = int(random.choice([0, len(strokes) // 2, len(strokes)]))
    return in_session(strokes[:at] + relaxations + strokes[at:], 0.0, float(random.uniform(30.0, 240.0)))


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


SCALE_PERIOD_MM = 0.020
"""Period of the encoder's scale."""
_BEFORE_S, _AFTER_S = 0.02, 0.25
"""The stage's own motion is followed from so long before to so long after each change of the commanded acceleration;
between, it is at rest against the slowly varying force."""


@dataclass(frozen=True, slots=True)
class StageLoop:
    """A stage under a position loop, which gives way to the force on it.

    `natural_hz`, `damping`, `mass_kg`: of stage and loop. `scale_error_mm`: amplitude of the encoder's error within a
    period of its scale.
    """

    natural_hz: float
    damping: float
    mass_kg: float
    scale_error_mm: float

    def recorded(self, position: Floats) -> Floats:
        """Return the position that the encoder counts."""
        return position + self.scale_error_mm * np.sin(2 * np.pi * position / SCALE_PERIOD_MM)

    def followed(
        self, command: SampledMotion, changes_s: Sequence[float], smooth: Floats, friction: Floats, slip_mm_s: float
    ) -> SampledMotion:
        """Return the stage's motion.

        Parameters
        ----------
        changes_s
            When the commanded acceleration changes.
        smooth, friction
            Force [mN] that does not follow the velocity at once, and friction, which does: over `slip_mm_s`; `(N,)`.
        """
        t, stiffness = command.t, self.mass_kg * (2 * np.pi * self.natural_hz) ** 2
        grip = np.tanh(command.v / slip_mm_s)
        away = -(smooth + friction * grip) / stiffness
        rate = np.gradient(away, t)
        near = np.any([(t > change - _BEFORE_S) & (t < change + _AFTER_S) for change in changes_s], axis=0)
        edges = np.flatnonzero(np.diff(near, prepend=False, append=False)).reshape(-1, 2).tolist()
        for first, last in edges:
            part = slice(first, last)
            away[part], rate[part] = self._transient(
                t[part], command.v[part], smooth[part], friction[part], slip_mm_s, float(away[first])
            )
        v = command.v + rate
        return SampledMotion(t, command.p + away, v, np.gradient(v, t))

    def _transient(
        self, t: Floats, commanded: Floats, smooth: Floats, friction: Floats, slip_mm_s: float, away: float
    ) -> tuple[Floats, Floats]:
        """Integrate the deviation [mm] and its rate, friction implicitly, from a deviation at rest."""
        omega, most = 2 * np.pi * self.natural_hz, float(friction.max(initial=1e-9))
        # In such a step friction changes the velocity by less than its own width, so that the iteration contracts.
        interval = float(t[1] - t[0])
        finer = ceil(interval / min(0.2 / omega, self.mass_kg * slip_mm_s / most))
        h = interval / finer
        times = t[0] + h * np.arange((t.size - 1) * finer + 1)
        values = [np.interp(times, t, column).tolist() for column in (commanded, smooth, friction)]
        k, rate, found = 1 + 2 * self.damping * omega * h, 0.0, [(away, 0.0)]
        for v, load, grip in zip(*(column[1:] for column in values), strict=True):
            driven = rate - h * (omega**2 * away + load / self.mass_kg)
            beta = h * grip / self.mass_kg
            for _ in range(6):
                rate -= (k * rate - driven + beta * tanh((v + rate) / slip_mm_s)) / (k + beta / slip_mm_s)
            away += h * rate
            found.append((away, rate))
        result = np.array(found)[::finer]
        return result[:, 0], result[:, 1]
