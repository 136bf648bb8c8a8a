"""The bench that the doubles of card and drive stand in front of: carriage, gut, force sensor, encoder and wires."""

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.config.model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Acquisition
from dragrig.rig.profile import Piece
from dragrig.sim_backend.doubles.drive.amplifier import SETTLING_S, Amplifier, smoothed
from dragrig.sim_backend.doubles.drive.relay import Relay
from dragrig.sim_backend.doubles.world.carriage import Carriage, pushed
from dragrig.sim_backend.doubles.world.clock import DoubleClock
from dragrig.sim_backend.doubles.world.gut import Gut, alone
from dragrig.sim_backend.doubles.world.kept import Chunk, joined
from dragrig.sim_backend.doubles.world.mishaps import Mishaps

SWITCH_MM = 3.0
"""How far beyond the soft limits the limit switches are."""
INDEX_MM = 0.0
"""Where the index pulse is."""
BODY_TEMPERATURE_DEGC = 37.0
_CREEPS_MM_S = 0.2
"""Below this it is held by a loop and not on its way."""
_KEPT_S = 2.0
"""How much longer than the card's buffer samples are kept."""


@dataclass(frozen=True, slots=True)
class _Sampling:
    began_s: float
    rate_hz: float
    origin_counts: int
    gut: Gut


class World:
    """One bench in model time. Any thread may call anything."""

    def __init__(
        self, rig: RigSettings, model: FrictionModelSettings, clock: DoubleClock, mishaps: Mishaps | None = None
    ) -> None:
        self.clock = clock
        self.mishaps = mishaps or Mishaps()
        """What goes wrong; tests change it at any time."""
        self.rig = rig
        self._model = model
        self._lock = threading.RLock()
        self._since_s = clock.monotonic()
        self._carriage = self._felt = Carriage.standing(rig.stage.start_mm)
        lines = rig.hardware.card.lines
        self._amplifier = Amplifier(rig.hardware.drive.velocity, self._may_go)
        self._relay = Relay(lines.heartbeat, lines.heartbeat_s)
        self._gut = self._prepared(alone(), rig.sampling.rate_hz)
        self._sampling: _Sampling | None = None
        self._chunks: list[Chunk] = []
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
            self._push = pushed(distance_mm, 0.5 * within_s)

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
                self._felt = smoothed(self._felt, carriage, at_s, at_s + duration_s)
                self._carriage = carriage

    def begin_sampling(self, rate_hz: float) -> None:
        """Take sample 0 now."""
        with self._lock:
            gut = self._gut if self._gut.fits(rate_hz) else self._prepared(self._gut.acquisition, rate_hz)
            now_s = self.clock.monotonic()
            if not self.moving or (self._amplifier.on and abs(self.speed_mm_s()) < _CREEPS_MM_S):
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
            return joined(self._chunks, first, end)

    def end_sampling(self) -> None:
        """Take no further sample; the next one meets nothing unless told."""
        with self._lock:
            self._sampling = None
            self._chunks = []
            self._gut = self._prepared(alone(), self.rig.sampling.rate_hz)

    def read_line(self, line: str) -> bool:
        """Return the level of a digital line, as PORT/LINE without the device."""
        with self._lock:
            lines = self.rig.hardware.card.lines
            position_mm = self.position_mm()
            trouble = self.mishaps.now
            levels = {
                lines.e_stop: not trouble.e_stop_pressed,
                lines.limit_low: position_mm > self.rig.stage.lowest_mm - SWITCH_MM and not trouble.limit_low_pressed,
                lines.limit_high: position_mm < self.rig.stage.highest_mm + SWITCH_MM
                and not trouble.limit_high_pressed,
            }
            return levels.get(line, self._written.get(line, False))

    def write_line(self, line: str, high: bool) -> None:
        """Set a digital line."""
        with self._lock:
            self._written[line] = high
            self._relay.hear(line, high)

    def _prepared(self, acquisition: Acquisition, rate_hz: float) -> Gut:
        sampling = self.rig.sampling.model_copy(update={"rate_hz": rate_hz, "motor_force": True})
        return Gut(self.rig.model_copy(update={"sampling": sampling}), self._model, acquisition)

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
        trouble = self.mishaps.now
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
        self._forget_before(end - round((card.buffer_s + _KEPT_S) * sampling.rate_hz))

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
