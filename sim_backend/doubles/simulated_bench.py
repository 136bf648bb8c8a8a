"""The simulated bench in front of the doubles: carriage, gut, sensor, encoder, wires and clock, and their faults.

Positions of the carriage are the bench's own: 0 at the index pulse, whatever a drive takes for its zero. Times are
seconds since the motion's log began. In velocity mode the drive reads its input in 14 bits and follows as a first-order
lag; between two readings the carriage's speed changes linearly, so that a motion of seconds stays some hundred
pieces.
"""

import dataclasses
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import takewhile
from threading import Event as Signal

import numpy as np

from dragrig.config import Capsule, Fixture, FrictionModelSettings, RigSettings, Specimen, VelocityOutputSettings
from dragrig.rig import (
    Acquisition,
    AnyFloatArray,
    Contact,
    FloatArray,
    MotionProfile,
    Phase,
    Piece,
    WallClock,
    stationary_piece,
    trapezoid,
)
from dragrig.sim_backend.devices import UNDISTURBED, SimulatedChannels, Track, evaluate_profile, profile_position

_MIN_REST_S = 1e-3
_TIME_TOLERANCE_S = 1e-9


@dataclass(frozen=True, slots=True)
class Carriage:
    """A motion from a standstill at `origin_mm`; each command returns a new one, equal to this up to then."""

    origin_mm: float
    profile: MotionProfile

    @classmethod
    def standing(cls, position_mm: float) -> "Carriage":
        """Return a carriage at rest."""
        return cls(position_mm, MotionProfile.from_pieces([stationary_piece(_MIN_REST_S, Phase.REST)]))

    def position(self, time_s: float) -> float:
        """Position [mm] at a time."""
        return self.origin_mm + profile_position(self.profile, time_s)

    def positions(self, time_s: FloatArray) -> FloatArray:
        """Positions [mm] at increasing times."""
        return self.origin_mm + evaluate_profile(self.profile, time_s).position

    def speed(self, time_s: float) -> float:
        """Signed speed [mm/s] at a time."""
        return float(self.profile.velocity(time_s)) if time_s < self.profile.duration_s else 0.0

    def moving(self, time_s: float) -> bool:
        """Whether it moves at a time, or will."""
        return time_s < self.profile.motion_ends_s

    def followed(self, time_s: float, pieces: Sequence[Piece]) -> "Carriage":
        """Return the motion that continues with `pieces` from a time on, with the speed at that time."""
        past = list(self.profile.pieces()[: np.searchsorted(self.profile.start_s, time_s - _TIME_TOLERANCE_S)])
        if past:
            last_s = time_s - self.profile.start_s.item(len(past) - 1)
            past[-1] = replace(past[-1], duration_s=min(past[-1].duration_s, last_s))
        rest_s = time_s - self.profile.duration_s
        if rest_s > 0:
            past.append(stationary_piece(rest_s, Phase.HOLD))
        return replace(self, profile=MotionProfile.from_pieces((*past, *pieces)))

    def braked(self, time_s: float, deceleration_mm_s2: float) -> "Carriage":
        """Return the motion that brakes to a standstill from a time on."""
        if not self.moving(time_s):
            return self
        return replace(self, profile=self.profile.stopped(time_s, deceleration_mm_s2))


def push_pieces(distance_mm: float, duration_s: float) -> tuple[Piece, ...]:
    """Return a push by hand over a signed distance, gentle at both ends."""
    ramp_s = 0.2 * duration_s
    speed_mm_s = abs(distance_mm) / (duration_s - ramp_s)
    return trapezoid(distance_mm, speed_mm_s, speed_mm_s / ramp_s)


VELOCITY_LAG_S = 0.002
"""Time constant with which the carriage follows the voltage."""
INPUT_RESOLUTION_V = 20.0 / 2**14
SETTLING_S = 3 * VELOCITY_LAG_S
"""Time after which the carriage has the speed of a voltage that is held."""
_BATCH_S = 0.02
_SPEED_TOLERANCE_MM_S = 1e-6
_FOREVER_S = 36_000.0
_RELATIVE_SPEED_TOLERANCE = 0.02
_CATCH_UP_S = 0.5
_MAX_CREEP_MM_S = 1.0
_MIN_TRAVEL_MM = 0.02
_MIN_SPEED_STEP_MM_S = 0.02


