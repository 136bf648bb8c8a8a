"""The real rig's backend on doubles of its devices: for a newcomer to see, and for tests to break."""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace

from dragrig.rig import BackendRequest
from dragrig.rig.hardware import HardwareBackend
from dragrig.rig.hardware.dialects import fitting_dialect
from dragrig.sim_backend.devices import draw_specimen_model
from dragrig.sim_backend.doubles.c_library import installed
from dragrig.sim_backend.doubles.card import Card
from dragrig.sim_backend.doubles.drive_double import make_drive_double
from dragrig.sim_backend.doubles.protocol_double import DoublePort
from dragrig.sim_backend.doubles.simulated_bench import DoubleClock, FaultInjector, SimulatedBench


class DoubleBackend(HardwareBackend):
    """The real rig's own code, from plan to plug, with doubles on the far side of NI's library and of the serial port.

    Its run files say that they are simulated, for no gut was ever touched.

    Parameters
    ----------
    faults
        Faults (default: none).
    """

    name = "simulated"
    """Name that the run files carry."""

    def __init__(self, request: BackendRequest, faults: FaultInjector | None = None) -> None:
        rig = request.rig
        fitting_dialect(rig.hardware)
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
            self.drive = stack.enter_context(make_drive_double(self.bench))
            """The drive, as its maker sees it."""
            port = stack.enter_context(DoublePort(self.drive))
            stack.enter_context(installed(Card(self.bench)))
            card = rig.hardware.card.model_copy(update={"server": ""})
            drive = rig.hardware.drive.model_copy(update={"port": port.address})
            hardware = rig.hardware.model_copy(update={"card": card, "drive": drive})
            wired = rig.model_copy(update={"hardware": hardware})
            # What an acquisition meets is the one thing that no wire carries.
            super().__init__(replace(request, rig=wired), clock, self.bench.present)
            self._open.push(stack.pop_all())  # first, so that the doubles are closed last
        if request.connect:
            self.connect()

    def description(self) -> Mapping[str, str | float | int | bool]:
        """Return the real rig's description of itself, and that it is none."""
        return {**super().description(), **self._facts}

    def hang(self, load_mN: float) -> None:
        """Hang a load on the force sensor."""
        self.bench.faults.inject(force_added_mN=load_mN)

    def push(self, distance_mm: float, within_s: float) -> None:
        """Push the carriage, now or during the next measurement."""
        self.bench.push(distance_mm, within_s)

    def press(self, switch: str, *, on: bool) -> None:
        """Press a switch or release it."""
        self.bench.faults.inject(**{f"{switch}_pressed": on})


def open_backend(request: BackendRequest) -> DoubleBackend:
    """Open the real rig's backend on doubles of card and drive."""
    return DoubleBackend(request)
