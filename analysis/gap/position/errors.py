"""By how much the recorded position differs from the command: means over blocks of each run."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.nominal.experiment import Experiment
from dragrig.analysis.nominal.load import EXTERNAL
from dragrig.analysis.nominal.wander import COUNT_MM, noise_of
from dragrig.rig.arrays import FloatArray

MOST_BLOCKS = 400
BEFORE_S, AFTER_S = 0.05, 1.5
"""What is looked at of the rest before a motion and of the hold after it."""
ROUNDING = 1e-9
ENTERING = 0.5
"""A record whose first speed is above this part of its highest begins in motion; a ramp starts at next to none."""
LEAST_COUNTS = 0.7
"""Errors of a run below so many counts are the encoder's."""


@dataclass(frozen=True, slots=True, eq=False)
class PositionErrors:
    """One run, in `B` blocks.

    Attributes
    ----------
    experiment
        The run.
    time_s, command_mm, velocity_mm_s
        Middles of the blocks, where the stage was told to be, and how fast; shape `(B,)`.
    error_mm
        Recorded less commanded position, its mean over the rest before the motion taken off; its mean over the record
        where this begins in motion.
    force_mN
        The force, its first value taken off; zeros where none was recorded.
    session_s
        The first sample on the session's clock.
    origin_mm
        Where it begins, from where the first run does.
    entering_mm_s
        How fast the stage was told to go already as the record begins; 0 for one that begins at rest.
    count_mm
        The encoder's count; differences smaller than this do not matter.
    noise_mm
        By how much the record wanders at rest, one standard deviation; 0 where it is from one count to the next. What a
        servo dithers by is not less in the mean of a block.
    """

    experiment: Experiment
    time_s: FloatArray
    command_mm: FloatArray
    velocity_mm_s: FloatArray
    error_mm: FloatArray
    force_mN: FloatArray
    session_s: float
    origin_mm: float = 0.0
    entering_mm_s: float = 0.0
    count_mm: float = COUNT_MM
    noise_mm: float = 0.0

    @property
    def rms_mm(self) -> float:
        """Its size beyond the encoder's quantisation and noise."""
        squares = float(np.mean(self.error_mm**2)) - self.quantisation_mm**2 / 2 - self.noise_mm**2
        return float(np.sqrt(max(squares, 0.0)))

    @property
    def strays(self) -> bool:
        """Whether it is more than the encoder's counts and noise."""
        return self.rms_mm >= self.least_mm

    @property
    def least_mm(self) -> float:
        """The least error that is seen."""
        return max(LEAST_COUNTS * self.count_mm, self.noise_mm)

    @property
    def quantisation_mm(self) -> float:
        """What its counts make a single position differ by, one standard deviation."""
        return self.count_mm / float(np.sqrt(12))

    @property
    def top_speed_mm_s(self) -> float:
        """The fastest that the stage was told to go."""
        return float(np.abs(self.velocity_mm_s).max())

    def delayed(self, delay_s: float) -> FloatArray:
        """Return the command at the blocks' middles, so much later, shape `(B,)`."""
        return self.late(np.array([delay_s]))[:, 0]

    def late(self, delays_s: FloatArray) -> FloatArray:
        """Return the command at the blocks' middles, later by each of the delays, shape `(B, D)`."""
        trace = self.experiment.run.trace
        at = self.time_s[:, None] - delays_s
        command = np.interp(at, self.experiment.time_s, np.asarray(trace.command, dtype=np.float64))
        return np.asarray(command + self.entering_mm_s * np.minimum(at - self.experiment.time_s[0], 0.0))

    def from_zero(self, strayed: FloatArray) -> FloatArray:
        """Take off what this run's zero takes off its errors, shape `(B,)` or `(B, C)`."""
        if not self.entering_mm_s:
            return strayed
        left = strayed - strayed.mean(axis=0)
        return np.where(np.abs(left) > ROUNDING * np.abs(strayed).max(axis=0), left, 0.0)


def position_errors(experiments: Sequence[Experiment]) -> tuple[PositionErrors, ...]:
    """Return the position errors of all runs that move and recorded a position and a command."""
    starts = [one.run.info.header.start_time for one in experiments]
    origins = [origin_of(one) for one in experiments]
    found = []
    for experiment, start, origin in zip(experiments, starts, origins, strict=True):
        one = _errors(experiment, (start - min(starts)).total_seconds(), origin - origins[0])
        if one is not None:
            found.append(one)
    return tuple(found)


def origin_of(experiment: Experiment) -> float:
    """Return where on its machine a measurement from elsewhere begins, to the encoder's count.

    Runs of this rig begin at 0, for a ripple of the catalogue counts from the start of each run.
    """
    header = experiment.run.info.header
    said = header.entry.get("origin_mm", 0.0) if header.backend == EXTERNAL else 0.0
    return round(float(said), 3) if isinstance(said, int | float) and np.isfinite(said) else 0.0


def _errors(experiment: Experiment, session_s: float, origin_mm: float) -> PositionErrors | None:
    trace = experiment.run.trace
    if "position" not in trace.channels:
        return None
    position = np.asarray(trace.position, dtype=np.float64)
    command = np.asarray(trace.command, dtype=np.float64)
    time = experiment.time_s
    moves = np.flatnonzero(np.abs(np.diff(command)) > 0)
    if not moves.size or not np.isfinite(command).all():
        return None
    begin = np.searchsorted(time, time[moves[0]] - BEFORE_S)
    end = np.searchsorted(time, time[moves[-1]] + AFTER_S)
    inside = np.arange(begin, end)[np.isfinite(position[begin:end])]
    if inside.size < 8:
        return None
    rest = np.isfinite(position[: moves[0] + 1])
    zero = float(np.mean((position - command)[: moves[0] + 1][rest])) if rest.any() else 0.0
    velocity = np.gradient(command, time)
    entering = float(velocity[0]) if abs(velocity[0]) > ENTERING * np.abs(velocity).max() else 0.0
    if entering:
        zero = float(np.mean((position - command)[inside]))
    force = np.nan_to_num(np.asarray(trace.force, dtype=np.float64)) if "force" in trace.channels else 0.0 * time
    edges = np.unique(np.linspace(0, inside.size, min(MOST_BLOCKS, inside.size) + 1).astype(int))[:-1]
    count = np.diff(np.append(edges, inside.size))

    def means(values: FloatArray) -> FloatArray:
        return np.asarray(np.add.reduceat(values[inside], edges) / count)

    return PositionErrors(
        experiment,
        means(time),
        means(command - command[0]),
        means(velocity),
        means(position - command) - zero,
        means(force - force[:20].mean()),
        session_s,
        origin_mm,
        entering,
        experiment.count_mm,
        noise_of(experiment.wander_mm, experiment.count_mm),
    )
