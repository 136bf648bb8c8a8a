"""Samples with their setpoint, and the checks made on them: rest offset, clipping, slip, following error, lost samples.

Checks are accumulated block by block, so that they need no memory of the run and are ready the moment it ends.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt
from statistics import median

import numpy as np

from dragrig.rig.arrays import AnyFloatArray, FloatArray, PhaseArray, read_only
from dragrig.rig.devices import Block
from dragrig.rig.profile import MotionProfile, Phase
from dragrig.rig.runfile.model import Attribute

_CHUNK_SAMPLES = 16_384


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """A block with its time, command and phase; every array read-only, shape `(n,)`.

    `channels` holds what the block does, with the tare taken off the force.
    """

    first_index: int
    time: FloatArray
    command: AnyFloatArray
    phase: PhaseArray
    channels: Mapping[str, AnyFloatArray]

    @property
    def end_index(self) -> int:
        """Index after the last sample."""
        return self.first_index + len(self.time)

    def arrays(self) -> Mapping[str, AnyFloatArray | PhaseArray]:
        """Return all datasets of the run file's trace."""
        return {"time": self.time, "command": self.command, "phase": self.phase, **self.channels}


@dataclass(frozen=True, slots=True)
class BlockExtremes:
    """What guard and checks both need of a block, worked out once."""

    lowest_mm: float
    highest_mm: float
    least_mN: float
    greatest_mN: float
    following_mm: float

    @classmethod
    def at(cls, block: Block, command: AnyFloatArray) -> "BlockExtremes":
        """Take the extremes of position and raw force, and the largest distance from the command."""
        force, position = block.channels["force"], block.channels["position"]
        return cls(
            lowest_mm=float(np.minimum.reduce(position)),
            highest_mm=float(np.maximum.reduce(position)),
            least_mN=float(np.minimum.reduce(force)),
            greatest_mN=float(np.maximum.reduce(force)),
            following_mm=float(np.maximum.reduce(np.abs(position - command))),
        )


class SetpointSampler:
    """Time, command and phase of a profile's samples, worked out in long stretches and handed out in slices."""

    def __init__(self, profile: MotionProfile, rate_hz: float, tare_mN: float = 0.0) -> None:
        self._profile = profile
        self._rate_hz = rate_hz
        self._tare_mN = np.float32(tare_mN)
        self._from = 0
        self._time: FloatArray = np.zeros(0)
        self._command: AnyFloatArray = np.zeros(0, np.float32)
        self._phase: PhaseArray = np.zeros(0, np.uint8)

    def replace(self, profile: MotionProfile) -> None:
        """Go on with another profile, as after a stop."""
        self._profile = profile
        self._time = self._time[:0]

    def join(self, block: Block) -> Reading:
        """Put a block beside its command."""
        if not self._from <= block.first_index <= block.end_index <= self._from + len(self._time):
            self._work_out(block.first_index, block.samples)
        start = block.first_index - self._from
        stop = start + block.samples
        channels = dict(block.channels)
        if self._tare_mN:
            channels["force"] = block.channels["force"] - self._tare_mN
            read_only(channels["force"])
        return Reading(
            first_index=block.first_index,
            time=self._time[start:stop],
            command=self._command[start:stop],
            phase=self._phase[start:stop],
            channels=channels,
        )

    def _work_out(self, first: int, samples: int) -> None:
        self._from = first
        self._time = np.arange(first, first + max(_CHUNK_SAMPLES, samples)) / self._rate_hz
        self._command = self._profile.position(self._time).astype(np.float32)
        self._phase = self._profile.phase_at(self._time)
        for array in (self._time, self._command, self._phase):
            read_only(array)


_REST, _HOLD = int(Phase.REST), int(Phase.HOLD)
_SLIP_DELAY_S = 0.3
"""Slip is looked for from so long after the ramp: by then the fast branch has relaxed."""
_SLIP_BIN_S = 0.1
_SLIP_STANDARD_ERRORS = 8.0
"""A drop counts as slip when it exceeds the one before by so many standard errors of a bin …"""
_MIN_SLIP_FRACTION = 0.02
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
        self._rest = _RestStatistics()
        self._clipped = 0
        self._lost = 0
        self._following_mm = 0.0
        self._next = 0
        self._slip = _SlipDetector(rate_hz, accuracy_mN) if sticking else None

    def add(self, reading: Reading, look: BlockExtremes, raw_force: AnyFloatArray, *, commanded: bool = True) -> None:
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


class _RestStatistics:
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


class _SlipDetector:
    """Looks for a drop of the held force that is larger than the drop before it.

    A relaxing wall loses force ever more slowly, whatever its time constants; a capsule that slips does not.
    """

    def __init__(self, rate_hz: float, accuracy_mN: float) -> None:
        self.time_s = -1.0
        self._accuracy_mN = accuracy_mN
        self._rate_hz = rate_hz
        self._per_bin = max(round(_SLIP_BIN_S * rate_hz), 2)
        self._begun: float | None = None
        self._left: list[AnyFloatArray] = []
        self._gathered = 0
        self._bins: list[tuple[float, float]] = []

    def add(self, reading: Reading) -> None:
        hold = reading.phase == _HOLD
        if self._begun is None:
            self._begun = float(reading.time[hold.argmax()])
        settled = hold & (reading.time >= self._begun + _SLIP_DELAY_S)
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
        if now - before > max(_SLIP_STANDARD_ERRORS * noise, self._accuracy_mN) + _MIN_SLIP_FRACTION * abs(means[0]):
            self.time_s = time_s - 2 * self._per_bin / self._rate_hz
