"""Savitzky–Golay filter of a trace, of samples as they arrive, and of run files.

Source: Savitzky and Golay, Anal. Chem. 36, 1964.

The default window of 0.05 s and order 3 is a compromise. At 500 Hz it reduces white noise by a factor of 3.3
(at 1 kHz 4.8) and gives the speed to 0.01 mm/s from counts of 1 µm. The start-up of a drag test takes
0.1 to 0.3 s: between 50 and 90 % of its rise, the simulated one at 20 mm/s takes 0.182 s instead of 0.188 s. A window
of 0.1 s would reduce noise only 1.4 times further and double the time in which a start-up is blurred.
A jump (Coulomb friction as the stage starts) is spread over the window, with an overshoot of a tenth of the
jump. The window matters where the motion itself is short: the peak after a relaxation's ramp of
0.04 to 0.13 s comes out 1 to 3 % low. A run's measures are taken from the raw trace for this reason.
"""

from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre

from dragrig.analysis.segments import gap_starts, in_phase, mask_spans, unbroken_slices
from dragrig.config import AnalysisError
from dragrig.rig import AnyFloatArray, Attribute, FilteredTrace, FloatArray, Phase, Run, RunEvent, Trace, read_only

DEFAULT_WINDOW_S = 0.05
MIN_DEFAULT_SAMPLES = 7
"""Of the default window; at low rates it is longer than `DEFAULT_WINDOW_S`."""
MAX_ORDER = 8
"""Beyond this the fit at the ends of a piece is no longer well conditioned."""
MAX_DIRECT_WINDOW = 512
"""Longer windows are convolved by Fourier transform."""
_MIN_THREADED_SAMPLES = 1_000_000
_DISPLAY_BLOCK_SAMPLES, _BLOCK_WINDOWS, _BLOCKS_AT_ONCE = 8192, 8, 8
"""Of the Fourier transforms for display: so few stay in the processor's cache."""
MIN_MOTION_WINDOWS = 4.0
"""A motion shorter than this many windows is blurred, which an event says."""
FILTER_EVENT = "filter"
"""Kind of the events of the filter."""


