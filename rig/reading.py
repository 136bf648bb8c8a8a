"""Samples with their setpoint, and the checks made on them: rest offset, clipping, slip, response, losses.

Checks are accumulated block by block, so that they need no memory of the run and are ready the moment it ends.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isnan, nan, sqrt
from statistics import median

import numpy as np

from dragrig.rig.devices import Block, Contact
from dragrig.rig.profile import AnyFloatArray, FloatArray, MotionProfile, Phase, PhaseArray, read_only
from dragrig.rig.runfile import Attribute

_CHUNK_SAMPLES = 16_384
_STANDSTILL_S = 0.02
_DITHER_SHARE, _DITHER_COUNTS = 0.5, 3
"""How much an encoder may show on a stage that stands: of the bound for its error, and at least so many counts."""
_START_COUNTS = 2.5
"""A motion has begun after so many counts: halfway from a count to the next, so that rounding makes it no later."""
_LEAST_RESPONSE = 0.1
"""Share of the sensor's accuracy by which the force changes at least where a capsule touches the gut …"""
_RESPONSE_STANDARD_ERRORS = 5.0
"""… and standard errors of a block's mean."""
_INVERTED_SHARE = 0.25
"""Share of the force's largest change that must push along the motion, on average, in an inverted force."""
_MOVED_SHARE = 0.5
"""Share of its command's step that a stage moves at least where the force has to resist."""
_NOISE_WINDOW_S = 0.1
"""Noise is judged over this time, whole periods of the mains' hum, beside a parabola …"""
_NOISE_DELAY_S = 0.14
"""… and this long after a stop, when the stage no longer rings, nor the wall's fast branch bends the force."""
_NOISE_GROWTH, _LEAST_NOISE_SHARE = 2.0, 0.5
"""Noise may be so many times that before the motion, and this share of the sensor's accuracy in any case."""
_FOLLOWING_FORCE, _LEAST_STEP = 5.0, 0.2
"""A force of so many of the sensor's accuracies has to change by this share of one when the stage stops."""
_NO_RESPONSE, _INVERTED, _NOT_FOLLOWING = "none", "along the motion", "none to a stop"
_RESPONSE_WARNINGS = {
    _NO_RESPONSE: "the force did not change when the stage moved: is the sensor alive, and does the capsule touch?",
    _INVERTED: "the force acts along the motion, not against it: check the calibration's sign, or the sensor's wires",
    _NOT_FOLLOWING: "the force did not change when the stage stopped: was the sensor's cable pulled during the run?",
}
_PARABOLA_TERMS = 3
_REST, _BRAKING, _HOLD = int(Phase.REST), int(Phase.DECELERATE), int(Phase.HOLD)
_SLIP_DELAY_S = 0.3
"""Slip is looked for from this time after the ramp on: by then the fast branch has relaxed."""
_SLIP_BIN_S = 0.1
_SLIP_STANDARD_ERRORS = 8.0
"""A drop counts as slip when it exceeds the one before by so many standard errors of a bin …"""
_MIN_SLIP_FRACTION = 0.02
"""… and the accuracy of the sensor, plus this fraction of the force."""


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """A block with its time, command and phase; every array read-only, shape `(n,)`.

    `channels` holds the block's channels, with the tare subtracted from the force.
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
    """Extremes of a block that both guard and checks need: position, raw force, largest following error."""

    min_position_mm: float
    max_position_mm: float
    min_force_mN: float
    max_force_mN: float
    following_error_mm: float

    @classmethod
    def of(cls, block: Block, command: AnyFloatArray) -> "BlockExtremes":
        """Return the extremes of a block and its command, of shape `(n,)`."""
        force, position = block.channels["force"], block.channels["position"]
        return cls(
            min_position_mm=float(np.minimum.reduce(position)),
            max_position_mm=float(np.maximum.reduce(position)),
            min_force_mN=float(np.minimum.reduce(force)),
            max_force_mN=float(np.maximum.reduce(force)),
            following_error_mm=float(np.maximum.reduce(np.abs(position - command))),
        )


class SetpointSampler:
    """Time, command and phase of a profile's samples, computed in long chunks and returned in slices."""

    def __init__(self, profile: MotionProfile, rate_hz: float, tare_mN: float = 0.0) -> None:
        self._profile = profile
        self._rate_hz = rate_hz
        self._tare_mN = np.float32(tare_mN)
        self._first_index = 0
        self._time: FloatArray = np.zeros(0)
        self._command: AnyFloatArray = np.zeros(0, np.float32)
        self._phase: PhaseArray = np.zeros(0, np.uint8)

    def replace(self, profile: MotionProfile) -> None:
        """Continue with another profile, as after a stop."""
        self._profile = profile
        self._time = self._time[:0]

    def with_setpoint(self, block: Block) -> Reading:
        """Return a block with its command."""
        if not self._first_index <= block.first_index <= block.end_index <= self._first_index + len(self._time):
            self._first_index = block.first_index
            indices = np.arange(block.first_index, block.first_index + max(_CHUNK_SAMPLES, block.samples))
            self._time = indices / self._rate_hz
            self._command = self._profile.position(self._time).astype(np.float32)
            self._phase = self._profile.phase_at(self._time)
            for array in (self._time, self._command, self._phase):
                read_only(array)
        start = block.first_index - self._first_index
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


