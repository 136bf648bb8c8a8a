"""Savitzky–Golay smoothing of whole traces (Savitzky and Golay, Anal. Chem. 36, 1964)."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dragrig.analysis.gaps import unbroken
from dragrig.analysis.savgol_kernel import SavgolKernel
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import FloatArray, read_only
from dragrig.rig.runfile.model import Event

HIGHEST_ORDER = 8
"""Beyond this the fit at the ends of a piece is no longer well conditioned."""

TOO_SHORT = "filter"
"""Kind of the event that says a piece was too short to filter."""


@dataclass(frozen=True, slots=True)
class SavgolSettings:
    """Window, order and derivative of a Savitzky–Golay filter.

    Attributes
    ----------
    window_s
        Length of the window [s]; the nearest odd number of samples is taken.
    window_samples
        The same as an odd number of samples. Give one of the two.
    order
        Order of the polynomial fitted inside the window, 0 to 8.
    derivative
        0 smooths; `k` gives the k-th derivative by time, in the values' unit per s^k.

    Raises
    ------
    AnalysisError
        When the settings contradict themselves.
    """

    window_s: float | None = None
    window_samples: int | None = None
    order: int = 3
    derivative: int = 0

    def __post_init__(self) -> None:
        if (self.window_s is None) == (self.window_samples is None):
            raise AnalysisError("A filter window is given either in seconds or in samples; give one of the two.")
        if self.window_s is not None and not (np.isfinite(self.window_s) and self.window_s > 0):
            raise AnalysisError(f"A filter window of {self.window_s:g} s is impossible; give a length above 0 s.")
        if not 0 <= self.order <= HIGHEST_ORDER:
            raise AnalysisError(f"A filter of order {self.order} is not offered; choose 0 to {HIGHEST_ORDER}.")
        if not 0 <= self.derivative <= self.order:
            raise AnalysisError(
                f"Derivative {self.derivative} of a polynomial of order {self.order} says nothing; "
                f"choose a derivative from 0 to {self.order}."
            )
        if self.window_samples is not None:
            self._check_window(self.window_samples)

    def samples(self, sample_rate_hz: float) -> int:
        """Return the window's length in samples, an odd number.

        Raises
        ------
        AnalysisError
            When the window is too short for the order at this rate.
        """
        if self.window_samples is not None:
            return self.window_samples
        window_s = self.window_s or 0.0
        samples = 2 * int(window_s * sample_rate_hz / 2 + 1e-9) + 1
        if samples < self._shortest:
            raise AnalysisError(
                f"A window of {window_s:g} s is {samples} samples at {sample_rate_hz:g} Hz, too short for "
                f"order {self.order}; give at least {self._shortest} samples ({self._shortest / sample_rate_hz:g} s)."
            )
        return samples

    def kernel(self, sample_rate_hz: float) -> SavgolKernel:
        """Return the filter itself at a rate; raises `AnalysisError` as `samples` does."""
        return SavgolKernel.of(self.samples(sample_rate_hz), self.order, self.derivative, sample_rate_hz)

    @property
    def _shortest(self) -> int:
        return max(3, self.order + 1 + self.order % 2)

    def _check_window(self, samples: int) -> None:
        if samples % 2 == 0:
            raise AnalysisError(
                f"A filter window of {samples} samples has no middle; "
                f"give an odd number, {samples - 1} or {samples + 1}."
            )
        if samples < self._shortest:
            raise AnalysisError(
                f"A filter window of {samples} samples is too short for order {self.order}; "
                f"give at least {self._shortest} samples."
            )


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """Filtered values, shape `(N,)`, NaN where a piece was too short, and an event for each such piece."""

    values: FloatArray
    events: tuple[Event, ...]


def smooth(
    values: npt.ArrayLike,
    sample_rate_hz: float,
    settings: SavgolSettings,
    gaps: npt.ArrayLike = (),
    time: FloatArray | None = None,
) -> Smoothed:
    """Filter a trace, each unbroken piece on its own.

    At the ends of a piece the polynomial of its first or last full window is evaluated
    (`scipy.signal.savgol_filter` with `mode="interp"`). NaN and infinities break a piece as a gap does
    and stay NaN. A piece shorter than the window becomes NaN.

    Parameters
    ----------
    values
        Shape `(N,)`.
    sample_rate_hz
        Rate inside a piece.
    gaps
        Index of each first sample after a gap, as `gap_starts` returns them.
    time
        Times of the samples [s] for the events; sample index over rate when left out.

    Raises
    ------
    AnalysisError
        When the window is longer than the whole trace, or does not suit the order or the rate.
    """
    source = np.asarray(values, dtype=np.float64)
    window = settings.samples(sample_rate_hz)
    if window > len(source):
        raise AnalysisError(
            f"A filter window of {window} samples is longer than the whole run of {len(source)} samples; "
            "choose a shorter window."
        )
    kernel = settings.kernel(sample_rate_hz)
    result = np.full(len(source), np.nan)
    events: list[Event] = []
    for piece in unbroken(source, gaps):
        samples = piece.stop - piece.start
        if samples < window:
            at = float(time[piece.start]) if time is not None else piece.start / sample_rate_hz
            events.append(too_short(at, samples, window))
            continue
        result[piece] = kernel.whole(source[piece])
    read_only(result)
    return Smoothed(result, tuple(events))


def too_short(time_s: float, samples: int, window: int) -> Event:
    """Return the event that says a piece was not filtered."""
    message = f"a piece of {samples} samples is shorter than the window of {window}: not filtered"
    return Event(time_s, TOO_SHORT, message)
