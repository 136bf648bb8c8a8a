"""The drive in velocity mode: its analog input, and how the carriage follows it.

It reads its input in 14 bits and follows as a first-order lag; between two looks at it the carriage's speed changes
evenly, so that a motion of seconds stays some hundred pieces.
"""

from collections.abc import Callable

import numpy as np

from dragrig.config.hardware import VelocityOutputSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.profile import Phase, Piece
from dragrig.sim_backend.doubles.world.carriage import Carriage

LAG_S = 0.002
"""Time constant with which the carriage follows the voltage."""
RESOLUTION_V = 20.0 / 2**14
_BATCH_S = 0.02
SETTLING_S = 3 * LAG_S
"""After so long the carriage has the speed of a voltage that is held."""
_SAME_MM_S = 1e-6
_FOREVER_S = 36_000.0
_SLIVER_S = 1e-9
_ALIKE = 0.02
_CATCHES_UP_S = 0.5
_CREEPS_MM_S = 1.0
_UNFELT_MM = 0.02
_UNFELT_MM_S = 0.02


class Amplifier:
    """From voltages to the carriage's motion. Whoever calls a method holds the bench's lock.

    Parameters
    ----------
    may_go
        Says whether the carriage may go a way, −1 or +1: a pressed limit switch forbids one.
    """

    def __init__(self, settings: VelocityOutputSettings, may_go: Callable[[float], bool]) -> None:
        self._channel = settings.channel
        self._step_mm_s = RESOLUTION_V * settings.per_V
        self._may_go = may_go
        self.on = False
        """Whether the drive is switched on; off, it hears nothing."""
        self.busy = False
        """Whether a waveform is being put out."""

    def respond(
        self, carriage: Carriage, at_s: float, channel: str, volts: FloatArray, rate_hz: float
    ) -> Carriage | None:
        """Return the motion that follows from voltages that begin at a time; None when nothing changes.

        Parameters
        ----------
        at_s
            In the carriage's time.
        rate_hz
            0 for one voltage that is held.
        """
        if channel != self._channel:
            return None
        self.busy = rate_hz > 0
        if not self.on:
            return None
        wanted = np.rint(volts / RESOLUTION_V) * self._step_mm_s
        speed = carriage.speed(at_s)
        if abs(speed) <= _SAME_MM_S and not wanted.any() and not carriage.moving(at_s):
            return None
        pieces: list[Piece] = []
        if rate_hz == 0:
            speed = self._settle(pieces, speed, float(wanted[-1]))
        else:
            batch = max(1, round(_BATCH_S * rate_hz))
            for first in range(0, len(wanted), batch):
                speed = self._go_on(pieces, speed, wanted[first : first + batch], rate_hz)
        if speed:
            pieces.append(Piece(_FOREVER_S, 0.0, Phase.STEADY))
        return carriage.followed(at_s, pieces)

    def _settle(self, pieces: list[Piece], speed: float, wanted: float) -> float:
        target = self._allowed(wanted)
        if target != speed:
            pieces.append(Piece(SETTLING_S, (target - speed) / SETTLING_S, Phase.ACCELERATE))
        return target

    def _go_on(self, pieces: list[Piece], speed: float, wanted: FloatArray, rate_hz: float) -> float:
        sample_s = 1.0 / rate_hz
        kept = float(np.exp(-sample_s / LAG_S))
        begun, travel_mm = speed, 0.0
        for one in wanted.tolist():
            target = self._allowed(one)
            travel_mm += target * sample_s + (speed - target) * LAG_S * (1.0 - kept)
            speed = target + (speed - target) * kept
            speed = target if abs(speed - target) < _SAME_MM_S else speed
        _join(pieces, begun, speed, travel_mm, len(wanted) * sample_s)
        return speed

    def _allowed(self, speed: float) -> float:
        return speed if speed == 0.0 or self._may_go(float(np.sign(speed))) else 0.0


def _join(pieces: list[Piece], begun: float, ended: float, travel_mm: float, duration_s: float) -> None:
    """Append a stretch from one speed to another over a travel: one piece where the speed stays, else two."""
    if begun == ended and abs(travel_mm - begun * duration_s) < _SAME_MM_S * duration_s:
        pieces.append(Piece(duration_s, 0.0, Phase.STEADY))
        return
    half_s = duration_s / 2
    middle = (2 * travel_mm / duration_s) - (begun + ended) / 2
    pieces.append(Piece(half_s, (middle - begun) / half_s, Phase.ACCELERATE))
    pieces.append(Piece(half_s, (ended - middle) / half_s, Phase.ACCELERATE))


def smoothed(felt: Carriage, carriage: Carriage, at_s: float, until_s: float) -> Carriage:
    """Return `felt` gone on like `carriage` from one time to another, without the loop's small corrections.

    The friction of a motion is reckoned anew for each of its pieces, so it is given the few that matter: no creeping
    about a standstill, the same ramps, and between them speeds to within 2 %.
    """
    while until_s - at_s > _SLIVER_S:
        next_s = min(at_s + _BATCH_S, until_s)
        felt = _smoothed_once(felt, carriage, at_s, next_s)
        at_s = next_s
    return felt


def _smoothed_once(felt: Carriage, carriage: Carriage, at_s: float, until_s: float) -> Carriage:
    now, speed, duration_s = felt.speed(at_s), carriage.speed(until_s), until_s - at_s
    behind_mm = carriage.position(until_s) - felt.position(until_s)
    if now == 0.0 and abs(speed) <= _CREEPS_MM_S and abs(behind_mm) <= _UNFELT_MM:
        return felt
    slack = _ALIKE * abs(speed) + _UNFELT_MM_S
    if abs(speed) <= _ALIKE * _fastest_since_standing(felt):
        wanted = 0.0
    elif abs(speed - now) > slack:
        wanted = speed
    else:
        wanted = speed + behind_mm / _CATCHES_UP_S
        if abs(wanted - now) <= slack:
            return felt
    pieces = [Piece(duration_s, (wanted - now) / duration_s, Phase.ACCELERATE)]
    if wanted:
        pieces.append(Piece(_FOREVER_S, 0.0, Phase.STEADY))
    return felt.followed(at_s, pieces) if wanted or now else felt


def _fastest_since_standing(carriage: Carriage) -> float:
    fastest = 0.0
    for speed in reversed(carriage.profile.velocity_mm_s.tolist()):
        if speed == 0.0:
            break
        fastest = max(fastest, abs(speed))
    return fastest
