"""Motion profiles evaluated fast: at many times in order, or at one."""

from bisect import bisect_right
from dataclasses import dataclass, replace

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.rig.profile import MotionProfile, Phase, Piece, still


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Position [mm], velocity [mm/s] and acceleration [mm/s²], arrays of shape `(n,)`."""

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


def evaluate(profile: MotionProfile, time_s: FloatArray) -> Motion:
    """Evaluate a profile at increasing times, piece by piece: what its own methods give, several times faster."""
    position, velocity, acceleration = (np.empty_like(time_s) for _ in range(3))
    starts = np.append(profile.start_s, profile.duration_s)
    edges = np.append(np.searchsorted(time_s, starts), len(time_s))
    edges[0] = 0
    rests_at = float(profile.position(profile.duration_s))
    positions = np.append(profile.position_mm, rests_at).tolist()
    velocities = np.append(profile.velocity_mm_s, 0.0).tolist()
    accelerations = np.append(profile.acceleration_mm_s2, 0.0).tolist()
    for piece in np.flatnonzero(np.diff(edges)).tolist():
        here = slice(edges[piece], edges[piece + 1])
        rate = accelerations[piece]
        acceleration[here] = rate
        if rate == 0.0:
            velocity[here] = velocities[piece]
            position[here] = positions[piece] + velocities[piece] * (time_s[here] - starts[piece])
            continue
        elapsed = time_s[here] - starts[piece]
        velocity[here] = velocities[piece] + rate * elapsed
        position[here] = positions[piece] + (velocities[piece] + 0.5 * rate * elapsed) * elapsed
    return Motion(position, velocity, acceleration)


def position_at(profile: MotionProfile, time_s: float) -> float:
    """Position [mm] at one time, cheap enough to be asked for between any two blocks."""
    time_s = min(max(time_s, 0.0), profile.duration_s)
    piece = max(bisect_right(profile.start_s, time_s) - 1, 0)
    elapsed = time_s - profile.start_s.item(piece)
    speed = profile.velocity_mm_s.item(piece)
    rate = profile.acceleration_mm_s2.item(piece)
    return profile.position_mm.item(piece) + (speed + 0.5 * rate * elapsed) * elapsed


def standstill(duration_s: float) -> MotionProfile:
    """Return a profile that stays where it is."""
    return MotionProfile.from_pieces([still(max(duration_s, 1e-3), Phase.REST)])


def run_away(
    profile: MotionProfile, at_s: float, speed_mm_s: float, until_mm: float, accel_mm_s2: float
) -> MotionProfile:
    """Return a profile that is left at `at_s` for a signed speed and ends hard at `until_mm`."""
    kept = []
    for piece, start in zip(profile.pieces(), profile.start_s.tolist(), strict=True):
        if start < at_s:
            kept.append(replace(piece, duration_s=min(piece.duration_s, at_s - start)))
    change = speed_mm_s - float(profile.velocity(at_s))
    kept.append(Piece(abs(change) / accel_mm_s2, float(np.sign(change)) * accel_mm_s2, Phase.ACCELERATE))
    reached = MotionProfile.from_pieces(kept)
    left_mm = until_mm - float(reached.position(reached.duration_s))
    kept.append(Piece(max(left_mm / speed_mm_s, 0.0), 0.0, Phase.STEADY))
    impact = 100.0 * accel_mm_s2
    kept.append(Piece(abs(speed_mm_s) / impact, -float(np.sign(speed_mm_s)) * impact, Phase.DECELERATE))
    return MotionProfile.from_pieces(kept)
