"""What the tests of velocity mode share: the real rig on doubles, in a time that a stalled computer stalls too."""

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from threading import Event as Signal

from driving import until
from simulated import settings

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import BackendRequest
from dragrig.rig.hardware.backend import HardwareBackend
from dragrig.rig.hardware.dialects.base import find_dialect
from dragrig.sim_backend.doubles.c_library import installed
from dragrig.sim_backend.doubles.card.card import Card
from dragrig.sim_backend.doubles.drive_double import DriveDouble, make_drive_double
from dragrig.sim_backend.doubles.serial_ports import SocketPort
from dragrig.sim_backend.doubles.simulated_bench import DoubleClock, SimulatedBench

RATE = 1000.0
UPDATE_S, AHEAD, LAG_S = 0.03, 5, 0.002
LEAD_S = UPDATE_S * AHEAD


class StallingClock(DoubleClock):
    """The wall's pace, but no more than 5 ms between two looks at it: threads that starve together miss nothing.

    The drive's double looks every 2 ms.
    """

    longest_step_s = 0.005

    def __init__(self) -> None:
        super().__init__()
        self._looking = threading.Lock()
        self._looked_s, self._passed_s = time.perf_counter(), 0.0

    def monotonic(self) -> float:
        with self._looking:
            now_s = time.perf_counter()
            self._passed_s += min(now_s - self._looked_s, self.longest_step_s)
            self._looked_s = now_s
            return self._passed_s

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


def velocity_rig(encoder: dict[str, object] | None = None, heartbeat_s: float = 0.3, **voltage: object) -> RigSettings:
    velocity = {"update_s": UPDATE_S, "ahead": AHEAD, "lag_s": LAG_S, "gain_per_s": 4.0, **voltage}
    drive = {"mode": "velocity", "homing_speed_mm_s": 50.0, "silence_s": 5.0, "reply_s": 0.5, "velocity": velocity}
    lines = {"heartbeat": "port1/line4", "heartbeat_s": heartbeat_s}
    return settings(
        RATE,
        hardware={"card": {"lines": lines, "encoder": encoder or {}}, "drive": drive, "hang_s": 1.0},
        stage={"start_mm": 1.0},
        guard={"stale_data_s": 1.0},
    )


def open_voltage_rig(rig: RigSettings) -> VoltageRig:
    bench = SimulatedBench(rig, FrictionModelSettings(), StallingClock())
    with ExitStack() as opened:
        drive = opened.enter_context(make_drive_double(bench, find_dialect(rig.hardware.drive.dialect)))
        port = opened.enter_context(SocketPort(drive))
        opened.enter_context(installed(Card(bench, bench.put_out)))
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
