"""The simulated rig as a whole, its virtual clock, and the factory that opens it."""

import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from threading import Event as Signal

from dragrig.config import FrictionModelSettings, RigSettings
from dragrig.rig import BackendRequest, Clock, RigCheck, RigMemory, WallClock, with_utc_offset
from dragrig.sim_backend.devices.simulated_sampler import LeftContact, SimulatedSampler
from dragrig.sim_backend.devices.simulated_stage import (
    UNDISTURBED,
    Disturbances,
    PositionEncoder,
    SimulatedAxis,
    SimulatedStage,
)
from dragrig.sim_backend.devices.variability import draw_specimen_model
from dragrig.sim_backend.effects import active_effects


class VirtualClock:
    """A clock that advances by the durations slept, without waiting.

    It may be read and advanced from any thread.
    """

    def __init__(self, origin: datetime | None = None) -> None:
        self._origin = with_utc_offset(origin)
        self._elapsed_s = 0.0
        self._lock = threading.Lock()

    def now(self) -> datetime:
        """Time of day, with offset."""
        return self._origin + timedelta(seconds=self._elapsed_s)

    def monotonic(self) -> float:
        """Seconds since the clock was made."""
        return self._elapsed_s

    def sleep(self, duration_s: float, cancel: Signal) -> bool:
        """Advance by `duration_s` at once; return False without advancing when `cancel` is set."""
        if cancel.is_set():
            return False
        if duration_s > 0:
            with self._lock:
                self._elapsed_s += duration_s
        return True


@dataclass(frozen=True, slots=True)
class _Kept:
    """A simulated rig's part of the rig's memory."""

    position_mm: float
    homed: bool
    left: LeftContact | None


class SimulatedBackend:
    """The simulated rig and gut.

    Parameters
    ----------
    model
        The nominal model; with `variation.specimen` a specimen is drawn around it once, here.
    first_run_at
        When the campaign's first run began, if the session resumes one.
    memory
        Position, home and contact that the rig was closed with before, and into which `close` puts them.

    Raises
    ------
    SettingsError
        For impossible effects of the model.
    """

    name = "simulated"
    """Name that the run files carry."""
    needs_hands = False
    """Nothing here needs an operator."""

    def __init__(
        self,
        rig: RigSettings,
        model: FrictionModelSettings,
        clock: Clock,
        disturbances: Disturbances = UNDISTURBED,
        first_run_at: datetime | None = None,
        memory: RigMemory | None = None,
    ) -> None:
        active_effects(model)
        self._rig = rig
        self._model_name = model.name
        self._clock = clock
        drawn = draw_specimen_model(model, rig.simulated.seed) if rig.simulated.variation.specimen else model
        axis = SimulatedAxis(clock, 1.0 / rig.sampling.rate_hz, rig.stage.stop_accel_mm_s2)
        self._stage = SimulatedStage(rig.stage, axis, PositionEncoder.of(rig.encoder), disturbances)
        self._sampler = SimulatedSampler(rig, drawn, clock, axis, disturbances, first_run_at)
        self._memory = memory or RigMemory()
        if isinstance(before := self._memory.kept, _Kept):
            axis.place(before.position_mm)
            self._stage.homed, self._sampler.left = before.homed, before.left

    # Properties, so that an add-on that derives from this may put devices of its own in their place.

    @property
    def stage(self) -> SimulatedStage:
        """The simulated stage."""
        return self._stage

    @property
    def sampler(self) -> SimulatedSampler:
        """The simulated sampler."""
        return self._sampler

    @property
    def clock(self) -> Clock:
        """The clock of the simulated rig."""
        return self._clock

    def description(self) -> Mapping[str, str | float | int | bool]:
        """Return seed, sensor, model and whether the specimen was drawn at random; not the values drawn."""
        return {
            "sensor_serial": self._rig.force_sensor.serial or "simulated",
            "seed": self._rig.simulated.seed,
            "model": self._model_name,
            "specimen_drawn": self._rig.simulated.variation.specimen,
        }

    def examine(self) -> Iterator[RigCheck]:
        """Report model and seed; there is no hardware to check."""
        yield RigCheck("rig", True, f"simulated: model {self._model_name}, seed {self._rig.simulated.seed}")

    def close(self) -> None:
        """Stop the stage, end the acquisition and switch the drive off."""
        self.stage.stop()
        self.sampler.stop()
        self.stage.disable()
        state = self.stage.state()
        self._memory.kept = _Kept(state.position_mm, state.homed, self.sampler.left)

    def hang(self, load_mN: float) -> None:
        """Hang a load on the force sensor, in place of the capsule."""
        self.sampler.hang(load_mN)

    def push(self, distance_mm: float, within_s: float) -> None:
        """Push the stage during the next measurement."""
        del within_s
        self.sampler.push(distance_mm)

    def press(self, switch: str, *, on: bool) -> None:
        """Do nothing: no wire leads to a switch here."""


def open_backend(request: BackendRequest, disturbances: Disturbances = UNDISTURBED) -> SimulatedBackend:
    """Return a simulated rig in virtual time, or in real time when requested.

    `disturbances` are for tests; a backend opened by name has none.
    """
    clock: Clock = WallClock(request.origin) if request.real_time else VirtualClock(request.origin)
    return SimulatedBackend(request.rig, request.model, clock, disturbances, request.first_run_at, request.memory)
