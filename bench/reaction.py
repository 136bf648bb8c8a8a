"""How long the guard takes on the real rig's code, on doubles: from a condition to the stop command at the drive.

An e-stop, a limit switch and an alarm stop the drive by itself; here only the program's own command counts.

Run `python bench/reaction.py [--rounds 20]`. The bar is one block, 50 ms, and one round trip on the serial link.
"""

import argparse
import threading
import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.config.specimen import Capsule, Fixture, Specimen
from dragrig.rig.devices import Acquisition, BackendRequest, Contact
from dragrig.rig.engine import Engine
from dragrig.rig.guard import Guard
from dragrig.rig.hardware.dialects.base import Command
from dragrig.rig.profile import MotionProfile, Phase, stationary_piece, trapezoid
from dragrig.sim_backend.doubles.backend import DoubleBackend

SPEED_MM_S = 20.0
CONDITIONS: Mapping[str, Mapping[str, float | str]] = {
    "force over the limit": {"force_added_mN": 9000.0},
    "sensor open": {"sensor_open": True},
    "e-stop": {"e_stop_pressed": True},
    "upper limit switch": {"limit_high_pressed": True},
    "drive alarm": {"drive_alarm": "overcurrent"},
}
RIG = RigSettings.model_validate({"stage": {"start_mm": 5.0}, "hardware": {"drive": {"homing_speed_mm_s": 50.0}}})
ACQUISITION = Acquisition(
    run_id="bench",
    order=0,
    kind="drag",
    profile=MotionProfile.from_pieces(
        (stationary_piece(0.1, Phase.REST), *trapezoid(60.0, SPEED_MM_S, 1000.0), stationary_piece(0.1, Phase.HOLD))
    ),
    capsule=Capsule(name="smooth", surface="smooth", diameter_mm=12.9, length_mm=15.2, mass_g=50.1),
    specimen=Specimen(name="none"),
    fixture=Fixture.NONE,
    contact=Contact.NONE,
    insertion_dwell_s=0.0,
)


def reaction_s(double: DoubleBackend, guard: Guard, condition: Mapping[str, float | str], wait_s: float) -> float:
    """Start a motion, let something go wrong in the middle of it, and wait for the stop."""
    stops = count_stops(double)
    worker = threading.Thread(target=lambda: Engine(double, RIG, guard).acquire(replace(ACQUISITION)))
    worker.start()
    while double.bench.speed_mm_s() < SPEED_MM_S - 0.1:
        time.sleep(0.001)
    time.sleep(wait_s)
    struck_s = time.perf_counter()
    double.bench.faults.inject(**condition)
    while count_stops(double) == stops:
        time.sleep(0.0002)
    took_s = time.perf_counter() - struck_s
    worker.join()
    return took_s


def count_stops(double: DoubleBackend) -> int:
    """How many stop commands the drive has heard."""
    return sum(request.command is Command.STOP for request in double.drive.requests)


def main() -> None:
    """Print the reaction to each condition."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--rounds", type=int, default=20)
    rounds = options.parse_args().rounds
    random = np.random.default_rng(1)
    for name, condition in CONDITIONS.items():
        took = []
        for _ in range(rounds):
            double = DoubleBackend(BackendRequest(RIG, FrictionModelSettings()))
            double.bench.place(1.0)
            guard = Guard(RIG.guard)
            guard.reset(double.stage.state())
            double.stage.enable()
            double.stage.home()
            took.append(reaction_s(double, guard, condition, float(random.uniform(0.0, 0.1))))
            double.close()
        times_ms = 1000 * np.array(took)
        print(
            f"{name:22} median {np.median(times_ms):5.1f} ms, worst {times_ms.max():5.1f} ms, in {rounds} rounds; "
            f"{SPEED_MM_S * times_ms.max() / 1000:.2f} mm at {SPEED_MM_S:g} mm/s"
        )


if __name__ == "__main__":
    main()