@dataclass(frozen=True, slots=True)
class CheckReport:
    """Results of the checks, as attributes for the file, and warnings for the operator."""

    values: Mapping[str, Attribute]
    warnings: tuple[str, ...]
    encoder_fault: str = ""
    """By how much drive and encoder differ, without a full stop; empty where they agree or were not compared."""


class RunChecks:
    """Accumulates a run's checks; owned by the engine's thread.

    Parameters
    ----------
    contact
        With one, the force has to resist the motion.
    count_mm
        Length of the encoder's count.
    """

    def __init__(
        self,
        rate_hz: float,
        force_range_mN: tuple[float, float],
        accuracy_mN: float,
        contact: Contact,
        count_mm: float = 0.0,
    ) -> None:
        self._force_range_mN = force_range_mN
        self._accuracy_mN = accuracy_mN
        self._response = _ForceResponse(accuracy_mN) if contact is not Contact.NONE else None
        self._start_delay = _StartDelay(rate_hz, _START_COUNTS * count_mm)
        self._standstill = _Standstill(rate_hz)
        self._count_mm = count_mm
        self._mismatch: tuple[float, float] | None = None
        self._rest = _RestStatistics()
        self._noise_before, self._noise_after = _Noise(rate_hz), _Noise(rate_hz)
        self._settled = _SettledHold()
        self._stops = None if contact is Contact.NONE else _StopResponse(rate_hz, accuracy_mN)
        self._clipped = 0
        self._lost = 0
        self._following_error_mm = 0.0
        self._next_index = 0
        self._slip = _SlipDetector(rate_hz, accuracy_mN) if contact is Contact.STICKING else None

    def add(
        self, reading: Reading, extremes: BlockExtremes, raw_force: AnyFloatArray, *, commanded: bool = True
    ) -> None:
        """Check a reading.

        Parameters
        ----------
        raw_force
            The force before the tare.
        commanded
            Whether the stage follows its command; a stage that brakes does not.
        """
        self._lost += max(reading.first_index - self._next_index, 0)
        self._next_index = reading.end_index
        low_mN, high_mN = self._force_range_mN
        if extremes.max_force_mN >= high_mN or extremes.min_force_mN <= low_mN:
            self._clipped += int(np.count_nonzero((raw_force >= high_mN) | (raw_force <= low_mN)))
        if reading.phase[0] == _REST:
            at_rest = reading.channels["force"][reading.phase == _REST]
            self._rest.add(at_rest)
            self._noise_before.add(at_rest)
        if commanded:
            delay_s = _NOISE_DELAY_S + self._start_delay.delay_s
            self._noise_after.add(self._settled.force_of(reading, delay_s))
            if self._stops is not None and self._rest.count:
                self._stops.add(reading, self._rest.mean, self._start_delay.delay_s)
            self._following_error_mm = max(self._following_error_mm, extremes.following_error_mm)
            self._start_delay.add(reading)
        self._standstill.add(reading)
        if self._slip is not None and reading.phase[-1] == _HOLD:
            self._slip.add(reading)
        if self._response is not None and commanded and self._rest.count and reading.phase[-1] != _REST:
            self._response.add(reading, self._rest)

    @property
    def start_delay_s(self) -> float:
        """How much later than the command the encoder began to move; 0 until it is known."""
        return self._start_delay.delay_s

    def compare_travel(self, drive_travel_mm: float, bound_mm: float) -> None:
        """Compare the drive's travel with the encoder's, where that stood still at the end of the samples.

        Parameters
        ----------
        drive_travel_mm
            From the standstill before to that after the motion, by the drive's own position.
        bound_mm
            Largest difference that is no fault.
        """
        # A drive that set out late may still be under way.
        late = 1.0 + self._start_delay.delay_s / _STANDSTILL_S
        dither_mm = max(_DITHER_SHARE * bound_mm / late, _DITHER_COUNTS * self._count_mm)
        travel_mm = self._standstill.travel_mm(dither_mm) if self._start_delay.known else None
        if travel_mm is not None:
            self._mismatch = (travel_mm - drive_travel_mm, bound_mm)

    def report(self, late_replies: int = 0) -> CheckReport:
        """Return the results so far, with how often the drive answered late."""
        values: dict[str, Attribute] = {
            "lost_samples": self._lost,
            "clipped_samples": self._clipped,
            "following_error_mm": round(self._following_error_mm, 6),
        }
        if self._rest.count:
            values["rest_offset_mN"] = self._rest.mean
            values["rest_noise_mN"] = self._rest.noise
        warnings = []
        if self._lost:
            warnings.append(f"{self._lost} samples were lost")
        if self._clipped:
            warnings.append(f"{self._clipped} samples are at the end of the sensor's range")
        warnings += self._report_noise(values)
        if late_replies:
            values["late_replies"] = late_replies
            warnings.append(
                f"{late_replies} repl{'y' if late_replies == 1 else 'ies'} of the drive came late "
                "(hardware.drive.reply_s): this computer is busy; end other programs before a stop comes late"
            )
        encoder_fault = self._report_travel(values)
        if encoder_fault:
            warnings.append(encoder_fault)
        warnings += self._report_response(values)
        if self._slip is not None:
            values["slip_time_s"] = self._slip.time_s
            if self._slip.time_s >= 0:
                warnings.append(f"the capsule seems to have slipped at {self._slip.time_s:.1f} s")
        return CheckReport(values, tuple(warnings), encoder_fault)

    def _report_response(self, values: dict[str, Attribute]) -> list[str]:
        """Add the course of the force while the stage moved and stopped; return the warning that is due for it."""
        response = "" if self._response is None else self._response.verdict(self._rest)
        if response and response != _NO_RESPONSE and self._stops is not None and self._stops.unfollowed:
            response = _NOT_FOLLOWING
        values |= {"force_response": response} if response else {}
        return [text for verdict, text in _RESPONSE_WARNINGS.items() if verdict == response]

    def _report_noise(self, values: dict[str, Attribute]) -> list[str]:
        """Add the noise before and after the motion; return the warnings that are due for it, or for its growth."""
        before_mN, after_mN = self._noise_before.noise, self._noise_after.noise
        noise_mN, warnings = max(self._rest.noise, before_mN or 0.0), []
        if not noise_mN <= self._accuracy_mN:
            warnings.append(
                f"noise at rest is {noise_mN:.1f} mN, over the sensor's accuracy of {self._accuracy_mN:g} mN"
            )
        if before_mN is None or after_mN is None:
            return warnings
        least_mN = max(_LEAST_NOISE_SHARE * self._accuracy_mN, 1.5 * before_mN)
        allowed_mN = max(min(_NOISE_GROWTH * before_mN, self._accuracy_mN), least_mN)
        values |= {"noise_before_mN": before_mN, "noise_after_mN": after_mN, "noise_after_allowed_mN": allowed_mN}
        if not after_mN <= allowed_mN:
            warnings.append(
                f"noise or hum began within the run: {after_mN:.1f} mN at rest after the motion, {before_mN:.1f} mN "
                "before it; check the force sensor's cable and shield, and what was switched on"
            )
        return warnings

    def _report_travel(self, values: dict[str, Attribute]) -> str:
        """Add by how much encoder and drive differ; return the warning that is due for it, else nothing."""
        if self._mismatch is None:
            return ""
        off_mm, bound_mm = self._mismatch
        values |= {"encoder_mismatch_mm": round(off_mm, 6), "encoder_mismatch_allowed_mm": round(bound_mm, 6)}
        if abs(off_mm) <= bound_mm:
            return ""
        return (
            f"encoder and drive differ by {off_mm:+.3f} mm after the motion, and may by {bound_mm:.3f} mm: counts "
            "were lost or came twice, or the resolution is wrong"
        )


