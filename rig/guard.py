"""The guard: an interlock that stops the stage once and stays tripped until it is reset.

It starts tripped, so that nothing moves before a person has looked at the rig, and it trips once: nothing that follows
a trip replaces its reason. It watches force, position, speed, following error, an encoder that shows no counts while
the setpoint moves (a cable off, a broken wire, a stuck stage), and one that jumps as no stage can. A stage that set out
too late, or never, is told from a silent encoder once it stands, by the readings of drive and encoder until then.
"""

from dataclasses import dataclass
from math import inf, isfinite, isnan, nan

import numpy as np

from dragrig.config import GuardSettings, TrippedError
from dragrig.rig.devices import Block, StageState, TravelEnd, Trip, TripCause
from dragrig.rig.profile import AnyFloatArray, FloatArray, MotionExtremes
from dragrig.rig.reading import BlockExtremes

_SPEED_WINDOW_S = 0.01
_MAX_DITHER_COUNTS = 1.5
_MAX_JUMP_COUNTS = 3
_MAX_ACCELERATION_MM_S2 = 5000.0
"""More than any motion's."""
_CAUSES_OF_STANDING = {TripCause.ENCODER_SILENT, TripCause.FOLLOWING_ERROR, TripCause.NO_MOTION}
"""What a stage looks like that something else has stopped."""
LIMIT_SWITCH_CAUSES = {
    TravelEnd.LOW: TripCause.LIMIT_SWITCH_LOW,
    TravelEnd.HIGH: TripCause.LIMIT_SWITCH_HIGH,
}


@dataclass(frozen=True, slots=True)
class EncoderSilence:
    """How far and for how long the command moved while the encoder showed not a single count."""

    travel_mm: float
    duration_s: float
    from_rest: bool = False
    """Whether it has shown none since the command stood still."""


NO_SILENCE = EncoderSilence(0.0, 0.0)


@dataclass(slots=True)
class EncoderSilenceMonitor:
    """Follows the blocks of one motion.

    Parameters
    ----------
    dither_mm
        Movement that an encoder may show without counting: with one wire broken, its count alternates by one.
    """

    dither_mm: float
    _counting: tuple[Block, AnyFloatArray] | None = None
    _min_position_mm: float = inf
    _max_position_mm: float = -inf
    _command_mm: float = nan
    _moved_index: int | None = None
    _travel_mm: float = 0.0
    _has_counted: bool = False

    def add(self, block: Block, command: AnyFloatArray, extremes: BlockExtremes, rate_hz: float) -> EncoderSilence:
        """Take the next block and its command [mm], shape `(n,)`; return the silence at its end.

        A silence within a block that also has counts is returned with the next block.
        """
        if extremes.max_position_mm - extremes.min_position_mm > self.dither_mm:
            self._counting, self._has_counted = (block, command), True
            return NO_SILENCE
        if self._counting is not None:
            self._begin_after_last_count(*self._counting, rate_hz)
            self._counting = None
        low_mm = min(self._min_position_mm, extremes.min_position_mm)
        high_mm = max(self._max_position_mm, extremes.max_position_mm)
        if high_mm - low_mm > self.dither_mm or isnan(self._command_mm):
            self._has_counted |= not isnan(self._command_mm)
            self._begin(extremes.min_position_mm, extremes.max_position_mm, float(command[0]))
        else:
            self._min_position_mm, self._max_position_mm = low_mm, high_mm
        return self._continue(block.first_index, command, rate_hz)

    def _begin_after_last_count(self, block: Block, command: AnyFloatArray, rate_hz: float) -> None:
        position = block.channels["position"]
        counted = np.flatnonzero(np.abs(position - position[-1]) > self.dither_mm)
        first = int(counted[-1]) + 1 if counted.size else 0
        silent = position[first:]
        self._begin(float(silent.min()), float(silent.max()), float(command[first]))
        self._continue(block.first_index + first, command[first:], rate_hz)

    def _begin(self, min_position_mm: float, max_position_mm: float, command_mm: float) -> None:
        self._min_position_mm, self._max_position_mm = min_position_mm, max_position_mm
        self._command_mm, self._moved_index, self._travel_mm = command_mm, None, 0.0

    def _continue(self, first_index: int, command: AnyFloatArray, rate_hz: float) -> EncoderSilence:
        if command[0] == command[-1]:
            # The command stands still, as for most of a session; what it moved before counts when it goes on.
            self._has_counted, self._moved_index = False, None
            return NO_SILENCE
        travel = np.abs(command - self._command_mm)
        self._travel_mm = max(self._travel_mm, float(travel.max()))
        if self._travel_mm == 0:
            return NO_SILENCE
        if self._moved_index is None:
            self._moved_index = first_index + int((travel > 0).argmax())
        duration_s = (first_index + len(command) - self._moved_index) / rate_hz
        return EncoderSilence(self._travel_mm, duration_s, from_rest=not self._has_counted)


