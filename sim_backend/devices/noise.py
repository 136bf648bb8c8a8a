"""Random signals that repeat bit by bit: every purpose has a stream of its own."""

import math
import zlib
from collections.abc import Callable
from enum import IntEnum

import numpy as np

from dragrig.config.rig import MotorSettings, NoiseSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Acquisition


class Stream(IntEnum):
    """What a random stream is for; the numbers enter the seed and never change."""

    SPECIMEN = 1
    RUN = 2
    ZERO = 3
    FORCE_WHITE = 4
    FORCE_SLOW = 5
    MOTOR = 6


def generator(seed: int, stream: Stream, order: int = 0, name: str = "") -> np.random.Generator:
    """Return the generator of one stream, the same whenever it is asked for; `name` separates those of one run."""
    entropy = (seed, order, int(stream), zlib.crc32(name.encode()))
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(entropy)))


def noise_name(acquisition: Acquisition) -> str:
    """Return what separates the noise of acquisitions of one `order`: a tare, a way to the start, the run itself."""
    return f"{acquisition.kind} {acquisition.contact} {round(acquisition.profile.duration_s * 1e6)}"


class SlowNoise:
    """Exponentially correlated noise, an Ornstein–Uhlenbeck process sampled exactly, stationary from its first sample.

    Parameters
    ----------
    deviation, correlation_s
        Standard deviation, and the time over which the correlation falls to 1/e.
    """

    def __init__(
        self, random: np.random.Generator, deviation: float, correlation_s: float, sample_rate_hz: float
    ) -> None:
        from scipy.signal import lfilter

        step = 1.0 / (sample_rate_hz * correlation_s)
        self._random = random
        self._filter = lfilter
        self._decay = math.exp(-step)
        self._drive = deviation * math.sqrt(-math.expm1(-2.0 * step))
        self._carried = np.array([self._decay * deviation * float(random.standard_normal())])

    def draw(self, samples: int) -> FloatArray:
        """Return the next samples, shape `(samples,)`."""
        drive = self._random.standard_normal(samples)
        drive *= self._drive
        values, self._carried = self._filter([1.0], [1.0, -self._decay], drive, zi=self._carried)
        return np.asarray(values)


class NoiseTape:
    """A random signal drawn once and in order, kept from the oldest sample that is still wanted."""

    def __init__(self, draw: Callable[[int], FloatArray]) -> None:
        self._draw = draw
        self._kept = np.zeros(0)
        self._first = 0

    def read(self, first: int, end: int) -> FloatArray:
        """Return samples `first` to `end` of the signal and forget those before; `first` never goes back."""
        passed_over = first - self._first - len(self._kept)
        if passed_over > 0:
            self._draw(passed_over)
        self._kept = self._kept[first - self._first :]
        self._first = first
        missing = end - first - len(self._kept)
        if missing > 0:
            fresh = self._draw(missing)
            self._kept = np.concatenate((self._kept, fresh)) if len(self._kept) else fresh
        return self._kept[: end - first]


def force_noise(settings: NoiseSettings, seed: int, acquisition: Acquisition, sample_rate_hz: float) -> NoiseTape:
    """Return the force sensor's noise [mN]: zero offset of the run's `order`, white and slow noise."""
    order, name = acquisition.order, noise_name(acquisition)
    zero = settings.zero_mN * float(generator(seed, Stream.ZERO, order).standard_normal())
    white = generator(seed, Stream.FORCE_WHITE, order, name)
    slow = SlowNoise(
        generator(seed, Stream.FORCE_SLOW, order, name), settings.slow_mN, settings.slow_correlation_s, sample_rate_hz
    )

    def draw(samples: int) -> FloatArray:
        values = white.standard_normal(samples)
        values *= settings.white_mN
        values += slow.draw(samples)
        values += zero
        return values

    return NoiseTape(draw)


def motor_noise(settings: MotorSettings, seed: int, acquisition: Acquisition) -> NoiseTape:
    """Return the motor force's noise [mN], white."""
    random = generator(seed, Stream.MOTOR, acquisition.order, noise_name(acquisition))

    def draw(samples: int) -> FloatArray:
        values = random.standard_normal(samples)
        values *= settings.noise_mN
        return values

    return NoiseTape(draw)