class _RestStatistics:
    """Running mean, and noise from sample to sample, which a relaxing force does not hide."""

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
        # Not with @: from 10,000 samples on, BLAS would spread the sum over threads that spin.
        self._squares += float(np.einsum("i,i", steps, steps))

    @property
    def mean(self) -> float:
        return self._sum / self.count

    @property
    def noise(self) -> float:
        return sqrt(self._squares / self._steps / 2) if self._steps else 0.0


class _Noise:
    """Noise within a tenth of a second, hum included, beside a parabola that takes relaxation and drift.

    The median over such windows, so that a single jerk is none.
    """

    def __init__(self, rate_hz: float) -> None:
        self._samples = max(round(_NOISE_WINDOW_S * rate_hz), _PARABOLA_TERMS + 2)
        self._basis = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, self._samples), _PARABOLA_TERMS))[0]
        self._pending: FloatArray = np.zeros(0)
        self._windows_mN: list[float] = []

    @property
    def noise(self) -> float | None:
        """Standard deviation [mN]; None before the first window."""
        return median(self._windows_mN) if self._windows_mN else None

    def add(self, values: AnyFloatArray) -> None:
        """Take the next values of one standstill after another, shape `(n,)`."""
        if not len(values):
            return
        joined = np.concatenate((self._pending, values.astype(np.float64)))
        whole = len(joined) // self._samples * self._samples
        self._pending = joined[whole:]
        for window in joined[:whole].reshape(-1, self._samples):
            self._windows_mN.append(self.of(window))

    def of(self, window: FloatArray) -> float:
        """Return the noise of one window."""
        beside = window - self._basis @ (window @ self._basis)
        return sqrt(float(np.einsum("i,i", beside, beside)) / (len(window) - _PARABOLA_TERMS))


