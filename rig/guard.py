"""The guard: an interlock that stops the stage once and stays tripped until it is reset.

It starts tripped, so that nothing moves before a person has looked at the rig, and it trips once: whatever follows a
trip does not replace its reason. It watches force, position, speed, following error and an encoder that shows no
counts while the setpoint moves (a cable off, a broken wire, a stuck stage).
"""

from dataclasses import dataclass
from math import inf, isfinite, isnan, nan

import numpy as np

from dragrig.config.rig import GuardSettings
from dragrig.rig.arrays import AnyFloatArray
from dragrig.rig.devices import Block, StageState, TravelEnd, Trip, TripCause
from dragrig.rig.profile import MotionExtremes
from dragrig.rig.reading import BlockExtremes


@dataclass(frozen=True, slots=True)
class EncoderSilence:
    """How far and for how long the command went while the encoder showed not a single count."""

    travel_mm: float
    duration_s: float


NO_SILENCE = EncoderSilence(0.0, 0.0)


@dataclass(slots=True)
class EncoderSilenceMonitor:
    """Follows the blocks of one motion.

    Parameters
    ----------
    dither_mm
        What an encoder may show without having counted: with one wire broken, its count goes to and fro by one.
    """

    dither_mm: float
    _counting: tuple[Block, AnyFloatArray] | None = None
    _lowest_mm: float = inf
    _highest_mm: float = -inf
    _command_mm: float = nan
    _moved_index: int | None = None
    _travel_mm: float = 0.0

    def look(self, block: Block, command: AnyFloatArray, look: BlockExtremes, rate_hz: float) -> EncoderSilence:
        """Take the next block, shape `(n,)` as its command [mm], and return the silence at its end.

        A silence within a block in which something was counted is told with the block after it.
        """
        if look.highest_mm - look.lowest_mm > self.dither_mm:
            self._counting = (block, command)
            return NO_SILENCE
        if self._counting is not None:
            self._begin_after_last_count(*self._counting, rate_hz)
            self._counting = None
        lowest, highest = min(self._lowest_mm, look.lowest_mm), max(self._highest_mm, look.highest_mm)
        if highest - lowest > self.dither_mm or isnan(self._command_mm):
            self._begin(look.lowest_mm, look.highest_mm, float(command[0]))
        else:
            self._lowest_mm, self._highest_mm = lowest, highest
        return self._go_on(block.first_index, command, rate_hz)

    def _begin_after_last_count(self, block: Block, command: AnyFloatArray, rate_hz: float) -> None:
        position = block.channels["position"]
        counted = np.flatnonzero(np.abs(position - position[-1]) > self.dither_mm)
        first = int(counted[-1]) + 1 if counted.size else 0
        left = position[first:]
        self._begin(float(left.min()), float(left.max()), float(command[first]))
        self._go_on(block.first_index + first, command[first:], rate_hz)

    def _begin(self, lowest_mm: float, highest_mm: float, command_mm: float) -> None:
        self._lowest_mm, self._highest_mm, self._command_mm = lowest_mm, highest_mm, command_mm
        self._moved_index, self._travel_mm = None, 0.0

    def _go_on(self, first_index: int, command: AnyFloatArray, rate_hz: float) -> EncoderSilence:
        if self._travel_mm == 0 and command[0] == self._command_mm == command[-1]:
            # Told to stand, as for most of a session.
            return NO_SILENCE
        away = np.abs(command - self._command_mm)
        self._travel_mm = max(self._travel_mm, float(away.max()))
        if self._travel_mm == 0:
            return NO_SILENCE
        if self._moved_index is None:
            self._moved_index = first_index + int((away > 0).argmax())
        return EncoderSilence(self._travel_mm, (first_index + len(command) - self._moved_index) / rate_hz)


_SPEED_WINDOW_S = 0.01
_MAX_DITHER_COUNTS = 1.5
LIMIT_SWITCH_CAUSES = {TravelEnd.LOW: TripCause.LIMIT_SWITCH_LOW, TravelEnd.HIGH: TripCause.LIMIT_SWITCH_HIGH}
"""What a pressed limit switch of each side trips as."""


@dataclass(frozen=True, slots=True)
class Envelope:
    """What one motion may reach before the guard stops it; positions relative to the run's start."""

    lowest_mm: float
    highest_mm: float
    speed_mm_s: float

    @classmethod
    def around(cls, extremes: MotionExtremes, settings: GuardSettings) -> "Envelope":
        """Return the motion's own extremes plus the margins that the rig allows."""
        return cls(
            lowest_mm=extremes.lowest_mm - settings.position_margin_mm,
            highest_mm=extremes.highest_mm + settings.position_margin_mm,
            speed_mm_s=extremes.speed_mm_s * settings.speed_factor + settings.speed_margin_mm_s,
        )


