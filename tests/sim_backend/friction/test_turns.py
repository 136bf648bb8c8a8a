"""Where a motion turns."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import find_peaks

from dragrig.sim_backend.friction.motion import turning_samples


@given(st.integers(0, 2**32 - 1), st.integers(2, 80), st.floats(0.0, 0.9), st.floats(0.1, 4.0))
def test_turns_are_the_prominent_peaks_and_valleys(seed: int, samples: int, resting: float, min_mm: float) -> None:
    rng = np.random.default_rng(seed)
    position = np.cumsum(rng.normal(size=samples) * (rng.random(samples) > resting))
    peaks, valleys = (find_peaks(side * position, prominence=min_mm)[0] for side in (1.0, -1.0))
    assert turning_samples(position, min_mm).tolist() == sorted([*peaks.tolist(), *valleys.tolist()])


def test_of_equal_peaks_the_first_is_a_turn() -> None:
    position = np.array([0.0, 3.0, 2.5, 3.0, 0.0, 1.0])
    assert turning_samples(position, 1.0).tolist() == [1, 4]
    assert turning_samples(np.array([0.0, 3.0, 3.0, 3.0, 0.0]), 1.0).tolist() == [2]
    assert turning_samples(np.linspace(0.0, 5.0, 9), 1.0).size == 0