class _SettledHold:
    """The force of the standstills after motions, from some time after each stop on."""

    def __init__(self) -> None:
        self._begins_s = nan

    def force_of(self, reading: Reading, delay_s: float) -> FloatArray:
        """Return the part of a reading's force that is so much later than a stop, shape `(n,)`; it may be none."""
        holding = reading.phase == _HOLD
        if not holding.any():
            self._begins_s = nan
            return np.zeros(0)
        if isnan(self._begins_s) or not holding[0]:
            self._begins_s = float(reading.time[holding.argmax()])
        settled = holding & (reading.time >= self._begins_s + delay_s)
        return np.asarray(reading.channels["force"][settled], np.float64)


class _StopResponse:
    """Whether the force changes at each stop, as friction does, beside its drift.

    Compared are the means over a tenth of a second: two before the stage brakes, the second going on from the
    first, and one after it stands.
    """

    def __init__(self, rate_hz: float, accuracy_mN: float) -> None:
        self._accuracy_mN, self._noise = accuracy_mN, _Noise(rate_hz)
        self._samples = max(round(_NOISE_WINDOW_S * rate_hz), _PARABOLA_TERMS + 2)
        self._before: FloatArray = np.zeros(0)
        self._after: FloatArray = np.zeros(0)
        self._rate_hz, self._braking, self._late, self._moved = rate_hz, 0, 0, False
        self.unfollowed = 0
        """Number of stops that the force did not follow."""

    def add(self, reading: Reading, rest_mN: float, late_s: float) -> None:
        """Take the next reading, the mean force at rest before the motion, and how much later the stage moves."""
        changes = np.flatnonzero(np.diff(reading.phase)) + 1
        forces = np.split(reading.channels["force"].astype(np.float64), changes)
        for phase, force in zip(reading.phase[[0, *changes]].tolist(), forces, strict=True):
            if phase == _HOLD and self._moved:
                # A stage that set out late comes to its stop as late.
                going_on = force[: max(round(late_s * self._rate_hz) - self._late, 0)]
                self._late += len(going_on)
                self._after = np.concatenate((self._after, force[len(going_on) :]))
                if len(self._after) >= self._samples:
                    self._judge(rest_mN)
            elif phase == _BRAKING:
                self._braking += len(force)
            else:
                self._braking = self._late = 0
                self._moved |= phase not in {_REST, _HOLD}
                self._before = np.concatenate((self._before, force))[-2 * self._samples :]
                self._after = self._after[:0]

    def _judge(self, rest_mN: float) -> None:
        size, before = self._samples, self._before
        after, self._after, self._moved = self._after[:size], self._after[:0], False
        if len(before) < 2 * size:
            return
        earlier_mN, later_mN = float(before[:size].mean()), float(before[size:].mean())
        ahead = 1.0 + (self._braking + self._late) / size
        step_mN = float(after.mean()) - later_mN - ahead * (later_mN - earlier_mN)
        error_mN = self._noise.of(after) * sqrt((1.0 + (1.0 + ahead) ** 2 + ahead**2) / size)
        bound_mN = max(_LEAST_STEP * self._accuracy_mN, _RESPONSE_STANDARD_ERRORS * error_mN)
        if abs(later_mN - rest_mN) >= _FOLLOWING_FORCE * self._accuracy_mN and abs(step_mN) < bound_mN:
            self.unfollowed += 1


