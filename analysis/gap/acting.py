"""How large something is where it acts."""

import numpy as np

from dragrig.rig.arrays import FloatArray

ACTING = 0.1
"""Something acts where it is this share of the most that it is."""


def rms_where_acting(more: FloatArray, weights: FloatArray) -> float:
    """Return the weighted root mean square of values `(B,)` where they act; 0 where they do nowhere."""
    acting = np.abs(more) > ACTING * np.abs(more).max(initial=1e-12)
    if not acting.any():
        return 0.0
    return float(np.sqrt(weights[acting] @ more[acting] ** 2 / weights[acting].sum()))
