"""Hidden effects in position and time that the catalogue does not have; the right verdict is `unknown`."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dragrig.sim_backend.blind.effects.base import Draw, Effect, Scene
from dragrig.sim_backend.blind.motion import Floats
from dragrig.sim_backend.blind.programme import RunPlan


@dataclass(frozen=True, slots=True)
class EncoderMisses(Effect):
    """The encoder misses counts, or counts twice, at random places; the amplitude is the distance of one jump [mm]."""

    name, form, channel = "encoder_misses", "random jumps", "position"
    amplitude: Annotated[float, Draw(0.05, 0.25, log=True)]
    every_mm: Annotated[float, Draw(4.0, 15.0)]

    def position(self, position: Floats, force: Floats, scene: Scene) -> Floats:
        """Return the position the encoder sees."""
        random = scene.random("misses")
        at = np.cumsum(random.exponential(self.every_mm, 60))
        lost = self.amplitude * random.standard_normal(at.size)
        return np.asarray(position - np.concatenate([[0.0], np.cumsum(lost)])[np.searchsorted(at, position)])


@dataclass(frozen=True, slots=True)
class StageYields(Effect):
    """The stage yields elastically under the measured force [mm at 1 N], and nothing brings it back to the command."""

    name, form, channel = "stage_yields", "spring", "position"
    amplitude: Annotated[float, Draw(0.10, 0.40, log=True)]

    def position(self, position: Floats, force: Floats, scene: Scene) -> Floats:
        """Return the position the encoder sees."""
        return np.asarray(position - self.amplitude * (force - force[0]) / 1000.0)


@dataclass(frozen=True, slots=True)
class ClockOff(Effect):
    """The sampling clock is off by a part in some of the runs."""

    name, form, channel = "clock_off", "some runs", "position"
    amplitude: Annotated[float, Draw(0.01, 0.04, signed=True)]

    def clock(self, run: RunPlan, t: Floats, seed: int) -> Floats:
        """Return the true times of the samples."""
        wrong = np.random.default_rng((seed, run.order, 77)).random() < 0.5
        return t * (1 + self.amplitude) if wrong else t


FORMS: tuple[type[Effect], ...] = (EncoderMisses, StageYields, ClockOff)
