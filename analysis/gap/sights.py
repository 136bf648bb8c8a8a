"""Each run as the diagnosis sees it: block means of the force, what is predicted of them, and the scene for effects."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dragrig.analysis.gap.phases import commanded_phase
from dragrig.analysis.identification.joint.evidence import Evidence
from dragrig.analysis.nominal.capsule_forces import acquisition_of
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Acquisition, Contact
from dragrig.sim_backend.effects.scene import Scene, gut_scene

LONGEST_MM = 0.4
"""Blocks reach no further along the way, so that folds of some mm show."""


@dataclass(frozen=True, eq=False)
class Sight:
    """The force of one run, in `B` blocks.

    Attributes
    ----------
    evidence
        Block means and what predicts them.
    session_start_s
        Its first sample on the specimen's clock.
    """

    evidence: Evidence
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

    def scene(self, settings: FrictionModelSettings) -> Scene:
        """Return what effects see of the run at the nodes of its blocks, with a nominal model of these settings."""
        experiment = self.experiment
        still = experiment.followed if self.acquisition.contact is Contact.STICKING else None
        return gut_scene(
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
    def coordinates(self) -> "Coordinates":
        """What the blocks may be sorted by."""
        return Coordinates.of(self)

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
class Coordinates:
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
    def of(cls, sight: Sight) -> "Coordinates":
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


def sights_of(evidence: Mapping[str, Evidence] | tuple[Evidence, ...]) -> tuple[Sight, ...]:
    """Return the runs whose force is predicted, on one clock."""
    pieces = tuple(evidence.values()) if isinstance(evidence, Mapping) else evidence
    starts = [one.experiment.run.info.header.start_time for one in pieces]
    first = min(starts)
    return tuple(Sight(one, (start - first).total_seconds()) for one, start in zip(pieces, starts, strict=True))