class VelocityInput:
    """From voltages to the carriage's motion. The caller of a method holds the bench's lock.

    Parameters
    ----------
    may_go
        Whether the carriage may go in a direction, −1 or +1: a pressed limit switch forbids one.
    sense
        Sign of the speed at a positive voltage.
    """

    def __init__(
        self, settings: VelocityOutputSettings, may_go: Callable[[float], bool], sense: Callable[[], float]
    ) -> None:
        self._channel = settings.channel
        self._step_mm_s = INPUT_RESOLUTION_V * settings.per_V
        self._may_go, self._sense = may_go, sense
        self.on = False
        """Whether the drive is switched on; when off, the voltage has no effect."""
        self.busy = False
        """Whether a waveform is being put out."""

    def respond(
        self, carriage: Carriage, at_s: float, channel: str, volts: FloatArray, rate_hz: float
    ) -> Carriage | None:
        """Return the motion that follows from voltages that begin at a time; None when nothing changes.

        Parameters
        ----------
        at_s
            In the carriage's time.
        rate_hz
            0 for one voltage that is held.
        """
        if channel != self._channel:
            return None
        self.busy = rate_hz > 0
        if not self.on:
            return None
        targets = self._sense() * np.rint(volts / INPUT_RESOLUTION_V) * self._step_mm_s
        speed = carriage.speed(at_s)
        if abs(speed) <= _SPEED_TOLERANCE_MM_S and not targets.any() and not carriage.moving(at_s):
            return None
        pieces: list[Piece] = []
        if rate_hz == 0:
            target = self._allowed(float(targets[-1]))
            if target != speed:
                pieces.append(Piece(SETTLING_S, (target - speed) / SETTLING_S, Phase.ACCELERATE))
            speed = target
        else:
            batch = max(1, round(_BATCH_S * rate_hz))
            for first in range(0, len(targets), batch):
                speed = self._append_batch(pieces, speed, targets[first : first + batch], rate_hz)
        if speed:
            pieces.append(Piece(_FOREVER_S, 0.0, Phase.STEADY))
        return carriage.followed(at_s, pieces)

    def _append_batch(self, pieces: list[Piece], start_speed: float, targets: FloatArray, rate_hz: float) -> float:
        """Append one piece where the speed stays, else two of the same travel and end speed; return the end speed."""
        sample_s = 1.0 / rate_hz
        decay = float(np.exp(-sample_s / VELOCITY_LAG_S))
        speed, travel_mm, duration_s = start_speed, 0.0, len(targets) * sample_s
        for target in map(self._allowed, targets.tolist()):
            travel_mm += target * sample_s + (speed - target) * VELOCITY_LAG_S * (1.0 - decay)
            speed = target + (speed - target) * decay
            speed = target if abs(speed - target) < _SPEED_TOLERANCE_MM_S else speed
        if start_speed == speed and abs(travel_mm - speed * duration_s) < _SPEED_TOLERANCE_MM_S * duration_s:
            pieces.append(Piece(duration_s, 0.0, Phase.STEADY))
            return speed
        half_s = duration_s / 2
        middle = (2 * travel_mm / duration_s) - (start_speed + speed) / 2
        pieces.append(Piece(half_s, (middle - start_speed) / half_s, Phase.ACCELERATE))
        pieces.append(Piece(half_s, (speed - middle) / half_s, Phase.ACCELERATE))
        return speed

    def _allowed(self, speed: float) -> float:
        return speed if speed == 0.0 or self._may_go(float(np.sign(speed))) else 0.0


def simplified(felt: Carriage, carriage: Carriage, at_s: float, until_s: float) -> Carriage:
    """Return `felt` continued like `carriage` from one time to another, without the loop's small corrections.

    The friction of a motion is computed for each of its pieces, so it gets only those that matter: no creeping around a
    standstill, the same ramps, and between them speeds to within 2 %.
    """
    while until_s - at_s > _TIME_TOLERANCE_S:
        next_s = min(at_s + _BATCH_S, until_s)
        felt = _with_next_piece(felt, carriage, at_s, next_s)
        at_s = next_s
    return felt


