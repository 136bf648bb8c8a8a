"""Data of each run: block means of the force, their prediction, and the coordinates of the blocks.

`modulations` holds smooth functions of these coordinates, of order 1. No real effect has exactly the form of the
catalogue; a signature multiplied by a sum of modulations, each with a small prior, may deviate as real effects do
without becoming another effect.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dragrig.analysis.inference.linear_gaussian import ChannelBlocks
from dragrig.analysis.models.capsule_model import acquisition_of
from dragrig.analysis.models.experiment import Experiment
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Acquisition, Contact
from dragrig.rig.profile import Phase
from dragrig.sim_backend.effects.run_state import RunState, gut_run_state


def commanded_phase(experiment: Experiment, time_s: FloatArray) -> FloatArray:
    """Return the number of the commanded phase at times, shape `(n,)`."""
    index = np.searchsorted(experiment.time_s, time_s + 1e-9, side="right") - 1
    return np.asarray(experiment.run.trace.phase[np.clip(index, 0, None)], dtype=np.float64)


MAX_BLOCK_MM = 0.4
"""Blocks reach no further along the way, so that folds of some mm show."""


@dataclass(frozen=True, eq=False)
class RunData:
    """The force of one run, in `B` blocks.

    Attributes
    ----------
    evidence
        Block means and what predicts them.
    session_start_s
        Its first sample on the specimen's clock.
    """

    evidence: ChannelBlocks
    session_start_s: float

    @property
    def experiment(self) -> Experiment:
        """The run."""
        return self.evidence.experiment

    @property
    def file(self) -> str:
        """Its file."""
        return self.experiment.file

    @cached_property
    def acquisition(self) -> Acquisition:
        """What the run is to capsule and gut; raises `AnalysisError` where it does not say enough of its capsule."""
        return acquisition_of(self.experiment)

    def scene(self, settings: FrictionModelSettings) -> RunState:
        """Return what effects see of the run at the nodes of its blocks, with a nominal model of these settings."""
        experiment = self.experiment
        still = experiment.unsmoothed_motion if self.acquisition.contact is Contact.STICKING else None
        return gut_run_state(
            self.acquisition, settings, experiment.motion, self.evidence.blocks.nodes_s, self.session_start_s, still
        )

    @cached_property
    def heading(self) -> int:
        """Which way it ends up: 1 towards positive positions, -1 the other way, 0 where it began."""
        moved = self.experiment.position(self.experiment.time_s[-1:]) - self.experiment.position(np.zeros(1))
        return int(np.sign(np.round(moved[0], 1)))

    def of_blocks(self, at_nodes: FloatArray) -> FloatArray:
        """Average what is known at nodes over blocks, shape `(…, 2 B)` to `(…, B)`."""
        return self.evidence.blocks.of(at_nodes)

    @cached_property
    def coordinates(self) -> "BlockCoordinates":
        """What the blocks may be sorted by."""
        return BlockCoordinates.of(self)

    @cached_property
    def condition(self) -> tuple[str, float]:
        """Kind and commanded speed, or strain: runs that agree in both are repeats.

        Where a run does not say its speed, the highest measured is taken, to two digits.
        """
        header = self.experiment.run.info.header
        for key in ("speed_mm_s", "shear_strain"):
            value = header.protocol.get(key)
            if isinstance(value, int | float) and not isinstance(value, bool):
                return self.experiment.kind, float(value)
        if self.experiment.contact is Contact.STICKING:
            return self.experiment.kind, 0.0
        return self.experiment.kind, float(f"{self.coordinates.top_speed_mm_s[0]:.2g}")


@dataclass(frozen=True, slots=True, eq=False)
class BlockCoordinates:
    """Where the blocks of a run stand, arrays of shape `(B,)`."""

    time_s: FloatArray
    width_s: FloatArray
    phase: FloatArray
    position_mm: FloatArray
    speed_mm_s: FloatArray
    top_speed_mm_s: FloatArray
    since_event_s: FloatArray
    session_s: FloatArray

    @classmethod
    def of(cls, sight: RunData) -> "BlockCoordinates":
        """Look them up in the middle of each block."""
        experiment, blocks = sight.experiment, sight.evidence.blocks
        middle = blocks.middle_s
        speed = np.abs(experiment.velocity(middle))
        events = np.concatenate(([-np.inf], experiment.motion.breaks_s[1:-1]))
        latest = events[np.searchsorted(events, middle + 1e-9, side="right") - 1]
        return cls(
            time_s=middle,
            width_s=np.maximum(blocks.end_s - blocks.start_s, 1e-6),
            phase=commanded_phase(experiment, middle),
            position_mm=experiment.position(middle),
            speed_mm_s=speed,
            top_speed_mm_s=np.full_like(middle, speed.max(initial=0.0)),
            since_event_s=np.where(np.isfinite(latest), middle - latest, middle),
            session_s=sight.session_start_s + middle,
        )


def run_data_of(evidence: Mapping[str, ChannelBlocks] | tuple[ChannelBlocks, ...]) -> tuple[RunData, ...]:
    """Return the runs whose force is predicted, on one clock."""
    pieces = tuple(evidence.values()) if isinstance(evidence, Mapping) else evidence
    starts = [one.experiment.run.info.header.start_time for one in pieces]
    first = min(starts)
    return tuple(RunData(one, (start - first).total_seconds()) for one, start in zip(pieces, starts, strict=True))


LOG_SPEED_CENTRE, LOG_SPEED_HALF_RANGE = 1.6, 2.4
"""Speeds from 0.5 to 60 mm/s lie between −1 and 1."""
MIN_SPEED_MM_S = 0.3
TRAVEL_HALF_RANGE_MM = 20.0
STRAIN_CENTRE, STRAIN_HALF_RANGE = 1.25, 0.75


def smooth_modulations(sights: Sequence[RunData]) -> tuple[FloatArray, ...]:
    """Return the functions at the blocks of each run, shape `(K, B)` each."""
    last_s = max(float(one.coordinates.session_s.max()) for one in sights)
    return tuple(_modulations_of_run(one, max(last_s, 1.0)) for one in sights)


def _modulations_of_run(sight: RunData, last_s: float) -> FloatArray:
    at = sight.coordinates
    ones = np.ones_like(at.time_s)
    sticks = sight.experiment.contact is Contact.STICKING
    slides = 0.0 * ones if sticks else ones
    top = slides * _log_speed(at.top_speed_mm_s)
    place = slides * np.clip(at.position_mm / TRAVEL_HALF_RANGE_MM - 1.0, -1.2, 1.2)
    since = np.clip((np.log(at.since_event_s + 2e-3) + 2.0) / 4.0, -1.2, 1.2)
    strain = (sight.condition[1] - STRAIN_CENTRE) / STRAIN_HALF_RANGE * (ones - slides)
    rows = (
        top,
        _legendre_2(top) * slides,
        place,
        _legendre_2(place) * slides,
        since,
        2.0 * at.session_s / last_s - 1.0,
        strain,
        slides * _log_speed(at.speed_mm_s),
        ones * (sight.experiment.kind == "coulomb"),
        ones - slides,
        ones * (sight.experiment.contact is Contact.NONE),
        (at.phase == Phase.HOLD) * ones,
        ((at.phase == Phase.ACCELERATE) | (at.phase == Phase.DECELERATE)) * ones,
    )
    return np.stack(rows)


def _log_speed(speed_mm_s: FloatArray) -> FloatArray:
    scaled = (np.log(speed_mm_s + MIN_SPEED_MM_S) - LOG_SPEED_CENTRE) / LOG_SPEED_HALF_RANGE
    return np.asarray(np.clip(scaled, -1.5, 1.5))


def _legendre_2(value: FloatArray) -> FloatArray:
    return np.asarray(1.5 * value**2 - 0.5)


ACTIVE_SHARE = 0.1
"""Something acts where it is this share of the most that it is."""


def rms_where_active(more: FloatArray, weights: FloatArray) -> float:
    """Return the weighted root mean square of values `(B,)` where they act; 0 where they do nowhere."""
    acting = np.abs(more) > ACTIVE_SHARE * np.abs(more).max(initial=1e-12)
    if not acting.any():
        return 0.0
    return float(np.sqrt(weights[acting] @ more[acting] ** 2 / weights[acting].sum()))