class _StartDelay:
    """Measures how much later than the command the encoder begins to move, by whole samples."""

    def __init__(self, rate_hz: float, moved_mm: float) -> None:
        self.delay_s = 0.0
        self._rate_hz, self._moved_mm = rate_hz, moved_mm
        self._origin: tuple[float, float] | None = None
        self._commanded: int | None = None
        self._done = False

    @property
    def known(self) -> bool:
        """Whether command and encoder both moved, or neither was to."""
        return self._done or self._commanded is None

    def add(self, reading: Reading) -> None:
        if self._done:
            return
        command, position = reading.command, reading.channels["position"]
        if self._origin is None:
            self._origin = (float(command[0]), float(position[0]))
        if self._commanded is None:
            self._commanded = self._first_moved(reading, command, self._origin[0])
        if self._commanded is None:
            return
        followed = self._first_moved(reading, position, self._origin[1])
        self._done = followed is not None
        until = reading.end_index if followed is None else followed
        self.delay_s = max(until - self._commanded, 0) / self._rate_hz

    def _first_moved(self, reading: Reading, values: AnyFloatArray, origin: float) -> int | None:
        moved = np.abs(values - origin) > self._moved_mm
        return reading.first_index + int(moved.argmax()) if moved.any() else None


class _Standstill:
    """The encoder's travel from the first sample to a standstill at the last."""

    def __init__(self, rate_hz: float) -> None:
        self._samples = max(round(_STANDSTILL_S * rate_hz), 2)
        self._origin_mm: float | None = None
        self._latest: FloatArray = np.zeros(0)

    def add(self, reading: Reading) -> None:
        position = reading.channels["position"]
        if self._origin_mm is None:
            self._origin_mm = float(position[0])
        short = self._samples - len(position)
        kept = self._latest[-short:] if short > 0 else self._latest[:0]
        self._latest = np.concatenate((kept, position[-self._samples :].astype(np.float64)))

    def travel_mm(self, dither_mm: float) -> float | None:
        """Return the travel; None where the position still changed by more than `dither_mm` in the last samples."""
        if self._origin_mm is None or len(self._latest) < self._samples or float(np.ptp(self._latest)) > dither_mm:
            return None
        return float(self._latest.mean()) - self._origin_mm