@dataclass(frozen=True, slots=True, eq=False)
class SavgolKernel:
    """Window, order and derivative at one sample rate.

    Weights and ends are computed here, because `scipy.signal` solves with unscaled powers of the sample number: at
    12501 samples (0.05 s at 250 kHz) and order 4 or more its result is unrelated to the data.
    """

    window: int
    orthonormal: FloatArray
    """Polynomials on the window, orthonormal, shape `(window, order + 1)`."""
    derived: FloatArray
    """Their derivative at each sample, in 1/s^k."""
    weights: FloatArray
    """Weights of the samples in a window for its middle, in the order of a convolution."""

    @classmethod
    def of(cls, window: int, order: int, derivative: int, sample_rate_hz: float) -> "SavgolKernel":
        """Compute the polynomials; Legendre's keep the fit well conditioned."""
        at = np.linspace(-1.0, 1.0, window)
        orthonormal, triangle = np.linalg.qr(np.asarray(legendre.legvander(at, order), dtype=np.float64))
        rows = [legendre.legval(at, legendre.legder(row, derivative)) for row in np.eye(order + 1)]
        per_second = (2 * sample_rate_hz / (window - 1)) ** derivative
        derived = np.ascontiguousarray(np.linalg.solve(triangle.T, np.array(rows)).T * per_second)
        weights = np.ascontiguousarray((orthonormal @ derived[window // 2])[::-1])
        return cls(window, orthonormal, derived, weights)

    @property
    def half(self) -> int:
        """Samples before and after the middle of the window."""
        return self.window // 2

    def whole(self, piece: FloatArray, *, for_display: bool = False) -> FloatArray:
        """Filter a piece of `n >= window` samples to as many."""
        first, last = self.ends(piece[: self.window]), self.ends(piece[-self.window :])
        middle = self.middle_for_display(piece) if for_display else self.middle(piece)
        return np.concatenate((first[: self.half], middle, last[self.half + 1 :]))

    def middle(self, piece: FloatArray) -> FloatArray:
        """Filter a piece of `n >= window` samples to the `n - window + 1` that have a full window."""
        if self.window > MAX_DIRECT_WINDOW:
            from scipy.signal import oaconvolve

            return np.asarray(oaconvolve(piece, self.weights, mode="valid"), dtype=np.float64)
        return np.convolve(piece, self.weights, mode="valid")

    def middle_for_display(self, piece: FloatArray) -> FloatArray:
        """As `middle`, in nearly the same time for every window; rounded otherwise, by some 1e-15 of the values.

        Overlap-save: only full blocks are transformed, the samples after the last one are filtered by `middle`.
        """
        from scipy.fft import irfft, next_fast_len, rfft

        block = next_fast_len(max(_DISPLAY_BLOCK_SAMPLES, _BLOCK_WINDOWS * self.window), real=True)
        step = block - self.window + 1
        if len(piece) < block:
            return self.middle(piece)
        blocks = np.lib.stride_tricks.sliding_window_view(piece, block)[::step]
        done = len(blocks) * step
        result = np.empty(len(piece) - self.window + 1)
        steps = result[:done].reshape(len(blocks), step)
        transfer = rfft(self.weights, block)
        for first in range(0, len(blocks), _BLOCKS_AT_ONCE):
            some = slice(first, first + _BLOCKS_AT_ONCE)
            steps[some] = irfft(rfft(blocks[some]) * transfer, block)[:, self.window - 1 :]
        if done < len(result):
            result[done:] = self.middle(piece[done:])
        return result

    def ends(self, samples: FloatArray) -> FloatArray:
        """Evaluate the polynomial through exactly one window at each of its samples; the middle one is not used."""
        return np.asarray(self.derived @ (self.orthonormal.T @ samples))


@dataclass(frozen=True, slots=True)
class SavgolSettings:
    """Window, order and derivative of a Savitzky–Golay filter.

    Raises `AnalysisError` when the settings contradict themselves.
    """

    window_s: float | None = None
    """Length of the window [s]; the nearest odd number of samples is taken."""
    window_samples: int | None = None
    """The same as an odd number of samples. Give one of the two."""
    order: int = 3
    """Order of the polynomial fitted inside the window, 0 to 8."""
    derivative: int = 0
    """0 smooths; `k` gives the k-th derivative by time, in the values' unit per s^k."""

    def __post_init__(self) -> None:
        if (self.window_s is None) == (self.window_samples is None):
            raise AnalysisError("A filter window is given either in seconds or in samples; give one of the two.")
        if self.window_s is not None and not (np.isfinite(self.window_s) and self.window_s > 0):
            raise AnalysisError(f"A filter window of {self.window_s:g} s is impossible; give a length above 0 s.")
        if not 0 <= self.order <= MAX_ORDER:
            raise AnalysisError(f"A filter order of {self.order} is not supported; choose 0 to {MAX_ORDER}.")
        if not 0 <= self.derivative <= self.order:
            raise AnalysisError(
                f"Derivative {self.derivative} of a polynomial of order {self.order} is zero or undefined; "
                f"choose a derivative from 0 to {self.order}."
            )
        samples = self.window_samples
        if samples is not None and samples % 2 == 0:
            raise AnalysisError(
                f"A filter window of {samples} samples has no middle; "
                f"give an odd number, {samples - 1} or {samples + 1}."
            )
        if samples is not None and samples < self._shortest:
            raise AnalysisError(
                f"A filter window of {samples} samples is too short for order {self.order}; "
                f"give at least {self._shortest} samples."
            )

    def samples(self, sample_rate_hz: float) -> int:
        """Return the window's length in samples, an odd number.

        Raises `AnalysisError` when the window is too short for the order at this rate.
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


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedTrace:
    """Filtered values, shape `(N,)`, NaN where a piece was too short, and an event for each such piece."""

    values: FloatArray
    events: tuple[RunEvent, ...]


def smooth(
    values: npt.ArrayLike,
    sample_rate_hz: float,
    settings: SavgolSettings,
    gaps: npt.ArrayLike = (),
    time: FloatArray | None = None,
    *,
    for_display: bool = False,
) -> SmoothedTrace:
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
        Times of the samples [s] for the events; default: sample index over rate.
    for_display
        Faster on a long trace; rounding differs, far below single precision. Not for stored traces.

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
    events: list[RunEvent] = []
    for piece in unbroken_slices(source, gaps):
        samples = piece.stop - piece.start
        if samples < window:
            at = float(time[piece.start]) if time is not None else piece.start / sample_rate_hz
            events.append(too_short_event(at, samples, window))
            continue
        result[piece] = kernel.whole(source[piece], for_display=for_display)
    read_only(result)
    return SmoothedTrace(result, tuple(events))


def smooth_channel(trace: Trace, values: AnyFloatArray, settings: SavgolSettings) -> SmoothedTrace:
    """Filter a channel of a run, across none of its gaps; raises `AnalysisError` as `smooth`."""
    gaps = gap_starts(trace.time, trace.sample_rate_hz)
    return smooth(values, trace.sample_rate_hz, settings, gaps, trace.time)


def too_short_event(time_s: float, samples: int, window: int) -> RunEvent:
    """Event of a piece that was not filtered."""
    message = f"a piece of {samples} samples is shorter than the window of {window}: not filtered"
    return RunEvent(time_s, FILTER_EVENT, message)


class SavgolStream:
    """One channel, filtered block by block.

    Every sample pushed comes out once, in order, filtered; the returned pieces of `push` and `flush`, put end to
    end, are the result of `smooth` for the same samples and gaps. Memory: one window and one block.
    Not to be shared between threads.

    Parameters
    ----------
    sample_rate_hz
        Rate of the samples.
    settings
        Window, order and derivative.

    Raises
    ------
    AnalysisError
        When the window does not suit the order or the rate.
    """

    def __init__(self, sample_rate_hz: float, settings: SavgolSettings) -> None:
        self._rate = sample_rate_hz
        self._kernel = settings.kernel(sample_rate_hz)
        self._window = self._kernel.window
        self._half = self._kernel.half
        self._next_index = 0
        self._piece_start = 0
        self._seen = 0
        self._held = np.empty(0)
        self._events: list[RunEvent] = []

    @property
    def events(self) -> tuple[RunEvent, ...]:
        """One event for each piece that was too short to filter, so far."""
        return tuple(self._events)

    def push(self, values: npt.ArrayLike, first_index: int | None = None) -> FloatArray:
        """Take samples in and return those that are ready.

        Parameters
        ----------
        values
            Shape `(n,)`, any `n`.
        first_index
            Index of the first sample, counted from the run's first and including lost samples, as a
            block carries it; a value beyond the samples so far is a gap. Default: no gap.

        Raises
        ------
        AnalysisError
            When `first_index` lies before samples that were pushed already.
        """
        block = np.asarray(values, dtype=np.float64)
        ready: list[FloatArray] = []
        if first_index is not None and first_index != self._next_index:
            if first_index < self._next_index:
                raise AnalysisError(
                    f"Sample {first_index} was pushed after sample {self._next_index - 1}; push blocks in order."
                )
            ready.append(self.flush())
            self._next_index = first_index
        at = 0
        for start, stop in mask_spans(np.isfinite(block)):
            if start > at:
                ready.append(self._skip(start - at))
            ready.append(self._extend(block[start:stop]))
            at = stop
        if at < len(block):
            ready.append(self._skip(len(block) - at))
        return np.concatenate(ready) if ready else np.empty(0)

    def flush(self) -> FloatArray:
        """End the piece and return its remaining samples; the next sample pushed begins a new piece."""
        seen, held = self._seen, self._held
        self._seen, self._held = 0, np.empty(0)
        if seen == 0:
            return held
        if seen < self._window:
            self._events.append(too_short_event(self._piece_start / self._rate, seen, self._window))
            return np.full(seen, np.nan)
        return self._kernel.ends(held[-self._window :])[self._half + 1 :]

    def _extend(self, samples: FloatArray) -> FloatArray:
        if self._seen == 0:
            self._piece_start = self._next_index
        before = max(0, self._seen - self._half) if self._seen >= self._window else 0
        self._seen += len(samples)
        self._next_index += len(samples)
        self._held = np.concatenate((self._held, samples))
        if self._seen < self._window:
            return np.empty(0)
        held_from = self._seen - len(self._held)
        ready = [] if before else [self._kernel.ends(self._held[: self._window])[: self._half]]
        middle = self._kernel.middle(self._held)
        ready.append(middle[max(0, before - held_from - self._half) :])
        self._held = self._held[-self._window :].copy()
        return np.concatenate(ready)

    def _skip(self, samples: int) -> FloatArray:
        ended = self.flush()
        self._next_index += samples
        return np.concatenate((ended, np.full(samples, np.nan)))


@dataclass(frozen=True, slots=True, eq=False)
class FilteredRun:
    """Filtered traces of a run, and the events of the filter."""

    trace: FilteredTrace
    events: tuple[RunEvent, ...]


def default_filter_settings(sample_rate_hz: float) -> SavgolSettings:
    """Order 3 over 0.05 s, or over seven samples where these take longer."""
    if DEFAULT_WINDOW_S * sample_rate_hz < MIN_DEFAULT_SAMPLES:
        return SavgolSettings(window_samples=MIN_DEFAULT_SAMPLES)
    return SavgolSettings(window_s=DEFAULT_WINDOW_S)


def filter_run(
    run: Run,
    settings: SavgolSettings | None = None,
    forces: Collection[str] | None = None,
    *,
    for_display: bool = False,
) -> FilteredRun:
    """Filter the forces of a run, and derive `speed` [mm/s] from its position.

    Parameters
    ----------
    settings
        Default: `default_filter_settings` for the run's rate. A derivative applies to the forces
        (then in mN/s^k); the speed is always the first derivative of the position.
    forces
        Names of the forces to filter; default: all.
    for_display
        As for `smooth`.

    Raises
    ------
    AnalysisError
        When the window is longer than the run, or does not suit the order or the rate.
    """
    trace = run.trace
    settings = settings or default_filter_settings(trace.sample_rate_hz)
    wanted = [name for name in trace.channels if trace.units.get(name) == "mN" and (forces is None or name in forces)]
    differentiator = replace(settings, order=max(settings.order, 1), derivative=1)
    tasks = {name: (trace.channels[name], settings) for name in wanted} | {"speed": (trace.position, differentiator)}
    gaps = gap_starts(trace.time, trace.sample_rate_hz)

    def smoothed(task: tuple[AnyFloatArray, SavgolSettings]) -> SmoothedTrace:
        values, how = task
        return smooth(values, trace.sample_rate_hz, how, gaps, trace.time, for_display=for_display)

    # A convolution leaves the interpreter to other threads; for fewer samples they cost more than they save.
    threads = len(tasks) if len(trace.time) >= _MIN_THREADED_SAMPLES else 1
    try:
        with ThreadPoolExecutor(threads) as pool:
            results = dict(zip(tasks, pool.map(smoothed, tasks.values()), strict=True))
    except AnalysisError as error:
        raise AnalysisError(f"{run.info.path}: {error}") from error
    channels = {name: result.values for name, result in results.items()}
    force_unit = f"mN/s^{settings.derivative}" if settings.derivative else "mN"
    units = {name: "mm/s" if name == "speed" else force_unit for name in channels} | {"time": "s"}
    short_pieces = dict.fromkeys(event for result in results.values() for event in result.events)
    events = (*_blur_events(trace, settings), *short_pieces)
    signal = channels.get(trace.signal, channels["speed"])
    parameters = _filter_parameters(settings, trace.sample_rate_hz, signal, events)
    return FilteredRun(FilteredTrace(trace.time, channels, parameters, units), events)


def filter_file(path: Path, settings: SavgolSettings | None = None) -> FilteredRun:
    """Filter a run file and store the result in it, beside the raw trace.

    Raises
    ------
    AnalysisError
        As `filter_run`.
    RunFileError, OutputError
        When the file cannot be read, or its changed copy cannot be put in its place.
    """
    from dragrig.rig import read_run, store_filtered

    filtered = filter_run(read_run(path), settings)
    store_filtered(path, filtered.trace, filtered.events)
    return filtered


def _filter_parameters(
    settings: SavgolSettings, sample_rate_hz: float, signal: FloatArray, events: tuple[RunEvent, ...]
) -> dict[str, Attribute]:
    window = settings.samples(sample_rate_hz)
    return {
        "filter": "Savitzky-Golay",
        "window_s": window / sample_rate_hz,
        "window_samples": window,
        "order": settings.order,
        "derivative": settings.derivative,
        "ends": "polynomial of the first and last window of each unbroken piece",
        "unfiltered_samples": int(np.count_nonzero(np.isnan(signal))),
        "remarks": "; ".join(f"{event.time_s:.3f} s: {event.message}" for event in events),
    }


def _blur_events(trace: Trace, settings: SavgolSettings) -> tuple[RunEvent, ...]:
    """Event of a motion that is short beside the window."""
    moving = ~(in_phase(trace, Phase.REST) | in_phase(trace, Phase.HOLD))
    if not moving.any():
        return ()
    begin, end = float(trace.time[moving][0]), float(trace.time[moving][-1])
    window_s = settings.samples(trace.sample_rate_hz) / trace.sample_rate_hz
    if end - begin >= MIN_MOTION_WINDOWS * window_s:
        return ()
    message = f"the motion of {end - begin:.3g} s is short beside the window of {window_s:.3g} s: its force is blurred"
    return (RunEvent(begin, FILTER_EVENT, message),)
