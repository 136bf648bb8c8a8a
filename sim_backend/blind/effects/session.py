"""Hidden effects of a gut that changes through a session."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dragrig.sim_backend.blind.effects.base import TISSUE, Draw, Effect
from dragrig.sim_backend.blind.programme import RunPlan


@dataclass(frozen=True, slots=True)
class AgeingRoot(Effect):
    """Stiffness drifts with the root of the session's time, and is set back whenever somebody wets the gut."""

    name, form, kinds = "tissue_ageing", "root of time, wetted", TISSUE
    amplitude: Annotated[float, Draw(0.3, 0.6, signed=True)]
    every_s: Annotated[float, Draw(600.0, 1000.0)]
    share: Annotated[float, Draw(0.15, 0.3)]

    def stiffness(self, run: RunPlan) -> float:
        """Return the factor on all stiffness."""
        lasting, dried = (run.start_s / 3000.0) ** 0.5, (run.start_s / self.every_s) % 1.0
        return float(1 + self.amplitude * ((1 - self.share) * lasting + self.share * dried))


@dataclass(frozen=True, slots=True)
class AgeingLate(Effect):
    """Stiffness drifts slowly at first and faster later on, more and less as the room's warmth swings."""

    name, form, kinds = "tissue_ageing", "late, swings", TISSUE
    amplitude: Annotated[float, Draw(0.25, 0.5, signed=True)]
    power: Annotated[float, Draw(1.2, 2.0)]
    swing: Annotated[float, Draw(0.1, 0.2)]
    period_s: Annotated[float, Draw(500.0, 1000.0)]

    def stiffness(self, run: RunPlan) -> float:
        """Return the factor on all stiffness."""
        swung = 1 + self.swing * np.sin(2 * np.pi * run.start_s / self.period_s)
        return float(1 + self.amplitude * (run.start_s / 3000.0) ** self.power * swung)


@dataclass(frozen=True, slots=True)
class AgeingTurn(Effect):
    """Stiffness changes over from one value to another about a time within the session."""

    name, form, kinds = "tissue_ageing", "change-over", TISSUE
    amplitude: Annotated[float, Draw(0.25, 0.5, signed=True)]
    middle_s: Annotated[float, Draw(900.0, 2000.0)]
    width_s: Annotated[float, Draw(400.0, 750.0)]

    def stiffness(self, run: RunPlan) -> float:
        """Return the factor on all stiffness."""
        now, start = (1 / (1 + np.exp(-(t - self.middle_s) / self.width_s)) for t in (run.start_s, 0.0))
        return float(1 + self.amplitude * (now - start) / (1 - start))


@dataclass(frozen=True, slots=True)
class PreconditioningRational(Effect):
    """A fresh specimen is stiffer, the more the further it is strained; that fades with the run count."""

    name, form, kinds = "preconditioning", "rational, grows with strain", TISSUE
    amplitude: Annotated[float, Draw(0.35, 0.7)]
    runs: Annotated[float, Draw(1.5, 4.0)]
    power: Annotated[float, Draw(1.0, 2.0)]
    grows: Annotated[float, Draw(0.3, 0.6)]

    def stiffness(self, run: RunPlan) -> float:
        """Return the factor on all stiffness; the capsule strains the wall by about 100 %."""
        fresh = (1.0 if run.strain is None else run.strain) ** self.grows
        return float(1 + self.amplitude * fresh / (1 + (run.order / self.runs) ** self.power))


@dataclass(frozen=True, slots=True)
class PreconditioningBell(Effect):
    """The stiffness of a fresh specimen fades as a Gaussian of the run count."""

    name, form, kinds = "preconditioning", "Gaussian of run count", TISSUE
    amplitude: Annotated[float, Draw(0.35, 0.7)]
    runs: Annotated[float, Draw(2.0, 9.0)]

    def stiffness(self, run: RunPlan) -> float:
        """Return the factor on all stiffness."""
        return float(1 + self.amplitude * np.exp(-((run.order / self.runs) ** 2)))


FORMS: tuple[type[Effect], ...] = (AgeingRoot, AgeingLate, AgeingTurn, PreconditioningRational, PreconditioningBell)
