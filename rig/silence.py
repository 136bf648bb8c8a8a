"""An encoder that shows nothing while the command moves on: a cable off, a wire broken, a stage that is stuck."""

from dataclasses import dataclass

import numpy as np

from dragrig.rig.arrays import AnyFloatArray
from dragrig.rig.devices import Block
from dragrig.rig.reading import Look


@dataclass(frozen=True, slots=True)
class Silence:
    """How far and for how long the command went while the encoder showed not a single count."""

    travel_mm: float
    duration_s: float


NO_SILENCE = Silence(0.0, 0.0)


@dataclass(slots=True)
class SilenceWatch:
    """Follows the blocks of one motion.

    A block in which something was counted ends a silence; the next one begins with the block after it.

    Parameters
    ----------
    dither_mm
        What an encoder may show without having counted: with one wire broken, its count goes to and fro by one.
    """

    dither_mm: float
    _lowest_mm: float = np.inf
    _highest_mm: float = -np.inf
    _command_mm: float | None = None
    _moved_index: int | None = None
    _travel_mm: float = 0.0

    def look(self, block: Block, command: AnyFloatArray, look: Look, rate_hz: float) -> Silence:
        """Take the next block, shape `(n,)` as its command [mm], and return the silence at its end."""
        self._lowest_mm = min(self._lowest_mm, look.lowest_mm)
        self._highest_mm = max(self._highest_mm, look.highest_mm)
        if self._highest_mm - self._lowest_mm > self.dither_mm:
            self._begin_after(float(block.channels["position"][-1]), float(command[-1]))
            return NO_SILENCE
        if self._command_mm is None:
            self._command_mm = float(command[0])
        away = np.abs(command - self._command_mm)
        self._travel_mm = max(self._travel_mm, float(away.max()))
        if self._travel_mm == 0:
            return NO_SILENCE
        if self._moved_index is None:
            self._moved_index = block.first_index + int((away > 0).argmax())
        return Silence(self._travel_mm, (block.end_index - self._moved_index) / rate_hz)

    def _begin_after(self, position_mm: float, command_mm: float) -> None:
        self._lowest_mm = self._highest_mm = position_mm
        self._command_mm, self._moved_index, self._travel_mm = command_mm, None, 0.0
