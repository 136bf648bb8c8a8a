"""An encoder that shows nothing while the command moves on: a cable off, a wire broken, a stage that is stuck."""

from dataclasses import dataclass
from math import inf, isnan, nan

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

    Parameters
    ----------
    dither_mm
        What an encoder may show without having counted: with one wire broken, its count goes to and fro by one.
    """

    dither_mm: float
    _counting: tuple[Block, AnyFloatArray] | None = None
    _lowest_mm: float = inf
    _highest_mm: float = -inf
    _command_mm: float = nan
    _moved_index: int | None = None
    _travel_mm: float = 0.0

    def look(self, block: Block, command: AnyFloatArray, look: Look, rate_hz: float) -> Silence:
        """Take the next block, shape `(n,)` as its command [mm], and return the silence at its end.

        A silence within a block in which something was counted is told with the block after it.
        """
        if look.highest_mm - look.lowest_mm > self.dither_mm:
            self._counting = (block, command)
            return NO_SILENCE
        if self._counting is not None:
            self._begin_after_last_count(*self._counting, rate_hz)
            self._counting = None
        lowest, highest = min(self._lowest_mm, look.lowest_mm), max(self._highest_mm, look.highest_mm)
        if highest - lowest > self.dither_mm or isnan(self._command_mm):
            self._begin(look.lowest_mm, look.highest_mm, float(command[0]))
        else:
            self._lowest_mm, self._highest_mm = lowest, highest
        return self._go_on(block.first_index, command, rate_hz)

    def _begin_after_last_count(self, block: Block, command: AnyFloatArray, rate_hz: float) -> None:
        position = block.channels["position"]
        counted = np.flatnonzero(np.abs(position - position[-1]) > self.dither_mm)
        first = int(counted[-1]) + 1 if counted.size else 0
        left = position[first:]
        self._begin(float(left.min()), float(left.max()), float(command[first]))
        self._go_on(block.first_index + first, command[first:], rate_hz)

    def _begin(self, lowest_mm: float, highest_mm: float, command_mm: float) -> None:
        self._lowest_mm, self._highest_mm, self._command_mm = lowest_mm, highest_mm, command_mm
        self._moved_index, self._travel_mm = None, 0.0

    def _go_on(self, first_index: int, command: AnyFloatArray, rate_hz: float) -> Silence:
        if self._travel_mm == 0 and command[0] == self._command_mm == command[-1]:
            # Told to stand, as for most of a session.
            return NO_SILENCE
        away = np.abs(command - self._command_mm)
        self._travel_mm = max(self._travel_mm, float(away.max()))
        if self._travel_mm == 0:
            return NO_SILENCE
        if self._moved_index is None:
            self._moved_index = first_index + int((away > 0).argmax())
        return Silence(self._travel_mm, (first_index + len(command) - self._moved_index) / rate_hz)
