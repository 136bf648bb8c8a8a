"""What the tests of velocity mode share: the real rig on doubles, in a time that a stalled computer stalls too."""

import math
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from threading import Event as Signal

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import BackendRequest
from dragrig.rig.hardware.backend import HardwareBackend
from dragrig.rig.profile import FloatArray
from dragrig.sim_backend.doubles.c_library import installed
from dragrig.sim_backend.doubles.card.card import Card
from dragrig.sim_backend.doubles.drive_double import DriveDouble, make_drive_double
from dragrig.sim_backend.doubles.simulated_bench import DoubleClock, SimulatedBench
from driving import ANY_PORT, until
from simulated import settings

RATE = 1000.0
UPDATE_S, AHEAD, LAG_S = 0.03, 5, 0.002
LEAD_S = UPDATE_S * AHEAD


class StallingClock(DoubleClock):
    """Wall time, but no more than 5 ms between two readings, and never past the voltages that are written.

    So threads that starve on a busy machine miss nothing: the drive's double reads the clock every 2 ms, and a voltage
    never runs out unless `waits_for_voltage` is False.
    """

    max_step_s = 0.005

    def __init__(self) -> None:
        super().__init__()
        self._reading = threading.Lock()
        self._read_s, self._passed_s = time.perf_counter(), 0.0
        self._written_until_s = math.inf
        self.waits_for_voltage = True

    def monotonic(self) -> float:
        with self._reading:
            now_s = time.perf_counter()
            passed_s = self._passed_s + min(now_s - self._read_s, self.max_step_s)
            if self.waits_for_voltage:
                passed_s = min(passed_s, self._written_until_s)
            self._passed_s = max(self._passed_s, passed_s)
            self._read_s = now_s
            return self._passed_s

    def put_out(self, volts: FloatArray, rate_hz: float, at_s: float) -> None:
        """Stop at the end of these voltages, until others follow; one that is held has no end."""
        self._written_until_s = at_s + (len(volts) - 0.5) / rate_hz if rate_hz else math.inf

    def sleep(self, duration_s: float, cancel: Signal) -> bool:
        until_s = self.monotonic() + duration_s
        while (left_s := until_s - self.monotonic()) > 0:
            if cancel.wait(left_s):
                return False
        return not cancel.is_set()


class VoltageRig(HardwareBackend):
    """The real rig in velocity mode, and the doubles that it does not know of."""

    def __init__(self, request: BackendRequest, bench: SimulatedBench, drive: DriveDouble) -> None:
        super().__init__(request, bench.clock)
        self.bench, self.drive = bench, drive
        self.doubles = ExitStack()

    def close(self) -> None:
        self.bench.faults.clear()
        super().close()
        self.doubles.close()

    @property
    def is_under_way(self) -> bool:
        return abs(self.bench.speed_mm_s()) > 10.0

    @property
    def stands(self) -> bool:
        return not self.stage.state().moving and abs(self.bench.speed_mm_s()) < 0.1

    def await_standstill(self) -> None:
        until(lambda: self.stands)

    def ready(self) -> "VoltageRig":
        self.stage.enable()
        self.stage.home()
        return self


def velocity_rig(
    encoder: dict[str, object] | None = None,
    heartbeat_s: float = 0.5,
    hang_s: float = 5.0,
    silence_s: float = 5.0,
    reply_s: float = 2.0,
    **voltage: object,
) -> RigSettings:
    velocity = {"update_s": UPDATE_S, "ahead": AHEAD, "lag_s": LAG_S, "gain_per_s": 4.0, **voltage}
    drive = {
        "mode": "velocity",
        "homing_speed_mm_s": 50.0,
        "silence_s": silence_s,
        "reply_s": reply_s,
        "velocity": velocity,
    }
    lines = {"heartbeat": "port1/line4", "heartbeat_s": heartbeat_s}
    return settings(
        RATE,
        hardware={"card": {"lines": lines, "encoder": encoder or {}}, "drive": drive, "hang_s": hang_s},
        stage={"start_mm": 1.0},
        guard={"stale_data_s": 5.0},
    )


class _StallingBench(SimulatedBench):
    """A bench whose clock learns what is put out."""

    clock: StallingClock

    def put_out(self, output: str, volts: FloatArray, rate_hz: float, at_s: float) -> None:
        self.clock.put_out(volts, rate_hz, at_s)
        super().put_out(output, volts, rate_hz, at_s)


def open_voltage_rig(rig: RigSettings) -> VoltageRig:
    clock = StallingClock()
    bench = _StallingBench(rig, FrictionModelSettings(), clock)
    with ExitStack() as opened:
        drive = opened.enter_context(make_drive_double(bench))
        port = opened.enter_context(ANY_PORT(drive))
        opened.enter_context(installed(Card(bench)))
        reached = rig.hardware.drive.model_copy(update={"port": port.address})
        wired = rig.model_copy(update={"hardware": rig.hardware.model_copy(update={"drive": reached})})
        backend = VoltageRig(BackendRequest(wired, FrictionModelSettings()), bench, drive)
        backend.connect()
        backend.doubles = opened.pop_all()
        return backend


@contextmanager
def voltage_rig(rig: RigSettings | None = None) -> Iterator[VoltageRig]:
    backend = open_voltage_rig(rig or velocity_rig())
    try:
        yield backend
    finally:
        backend.close()
