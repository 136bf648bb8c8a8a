"""How the drive's double finds its origin: onto a limit switch, off it again, to the index pulse."""

import math

from dragrig.rig.profile import trapezoid
from dragrig.sim_backend.doubles.world.world import INDEX_MM, SWITCH_MM, World

OVERTRAVEL_MM = 1.0
"""How far beyond the limit switch it goes at most."""
ACCELERATION_MM_S2 = 500.0


class Homing:
    """One search, leg by leg; owned by the drive's double.

    Parameters
    ----------
    towards
        −1 for the lower switch, +1 for the upper one.
    """

    def __init__(self, world: World, towards: float, speed_mm_s: float) -> None:
        self._world = world
        self._speed_mm_s = speed_mm_s
        self._to_switch = math.copysign(1.0, towards)
        self.seeks_switch = True
        """Whether it is on its first leg."""

    @property
    def towards(self) -> float:
        """Which way it goes at present."""
        return self._to_switch if self.seeks_switch else -self._to_switch

    def begin(self) -> None:
        """Set out for the switch."""
        stage = self._world.rig.stage
        switch_mm = stage.lowest_mm - SWITCH_MM if self._to_switch < 0 else stage.highest_mm + SWITCH_MM
        self._go(switch_mm + self._to_switch * OVERTRAVEL_MM)

    def go_on(self) -> bool:
        """Begin the next leg; False when there is none, for the carriage stands on the index."""
        if not self.seeks_switch:
            return False
        self.seeks_switch = False
        stage = self._world.rig.stage
        self._go(min(max(INDEX_MM, stage.lowest_mm), stage.highest_mm))
        return True

    def _go(self, to_mm: float) -> None:
        travel_mm = to_mm - self._world.position_mm()
        self._world.follow(trapezoid(travel_mm, self._speed_mm_s, ACCELERATION_MM_S2))