class Guard:
    """Looks at every block; owned by the engine's thread.

    Parameters
    ----------
    count_mm
        Length of one count of the encoder.
    """

    def __init__(self, settings: GuardSettings, count_mm: float = 0.0) -> None:
        self._settings = settings
        self._dither_mm = _MAX_DITHER_COUNTS * count_mm
        self._trip: Trip | None = Trip(TripCause.START_UP, "the guard starts tripped and needs a reset")
        self._envelope = Envelope(0.0, 0.0, 0.0)
        self._last: tuple[int, float] | None = None
        self._before: AnyFloatArray | None = None
        self._silence = EncoderSilenceMonitor(self._dither_mm)
        self._freed: TripCause | None = None
        self._freed_next = False

    @property
    def trip(self) -> Trip | None:
        """What it is latched on; None when it is armed."""
        return self._trip

    def reset(self, state: StageState) -> Trip | None:
        """Release the latch if every condition is clear; return what it is still latched on."""
        self._trip = state.fault
        self._freed, self._freed_next = None, False
        return self._trip

    def override(self, side: TravelEnd, state: StageState) -> Trip | None:
        """Release the latch for one motion although the limit switch of this side is pressed.

        Everything else stays watched, and has to be clear now; return what it is still latched on.
        """
        freed = LIMIT_SWITCH_CAUSES[side]
        self._trip = state.fault if state.fault is not None and state.fault.cause is not freed else None
        self._freed, self._freed_next = (freed, True) if self._trip is None else (None, False)
        return self._trip

    def permits(self, fault: Trip) -> bool:
        """Whether a fault is the limit switch that an override freed for the motion under way."""
        return fault.cause is self._freed

    def watch(self, extremes: MotionExtremes) -> None:
        """Set the envelope for the motion about to begin; an override of the motion before is over."""
        self._envelope = Envelope.around(extremes, self._settings)
        self._last, self._before = None, None
        self._silence = EncoderSilenceMonitor(self._dither_mm)
        if not self._freed_next:
            self._freed = None
        self._freed_next = False

    def inspect(self, block: Block, command: AnyFloatArray, look: BlockExtremes, rate_hz: float) -> Trip | None:
        """Look at a block; return the trip that it causes, None when it is fine or the guard is latched already."""
        if self._trip is not None:
            return None
        self._trip = self._judge(block, command, look, rate_hz)
        return self._trip

    def latch(self, trip: Trip) -> Trip | None:
        """Trip on something that no sample shows; return the trip, None when it was latched already."""
        if self._trip is not None:
            return None
        self._trip = trip
        return trip

    def _judge(self, block: Block, command: AnyFloatArray, look: BlockExtremes, rate_hz: float) -> Trip | None:
        strongest = max(look.greatest_mN, -look.least_mN)
        if not isfinite(strongest + look.highest_mm):
            return Trip(TripCause.NOT_A_NUMBER, "a sample of force or position is not a number")
        trip = (
            self._judge_force(strongest)
            or self._judge_position(look.lowest_mm, look.highest_mm)
            or self._judge_speed(block, rate_hz)
            or self._judge_silence(block, command, look, rate_hz)
            or self._judge_following(look.following_mm, command, rate_hz)
        )
        self._before = command
        return trip

    def _judge_force(self, strongest: float) -> Trip | None:
        limit = self._settings.force_limit_mN
        if strongest <= limit:
            return None
        return Trip(TripCause.FORCE, f"force of {strongest:.0f} mN is over the limit of {limit:.0f} mN")

    def _judge_position(self, lowest: float, highest: float) -> Trip | None:
        allowed = self._envelope
        if allowed.lowest_mm <= lowest and highest <= allowed.highest_mm:
            return None
        seen = lowest if lowest < allowed.lowest_mm else highest
        return Trip(
            TripCause.POSITION,
            f"position {seen:.3f} mm from the run's start is outside {allowed.lowest_mm:.3f} to "
            f"{allowed.highest_mm:.3f} mm",
        )

    def _judge_speed(self, block: Block, rate_hz: float) -> Trip | None:
        position = block.channels["position"]
        index, before = self._last if self._last is not None else (block.first_index, float(position[0]))
        end = block.end_index - 1
        self._last = self._last or (index, before)
        # Over a shorter time, a count or two of the encoder would pass for a speed.
        if end - index < _SPEED_WINDOW_S * rate_hz:
            return None
        self._last = (end, float(position[-1]))
        speed = abs(float(position[-1]) - before) * rate_hz / (end - index)
        limit = self._envelope.speed_mm_s
        if speed <= limit:
            return None
        return Trip(TripCause.SPEED, f"speed of {speed:.1f} mm/s is over the limit of {limit:.1f} mm/s")

    def _judge_silence(self, block: Block, command: AnyFloatArray, look: BlockExtremes, rate_hz: float) -> Trip | None:
        silence, settings = self._silence.look(block, command, look, rate_hz), self._settings
        if silence.travel_mm <= settings.encoder_silent_mm or silence.duration_s <= settings.encoder_silent_s:
            return None
        lag_mm = settings.following_error_per_speed_s * self._commanded_speed(command, rate_hz)
        if silence.travel_mm <= settings.encoder_silent_mm + lag_mm:
            return None
        return Trip(
            TripCause.ENCODER_SILENT,
            f"the encoder showed not one count in {1000 * silence.duration_s:.0f} ms, while the command went "
            f"{silence.travel_mm:.2f} mm; look at its cable, and whether the stage is held",
        )

    def _judge_following(self, error: float, command: AnyFloatArray, rate_hz: float) -> Trip | None:
        if error <= self._settings.following_error_mm:
            return None
        speed = self._commanded_speed(command, rate_hz)
        limit = self._settings.following_error_mm + self._settings.following_error_per_speed_s * speed
        if error <= limit:
            return None
        return Trip(
            TripCause.FOLLOWING_ERROR, f"position is {error:.3f} mm off the command, where {limit:.3f} mm are allowed"
        )

    def _commanded_speed(self, command: AnyFloatArray, rate_hz: float) -> float:
        # What lags is where the command was before, so the speed of the block before counts too.
        joined = command if self._before is None else np.concatenate((self._before, command))
        return float(np.abs(np.diff(joined)).max()) * rate_hz if len(joined) > 1 else 0.0
