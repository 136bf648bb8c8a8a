"""The velocity loop: a thread that writes the next speeds as voltages and corrects them by the encoder, until it ends.

Everything is reckoned in the output's own samples, as the card counts them, so that neither this computer's clock nor
its haste shifts the command. What is written is put out `ahead` updates later at most; a stop takes as long to begin.
"""

import itertools
import threading
from collections.abc import Callable

from dragrig.config.errors import DeviceError, plain
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import Clock
from dragrig.rig.hardware.card.position import PositionCounter
from dragrig.rig.hardware.card.voltage import SAMPLING_STARTS, UnderflowError
from dragrig.rig.hardware.coupling import Coupling
from dragrig.rig.hardware.drive.feeding import Feeder
from dragrig.rig.hardware.drive.follower import Command, Follower
from dragrig.rig.hardware.drive.refusals import sets_out_s
from dragrig.rig.hardware.drive.standing import LONGEST_S, Standing
from dragrig.rig.profile import MotionProfile
from dragrig.rig.trips import Cause, Trip

_TRIES = 3


class VelocityLoop:
    """Output, counter and what they follow. Any thread may call anything; `brake` waits for nobody.

    Parameters
    ----------
    failed
        Called with what ended the loop or forbids motion, from whatever thread found out.
    cut
        Called when the stage cannot be braked by its voltage: takes the drive's power, and must not raise.
    over
        Called whenever a motion has ended.
    """

    def __init__(
        self,
        feeder: Feeder,
        follower: Follower,
        counter: PositionCounter,
        settings: RigSettings,
        coupling: Coupling,
        clock: Clock,
        failed: Callable[[Trip], None],
        cut: Callable[[], None],
        over: Callable[[], None],
    ) -> None:
        self._feeder, self._follower, self._counter = feeder, follower, counter
        self._coupling, self._clock, self._failed, self._cut, self._over = coupling, clock, failed, cut, over
        self._velocity, self._guard = settings.hardware.drive.velocity, settings.guard
        self._standing = Standing(
            settings.encoder.resolution_um / 1000.0,
            self._velocity.update_samples,
            round(LONGEST_S * self._velocity.rate_hz),
        )
        # Re-entrant, for whoever begins a motion also looks where it is.
        self._busy = threading.RLock()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        # A counter may be used by a signal handler that interrupts its own user; an Event may not.
        self._counting = itertools.count(1)
        self._stops = self._heeded = 0
        self.start_uncertainty_s = 0.0
        """How far time 0 of the last motion may be off the first sample."""

    @property
    def running(self) -> bool:
        """Whether it holds the stage."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def stops(self) -> int:
        """Which stop was asked for last: a mark for `follow`."""
        return self._stops

    def start(self) -> None:
        """Hold the stage where it is; raises `DeviceError` when the card refuses."""
        with self._busy:
            self._ended.clear()
            self._heeded = self._stops
            self._feeder.begin(Command.hold(self._counter.read()))
        self._thread = threading.Thread(target=self._run, name="velocity loop", daemon=True)
        self._thread.start()

    def follow(self, profile: MotionProfile, origin_mm: float, as_of: int, *, closed: bool = True) -> None:
        """Follow a profile from now on; with an armed sampler return at once, for the card begins it with the sampling.

        Parameters
        ----------
        as_of
            What `stops` was when this was planned: a stop since then ends it at once.
        closed
            Whether the encoder corrects it.

        Raises
        ------
        DeviceError
            When the loop has ended, or the card refuses.
        """
        with self._busy:
            if not self.running:
                raise DeviceError("the velocity loop has ended: switch the drive off and on.")
            self._heeded = as_of
            first = self._begin(Command(profile, origin_mm, 0.0, closed))
            self._coupling.set_moving(True)
        while not self._coupling.armed and self._coupling.moving and self._feeder.generated <= first:
            self._clock.sleep(1.0 / self._velocity.rate_hz, self._ended)

    def brake(self) -> int:
        """Come to a standstill; begins once what is written is put out. Return the mark that `stops` is now.

        Safe in any thread and in signal handlers.
        """
        self._stops = next(self._counting)
        return self._stops

    def look(self) -> float:
        """Return the position now, and tell the sampler when nothing moves any more; raises `DeviceError`."""
        with self._busy:
            if not self.running:
                return self._counter.read()
            generated, position_mm = self._observe()
            self._settle(generated, position_mm)
            return position_mm

    def held_mm(self) -> float:
        """Return the position that a stage at rest is held at; raises `DeviceError` when that cannot be read."""
        with self._busy:
            command = self._follower.command
            return command.end_mm if self.running and command.closed else self._counter.read()

    def recount(self, at_mm: float, *, index: bool) -> None:
        """Let the counter count on from a position and hold that; `index` lets the index pulse make it 0.

        Raises
        ------
        DeviceError
            When the card refuses.
        """
        with self._busy:
            self._counter.begin(at_mm, index=index)
            self._follower.follow(Command.rest() if index else Command.hold(at_mm))

    def end(self) -> None:
        """Brake, bring the voltage to 0, end the thread. Twice is once."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()

    def _begin(self, command: Command) -> float:
        rate_hz, sample = self._velocity.rate_hz, self._coupling.first_sample
        if self._coupling.armed and sample is None:
            self._feeder.drain()
            self._feeder.begin(command, SAMPLING_STARTS)
            self.start_uncertainty_s = 1.0 / rate_hz
            return 0.0
        first, self.start_uncertainty_s = float(self._feeder.written), 0.0
        if sample is not None:
            due = self._feeder.generated - (self._clock.monotonic() - sample.at_s) * rate_hz
            first = max(due, first - sets_out_s(command.profile) * rate_hz)
            self.start_uncertainty_s = sample.uncertainty_s + (first - due + 1.0) / rate_hz
        self._follower.follow(command.beginning(first))
        return first

    def _run(self) -> None:
        try:
            while not self._ended.is_set():
                with self._busy:
                    wait_s = self._turn()
                self._clock.sleep(wait_s, self._ended)
            with self._busy:
                self._feeder.drain()
                self._rest()
        except UnderflowError as error:
            self._give_up(Trip(Cause.WATCHDOG, plain(error)))
        except DeviceError as error:
            self._give_up(Trip(Cause.DRIVE_FAULT, plain(error)))
        except Exception as error:
            self._give_up(Trip(Cause.WATCHDOG, f"the velocity loop failed ({type(error).__name__}: {error})"))
            raise

    def _turn(self) -> float:
        generated, position_mm = self._observe()
        is_stopped, self._heeded = self._stops != self._heeded, self._stops
        if self._coupling.moving:
            if generated == 0 and (is_stopped or not self._coupling.armed):
                self._feeder.begin(Command.hold(position_mm))
                self._rest()
            elif is_stopped and not self._follower.braking:
                self._follower.brake()
                self._standing.forget()
        # A stage whose voltage ran dry has left its command too, and filling says why.
        if generated < self._feeder.written:
            self._refuse_to_run_away(generated, position_mm)
        wait_s = self._feeder.fill(generated)
        self._settle(generated, position_mm)
        return wait_s

    def _observe(self) -> tuple[int, float]:
        """Return how much was put out and the position at that time; keep the distance from the command."""
        longest = max(1, self._velocity.update_samples // 4)
        for _ in range(_TRIES):
            before = self._feeder.generated
            position_mm = self._counter.read()
            after = self._feeder.generated
            if after - before <= longest:
                # Sample `n - 1` is put out while `n` were.
                middle = (before + after - 1) / 2
                self._feeder.error_mm = self._follower.error_mm(middle, position_mm) if before else 0.0
                break
        return after, position_mm

    def _refuse_to_run_away(self, generated: int, position_mm: float) -> None:
        if trip := self._follower.off_command(generated, position_mm, self._feeder.error_mm, self._guard):
            self._feeder.error_mm = 0.0
            self._follower.brake()
            self._standing.forget()
            self._coupling.set_moving(True)
            self._failed(trip)

    def _settle(self, generated: int, position_mm: float) -> None:
        if not self._coupling.moving or generated == 0:
            return
        if not self._follower.braking:
            if self._follower.is_over(generated):
                self._rest()
            return
        if self._follower.stands and self._standing.is_seen(generated, self._feeder.written, position_mm):
            self._follower.follow(Command.hold(position_mm))
            self._rest()

    def _rest(self) -> None:
        self._coupling.set_moving(False)
        self._over()

    def _give_up(self, trip: Trip) -> None:
        self._failed(trip)
        try:
            self._feeder.zero()
            stands = self._standing.is_awaited(self._counter, self._clock, self._velocity.update_s)
        except DeviceError:
            stands = False
        if not stands:
            self._cut()
        self._rest()
