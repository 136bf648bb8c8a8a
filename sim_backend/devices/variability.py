"""Randomness in a simulated rig: noise of the channels, and how specimens and runs vary.

Each purpose has a random stream of its own, so that results repeat bit by bit.
"""

import math
import zlib
from collections.abc import Callable
from enum import IntEnum
from itertools import accumulate

import numpy as np

from dragrig.config import FrictionModelSettings, MotorSettings, NoiseSettings, VariationSettings
from dragrig.rig import Acquisition, FloatArray


class RandomStream(IntEnum):
    """The purpose of a random stream; the numbers enter the seed and never change."""

    SPECIMEN = 1
    RUN = 2
    ZERO = 3
    FORCE_WHITE = 4
    FORCE_SLOW = 5
    MOTOR = 6


def random_generator(seed: int, stream: RandomStream, order: int = 0, name: str = "") -> np.random.Generator:
    """Return the generator of one stream, always in its initial state; `name` distinguishes the streams of one run."""
    entropy = (seed, order, int(stream), zlib.crc32(name.encode()))
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(entropy)))


def noise_name(acquisition: Acquisition) -> str:
    """Return a name that distinguishes acquisitions of one `order`: a tare, a move to the start, the run itself."""
    return f"{acquisition.kind} {acquisition.contact} {round(acquisition.profile.duration_s * 1e6)}"


class SlowNoise:
    """Exponentially correlated noise, an Ornstein–Uhlenbeck process sampled exactly, stationary from its first sample.

    Parameters
    ----------
    deviation, correlation_s
        Standard deviation, and the time over which the correlation falls to 1/e.
    """

    def __init__(self, random: np.random.Generator, deviation: float, correlation_s: float, rate_hz: float) -> None:
        step = 1.0 / (rate_hz * correlation_s)
        self._random = random
        self._decay = math.exp(-step)
        self._innovation_sd = deviation * math.sqrt(-math.expm1(-2.0 * step))
        self._left = self._decay * deviation * float(random.standard_normal())

    def draw(self, samples: int) -> FloatArray:
        """Return the next samples, at least one, shape `(samples,)`."""
        innovations = self._random.standard_normal(samples) * self._innovation_sd
        innovations[0] += self._left
        # Filtered here: to load a library's filter takes longer than a short run.
        filtered = accumulate(innovations.tolist(), lambda last, fresh: self._decay * last + fresh)
        values = np.fromiter(filtered, np.float64, samples)
        self._left = self._decay * values.item(-1)
        return values


class BufferedNoise:
    """A random signal drawn once and in order; samples before the last one read from are dropped."""

    def __init__(self, draw: Callable[[int], FloatArray]) -> None:
        self._draw = draw
        self._buffer = np.zeros(0)
        self._first = 0

    def read(self, first: int, end: int) -> FloatArray:
        """Return samples `first` to `end` of the signal and drop those before; `first` must not decrease."""
        skipped = first - self._first - len(self._buffer)
        if skipped > 0:
            self._draw(skipped)
        self._buffer = self._buffer[first - self._first :]
        self._first = first
        missing = end - first - len(self._buffer)
        if missing > 0:
            drawn = self._draw(missing)
            self._buffer = np.concatenate((self._buffer, drawn)) if len(self._buffer) else drawn
        return self._buffer[: end - first]


def force_noise(settings: NoiseSettings, seed: int, acquisition: Acquisition, sample_rate_hz: float) -> BufferedNoise:
    """Return the force sensor's noise [mN]: zero offset of the run's `order`, white and slow noise."""
    order, name = acquisition.order, noise_name(acquisition)
    zero = settings.zero_mN * float(random_generator(seed, RandomStream.ZERO, order).standard_normal())
    white = random_generator(seed, RandomStream.FORCE_WHITE, order, name)
    slow = SlowNoise(
        random_generator(seed, RandomStream.FORCE_SLOW, order, name),
        settings.slow_mN,
        settings.slow_correlation_s,
        sample_rate_hz,
    )
    return BufferedNoise(lambda samples: white.standard_normal(samples) * settings.white_mN + slow.draw(samples) + zero)


def motor_noise(settings: MotorSettings, seed: int, acquisition: Acquisition) -> BufferedNoise:
    """Return the white noise of the motor force [mN]."""
    random = random_generator(seed, RandomStream.MOTOR, acquisition.order, noise_name(acquisition))
    return BufferedNoise(lambda samples: random.standard_normal(samples) * settings.noise_mN)


BETWEEN_SPECIMENS = {
    "stiffness_scale": 0.15,
    "e1_scale": 0.07,
    "e2_scale": 0.07,
    "e3_scale": 0.07,
    "eta1_scale": 0.07,
    "eta2_scale": 0.07,
    "friction_coefficient": 0.12,
    "mucus_scale": 0.20,
    "force_gain": 0.005,
    "insertion_dwell_scale": 0.25,
}
"""Relative standard deviations between specimens, by name in the model's settings."""

CONTACT_ANGLE_SD_DEG = 0.7
"""Standard deviation of the contact angle between specimens."""

MAX_DEVIATIONS = 3.0
"""Draws are clipped at this many standard deviations."""


def lognormal_variation(nominal: float, relative_deviation: float, normal: float) -> float:
    """Return `nominal` times a lognormal factor of mean 1 and this relative standard deviation.

    `normal` is a standard normal deviate; it is clipped at `MAX_DEVIATIONS`.
    """
    width = math.sqrt(math.log1p(relative_deviation**2))
    return nominal * math.exp(width * min(max(normal, -MAX_DEVIATIONS), MAX_DEVIATIONS) - 0.5 * width**2)


def draw_specimen_model(model: FrictionModelSettings, seed: int) -> FrictionModelSettings:
    """Return the model of a random specimen: lognormal factors, and a clipped normal contact angle."""
    normals = random_generator(seed, RandomStream.SPECIMEN).standard_normal(len(BETWEEN_SPECIMENS) + 1)
    drawn = {
        name: lognormal_variation(float(getattr(model, name)), deviation, float(normal))
        for (name, deviation), normal in zip(BETWEEN_SPECIMENS.items(), normals, strict=False)
    }
    angle_deg = CONTACT_ANGLE_SD_DEG * float(np.clip(normals[-1], -MAX_DEVIATIONS, MAX_DEVIATIONS))
    drawn["contact_angle_offset_deg"] = model.contact_angle_offset_deg + angle_deg
    return model.model_copy(update=drawn)


def draw_run_model(
    model: FrictionModelSettings, variation: VariationSettings, seed: int, order: int
) -> FrictionModelSettings:
    """Return the model of one run on a specimen: lognormal factors on stiffness and friction coefficient."""
    stiffness, friction = random_generator(seed, RandomStream.RUN, order).standard_normal(2)
    return model.model_copy(
        update={
            "stiffness_scale": lognormal_variation(model.stiffness_scale, variation.run_stiffness, float(stiffness)),
            "friction_coefficient": lognormal_variation(
                model.friction_coefficient, variation.run_friction, float(friction)
            ),
        }
    )
