"""What a Savitzky–Golay filter does to one unbroken piece: a convolution in the middle, a polynomial at each end."""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from dragrig.rig.arrays import FloatArray

LONGEST_DIRECT_WINDOW = 512
"""Beyond this the convolution goes through the Fourier transform, and nothing is convolved for the ends."""


@dataclass(frozen=True, slots=True, eq=False)
class SavgolKernel:
    """Window, order and derivative at one sample rate.

    `scipy.signal` fits the ends of a piece, and convolves. The weights of the middle are computed here, because
    `scipy.signal.savgol_coeffs` solves with unscaled powers of the sample number: at 12501 samples
    (0.05 s at 250 kHz) and order 4 or more its answer has nothing to do with the data any more.

    Attributes
    ----------
    orthonormal
        Polynomials on the window, orthonormal, shape `(window, order + 1)`.
    derived
        Their derivative at each sample, in 1/s^k.
    weights
        Weights of the samples in a window for its middle, in the order of a convolution.
    """

    window: int
    order: int
    derivative: int
    sample_rate_hz: float
    orthonormal: FloatArray
    derived: FloatArray
    weights: FloatArray

    @classmethod
    def of(cls, window: int, order: int, derivative: int, sample_rate_hz: float) -> "SavgolKernel":
        """Work out the polynomials; Legendre's keep the fit well conditioned."""
        at = np.linspace(-1.0, 1.0, window)
        orthonormal, triangle = np.linalg.qr(np.asarray(legendre.legvander(at, order), dtype=np.float64))
        rows = [legendre.legval(at, legendre.legder(row, derivative)) for row in np.eye(order + 1)]
        per_second = (2 * sample_rate_hz / (window - 1)) ** derivative
        derived = np.ascontiguousarray(np.linalg.solve(triangle.T, np.array(rows)).T * per_second)
        weights = np.ascontiguousarray((orthonormal @ derived[window // 2])[::-1])
        return cls(window, order, derivative, sample_rate_hz, orthonormal, derived, weights)

    @property
    def half(self) -> int:
        """Samples before and after the middle of the window."""
        return self.window // 2

    def whole(self, piece: FloatArray) -> FloatArray:
        """Filter a piece of `n >= window` samples to as many."""
        first, last = self.ends(piece[: self.window]), self.ends(piece[-self.window :])
        return np.concatenate((first[: self.half], self.middle(piece), last[self.half + 1 :]))

    def middle(self, piece: FloatArray) -> FloatArray:
        """Filter a piece of `n >= window` samples to the `n - window + 1` that have a full window."""
        from scipy.ndimage import convolve1d
        from scipy.signal import oaconvolve

        if self.window > LONGEST_DIRECT_WINDOW:
            return np.asarray(oaconvolve(piece, self.weights, mode="valid"), dtype=np.float64)
        return np.asarray(convolve1d(piece, self.weights, mode="constant")[self.half : len(piece) - self.half])

    def ends(self, samples: FloatArray) -> FloatArray:
        """Evaluate the polynomial through exactly one window at each of its samples; the middle one is not used."""
        from scipy.signal import savgol_filter

        if self.window > LONGEST_DIRECT_WINDOW:
            return np.asarray(self.derived @ (self.orthonormal.T @ samples))
        fitted = savgol_filter(
            samples, self.window, self.order, self.derivative, 1 / self.sample_rate_hz, mode="interp"
        )
        return np.asarray(fitted, dtype=np.float64)
