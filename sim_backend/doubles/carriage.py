"""The carriage of the simulated bench, the drive's velocity input that moves it, and the heartbeat relay.

Positions are the bench's own: 0 at the index pulse, whatever a drive takes for its zero. Times are seconds since the
motion's log began. In velocity mode the drive reads its input in 14 bits and follows as a first-order lag; between two
readings the carriage's speed changes linearly, so that a motion of seconds stays some hundred pieces.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile

import numpy as np

from dragrig.config.hardware import VelocityOutputSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.profile import MotionProfile, Phase, Piece, stationary_piece, trapezoid
from dragrig.sim_backend.devices.simulated_stage import evaluate_profile, profile_position

_MIN_REST_S = 1e-3
_TIME_TOLERANCE_S = 1e-9


@dataclass(frozen=True, slots=True)
class Carriage:
    """A motion from a standstill at `origin_mm`; each command returns a new one, equal to this up to then."""

    origin_mm: float
    profile: MotionProfile

    @classmethod
    def standing(cls, position_mm: float) -> "Carriage":
        """Return a carriage at rest."""
        return cls(position_mm, MotionProfile.from_pieces([stationary_piece(_MIN_REST_S, Phase.REST)]))

    @property
    def has_moved(self) -> bool:
        """Whether it ever moves."""
        return self.profile.motion_ends_s > 0

    def position(self, time_s: float) -> float:
        """Position [mm] at a time."""
        return self.origin_mm + profile_position(self.profile, time_s)

    def positions(self, time_s: FloatArray) -> FloatArray:
        """Positions [mm] at increasing times."""
        return self.origin_mm + evaluate_profile(self.profile, time_s).position

    def speed(self, time_s: float) -> float:
        """Signed speed [mm/s] at a time."""
        return float(self.profile.velocity(time_s)) if time_s < self.profile.duration_s else 0.0

    def moving(self, time_s: float) -> bool:
        """Whether it moves at a time, or will."""
        return time_s < self.profile.motion_ends_s

    def followed(self, time_s: float, pieces: Sequence[Piece]) -> "Carriage":
        """Return the motion that continues with `pieces` from a time on, with the speed at that time."""
        past = [
            replace(piece, duration_s=min(piece.duration_s, time_s - start))
            for piece, start in zip(self.profile.pieces(), self.profile.start_s.tolist(), strict=True)
            if start < time_s - _TIME_TOLERANCE_S
        ]
        rest_s = time_s - self.profile.duration_s
        if rest_s > 0:
            past.append(stationary_piece(rest_s, Phase.HOLD))
        return replace(self, profile=MotionProfile.from_pieces((*past, *pieces)))

    def braked(self, time_s: float, deceleration_mm_s2: float) -> "Carriage":
        """Return the motion that brakes to a standstill from a time on."""
        if not self.moving(time_s):
            return self
        return replace(self, profile=self.profile.stopped(time_s, deceleration_mm_s2))


def push_pieces(distance_mm: float, duration_s: float) -> tuple[Piece, ...]:
    """Return a push by hand over a signed distance, gentle at both ends."""
    ramp_s = 0.2 * duration_s
    speed_mm_s = abs(distance_mm) / (duration_s - ramp_s)
    return trapezoid(distance_mm, speed_mm_s, speed_mm_s / ramp_s)


VELOCITY_LAG_S = 0.002
"""Time constant with which the carriage follows the voltage."""
INPUT_RESOLUTION_V = 20.0 / 2**14
SETTLING_S = 3 * VELOCITY_LAG_S
"""Time after which the carriage has the speed of a voltage that is held."""
_BATCH_S = 0.02
_SPEED_TOLERANCE_MM_S = 1e-6
_FOREVER_S = 36_000.0
_RELATIVE_SPEED_TOLERANCE = 0.02
_CATCH_UP_S = 0.5
_MAX_CREEP_MM_S = 1.0
_MIN_TRAVEL_MM = 0.02
_MIN_SPEED_STEP_MM_S = 0.02


class VelocityInput:
    """From voltages to the carriage's motion. The caller of a method holds the bench's lock.

    Parameters
    ----------
    may_go
        Whether the carriage may go in a direction, −1 or +1: a pressed limit switch forbids one.
    """

    def __init__(self, settings: VelocityOutputSettings, may_go: Callable[[float], bool]) -> None:
        self._channel = settings.channel
        self._step_mm_s = INPUT_RESOLUTION_V * settings.per_V
        self._may_go = may_go
        self.on = False
        """Whether the drive is switched on; when off, the voltage has no effect."""
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
        targets = np.rint(volts / INPUT_RESOLUTION_V) * self._step_mm_s
        speed = carriage.speed(at_s)
        if abs(speed) <= _SPEED_TOLERANCE_MM_S and not targets.any() and not carriage.moving(at_s):
            return None
        pieces: list[Piece] = []
        if rate_hz == 0:
            target = self._allowed(float(targets[-1]))
            if target != speed:
                pieces.append(Piece(SETTLING_S, (target - speed) / SETTLING_S, Phase.ACCELERATE))
            speed = target
        else:
            batch = max(1, round(_BATCH_S * rate_hz))
            for first in range(0, len(targets), batch):
                speed = self._append_batch(pieces, speed, targets[first : first + batch], rate_hz)
        if speed:
            pieces.append(Piece(_FOREVER_S, 0.0, Phase.STEADY))
        return carriage.followed(at_s, pieces)

    def _append_batch(self, pieces: list[Piece], start_speed: float, targets: FloatArray, rate_hz: float) -> float:
        """Append one piece where the speed stays, else two of the same travel and end speed; return the end speed."""
        sample_s = 1.0 / rate_hz
        decay = float(np.exp(-sample_s / VELOCITY_LAG_S))
        speed, travel_mm, duration_s = start_speed, 0.0, len(targets) * sample_s
        for target in map(self._allowed, targets.tolist()):
            travel_mm += target * sample_s + (speed - target) * VELOCITY_LAG_S * (1.0 - decay)
            speed = target + (speed - target) * decay
            speed = target if abs(speed - target) < _SPEED_TOLERANCE_MM_S else speed
        if start_speed == speed and abs(travel_mm - speed * duration_s) < _SPEED_TOLERANCE_MM_S * duration_s:
            pieces.append(Piece(duration_s, 0.0, Phase.STEADY))
            return speed
        half_s = duration_s / 2
        middle = (2 * travel_mm / duration_s) - (start_speed + speed) / 2
        pieces.append(Piece(half_s, (middle - start_speed) / half_s, Phase.ACCELERATE))
        pieces.append(Piece(half_s, (speed - middle) / half_s, Phase.ACCELERATE))
        return speed

    def _allowed(self, speed: float) -> float:
        return speed if speed == 0.0 or self._may_go(float(np.sign(speed))) else 0.0


def simplified(felt: Carriage, carriage: Carriage, at_s: float, until_s: float) -> Carriage:
    """Return `felt` continued like `carriage` from one time to another, without the loop's small corrections.

    The friction of a motion is computed for each of its pieces, so it gets only those that matter: no creeping around a
    standstill, the same ramps, and between them speeds to within 2 %.
    """
    while until_s - at_s > _TIME_TOLERANCE_S:
        next_s = min(at_s + _BATCH_S, until_s)
        felt = _with_next_piece(felt, carriage, at_s, next_s)
        at_s = next_s
    return felt


def _with_next_piece(felt: Carriage, carriage: Carriage, at_s: float, until_s: float) -> Carriage:
    now, target, duration_s = felt.speed(at_s), carriage.speed(until_s), until_s - at_s
    behind_mm = carriage.position(until_s) - felt.position(until_s)
    if now == 0.0 and abs(target) <= _MAX_CREEP_MM_S and abs(behind_mm) <= _MIN_TRAVEL_MM:
        return felt
    tolerance = _RELATIVE_SPEED_TOLERANCE * abs(target) + _MIN_SPEED_STEP_MM_S
    speeds = reversed(felt.profile.velocity_mm_s.tolist())
    fastest_since_rest = max(map(abs, takewhile(bool, speeds)), default=0.0)
    if abs(target) <= _RELATIVE_SPEED_TOLERANCE * fastest_since_rest:
        target = 0.0
    elif abs(target - now) <= tolerance:
        target += behind_mm / _CATCH_UP_S
        if abs(target - now) <= tolerance:
            return felt
    if not (target or now):
        return felt
    pieces = [Piece(duration_s, (target - now) / duration_s, Phase.ACCELERATE)]
    if target:
        pieces.append(Piece(_FOREVER_S, 0.0, Phase.STEADY))
    return felt.followed(at_s, pieces)


MISSED_BEATS = 3
"""How many missed beats open the relay."""


class HeartbeatRelay:
    """A relay that is closed while edges come, in wall time; one that is not wired is always closed.

    Parameters
    ----------
    line
        The heartbeat's line, as PORT/LINE; empty when there is none.
    beat_s
        Time between two edges.
    """

    def __init__(self, line: str, beat_s: float) -> None:
        self._line = line
        self._timeout_s = MISSED_BEATS * beat_s
        self._high = False
        self._edge_s = float("-inf")

    @property
    def closed(self) -> bool:
        """Whether the drive has power."""
        return not self._line or time.monotonic() - self._edge_s < self._timeout_s

    def notice(self, line: str, high: bool) -> None:
        """Notice a level that was written to a line."""
        if line == self._line and high is not self._high:
            self._high = high
            self._edge_s = time.monotonic()
