"""What the card's double needs of the bench in front of it."""

from collections.abc import Mapping
from typing import Protocol

from dragrig.config.rig import RigSettings
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.doubles.world.mishaps import Mishaps


class PacedClock(Protocol):
    """Time that runs `pace` times as fast as the wall's."""

    @property
    def pace(self) -> float:
        """Seconds of this clock in one of the wall's."""
        ...

    def monotonic(self) -> float:
        """Seconds from an arbitrary start."""
        ...


class Bench(Protocol):
    """Force sensor, encoder and digital lines, as the card's terminals meet them. `World` is one."""

    @property
    def rig(self) -> RigSettings:
        """Settings of the rig: what is wired where, and how long a count of the encoder is."""
        ...

    @property
    def clock(self) -> PacedClock:
        """The time in which samples are taken."""
        ...

    @property
    def mishaps(self) -> Mishaps:
        """What goes wrong."""
        ...

    def position_mm(self) -> float:
        """Where the carriage is; 0 at the encoder's index pulse."""
        ...

    def begin_sampling(self, rate_hz: float) -> None:
        """Take sample 0 now."""
        ...

    @property
    def began_s(self) -> float:
        """The clock's reading at sample 0; its present one while no sample is taken."""
        ...

    def available(self) -> int:
        """Return how many samples were taken since then."""
        ...

    def sample(self, first: int, end: int) -> Mapping[str, FloatArray]:
        """Return `force_V`, `encoder_counts` and each further input's volts by its name."""
        ...

    def end_sampling(self) -> None:
        """Take no further sample."""
        ...

    def read_line(self, line: str) -> bool:
        """Return the level of a digital line, as PORT/LINE."""
        ...

    def write_line(self, line: str, high: bool) -> None:
        """Set a digital line."""
        ...