def _with_next_piece(felt: Carriage, carriage: Carriage, at_s: float, until_s: float) -> Carriage:
    now, target, duration_s = felt.speed(at_s), carriage.speed(until_s), until_s - at_s
    behind_mm = carriage.position(until_s) - felt.position(until_s)
    if now == 0.0 and abs(target) <= _MAX_CREEP_MM_S and abs(behind_mm) <= _MIN_TRAVEL_MM:
        return felt
    tolerance = _RELATIVE_SPEED_TOLERANCE * abs(target) + _MIN_SPEED_STEP_MM_S
    speeds = reversed(felt.profile.velocity_mm_s.tolist())
    fastest_since_rest = max(map(abs, takewhile(bool, speeds)), default=0.0)
    if abs(target) <= _RELATIVE_SPEED_TOLERANCE * fastest_since_rest:
        target = 0.0
    elif abs(target - now) <= tolerance:
        target += behind_mm / _CATCH_UP_S
        if abs(target - now) <= tolerance:
            return felt
    if not (target or now):
        return felt
    pieces = [Piece(duration_s, (target - now) / duration_s, Phase.ACCELERATE)]
    if target:
        pieces.append(Piece(_FOREVER_S, 0.0, Phase.STEADY))
    return felt.followed(at_s, pieces)


MISSED_BEATS = 3
"""How many missed beats open the relay."""


class HeartbeatRelay:
    """A relay that is closed while edges come, in wall time; one without a line is always closed.

    Parameters
    ----------
    line
        The heartbeat's line, as PORT/LINE; empty when there is none.
    beat_s
        Time between two edges.
    """

    def __init__(self, line: str, beat_s: float) -> None:
        self._line = line
        self._timeout_s = MISSED_BEATS * beat_s
        self._high = False
        self._edge_s = float("-inf")

    def closed(self, own_s: float = 0.0) -> bool:
        """Whether the drive has power; `own_s` is the relay's time from the last edge on, 0 for three beats."""
        return not self._line or time.monotonic() - self._edge_s < (own_s or self._timeout_s)

    def notice(self, line: str, high: bool) -> None:
        """Notice a level that was written to a line."""
        if line == self._line and high is not self._high:
            self._high = high
            self._edge_s = time.monotonic()