class _ForceResponse:
    """Whether the force changes against its value at rest while the stage moves, and resists the motion.

    A force of friction does work against the motion, also where something else changes it: its sign follows from the
    work.
    """

    def __init__(self, accuracy_mN: float) -> None:
        self._accuracy_mN = accuracy_mN
        self._largest_mN = 0.0
        self._work, self._path_mm = 0.0, 0.0
        self._samples = 0
        self._blocks = 0

    def add(self, reading: Reading, rest: _RestStatistics) -> None:
        position = reading.channels["position"]
        step_mm, moved_mm = (float(along[-1]) - float(along[0]) for along in (reading.command, position))
        # While a stage that sets out late still stands, the force only relaxes.
        if step_mm == 0 or abs(moved_mm) < _MOVED_SHARE * abs(step_mm):
            return
        change_mN = float(reading.channels["force"].mean(dtype=np.float64)) - rest.mean
        self._largest_mN = max(self._largest_mN, abs(change_mN))
        self._work += change_mN * step_mm
        self._path_mm += abs(step_mm)
        self._samples += len(reading.time)
        self._blocks += 1

    def verdict(self, rest: _RestStatistics) -> str:
        """Return the course of the force; empty where the stage did not move."""
        if not self._path_mm:
            return ""
        scatter_mN = rest.noise * sqrt(self._blocks / self._samples + 1 / rest.count)
        if self._largest_mN < max(_LEAST_RESPONSE * self._accuracy_mN, _RESPONSE_STANDARD_ERRORS * scatter_mN):
            return _NO_RESPONSE
        resisting_mN = self._work / self._path_mm
        inverted = resisting_mN < -max(self._accuracy_mN, _INVERTED_SHARE * self._largest_mN)
        return _INVERTED if inverted else "resists the motion"


class _SlipDetector:
    """Detects a drop of the held force that is larger than the drop before it.

    A relaxing wall loses force ever more slowly, with any time constants; a capsule that slips does not.
    """

    def __init__(self, rate_hz: float, accuracy_mN: float) -> None:
        self.time_s = -1.0
        self._accuracy_mN = accuracy_mN
        self._rate_hz = rate_hz
        self._bin_samples = max(round(_SLIP_BIN_S * rate_hz), 2)
        self._hold_begins_s: float | None = None
        self._pending: list[AnyFloatArray] = []
        self._pending_samples = 0
        self._bins: list[tuple[float, float]] = []

    def add(self, reading: Reading) -> None:
        hold = reading.phase == _HOLD
        if self._hold_begins_s is None:
            self._hold_begins_s = float(reading.time[hold.argmax()])
        settled = hold & (reading.time >= self._hold_begins_s + _SLIP_DELAY_S)
        if not settled.any():
            return
        self._pending.append(reading.channels["force"][settled])
        self._pending_samples += int(settled.sum())
        if self._pending_samples >= self._bin_samples:
            self._close_bin(float(reading.time[-1]))

    def _close_bin(self, time_s: float) -> None:
        force = np.concatenate(self._pending)
        self._pending, self._pending_samples = [], 0
        self._bins = [*self._bins[-4:], (float(force.mean()), float(force.std(ddof=1)) / sqrt(len(force)))]
        if len(self._bins) < 5 or self.time_s >= 0:
            return
        means = [mean for mean, _ in self._bins]
        # The median, because the bin that holds the slip looks noisy by itself.
        noise = median(error for _, error in self._bins)
        # Drops over two bins, because a slip may fall into the middle of one.
        drop_before, drop = means[0] - means[2], means[2] - means[4]
        threshold = max(_SLIP_STANDARD_ERRORS * noise, self._accuracy_mN) + _MIN_SLIP_FRACTION * abs(means[0])
        if drop - drop_before > threshold:
            self.time_s = time_s - 2 * self._bin_samples / self._rate_hz
