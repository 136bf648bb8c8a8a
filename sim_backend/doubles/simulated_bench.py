"""The simulated bench in front of the doubles: carriage, intestine, force sensor, encoder, wires, and its clock."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from threading import Event as Signal

import numpy as np

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.config.specimen import Capsule, Fixture, Specimen
from dragrig.rig.arrays import AnyFloatArray, FloatArray
from dragrig.rig.devices import Acquisition, Contact, with_utc_offset
from dragrig.rig.profile import MotionProfile, Phase, Piece, stationary_piece
from dragrig.sim_backend.devices.simulated_sampler import SimulatedChannels
from dragrig.sim_backend.devices.simulated_stage import UNDISTURBED, Track
from dragrig.sim_backend.doubles.carriage import (
    SETTLING_S,
    Carriage,
    HeartbeatRelay,
    VelocityInput,
    push_pieces,
    simplified,
)
from dragrig.sim_backend.doubles.fault_injection import FaultInjector

_MIN_SKIP_S = 0.5


def never() -> bool:
    """Return False: for a clock that never passes over anything."""
    return False


class DoubleClock:
    """A clock `pace` times as fast as the wall's. Any thread may use it.

    Parameters
    ----------
    pace
        Seconds of this clock in one of the wall's.
    origin
        Time of day at its start; now unless given.
    """

    def __init__(self, pace: float = 1.0, origin: datetime | None = None) -> None:
        self.pace = pace
        self._origin = with_utc_offset(origin)
        self._begun_s = time.perf_counter()
        self._passed_over_s = 0.0
        self._idle: Callable[[], bool] = never
        self._lock = threading.Lock()

    def pass_over_when(self, idle: Callable[[], bool]) -> None:
        """Let long waits take no time while `idle` says that nothing happens: no sample is taken, nothing moves."""
        self._idle = idle

    def now(self) -> datetime:
        """Time of day, with offset."""
        return self._origin + timedelta(seconds=self.monotonic())

    def monotonic(self) -> float:
        """Seconds of this clock since it was made."""
        return self._passed_over_s + self.pace * (time.perf_counter() - self._begun_s)

    def sleep(self, duration_s: float, cancel: Signal) -> bool:
        """Wait; return False within milliseconds when `cancel` is set before the time is over."""
        if cancel.is_set():
            return False
        if duration_s > _MIN_SKIP_S and self._idle():
            with self._lock:
                self._passed_over_s += duration_s
            return True
        return not (cancel.wait(duration_s / self.pace) if duration_s > 0 else cancel.is_set())


SampleChunk = tuple[int, Mapping[str, FloatArray]]
"""Index of its first sample, and the samples by quantity."""


def concatenated(chunks: Sequence[SampleChunk], first: int, end: int) -> Mapping[str, FloatArray]:
    """Return samples `first` to before `end`, shape `(end - first,)` each, of chunks that follow one another."""
    pieces: dict[str, list[FloatArray]] = {name: [] for name in chunks[0][1]}
    for begin, chunk in chunks:
        for name, values in chunk.items():
            here = values[max(first - begin, 0) : max(end - begin, 0)]
            if len(here):
                pieces[name].append(here)
    return {name: np.concatenate(parts) if parts else np.zeros(0) for name, parts in pieces.items()}


_LOOKAHEAD_S = 0.25
_FOREVER_S = 36_000.0


class SensorForce:
    """The simulated rig's force sensor and motor, fed with what the carriage really does.

    Parameters
    ----------
    acquisition
        What touches what; its profile says which way the first motion will go, and no more.
    """

    def __init__(self, rig: RigSettings, model: FrictionModelSettings, acquisition: Acquisition) -> None:
        self._rate_hz = rig.sampling.rate_hz
        self.acquisition = acquisition
        """What touches what."""
        self._signals = SimulatedChannels(rig, model, acquisition, UNDISTURBED)
        self._fresh = True
        self._seen: Carriage | None = None
        self._waits_until_s = 0.0

    def fits(self, rate_hz: float) -> bool:
        """Whether it is for this sample rate and no sample was computed yet."""
        return rate_hz == self._rate_hz and self._fresh

    def compute(self, first: int, end: int, carriage: Carriage) -> Mapping[str, AnyFloatArray]:
        """Return force and motor force [mN] of samples `first` to before `end`; `first` never goes back."""
        self._fresh = False
        until_s = end / self._rate_hz
        if carriage.has_moved:
            if carriage is not self._seen:
                self._seen = carriage
                pieces = (*carriage.profile.pieces(), stationary_piece(_FOREVER_S, Phase.HOLD))
                self._follow(MotionProfile.from_pieces(pieces))
        elif until_s > self._waits_until_s:
            self._expect_motion_after(until_s)
        return self._signals.compute(first, end, carriage.origin_mm)

    def _expect_motion_after(self, time_s: float) -> None:
        # A rest has the sign of the motion to come, so the plan's first motion is expected until it happens.
        planned = self.acquisition.profile.pieces()
        moving = [place for place, piece in enumerate(planned) if piece.acceleration_mm_s2]
        before = sum(piece.duration_s for piece in planned[: moving[0]]) if moving else 0.0
        self._waits_until_s = max(before, time_s + _LOOKAHEAD_S)
        rest = stationary_piece(self._waits_until_s, Phase.REST)
        to_come = planned[moving[0] :] if moving else ()
        self._follow(MotionProfile.from_pieces((rest, *to_come, stationary_piece(_FOREVER_S, Phase.HOLD))))

    def _follow(self, profile: MotionProfile) -> None:
        self._signals.follow(Track(profile, 0.0))


def no_contact() -> Acquisition:
    """Return what is sampled when nobody says what: a capsule that touches nothing."""
    return Acquisition(
        run_id="",
        order=0,
        kind="alone",
        profile=MotionProfile.from_pieces([stationary_piece(1.0, Phase.REST)]),
        capsule=Capsule(name="none", surface="smooth", diameter_mm=12.9, length_mm=15.2, mass_g=50.0),
        specimen=Specimen(name="none"),
        fixture=Fixture.NONE,
        contact=Contact.NONE,
        insertion_dwell_s=0.0,
    )


SWITCH_OFFSET_MM = 3.0
"""How far beyond the soft limits the limit switches are."""
INDEX_POSITION_MM = 0.0
"""Where the index pulse is."""
BODY_TEMPERATURE_DEGC = 37.0
_MAX_HOLD_SPEED_MM_S = 0.2
"""Below this it is held by a loop and not on its way."""
_EXTRA_BUFFER_S = 2.0
"""How much longer than the card's buffer samples are kept."""