@dataclass(frozen=True, slots=True)
class ActiveFaults:
    """Everything that is wrong at present; default: nothing."""

    card_unplugged: bool = False
    """The card was pulled: every call that touches it fails with −201003."""
    card_gone: bool = False
    """The driver no longer knows the card: −88705."""
    card_absent: bool = False
    """The driver lists no such card; its channels are not found: −200220."""
    card_reserved: bool = False
    """Another program holds the card: starting or reserving a task fails with −50103."""
    card_stalled: bool = False
    """Samples are taken, but none reaches the program before this ends; reads time out with what there was."""
    overwritten_samples: int = 0
    """Total number of samples that the card's buffer lost before they were read: with every increase, each running task
    loses that many unread samples, and its next relative read fails with −200279.
    """
    short_reads: int = 0
    """Total number of buffered reads of each task that time out (−200284) with half of what they requested."""
    drive_alarm: str = ""
    """Text or code of an alarm that the drive raises; empty for none."""
    drive_reply_late_s: float = 0.0
    """Delay of the drive's replies, in wall time."""
    drive_reply_load_s: float = 0.0
    """Longest further delay of a reply by the load of a busy computer, in wall time: each is drawn, most are short."""
    drive_starts_late_s: float = 0.0
    """Time from the drive's acknowledgement of a stroke to its start."""
    homing_reversed: bool = False
    """The drive homes over the other limit switch, whatever it is told."""
    drive_garbled: bool = False
    """The drive's replies arrive with wrong bytes."""
    drive_silent: bool = False
    """The drive carries out requests, but does not reply."""
    drive_unplugged: bool = False
    """The serial adapter was pulled: the port fails."""
    drive_cut_off: bool = False
    """The plug was pulled at the drive: nothing arrives at either side, and the port does not fail."""
    drive_unwatched: bool = False
    """The drive has no silence timeout, whatever it holds as one: it goes on with its last motion."""
    force_added_mN: float = 0.0
    """Force on the sensor in addition to the specimen's."""
    sensor_open: bool = False
    """The force sensor's cable is pulled: the input is where its pull-up or pull-down holds it."""
    force_floats_mN: float = 0.0
    force_floats_hum_mN: float = 0.0
    force_floats_drift_mN_s: float = 0.0
    """`force_floats_mN`, `force_floats_hum_mN`, `force_floats_drift_mN_s`: the force sensor's cable is pulled, and its
    input floats: what it shows first, 0 for no such fault, the amplitude of its 50 Hz hum, and its drift from then on.
    """
    force_dead: bool = False
    """The force sensor's amplifier gives 0 V, whatever happens; the converter adds its own noise."""
    force_frozen: bool = False
    """The force input repeats one sample."""
    force_constant_V: float = 0.0
    """The force input gives exactly this voltage; 0 for none."""
    force_inverted: bool = False
    """The force sensor is wired the wrong way round."""
    force_rail_V: float = 0.0
    """The force sensor's amplifier saturates at this voltage, of either sign; 0 where the card's range ends first."""
    force_tone_mN: float = 0.0
    force_tone_hz: float = 0.0
    """`force_tone_mN`, `force_tone_hz`: amplitude and frequency of a tone on the force sensor's wires."""
    encoder_stuck: bool = False
    """The encoder repeats one count."""
    encoder_added_counts: int = 0
    """Total number of counts that came too many; negative for counts that were lost."""
    encoder_lost_share: float = 0.0
    """Share of the counts of a motion that is lost; negative for counts that come twice."""
    encoder_jitter_counts: int = 0
    """The encoder's count is off by up to so many, at random."""
    encoder_error: bool = False
    """The read head reports an error on its E line, or that wire is broken."""
    switches_swapped: bool = False
    """The wires of the two limit switches are swapped."""
    switches_normally_open: bool = False
    """The switches' normally open contacts are wired."""
    enable_not_wired: bool = False
    """The drive is enabled whatever the enable line says."""
    enable_opens_s: float = 0.0
    """Time that a relay between the enable line and the drive takes to open, in wall time."""
    relay_not_wired: bool = False
    """The heartbeat relay's contact is in no circuit of the drive, which has power whatever the heartbeat does."""
    relay_opens_s: float = 0.0
    """Time from the last edge until the heartbeat relay opens, in wall time; 0 for three beats."""
    encoder_swapped: bool = False
    """A and B of the encoder are exchanged, so that it counts the other way."""
    encoder_scale: float = 1.0
    """Counts of the encoder over those of the settings' resolution."""
    index_phase: str = "a_high_b_high"
    """State of A and B in which the index pulse is high, as `z_phase` of the settings."""
    velocity_swapped: bool = False
    """The two wires of the velocity command are exchanged."""
    carriage_blocked: bool = False
    """Nothing moves the carriage."""
    e_stop_pressed: bool = False
    limit_low_pressed: bool = False
    limit_high_pressed: bool = False
    """`e_stop_pressed`, `limit_low_pressed`, `limit_high_pressed`: a hand is on the button; a switch is actuated or its
    wire broken.
    """


class FaultInjector:
    """Holds the active faults; any thread may read or change them."""

    def __init__(self, active: ActiveFaults | None = None) -> None:
        self._lock = threading.Lock()
        self._active = active or ActiveFaults()
        self._listeners: list[Callable[[], None]] = []

    @property
    def active(self) -> ActiveFaults:
        """The faults that are active at present."""
        return self._active

    def replace(self, active: ActiveFaults) -> None:
        """Make exactly these faults active, and notify the listeners."""
        with self._lock:
            self._active = active
            listeners = tuple(self._listeners)
        for listener in listeners:
            listener()

    def inject(self, **changes: float | str) -> None:
        """Change the named attributes of `ActiveFaults`; the others stay."""
        with self._lock:
            changed = dataclasses.replace(self._active, **changes)  # type: ignore[arg-type]
        self.replace(changed)

    def clear(self) -> None:
        """End all faults."""
        self.replace(ActiveFaults())

    def subscribe(self, listener: Callable[[], None]) -> None:
        """Call `listener` after every change, in the thread that made it."""
        with self._lock:
            self._listeners.append(listener)


SWITCH_OFFSET_MM = 3.0
"""How far beyond the soft limits the limit switches are."""
INDEX_POSITION_MM = 0.0
BODY_TEMPERATURE_DEGC = 37.0
_MIN_SKIP_S = 0.5
_MAX_HOLD_SPEED_MM_S = 0.2
"""Below this a carriage counts as held by the velocity loop, not as moving."""
_EXTRA_BUFFER_S = 2.0
"""How much longer than in the card's buffer samples are held."""
_LOOKAHEAD_S = 0.25
_SAMPLE_TOLERANCE = 1e-6
_FLOATING_V = 1.3
_MAINS_HZ = 50.0
CONVERTER_NOISE = 0.8 * 2.0**-15
"""The PCI-6229's own noise (standard deviation), as a share of an input's range: 244 µV at ±10 V (specifications)."""


