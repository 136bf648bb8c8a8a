"""Array types that cross module boundaries."""

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
AnyFloatArray: TypeAlias = npt.NDArray[np.float32] | npt.NDArray[np.float64]
PhaseArray: TypeAlias = npt.NDArray[np.uint8]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
IndexArray: TypeAlias = npt.NDArray[np.intp]


def read_only(array: npt.NDArray[np.generic]) -> None:
    """Forbid writing to `array` from here on."""
    array.flags.writeable = False