@dataclass(frozen=True, slots=True)
class _Sampling:
    began_s: float
    rate_hz: float
    origin_counts: int
    gut: SensorForce


class SimulatedBench:
    """One bench in model time. Any thread may call anything."""

    def __init__(
        self, rig: RigSettings, model: FrictionModelSettings, clock: DoubleClock, faults: FaultInjector | None = None
    ) -> None:
        self.clock = clock
        self.faults = faults or FaultInjector()
        """What goes wrong; tests change it at any time."""
        self.rig = rig
        self._model = model
        self._lock = threading.RLock()
        self._since_s = clock.monotonic()
        self._carriage = self._felt = Carriage.standing(rig.stage.start_mm)
        lines = rig.hardware.card.lines
        self._amplifier = VelocityInput(rig.hardware.drive.velocity, self._may_go)
        self._relay = HeartbeatRelay(lines.heartbeat, lines.heartbeat_s)
        self._gut = self._prepared(no_contact(), rig.sampling.rate_hz)
        self._sampling: _Sampling | None = None
        self._chunks: list[SampleChunk] = []
        self._computed = 0
        self._push: tuple[Piece, ...] = ()
        self._written: dict[str, bool] = {}
        clock.pass_over_when(lambda: self._sampling is None and not self.moving and not self._amplifier.busy)

    def present(self, acquisition: Acquisition) -> None:
        """Let the next sampling meet this acquisition's capsule and gut."""
        # Prepared beforehand, so that the first sample does not wait for it.
        self._gut = self._prepared(acquisition, self.rig.sampling.rate_hz)

    @property
    def moving(self) -> bool:
        """Whether the carriage moves."""
        with self._lock:
            return self._carriage.moving(self._elapsed())

    def position_mm(self) -> float:
        """Where the carriage is; 0 at the index pulse."""
        with self._lock:
            return self._carriage.position(self._elapsed())

    def speed_mm_s(self) -> float:
        """Signed speed of the carriage."""
        with self._lock:
            return self._carriage.speed(self._elapsed())

    def follow(self, pieces: Sequence[Piece]) -> None:
        """Go on with `pieces` from the present position and speed."""
        with self._lock:
            self._carriage = self._felt = self._carriage.followed(self._elapsed(), pieces)

    def brake(self, deceleration_mm_s2: float) -> None:
        """Come to a standstill."""
        with self._lock:
            now_s = self._elapsed()
            self._carriage = self._carriage.braked(now_s, deceleration_mm_s2)
            self._felt = self._felt.braked(now_s, deceleration_mm_s2)

    def place(self, position_mm: float) -> None:
        """Stand somewhere else at once."""
        with self._lock:
            self._stand(position_mm, self.clock.monotonic())

    def push(self, distance_mm: float, within_s: float) -> None:
        """Let a hand push the carriage, from the next sample 0 on and for half of the time given."""
        with self._lock:
            self._push = push_pieces(distance_mm, 0.5 * within_s)

    @property
    def powered(self) -> bool:
        """Whether the heartbeat relay, if there is one, lets the drive have its power."""
        return self._relay.closed

    def obey_voltage(self, on: bool) -> None:
        """Let the voltage move the carriage from its next samples on, or not any more: the drive in velocity mode."""
        with self._lock:
            self._amplifier.on = on

    def put_out(self, output: str, volts: FloatArray, rate_hz: float, at_s: float) -> None:
        """Put out voltages, the first at a reading of the clock; at rate 0 one that is held. The card's."""
        with self._lock:
            at_s -= self._since_s
            carriage = self._amplifier.respond(self._carriage, at_s, output, volts, rate_hz)
            if carriage is not None:
                duration_s = len(volts) / rate_hz if rate_hz else SETTLING_S
                self._felt = simplified(self._felt, carriage, at_s, at_s + duration_s)
                self._carriage = carriage

    def begin_sampling(self, rate_hz: float) -> None:
        """Take sample 0 now."""
        with self._lock:
            gut = self._gut if self._gut.fits(rate_hz) else self._prepared(self._gut.acquisition, rate_hz)
            now_s = self.clock.monotonic()
            if not self.moving or (self._amplifier.on and abs(self.speed_mm_s()) < _MAX_HOLD_SPEED_MM_S):
                self._stand(self.position_mm(), now_s)
            counts = self._counts(np.array([self.position_mm()]))
            self._sampling = _Sampling(now_s, rate_hz, int(counts[0]), gut)
            self._chunks, self._computed = [], 0
            if self._push:
                self.follow(self._push)
                self._push = ()

    @property
    def began_s(self) -> float:
        """The clock's reading at sample 0; its present one while no sample is taken."""
        return self.clock.monotonic() if self._sampling is None else self._sampling.began_s

    def available(self) -> int:
        """Return how many samples were taken since sampling began."""
        with self._lock:
            sampling = self._sampling
            return 0 if sampling is None else int((self.clock.monotonic() - self.began_s) * sampling.rate_hz) + 1

    def sample(self, first: int, end: int) -> Mapping[str, FloatArray]:
        """Return samples `first` to before `end`, shape `(end - first,)` each.

        `force_V`; `encoder_counts`, from the position at sample 0; and each further input's volts by its name.

        Raises
        ------
        ValueError
            For samples that were not taken yet, or that the card's buffer lost long ago.
        """
        with self._lock:
            if self._sampling is None or not 0 <= first <= end <= self.available():
                raise ValueError(f"samples {first} to {end} are not there")
            self._compute(self._sampling, end)
            if not self._chunks or first < self._chunks[0][0]:
                raise ValueError(f"sample {first} is lost")
            return concatenated(self._chunks, first, end)

    def end_sampling(self) -> None:
        """Take no further sample; the next one meets nothing unless told."""
        with self._lock:
            self._sampling = None
            self._chunks = []
            self._gut = self._prepared(no_contact(), self.rig.sampling.rate_hz)

    def read_line(self, line: str) -> bool:
        """Return the level of a digital line, as PORT/LINE without the device."""
        with self._lock:
            lines = self.rig.hardware.card.lines
            position_mm = self.position_mm()
            trouble = self.faults.active
            levels = {
                lines.e_stop: not trouble.e_stop_pressed,
                lines.limit_low: position_mm > self.rig.stage.lowest_mm - SWITCH_OFFSET_MM
                and not trouble.limit_low_pressed,
                lines.limit_high: position_mm < self.rig.stage.highest_mm + SWITCH_OFFSET_MM
                and not trouble.limit_high_pressed,
            }
            return levels.get(line, self._written.get(line, False))

    def write_line(self, line: str, high: bool) -> None:
        """Set a digital line."""
        with self._lock:
            self._written[line] = high
            self._relay.hear(line, high)

    def _prepared(self, acquisition: Acquisition, rate_hz: float) -> SensorForce:
        sampling = self.rig.sampling.model_copy(update={"rate_hz": rate_hz, "motor_force": True})
        return SensorForce(self.rig.model_copy(update={"sampling": sampling}), self._model, acquisition)

    def _elapsed(self) -> float:
        return self.clock.monotonic() - self._since_s

    def _stand(self, position_mm: float, since_s: float) -> None:
        self._carriage = self._felt = Carriage.standing(position_mm)
        self._since_s = since_s

    def _may_go(self, direction: float) -> bool:
        lines = self.rig.hardware.card.lines
        switch = lines.limit_low if direction < 0 else lines.limit_high
        return not switch or self.read_line(switch)

    def _compute(self, sampling: _Sampling, end: int) -> None:
        first = self._computed
        if end <= first:
            return
        since_begin_s = np.arange(first, end) / sampling.rate_hz
        shown = sampling.gut.compute(first, end, self._as_sampled(sampling))
        trouble = self.faults.active
        card, force = self.rig.hardware.card, shown["force"].astype(np.float64)
        volts = (force + trouble.force_added_mN) / card.force.per_V + card.force.zero_V
        if trouble.sensor_open:
            volts[:] = 10.0 * np.sign(card.force.per_V)
        positions = self._carriage.positions(since_begin_s + (sampling.began_s - self._since_s))
        counts = self._counts(positions) - sampling.origin_counts
        if trouble.encoder_stuck:
            counts[:] = self._chunks[-1][1]["encoder_counts"][-1] if self._chunks else 0.0
        chunk = {"force_V": volts, "encoder_counts": counts}
        for one in card.inputs:
            quantity = {"motor_force": shown["motor_force"], "temperature": BODY_TEMPERATURE_DEGC}.get(one.name, 0.0)
            chunk[one.name] = np.broadcast_to(np.asarray(quantity, np.float64), counts.shape) / one.per_V + one.zero_V
        self._chunks.append((first, chunk))
        self._computed = end
        self._forget_before(end - round((card.buffer_s + _EXTRA_BUFFER_S) * sampling.rate_hz))

    def _as_sampled(self, sampling: _Sampling) -> Carriage:
        # A gut knows motions from a standstill at its first sample; one that began before it is not for it.
        if sampling.began_s - self._since_s > 1.0 / sampling.rate_hz:
            return Carriage.standing(self._carriage.origin_mm)
        return self._felt

    def _counts(self, position_mm: FloatArray) -> FloatArray:
        counts = np.rint(position_mm * (1000.0 / self.rig.encoder.resolution_um))
        return -counts if self.rig.hardware.card.encoder.reversed else counts

    def _forget_before(self, index: int) -> None:
        while len(self._chunks) > 1 and self._chunks[1][0] <= index:
            del self._chunks[0]