class DoubleClock(WallClock):
    """A clock `pace` times as fast as the wall clock. Any thread may use it.

    Parameters
    ----------
    pace
        Seconds of this clock in a second of wall time.
    origin
        Time of day at its start; default: now.
    """

    def __init__(self, pace: float = 1.0, origin: datetime | None = None) -> None:
        super().__init__(origin)
        self.pace = pace
        self._skipped_s = 0.0
        self.is_idle: Callable[[], bool] = lambda: False
        """Whether long waits take no time: no sample is taken, nothing moves."""
        self._lock = threading.Lock()

    def monotonic(self) -> float:
        """Seconds of this clock since it was made."""
        return self._skipped_s + self.pace * super().monotonic()

    def sleep(self, duration_s: float, cancel: Signal) -> bool:
        """Wait; return False within milliseconds when `cancel` is set before the time is over."""
        if cancel.is_set():
            return False
        if duration_s > _MIN_SKIP_S and self.is_idle():
            with self._lock:
                self._skipped_s += duration_s
            return True
        return super().sleep(duration_s / self.pace, cancel)


class SensorForce:
    """The simulated rig's force sensor and motor, for a motion that becomes known only as it happens.

    Both are computed at the settings' sample rate and interpolated to the times at which the card samples.

    Parameters
    ----------
    acquisition
        The contact; of its profile only the direction of the first motion is used.
    """

    def __init__(self, rig: RigSettings, model: FrictionModelSettings, acquisition: Acquisition) -> None:
        self._rate_hz = rig.sampling.rate_hz
        self.acquisition = acquisition
        self._channels = SimulatedChannels(rig, model, acquisition, UNDISTURBED)
        self._followed: Carriage | None = None
        self._waits_until_s = 0.0
        self._index = 0
        self._last = {name: np.zeros(0) for name in ("force", "motor_force")}

    def at(self, time_s: FloatArray, carriage: Carriage) -> Mapping[str, FloatArray]:
        """Return force and motor force [mN] at increasing times, shape `(n,)`, which never go back."""
        position = time_s * self._rate_hz
        first, end = self._index, math.ceil(position[-1] - _SAMPLE_TOLERANCE) + 1
        if end > first:
            computed = self._compute(first, end, carriage)
            self._last = {name: np.concatenate([last[-2:], computed[name]]) for name, last in self._last.items()}
            self._index = end
        return {
            name: np.interp(position, np.arange(self._index - len(values), self._index), values)
            for name, values in self._last.items()
        }

    def _compute(self, first: int, end: int, carriage: Carriage) -> Mapping[str, AnyFloatArray]:
        until_s = end / self._rate_hz
        if carriage.profile.motion_ends_s > 0:
            if carriage is not self._followed:
                self._followed = carriage
                self._follow((*carriage.profile.pieces(), stationary_piece(_FOREVER_S, Phase.HOLD)))
        elif until_s > self._waits_until_s:
            self._expect_motion_after(until_s)
        return self._channels.compute(first, end, carriage.origin_mm)

    def _expect_motion_after(self, time_s: float) -> None:
        # The force at rest has the sign of the motion to come, so the plan's first motion is expected until it happens.
        planned = self.acquisition.profile.pieces()
        moving = [index for index, piece in enumerate(planned) if piece.acceleration_mm_s2]
        before_s = sum(piece.duration_s for piece in planned[: moving[0]]) if moving else 0.0
        self._waits_until_s = max(before_s, time_s + _LOOKAHEAD_S)
        rest = stationary_piece(self._waits_until_s, Phase.REST)
        to_come = planned[moving[0] :] if moving else ()
        self._follow((rest, *to_come, stationary_piece(_FOREVER_S, Phase.HOLD)))

    def _follow(self, pieces: Sequence[Piece]) -> None:
        self._channels.follow(Track(MotionProfile.from_pieces(pieces), 0.0))


def no_contact() -> Acquisition:
    """Return the acquisition by default: a capsule that touches nothing."""
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