@dataclass(frozen=True, slots=True)
class Envelope:
    """Range of one motion within which the guard does not trip; positions relative to the run's start."""

    lowest_mm: float
    highest_mm: float
    speed_mm_s: float

    @classmethod
    def around(cls, extremes: MotionExtremes, settings: GuardSettings) -> "Envelope":
        """Return the motion's own extremes plus the rig's margins."""
        return cls(
            lowest_mm=extremes.lowest_mm - settings.position_margin_mm,
            highest_mm=extremes.highest_mm + settings.position_margin_mm,
            speed_mm_s=extremes.speed_mm_s * settings.speed_factor + settings.speed_margin_mm_s,
        )


class Guard:
    """Checks every block; owned by the engine's thread.

    Parameters
    ----------
    count_mm
        Length of one count of the encoder.
    """

    def __init__(self, settings: GuardSettings, count_mm: float = 0.0) -> None:
        self._settings = settings
        self._dither_mm = _MAX_DITHER_COUNTS * count_mm
        self._max_jump_mm = max(settings.encoder_error_mm, _MAX_JUMP_COUNTS * count_mm)
        self._latest: tuple[int, FloatArray] = (0, np.zeros(0))
        self._trip: Trip | None = Trip(TripCause.START_UP, "the guard is tripped at start-up until it is reset")
        self._envelope = Envelope(0.0, 0.0, 0.0)
        self._speed_start: tuple[int, float] | None = None
        self._previous_command: AnyFloatArray | None = None
        self._silence = EncoderSilenceMonitor(self._dither_mm)
        self._unmoved = ""
        """For how long and how far an encoder was silent that had not counted before, as the trip says it."""
        self._overridden: TripCause | None = None
        self._override_next_motion = False

    @property
    def trip(self) -> Trip | None:
        """The trip that it is latched on; None when it is armed."""
        return self._trip

    def require_armed(self) -> None:
        """Raise `TrippedError` while the guard is tripped."""
        if self._trip is not None:
            raise TrippedError(f"the guard is tripped: {self._trip.message}; clear the cause and reset it.")

    def reset(self, state: StageState) -> Trip | None:
        """Release the latch if every condition is clear; return the trip that it is still latched on."""
        self._trip = state.fault
        self._overridden, self._override_next_motion = None, False
        return self._trip

    def override(self, side: TravelEnd, state: StageState) -> Trip | None:
        """Release the latch for one motion although the limit switch of this side is pressed.

        Every other condition must be clear now and stays watched; return the trip that it is still latched on.
        """
        switch = LIMIT_SWITCH_CAUSES[side]
        self._trip = state.fault if state.fault is not None and state.fault.cause is not switch else None
        self._overridden, self._override_next_motion = (switch, True) if self._trip is None else (None, False)
        return self._trip

    def permits(self, fault: Trip) -> bool:
        """Whether a fault is the limit switch that is overridden for the current motion."""
        return fault.cause is self._overridden

    def watch(self, extremes: MotionExtremes) -> None:
        """Set the envelope for the motion about to begin; an override for the motion before ends."""
        self._envelope = Envelope.around(extremes, self._settings)
        self._speed_start, self._previous_command, self._latest = None, None, (0, np.zeros(0))
        self._silence = EncoderSilenceMonitor(self._dither_mm)
        if not self._override_next_motion:
            self._overridden = None
        self._override_next_motion = False

    def inspect(
        self,
        block: Block,
        command: AnyFloatArray,
        extremes: BlockExtremes,
        rate_hz: float,
    ) -> Trip | None:
        """Check a block; return the trip that it causes, None when it is fine or the guard is latched already."""
        if self._trip is not None:
            return None
        largest_mN, limit_mN = max(extremes.max_force_mN, -extremes.min_force_mN), self._settings.force_limit_mN
        if not isfinite(largest_mN + extremes.max_position_mm):
            self._trip = Trip(TripCause.NOT_A_NUMBER, "a sample of force or position is not a number")
        elif largest_mN > limit_mN:
            force = f"force of {largest_mN:.0f} mN is over the limit of {limit_mN:.0f} mN"
            self._trip = Trip(TripCause.FORCE, force)
        else:
            self._trip = (
                self._check_position(extremes.min_position_mm, extremes.max_position_mm)
                or self._check_jump(block, rate_hz)
                or self._check_speed(block, rate_hz)
                or self._check_silence(block, command, extremes, rate_hz)
                or self._check_following(extremes.following_error_mm, command, rate_hz)
            )
        self._previous_command = command
        return self._trip

    @property
    def silent_from_rest(self) -> bool:
        """Whether it is latched on an encoder that has shown no count since the motion began."""
        return self._trip is not None and self._trip.cause is TripCause.ENCODER_SILENT and bool(self._unmoved)

    def explain_silence(self, counted_mm: float, drive_travel_mm: float) -> Trip | None:
        """Tell a stage that set out too late, or not at all, from a silent encoder, once it stands again.

        Parameters
        ----------
        counted_mm
            Range of the positions that the encoder showed since the silence, while the stage was stopped.
        drive_travel_mm
            How far the drive has moved by its own account; NaN where it has none.

        Returns
        -------
            The trip that takes the place of the silent encoder's; None where that stays.
        """
        if not self.silent_from_rest:
            return None
        if counted_mm <= self._dither_mm and not drive_travel_mm <= self._settings.encoder_error_mm:
            return None
        self._trip = Trip(
            TripCause.NO_MOTION,
            f"neither drive nor encoder moved {self._unmoved}; the drive begins too late, or the stage is blocked",
        )
        return self._trip

    @property
    def may_be_stopped(self) -> bool:
        """Whether it is latched on a picture in the samples like that of an emergency stop."""
        return self._trip is not None and self._trip.cause in _CAUSES_OF_STANDING

    def explain_standing(self, fault: Trip | None) -> Trip | None:
        """Take an emergency stop in place of its effects, which the samples may show first.

        Returns the trip that takes the place of the one that it is latched on; None where that stays.
        """
        if not self.may_be_stopped or fault is None or fault.cause is not TripCause.EMERGENCY_STOP:
            return None
        self._trip = fault
        return fault

    def latch(self, trip: Trip) -> Trip | None:
        """Trip on a condition that no sample shows; return the trip, None when it was latched already."""
        if self._trip is not None:
            return None
        self._trip = trip
        return trip

    def _check_position(self, lowest_mm: float, highest_mm: float) -> Trip | None:
        allowed = self._envelope
        if allowed.lowest_mm <= lowest_mm and highest_mm <= allowed.highest_mm:
            return None
        position_mm = lowest_mm if lowest_mm < allowed.lowest_mm else highest_mm
        return Trip(
            TripCause.POSITION,
            f"position {position_mm:.3f} mm from the run's start is outside {allowed.lowest_mm:.3f} to "
            f"{allowed.highest_mm:.3f} mm",
        )

    def _check_jump(self, block: Block, rate_hz: float) -> Trip | None:
        """Find a sample at which the position leaves its course and goes on beside it, at any speed.

        The speed changes there and changes back; that of an encoder that falls silent, or of a stage that is held up,
        changes once.
        """
        expected, latest = self._latest
        position = np.asarray(block.channels["position"], np.float64)
        course = np.concatenate((latest, position)) if expected == block.first_index else position
        self._latest = (block.end_index, course[-3:])
        if len(course) < 4:
            return None
        changes = np.diff(course, 2)
        there, back = changes[:-1], -changes[1:]
        jump_mm = float(np.minimum(np.abs(there), np.abs(back))[there * back > 0].max(initial=0.0))
        if jump_mm <= self._max_jump_mm + _MAX_ACCELERATION_MM_S2 / rate_hz**2:
            return None
        return Trip(
            TripCause.ENCODER_JUMP,
            f"the position jumped by {jump_mm:.3f} mm from a sample to the next: counts are lost or come twice; check "
            "the encoder's gap to its scale, its line receiver and the shield",
        )

    def _check_speed(self, block: Block, rate_hz: float) -> Trip | None:
        position = block.channels["position"]
        start, start_mm = self._speed_start or (block.first_index, float(position[0]))
        self._speed_start = (start, start_mm)
        end = block.end_index - 1
        # Over a shorter time, a count or two of the encoder would look like a speed.
        if end - start < _SPEED_WINDOW_S * rate_hz:
            return None
        self._speed_start = (end, float(position[-1]))
        speed = abs(float(position[-1]) - start_mm) * rate_hz / (end - start)
        limit = self._envelope.speed_mm_s
        if speed <= limit:
            return None
        return Trip(TripCause.SPEED, f"speed of {speed:.1f} mm/s is over the limit of {limit:.1f} mm/s")

    def _check_silence(
        self,
        block: Block,
        command: AnyFloatArray,
        extremes: BlockExtremes,
        rate_hz: float,
    ) -> Trip | None:
        silence, settings = self._silence.add(block, command, extremes, rate_hz), self._settings
        if silence.travel_mm <= settings.encoder_silent_mm or silence.duration_s <= settings.encoder_silent_s:
            return None
        lag_mm = settings.following_error_per_speed_s * self._commanded_speed(command, rate_hz)
        if silence.travel_mm <= settings.encoder_silent_mm + lag_mm:
            return None
        moved = f"for {1000 * silence.duration_s:.0f} ms, while the command moved by {silence.travel_mm:.2f} mm"
        self._unmoved = moved if silence.from_rest else ""
        return Trip(
            TripCause.ENCODER_SILENT,
            f"the encoder showed no count {moved}; check its cable, and whether the stage is blocked",
        )

    def _check_following(self, error_mm: float, command: AnyFloatArray, rate_hz: float) -> Trip | None:
        if error_mm <= self._settings.following_error_mm:
            return None
        speed = self._commanded_speed(command, rate_hz)
        limit_mm = self._settings.following_error_mm + self._settings.following_error_per_speed_s * speed
        if error_mm <= limit_mm:
            return None
        return Trip(
            TripCause.FOLLOWING_ERROR, f"following error of {error_mm:.3f} mm is over the limit of {limit_mm:.3f} mm"
        )

    def _commanded_speed(self, command: AnyFloatArray, rate_hz: float) -> float:
        # A lagging stage is where the command was before, so the speed of the block before counts too.
        previous = self._previous_command
        joined = command if previous is None else np.concatenate((previous, command))
        return float(np.abs(np.diff(joined)).max()) * rate_hz if len(joined) > 1 else 0.0
