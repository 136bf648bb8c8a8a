"""Velocity mode on the doubles, at the settings' defaults: how well it follows, how still it holds, how soon it stops.

python bench/velocity.py [stops]
"""

import sys
import threading

import numpy as np

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.config.specimen import Capsule, Fixture, Specimen
from dragrig.rig.devices import Acquisition, BackendRequest, Contact
from dragrig.rig.profile import FloatArray, MotionProfile, Phase, Piece, stationary_piece, trapezoid
from dragrig.sim_backend.doubles.backend import DoubleBackend
from dragrig.sim_backend.doubles.simulated_bench import VELOCITY_LAG_S

RATE = 1000.0
NEVER = threading.Event()
RIG = RigSettings.model_validate(
    {
        "hardware": {
            "card": {"lines": {"heartbeat": "port1/line4"}},
            "drive": {"mode": "velocity", "homing_speed_mm_s": 50.0, "velocity": {"lag_s": VELOCITY_LAG_S}},
        },
        "stage": {"start_mm": 1.0},
    }
)


def stroke(travel_mm: float, speed_mm_s: float) -> MotionProfile:
    """Return a stroke with a rest before and a hold after it."""
    pieces = trapezoid(travel_mm, speed_mm_s, 2000.0)
    return MotionProfile.from_pieces((stationary_piece(0.2, Phase.REST), *pieces, stationary_piece(1.0, Phase.HOLD)))


def sine(speed_mm_s: float, period_s: float) -> MotionProfile:
    """Return two periods of a speed like a sine, in steps of 10 ms."""
    time_s = np.arange(0.0, 2 * period_s + 0.005, 0.01)
    changes = np.diff(speed_mm_s * np.sin(2 * np.pi * time_s / period_s)) / 0.01
    return MotionProfile.from_pieces(
        (*(Piece(0.01, change, Phase.STEADY) for change in changes), stationary_piece(1.0, Phase.HOLD))
    )


def record(backend: DoubleBackend, profile: MotionProfile, stop_s: float = np.inf) -> tuple[FloatArray, float]:
    """Return the sampled positions of a run without a gut, and when it was stopped, if it was."""
    capsule = Capsule(name="none", surface="smooth", diameter_mm=12.9, length_mm=15.2, mass_g=50.0)
    backend.sampler.arm(
        Acquisition("bench", 0, "bench", profile, capsule, Specimen(name="none"), Fixture.NONE, Contact.NONE, 0.0)
    )
    backend.stage.move(profile)
    backend.sampler.start()
    parts, stopped_s = [], np.nan
    while (block := backend.sampler.read(NEVER)) is not None:
        parts.append(block.channels["position"])
        if block.end_index / RATE >= stop_s and np.isnan(stopped_s):
            stopped_s = backend.clock.monotonic() - backend.bench.began_s
            backend.stage.stop()
    backend.sampler.stop()
    return np.concatenate(parts).astype(np.float64), stopped_s


class Bench:
    """Runs that are repeated when the voltage ran dry, and how often that was."""

    def __init__(self, backend: DoubleBackend) -> None:
        self._backend = backend
        self.runs = self.dry = 0

    def record(self, profile: MotionProfile, stop_s: float = np.inf) -> tuple[FloatArray, float]:
        """Return what `record` does of a run that nothing disturbed."""
        start_mm = self._backend.stage.state().position_mm
        while True:
            self.runs += 1
            seen = record(self._backend, profile, stop_s)
            if self._backend.stage.fault is None:
                return seen
            self.dry += 1
            self._backend.stage.disable()
            self._backend.stage.enable()
            back_mm = start_mm - self._backend.stage.state().position_mm
            if abs(back_mm) > 0.1:
                record(self._backend, stroke(back_mm, 40.0))


def main(stops: int) -> None:
    """Print what is measured."""
    backend = DoubleBackend(BackendRequest(RIG, FrictionModelSettings()))
    try:
        backend.stage.enable()
        backend.stage.home()
        bench = Bench(backend)
        for name, profile in (
            ("stroke at 1 mm/s", stroke(2.0, 1.0)),
            ("stroke at 40 mm/s", stroke(40.0, 40.0)),
            ("stroke at 100 mm/s", stroke(60.0, 100.0)),
            ("sine up to 60 mm/s", sine(60.0, 1.0)),
        ):
            seen, _ = bench.record(profile)
            off_um = 1000.0 * (seen - profile.position(np.arange(len(seen)) / RATE))
            print(
                f"{name}: at most {np.abs(off_um).max():.0f} µm off, rms {off_um.std():.1f} µm, "
                f"{off_um[-1]:+.0f} µm after 1 s of hold"
            )
        held = []
        for _ in range(100):
            backend.clock.sleep(0.05, NEVER)
            held.append(1000.0 * backend.bench.position_mm())
        print(f"held for 5 s: within {np.ptp(held):.1f} µm")
        begins, ends = [], []
        for direction in [1.0, -1.0] * ((stops + 1) // 2):
            seen, stopped_s = bench.record(stroke(direction * 21.0, 60.0), 0.45)
            speed = np.abs(np.gradient(seen)) * RATE
            begins.append((np.flatnonzero(speed > 59.0)[-1] + 1) / RATE - stopped_s)
            ends.append((np.flatnonzero(speed > 0.5)[-1] + 1) / RATE - stopped_s)
        for subject, times in (("braking begins", begins), ("the stage stands", ends)):
            ms = 1000.0 * np.array(times)
            print(
                f"{subject} {np.median(ms):.0f} ms after stop(), at most {ms.max():.0f} ms ({len(ms)} stops at 60 mm/s)"
            )
        print(f"{bench.dry} of {bench.runs} runs ended early, because this computer let the voltage run dry")
    finally:
        backend.close()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