@dataclass(slots=True)
class _Sampling:
    """One sampling, and its samples as computed so far: pairs of first index and samples by quantity."""

    began_s: float
    rate_hz: float
    origin_counts: int
    force: SensorForce
    noise: np.random.Generator
    added_counts: int
    """What the fault of that name was when sampling began."""
    computed: int = 0
    last_count: float = 0.0
    lost_counts: float = 0.0
    floats_since_s: float = math.inf
    chunks: list[tuple[int, dict[str, FloatArray]]] = field(default_factory=list)


class SimulatedBench:
    """One bench in model time. Any thread may call any method.

    Parameters
    ----------
    faults
        Injected faults; default: none. Tests change them at any time.
    """

    def __init__(
        self, rig: RigSettings, model: FrictionModelSettings, clock: DoubleClock, faults: FaultInjector | None = None
    ) -> None:
        self.clock = clock
        self.faults = faults or FaultInjector()
        self.rig = rig
        self._model = model
        self._lock = threading.RLock()
        self._since_s = clock.monotonic()
        self._carriage = self._felt = Carriage.standing(rig.stage.start_mm)
        lines = rig.hardware.card.lines
        self._velocity_input = VelocityInput(
            rig.hardware.drive.velocity, self._may_go, lambda: -1.0 if self.faults.active.velocity_swapped else 1.0
        )
        self._relay = HeartbeatRelay(lines.heartbeat, lines.heartbeat_s)
        self._next_force = self._sensor_force(no_contact())
        self._samplings = 0
        self._sampling: _Sampling | None = None
        self._push: tuple[Piece, ...] = ()
        self._written: dict[str, bool] = {}
        self._lowered_s: dict[str, float] = {}
        clock.is_idle = lambda: self._sampling is None and not self.moving and not self._velocity_input.busy

    def present(self, acquisition: Acquisition) -> None:
        """Let the next sampling measure this acquisition's capsule and specimen."""
        # Prepared beforehand, so that the first sample does not wait for it.
        self._next_force = self._sensor_force(acquisition)

    @property
    def moving(self) -> bool:
        """Whether the carriage moves."""
        with self._lock:
            return self._carriage.moving(self._elapsed_s())

    def position_mm(self) -> float:
        """Return the carriage's position; 0 at the index pulse."""
        with self._lock:
            return self._carriage.position(self._elapsed_s())

    def speed_mm_s(self) -> float:
        """Return the carriage's signed speed."""
        with self._lock:
            return self._carriage.speed(self._elapsed_s())

    def follow(self, pieces: Sequence[Piece]) -> None:
        """Continue with `pieces` from the present position and speed."""
        with self._lock:
            if not self.faults.active.carriage_blocked:
                self._carriage = self._felt = self._carriage.followed(self._elapsed_s(), pieces)

    def brake(self, deceleration_mm_s2: float) -> None:
        """Come to a standstill."""
        with self._lock:
            now_s = self._elapsed_s()
            self._carriage = self._carriage.braked(now_s, deceleration_mm_s2)
            self._felt = self._felt.braked(now_s, deceleration_mm_s2)

    def place(self, position_mm: float) -> None:
        """Stand at another position at once."""
        with self._lock:
            self._stand(position_mm, self.clock.monotonic())

    def push(self, distance_mm: float, within_s: float) -> None:
        """Let a hand push the carriage for half of the time: now, or from the next sample 0 on where none is taken."""
        with self._lock:
            self._push = push_pieces(distance_mm, 0.5 * within_s)
            if self._sampling is not None:
                self._begin_push()

    @property
    def powered(self) -> bool:
        """Whether the heartbeat relay, if there is one, keeps the drive's power on."""
        faults = self.faults.active
        return faults.relay_not_wired or self._relay.closed(faults.relay_opens_s)

    @property
    def enabled(self) -> bool:
        """Whether the enable line, if there is one, lets the drive be on."""
        with self._lock:
            line, faults = self.rig.hardware.card.lines.enable, self.faults.active
            if not line or faults.enable_not_wired or self.read_line(line):
                return True
            return time.monotonic() - self._lowered_s.get(line, float("-inf")) < faults.enable_opens_s

    def obey_voltage(self, on: bool) -> None:
        """Let the voltage move the carriage from its next samples on, or no longer: the drive in velocity mode."""
        with self._lock:
            self._velocity_input.on = on

    def put_out(self, output: str, volts: FloatArray, rate_hz: float, at_s: float) -> None:
        """Put out voltages, the first at a reading of the clock; at rate 0 one that is held (called by the card)."""
        with self._lock:
            at_s -= self._since_s
            carriage = self._velocity_input.respond(self._carriage, at_s, output, volts, rate_hz)
            if carriage is not None and not self.faults.active.carriage_blocked:
                duration_s = len(volts) / rate_hz if rate_hz else SETTLING_S
                self._felt = simplified(self._felt, carriage, at_s, at_s + duration_s)
                self._carriage = carriage

    def begin_sampling(self, rate_hz: float) -> None:
        """Take sample 0 now."""
        with self._lock:
            now_s = self.clock.monotonic()
            held = self._velocity_input.on and abs(self.speed_mm_s()) < _MAX_HOLD_SPEED_MM_S
            if not self.moving or held:
                self._stand(self.position_mm(), now_s)
            counts = self.counts(np.array([self.position_mm()]))
            noise = np.random.default_rng([self.rig.simulated.seed, self._samplings])
            self._samplings += 1
            added = self.faults.active.encoder_added_counts
            self._sampling = _Sampling(now_s, rate_hz, int(counts[0]), self._next_force, noise, added)
            self._begin_push()

    def _begin_push(self) -> None:
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
            sampling = self._sampling
            if sampling is None or not 0 <= first <= end <= self.available():
                raise ValueError(f"samples {first} to {end} were not taken")
            self._compute(sampling, end)
            if not sampling.chunks or first < sampling.chunks[0][0]:
                raise ValueError(f"sample {first} is lost")
            chunks = [
                (begin, chunk)
                for begin, chunk in sampling.chunks
                if begin < end and begin + len(chunk["force_V"]) > first
            ] or sampling.chunks[-1:]
            parts = [
                {name: values[max(first - begin, 0) : max(end - begin, 0)] for name, values in chunk.items()}
                for begin, chunk in chunks
            ]
            return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def end_sampling(self) -> None:
        """Take no further sample; the next sampling has no contact by default."""
        with self._lock:
            self._sampling = None
            self._next_force = self._sensor_force(no_contact())

    def read_line(self, line: str) -> bool:
        """Return the level of a digital line, as PORT/LINE without the device."""
        with self._lock:
            lines, stage, faults = self.rig.hardware.card.lines, self.rig.stage, self.faults.active
            if line and line == lines.encoder_error:
                return not faults.encoder_error
            if line == (lines.limit_low if faults.switches_swapped else lines.limit_high):
                closed = not faults.limit_high_pressed and self.position_mm() < stage.highest_mm + SWITCH_OFFSET_MM
            elif line == (lines.limit_high if faults.switches_swapped else lines.limit_low):
                closed = not faults.limit_low_pressed and self.position_mm() > stage.lowest_mm - SWITCH_OFFSET_MM
            elif line == lines.e_stop:
                closed = not faults.e_stop_pressed
            else:
                return self._written.get(line, False)
            return closed is not faults.switches_normally_open

    def write_line(self, line: str, high: bool) -> None:
        """Set a digital line."""
        with self._lock:
            if self._written.get(line, False) and not high:
                self._lowered_s[line] = time.monotonic()
            self._written[line] = high
            self._relay.notice(line, high)

    def _sensor_force(self, acquisition: Acquisition) -> SensorForce:
        sampling = self.rig.sampling.model_copy(update={"motor_force": True})
        return SensorForce(self.rig.model_copy(update={"sampling": sampling}), self._model, acquisition)

    def _elapsed_s(self) -> float:
        return self.clock.monotonic() - self._since_s

    def _stand(self, position_mm: float, since_s: float) -> None:
        self._carriage = self._felt = Carriage.standing(position_mm)
        self._since_s = since_s

    def _may_go(self, direction: float) -> bool:
        lines = self.rig.hardware.card.lines
        switch = lines.limit_low if direction < 0 else lines.limit_high
        return not switch or self.read_line(switch)

    def _compute(self, sampling: _Sampling, end: int) -> None:
        first = sampling.computed
        if end <= first:
            return
        began_s = sampling.began_s - self._since_s
        # The friction knows motions from a standstill at the first sample; one that began before it is left out.
        felt = self._felt if began_s <= 1.0 / sampling.rate_hz else Carriage.standing(self._carriage.origin_mm)
        time_s = np.arange(first, end) / sampling.rate_hz
        simulated = sampling.force.at(time_s, felt)
        before = sampling.chunks[-1][1] if sampling.chunks else None
        counts = self.counts(self._carriage.positions(time_s + began_s)) - sampling.origin_counts
        chunk = {
            "force_V": self._force_volts(sampling, time_s, simulated["force"], before),
            "encoder_counts": self._seen_counts(sampling, counts, before),
        }
        card = self.rig.hardware.card
        quantities = {"motor_force": simulated["motor_force"], "temperature": BODY_TEMPERATURE_DEGC}
        for channel in card.inputs:
            values = np.asarray(quantities.get(channel.name, 0.0), np.float64)
            volts = np.broadcast_to(values, counts.shape) / channel.per_V + channel.zero_V
            chunk[channel.name] = volts + _converter_noise(sampling, channel.range_V, len(counts))
        sampling.chunks.append((first, chunk))
        sampling.computed = end
        oldest = end - round((card.buffer_s + _EXTRA_BUFFER_S) * sampling.rate_hz)
        while len(sampling.chunks) > 1 and sampling.chunks[1][0] <= oldest:
            del sampling.chunks[0]

    def counts(self, position_mm: FloatArray) -> FloatArray:
        """Return the encoder's counts at positions, 0 at the index pulse."""
        faults = self.faults.active
        counts = np.rint(position_mm * (1000.0 * faults.encoder_scale / self.rig.encoder.resolution_um))
        return -counts if self.rig.hardware.card.encoder.reversed is not faults.encoder_swapped else counts

    def _force_volts(
        self, sampling: _Sampling, time_s: FloatArray, force_mN: FloatArray, before: dict[str, FloatArray] | None
    ) -> FloatArray:
        """Return the force input's volts, with the faults of sensor, amplifier and wires."""
        faults, wiring = self.faults.active, self.rig.hardware.card.force
        load_mN = force_mN + faults.force_added_mN
        if faults.force_tone_mN:
            load_mN = load_mN + faults.force_tone_mN * np.sin(2 * np.pi * faults.force_tone_hz * time_s)
        volts = (-load_mN if faults.force_inverted else load_mN) / wiring.per_V + wiring.zero_V
        if faults.force_rail_V:
            volts = np.clip(volts, -faults.force_rail_V, faults.force_rail_V)
        if faults.force_dead:
            volts = np.zeros_like(volts)
        if faults.sensor_open:
            unplugged_V = {"rail": 10.0, "zero": 0.0, "floating": _FLOATING_V}[wiring.unplugged]
            volts = np.full_like(volts, unplugged_V * float(np.sign(wiring.per_V)))
        if faults.force_floats_mN:
            since_s = sampling.floats_since_s = min(sampling.floats_since_s, float(time_s[0]))
            hum_mN = faults.force_floats_hum_mN * np.sin(2 * np.pi * _MAINS_HZ * time_s)
            floats_mN = faults.force_floats_mN + faults.force_floats_drift_mN_s * (time_s - since_s) + hum_mN
            volts = floats_mN / wiring.per_V + wiring.zero_V
        volts = volts + _converter_noise(sampling, wiring.range_V, len(volts))
        if faults.force_frozen:
            volts[:] = volts[0] if before is None else before["force_V"][-1]
        if faults.force_constant_V:
            volts[:] = faults.force_constant_V
        return np.asarray(volts)

    def _seen_counts(self, sampling: _Sampling, counts: FloatArray, before: dict[str, FloatArray] | None) -> FloatArray:
        """Return the counts that reach the card, with the faults of encoder and wires."""
        faults = self.faults.active
        if faults.encoder_stuck:
            return np.full_like(counts, 0.0 if before is None else before["encoder_counts"][-1])
        steps = np.diff(counts, prepend=sampling.last_count)
        sampling.last_count = float(counts[-1])
        lost = sampling.lost_counts + faults.encoder_lost_share * np.cumsum(steps)
        sampling.lost_counts = float(lost[-1])
        seen = counts - np.rint(lost) + (faults.encoder_added_counts - sampling.added_counts)
        if faults.encoder_jitter_counts:
            most = faults.encoder_jitter_counts
            seen = seen + sampling.noise.integers(-most, most, size=len(seen), endpoint=True)
        return seen


def _converter_noise(sampling: _Sampling, range_V: float, samples: int) -> FloatArray:
    return sampling.noise.normal(0.0, CONVERTER_NOISE * range_V, samples)
