"""The sampler of the real rig: force, position and further inputs on the card's sample clock."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from threading import Event as Signal
from threading import Lock

from dragrig.config.errors import DeviceError, SettingsError
from dragrig.config.lab import Calibration
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import LONGEST_BLOCK_S, Acquisition, Block, Clock
from dragrig.rig.hardware.card.connection import Connection
from dragrig.rig.hardware.card.faults import told_in_words
from dragrig.rig.hardware.card.fetching import Fetcher
from dragrig.rig.hardware.card.measuring import gather
from dragrig.rig.hardware.card.reader import Reader, Stretch
from dragrig.rig.hardware.card.scaling import Scaling
from dragrig.rig.hardware.card.tasks import SampledTasks, metres_per_count
from dragrig.rig.hardware.coupling import Coupling, FirstSample
from dragrig.rig.raw import RawReading
from dragrig.rig.runfile.model import Channel

AGGREGATE_HZ = 250_000
"""Samples per second that the PCI-6229 converts in all (PCI-6229 specifications)."""
_LONGEST_FETCH_S = LONGEST_BLOCK_S - 0.002
"""Leaves the guard its time, so that a condition stops the stage within one longest block."""


@dataclass(slots=True)
class _Armed:
    """An acquisition from arming to its end: tasks until they are started, then the reader that owns them."""

    tasks: SampledTasks
    samples: int
    started: bool = False
    reader: Reader | None = None


class CardSampler:
    """Samples by the card's own clock; a thread fetches, whoever calls `read` gets blocks.

    One thread arms, starts and reads; `stop` may come from any.

    Parameters
    ----------
    calibrations
        The calibrations that hold now, by quantity (force, encoder).
    coupling, clock
        What is shared with the stage: who moves, and the time of the first sample.
    fed
        Called whenever the program shows that it waits for samples or takes them.

    Raises
    ------
    SettingsError
        When the settings ask for more than the card can convert.
    """

    def __init__(
        self,
        connection: Connection,
        rig: RigSettings,
        calibrations: Mapping[str, Calibration],
        coupling: Coupling,
        clock: Clock,
        fed: Callable[[], None] = lambda: None,
    ) -> None:
        _refuse_too_fast(rig)
        self._connection, self._rig, self._coupling, self._clock, self._fed = connection, rig, coupling, clock, fed
        self._scaling = Scaling.of(rig, calibrations)
        self._rate_hz = rig.sampling.rate_hz
        # Half of what counts as stale, so that a healthy card cannot look stale.
        block_s = min(rig.sampling.block_s, _LONGEST_FETCH_S, rig.guard.stale_data_s / 2)
        self._block_samples = max(1, int(block_s * self._rate_hz + 1e-6))
        self._lock = Lock()
        self._armed: _Armed | None = None
        self._was_armed = False
        self._hung: Reader | None = None

    @property
    def sample_rate_hz(self) -> float:
        """Samples per second of every channel."""
        return self._rate_hz

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Force, position, and the further inputs of the settings."""
        return self._scaling.channels

    @property
    def force_range_mN(self) -> tuple[float, float]:
        """Forces at the ends of the force input's range."""
        return self._scaling.force_range_mN

    def arm(self, acquisition: Acquisition) -> None:
        """Reserve and program the card for an acquisition of the profile's length.

        Raises
        ------
        DeviceError
            When the acquisition before was not ended with `stop`, the stage moves, or the card refuses.
        """
        if self._armed is not None:
            raise DeviceError("the sampler is still armed for the acquisition before: stop it first.")
        if self._coupling.moving:
            raise DeviceError("the sampler cannot be armed while the stage moves: wait or stop it first.")
        tasks = self._tasks("it is armed")
        self._armed = _Armed(tasks, acquisition.profile.samples(self._rate_hz))
        self._was_armed = True
        self._coupling.arm()

    def start(self) -> None:
        """Take the first sample now, and tell the stage when that was.

        Raises
        ------
        DeviceError
            When the sampler is not armed, was started already, or the card refuses.
        """
        armed = self._armed
        if armed is None or armed.started:
            raise DeviceError("the sampler cannot start: arm it once for each acquisition.")
        armed.started = True
        if self._coupling.stopped:
            return
        with told_in_words(self._connection.card, "it starts"):
            armed.tasks.start(self._begin)
        with self._lock:
            if self._armed is armed:
                armed.reader = self._reader(armed)

    def read(self, cancel: Signal) -> Block | None:
        """Return the next block; None after the last one, after `stop`, and when `cancel` is set.

        Raises
        ------
        DeviceError
            When the sampler was not started, or the card fails.
        StaleDataError
            When nothing arrives for as long as `guard.stale_data_s`.
        """
        self._fed()
        armed = self._armed
        if armed is None and self._was_armed:
            return None
        if armed is None or not armed.started:
            raise DeviceError("the sampler has nothing to read: arm and start it first.")
        return None if armed.reader is None else armed.reader.take(cancel, self._fed)

    def stop(self) -> None:
        """End the acquisition and release the card. Waits no longer than a hanging driver is worth.

        Raises
        ------
        DeviceError
            When the driver does not return, or does not release the card.
        """
        with self._lock:
            armed, self._armed = self._armed, None
        self._coupling.disarm()
        if armed is None:
            return
        card = self._connection.card
        if armed.reader is None:
            with told_in_words(card, "it is released"):
                armed.tasks.close()
        elif not armed.reader.end(self._patience_s):
            self._hung = armed.reader
            raise DeviceError(
                f"the driver of card {card.device} has not returned for {self._patience_s:g} s: the card is held until "
                "it does; restart the program, and the computer if that does not help."
            )

    def measure(self, duration_s: float) -> RawReading:
        """Sample for a while, moving nothing, and return what converter and counter say, for a calibration.

        Raises
        ------
        DeviceError
            When the sampler is armed, or the card fails.
        StaleDataError
            When nothing arrives for as long as `guard.stale_data_s`.
        """
        if self._armed is not None:
            raise DeviceError("the sampler is armed for an acquisition: stop it before a measurement.")
        with told_in_words(self._connection.card, "it measures"):
            tasks = self._tasks("it measures")
            try:
                tasks.start(lambda start: start())
                volts, counts = gather(
                    self._fetcher(tasks),
                    max(1, round(duration_s * self._rate_hz)),
                    self._block_samples,
                    self._rig.guard.stale_data_s,
                    self._connection.card,
                    self._fed,
                )
            finally:
                tasks.close()
        return RawReading.of(volts, -counts if self._connection.card.encoder.reversed else counts)

    @property
    def _patience_s(self) -> float:
        return self._rig.hardware.hang_s + 1.0

    def _tasks(self, doing: str) -> SampledTasks:
        card = self._connection.card
        if self._hung is not None and self._hung.alive:
            raise DeviceError(
                f"card {card.device} is still held by a driver that does not return: restart the program, and the "
                "computer if that does not help."
            )
        with told_in_words(card, doing):
            return SampledTasks(self._connection, self._rig)

    def _begin(self, start: Callable[[], None]) -> None:
        before_s = self._clock.monotonic()
        start()
        after_s = self._clock.monotonic()
        self._coupling.begin(FirstSample((before_s + after_s) / 2, (after_s - before_s) / 2))

    def _fetcher(self, tasks: SampledTasks) -> Fetcher:
        inputs = len(self._scaling.channels) - 1
        return Fetcher(tasks.analog, tasks.encoder, inputs, self._block_samples, metres_per_count(self._rig))

    def _reader(self, armed: _Armed) -> Reader:
        return Reader(
            self._fetcher(armed.tasks),
            self._scaling,
            Stretch(armed.samples, self._block_samples, self._rate_hz, self._rig.guard.stale_data_s),
            self._coupling,
            self._connection.card,
            armed.tasks.close,
        )


def _refuse_too_fast(rig: RigSettings) -> None:
    inputs = 1 + len(rig.hardware.card.inputs)
    if inputs * rig.sampling.rate_hz > AGGREGATE_HZ:
        raise SettingsError(
            f"sampling.rate_hz = {rig.sampling.rate_hz:g} with {inputs} analog inputs is more than the "
            f"{AGGREGATE_HZ:,} samples per second that the card converts in all: set at most "
            f"{AGGREGATE_HZ // inputs:,}, or leave out some of hardware.card.inputs."
        )
