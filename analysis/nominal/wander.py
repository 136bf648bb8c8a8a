"""How fine a recorded position is, and how far it wanders at rest: an encoder's counts, noise, a servo's dither."""

import tomllib

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from dragrig.analysis.phases import Mask
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.recorded import JITTER_MM, WINDOW_S, on_a_grid
from dragrig.sim_backend.friction.smoothing import ORDER

SETTLED_S = 0.2
"""A stage stands still so long after its command does."""
LEAST_REST_S = 0.3
"""Rests shorter than this together do not show how far it wanders."""
QUIETEST = 0.25
"""Share of the windows at rest that are looked at, for in others a stage may still come to rest."""
QUIETEST_SDS, USUAL_SDS = 2.9, 6.0
"""What they span at most in white noise, in its standard deviations, and what nearly all do, also longer ones."""
MOST_MM = 0.02
"""What goes further than this is a motion, unless it is from one count to the next."""
COUNT_MM = 0.001
"""An encoder's count is taken for no less, and for this where nothing is said of it."""


class _Encoder(BaseModel):
    resolution_um: float = Field(default=1e3 * COUNT_MM, gt=0)


class _Rig(BaseModel):
    encoder: _Encoder = _Encoder()


class _Settings(BaseModel):
    rig: _Rig = _Rig()


def count_of(settings_toml: str) -> float:
    """Return the encoder's count [mm] that a run's settings tell, at least `COUNT_MM`; that where they tell none."""
    try:
        said = _Settings.model_validate(tomllib.loads(settings_toml))
    except (tomllib.TOMLDecodeError, ValidationError):
        return COUNT_MM
    return max(1e-3 * said.rig.encoder.resolution_um, COUNT_MM)


def wander_of(
    time_s: FloatArray, position_mm: FloatArray, command_mm: FloatArray | None, count_mm: float = COUNT_MM
) -> float:
    """Return how far a recorded position wanders within `WINDOW_S` at rest, from least to largest [mm].

    Parameters
    ----------
    time_s, position_mm
        The record, shape `(N,)`: rising times from 0, finite positions.
    command_mm
        Where the stage was told to be, shape `(N,)`, which shows its rests; None where that is not known. Then the
        wander is what a parabola leaves in the middle of a window, in white noise.
    count_mm
        The encoder's count.

    Returns
    -------
    At least the jitter of such an encoder, and at most `MOST_MM` if that is more.
    """
    grid, position = on_a_grid(time_s, position_mm)
    window = max(ORDER + 3, 2 * round(0.5 * WINDOW_S / float(grid[1])) + 1)
    jitter_mm = jitter_of(count_mm)
    if position.size < 2 * window:
        return jitter_mm
    rests = None if command_mm is None else _rests(grid, np.interp(grid, time_s, command_mm), window)
    if rests is None or np.count_nonzero(rests) * float(grid[1]) < LEAST_REST_S:
        sd = _noise(position, window)
    else:
        sd = float(np.quantile(_spans(position, window)[rests], QUIETEST)) / QUIETEST_SDS
    return max(jitter_mm, min(USUAL_SDS * sd, MOST_MM))


def jitter_of(count_mm: float) -> float:
    """Return how far [mm] an encoder wanders at rest: from one count to the next."""
    return JITTER_MM * count_mm / COUNT_MM


def noise_of(wander_mm: float, count_mm: float) -> float:
    """Return the standard deviation [mm] of a position that wanders so far; 0 where it is by the counts alone."""
    return wander_mm / USUAL_SDS if wander_mm > jitter_of(count_mm) else 0.0


def _rests(grid_s: FloatArray, command_mm: FloatArray, window: int) -> Mask:
    """Tell in the middle of which windows the stage has been told to stand still all through and long before."""
    from scipy.ndimage import maximum_filter1d

    moving = np.append(np.diff(command_mm) != 0, False)
    last_move_s = np.maximum.accumulate(np.where(moving, grid_s, -np.inf))
    begun = maximum_filter1d(moving.astype(np.uint8), window) == 0
    settled = grid_s - last_move_s > SETTLED_S + WINDOW_S
    settled[: window // 2] = settled[moving.size - window // 2 :] = False
    return np.asarray(begun & settled)


def _spans(position_mm: FloatArray, window: int) -> FloatArray:
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    return np.asarray(maximum_filter1d(position_mm, window) - minimum_filter1d(position_mm, window))


def _noise(position_mm: FloatArray, window: int) -> float:
    """Return the standard deviation of white noise beside a motion, most of which is steady."""
    from scipy.signal import savgol_filter

    left = position_mm - savgol_filter(position_mm, window, ORDER)
    kept = 1.0 - 9.0 / (4.0 * window)
    return 1.4826 * float(np.median(np.abs(left))) / float(np.sqrt(kept))
