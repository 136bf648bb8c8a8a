"""The real rig's backend on doubles of its devices: for a newcomer to see, and for tests to break."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from threading import Event as Signal

from dragrig.rig.devices import Acquisition, BackendRequest, Block, Clock, RawReading, RigCheck, Sampler, Stage
from dragrig.rig.hardware.backend import HardwareBackend
from dragrig.rig.hardware.dialects.base import find_dialect
from dragrig.rig.runfile.model import RecordedChannel
from dragrig.sim_backend.devices.variability import draw_specimen_model
from dragrig.sim_backend.doubles.c_library import installed
from dragrig.sim_backend.doubles.card.card import Card
from dragrig.sim_backend.doubles.drive_double import make_drive_double
from dragrig.sim_backend.doubles.serial_ports import SocketPort
from dragrig.sim_backend.doubles.simulated_bench import DoubleClock, FaultInjector, SimulatedBench


class NotifyingSampler:
    """The real sampler, with the bench told what every acquisition meets: the one thing no wire carries."""

    def __init__(self, sampler: Sampler, tell: Callable[[Acquisition], None]) -> None:
        self._sampler = sampler
        self._tell = tell

    @property
    def sample_rate_hz(self) -> float:
        """Samples per second of every channel."""
        return self._sampler.sample_rate_hz

    @property
    def channels(self) -> tuple[RecordedChannel, ...]:
        """What each block holds."""
        return self._sampler.channels

    @property
    def force_range_mN(self) -> tuple[float, float]:
        """Least and greatest force that the input can tell."""
        return self._sampler.force_range_mN

    def arm(self, acquisition: Acquisition) -> None:
        """Tell the bench, then prepare the acquisition."""
        self._tell(acquisition)
        self._sampler.arm(acquisition)

    def start(self) -> None:
        """Take the first sample now."""
        self._sampler.start()

    def read(self, cancel: Signal) -> Block | None:
        """Return the next block."""
        return self._sampler.read(cancel)

    def stop(self) -> None:
        """End the acquisition."""
        self._sampler.stop()

    def measure(self, duration_s: float) -> RawReading:
        """Return raw volts and counts."""
        return self._sampler.measure(duration_s)


class DoubleBackend:
    """The real rig's own code, from plan to plug, with doubles on the far side of NI's library and of the serial port.

    Its run files say that they are simulated, for no gut was ever touched.

    Parameters
    ----------
    faults
        What goes wrong; nothing unless given.
    """

    def __init__(self, request: BackendRequest, faults: FaultInjector | None = None) -> None:
        rig = request.rig
        simulated = rig.simulated
        drawn = draw_specimen_model(request.model, simulated.seed) if simulated.variation.specimen else request.model
        self._facts: dict[str, str | float | int | bool] = {
            "double": "hardware",
            "seed": simulated.seed,
            "model": request.model.name,
            "specimen_drawn": simulated.variation.specimen,
        }
        clock = DoubleClock(request.pace, request.origin)
        self.bench = SimulatedBench(rig, drawn, clock, faults)
        """The bench, for whoever wants to look behind the wires."""
        with ExitStack() as stack:
            self.drive = stack.enter_context(make_drive_double(self.bench, find_dialect(rig.hardware.drive.dialect)))
            """The drive, as its maker sees it."""
            port = stack.enter_context(SocketPort(self.drive))
            stack.enter_context(installed(Card(self.bench, self.bench.put_out)))
            wired = rig.model_copy(
                update={
                    "hardware": rig.hardware.model_copy(
                        update={
                            "card": rig.hardware.card.model_copy(update={"server": ""}),
                            "drive": rig.hardware.drive.model_copy(update={"port": port.address}),
                        }
                    )
                }
            )
            self._real = HardwareBackend(replace(request, rig=wired), clock)
            if request.connect:
                self._real.connect()
            self._open = stack.pop_all()

    @property
    def name(self) -> str:
        """Name that the run files carry."""
        return "simulated"

    @property
    def needs_hands(self) -> bool:
        """Asks for a person as the real rig does."""
        return self._real.needs_hands

    @property
    def stage(self) -> Stage:
        """The real stage on the drive's double."""
        return self._real.stage

    @property
    def sampler(self) -> Sampler:
        """The real sampler on the card's double."""
        return NotifyingSampler(self._real.sampler, self.bench.present)

    @property
    def clock(self) -> Clock:
        """Time as the doubles have it."""
        return self._real.clock

    def description(self) -> Mapping[str, str | float | int | bool]:
        """Return what the real rig says of itself, and that it is none."""
        return {**self._real.description(), **self._facts}

    def examine(self) -> Iterator[RigCheck]:
        """Look at every double as at the real devices."""
        yield from self._real.examine()

    def hang(self, load_mN: float) -> None:
        """Hang a load on the force sensor."""
        self.bench.faults.inject(force_added_mN=load_mN)

    def push(self, distance_mm: float, within_s: float) -> None:
        """Push the carriage during the next measurement."""
        self.bench.push(distance_mm, within_s)

    def close(self) -> None:
        """Let go of everything, the doubles last."""
        self._real.close()
        self._open.close()


def open_backend(request: BackendRequest) -> DoubleBackend:
    """Open the real rig's backend on doubles of card and drive."""
    return DoubleBackend(request)
