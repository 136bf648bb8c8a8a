"""What is looked at right after a run: rest offset, clipping, slip, following error, lost samples.

Everything is gathered block by block, so that it costs no memory and is there the moment the run ends.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt
from statistics import median

import numpy as np

from dragrig.rig.arrays import AnyFloatArray
from dragrig.rig.profile import Phase
from dragrig.rig.reading import Look, Reading
from dragrig.rig.runfile.model import Attribute

_REST, _HOLD = int(Phase.REST), int(Phase.HOLD)
_SETTLED_S = 0.3
"""Slip is looked for from so long after the ramp: by then the fast branch has relaxed."""
_BIN_S = 0.1
_NOISE_BINS = 8.0
"""A drop counts as slip when it exceeds the one before by so many standard errors of a bin …"""
_SMALLEST_SLIP = 0.02
"""… and the accuracy of the sensor, plus this part of the force."""


@dataclass(frozen=True, slots=True)
class CheckReport:
    """What was seen, as attributes for the file, and what a person should be told."""

    values: Mapping[str, Attribute]
    warnings: tuple[str, ...]


class RunChecks:
    """Gathers what a run's checks need; owned by the engine's thread."""

    def __init__(
        self, rate_hz: float, force_range_mN: tuple[float, float], accuracy_mN: float, *, sticking: bool
    ) -> None:
        self._rate_hz = rate_hz
        self._range = force_range_mN
        self._accuracy_mN = accuracy_mN
        self._rest = _Moments()
        self._clipped = 0
        self._lost = 0
        self._following_mm = 0.0
        self._next = 0
        self._slip = _SlipWatch(rate_hz, accuracy_mN) if sticking else None

    def add(self, reading: Reading, look: Look, raw_force: AnyFloatArray, *, commanded: bool = True) -> None:
        """Look at a reading.

        Parameters
        ----------
        raw_force
            The force before the tare.
        commanded
            Whether the stage follows its command; a stage that brakes does not.
        """
        self._lost += max(reading.first_index - self._next, 0)
        self._next = reading.end_index
        lowest, highest = self._range
        if look.greatest_mN >= highest or look.least_mN <= lowest:
            self._clipped += int(np.count_nonzero((raw_force >= highest) | (raw_force <= lowest)))
        if reading.phase[0] == _REST:
            self._rest.add(reading.channels["force"][reading.phase == _REST])
        if commanded:
            self._following_mm = max(self._following_mm, look.following_mm)
        if self._slip is not None and reading.phase[-1] == _HOLD:
            self._slip.add(reading)

    def report(self) -> CheckReport:
        """Return what was seen so far."""
        values: dict[str, Attribute] = {
            "lost_samples": self._lost,
            "clipped_samples": self._clipped,
            "following_error_mm": round(self._following_mm, 6),
        }
        if self._rest.count:
            values["rest_offset_mN"] = self._rest.mean
            values["rest_noise_mN"] = self._rest.noise
        warnings = []
        if self._lost:
            warnings.append(f"{self._lost} samples were lost")
        if self._clipped:
            warnings.append(f"{self._clipped} samples are at the end of the sensor's range")
        if self._rest.noise > self._accuracy_mN:
            warnings.append(
                f"noise at rest is {self._rest.noise:.1f} mN, where the sensor is good to {self._accuracy_mN:g}"
            )
        if self._slip is not None:
            values["slip_time_s"] = self._slip.time_s
            if self._slip.time_s >= 0:
                warnings.append(f"the capsule seems to have slipped at {self._slip.time_s:.1f} s")
        return CheckReport(values, tuple(warnings))


class _Moments:
    """Running mean, and noise from sample to sample, which a force that still relaxes does not hide."""

    def __init__(self) -> None:
        self.count = 0
        self._sum = 0.0
        self._steps = 0
        self._squares = 0.0

    def add(self, values: AnyFloatArray) -> None:
        self.count += len(values)
        self._sum += float(values.sum(dtype=np.float64))
        steps = np.diff(values.astype(np.float64))
        self._steps += len(steps)
        self._squares += float(steps @ steps)

    @property
    def mean(self) -> float:
        return self._sum / self.count

    @property
    def noise(self) -> float:
        return sqrt(self._squares / self._steps / 2) if self._steps else 0.0


class _SlipWatch:
    """Looks for a drop of the held force that is larger than the drop before it.

    A relaxing wall loses force ever more slowly, whatever its time constants; a capsule that slips does not.
    """

    def __init__(self, rate_hz: float, accuracy_mN: float) -> None:
        self.time_s = -1.0
        self._accuracy_mN = accuracy_mN
        self._rate_hz = rate_hz
        self._per_bin = max(round(_BIN_S * rate_hz), 2)
        self._begun: float | None = None
        self._left: list[AnyFloatArray] = []
        self._gathered = 0
        self._bins: list[tuple[float, float]] = []

    def add(self, reading: Reading) -> None:
        hold = reading.phase == _HOLD
        if self._begun is None:
            self._begun = float(reading.time[hold.argmax()])
        settled = hold & (reading.time >= self._begun + _SETTLED_S)
        if not settled.any():
            return
        self._left.append(reading.channels["force"][settled])
        self._gathered += int(settled.sum())
        if self._gathered >= self._per_bin:
            self._judge(float(reading.time[-1]))

    def _judge(self, time_s: float) -> None:
        gathered = np.concatenate(self._left)
        self._left, self._gathered = [], 0
        self._bins = [*self._bins[-4:], (float(gathered.mean()), float(gathered.std(ddof=1)) / sqrt(len(gathered)))]
        if len(self._bins) < 5 or self.time_s >= 0:
            return
        means = [mean for mean, _ in self._bins]
        # The median, because the bin that holds the slip looks noisy by itself.
        noise = median(error for _, error in self._bins)
        # Over two bins each, because a slip may fall into the middle of one.
        before, now = means[0] - means[2], means[2] - means[4]
        if now - before > max(_NOISE_BINS * noise, self._accuracy_mN) + _SMALLEST_SLIP * abs(means[0]):
            self.time_s = time_s - 2 * self._per_bin / self._rate_hz
