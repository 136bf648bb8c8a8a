"""How much faster than real time the simulated rig makes the `paper` plan, model and devices in memory.

Run `python bench/simulation.py`. Rests, prompts and ways back are not counted.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import threading
import time
from collections.abc import Callable

import numpy as np

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.plan import Plan
from dragrig.config.rig import RigSettings
from dragrig.config.settings import find_settings
from dragrig.config.specimen import Specimen
from dragrig.rig.devices import Acquisition, Backend, BackendRequest
from dragrig.rig.programme import PlannedRun, build_programme
from dragrig.sim_backend.devices import open_backend
from dragrig.sim_backend.devices.simulated_sampler import CHUNK_SAMPLES, SimulatedChannels
from dragrig.sim_backend.devices.simulated_stage import UNDISTURBED
from dragrig.sim_backend.devices.variability import force_noise, motor_noise
from dragrig.sim_backend.friction import prepare

REPEATS = 7
RIG = RigSettings()
MODEL = FrictionModelSettings()
RATE_HZ = RIG.sampling.rate_hz


def acquisition(order: int, run: PlannedRun) -> Acquisition:
    """Return what the engine asks for, one minute after the insertion."""
    return Acquisition(
        run_id=f"bench-{order}",
        order=order,
        kind=run.protocol.kind,
        profile=run.profile,
        capsule=run.capsule,
        specimen=run.specimen,
        fixture=run.fixture,
        contact=run.contact,
        insertion_dwell_s=60.0,
        shear_strain=run.shear_strain,
        sheared_from=run.sheared_from,
    )


def whole(backend: Backend, programme: list[Acquisition]) -> int:
    """Arm, move and read every block; returns the number of samples."""
    cancel = threading.Event()
    samples = 0
    for entry in programme:
        backend.stage.home()
        backend.sampler.arm(entry)
        backend.stage.move(entry.profile)
        backend.sampler.start()
        while (block := backend.sampler.read(cancel)) is not None:
            samples += block.samples
        backend.sampler.stop()
    return samples


def chunks(item: Acquisition) -> list[tuple[int, int]]:
    """Return stretches of samples as the sampler computes them."""
    total = item.profile.samples(RATE_HZ)
    return [(first, min(first + CHUNK_SAMPLES, total)) for first in range(0, total, CHUNK_SAMPLES)]


def friction(programme: list[Acquisition]) -> None:
    """Prepare and evaluate the friction alone."""
    for entry in programme:
        prepared = prepare(entry, MODEL)
        for first, end in chunks(entry):
            prepared.force(np.arange(first, end) / RATE_HZ)


def noise(programme: list[Acquisition]) -> None:
    """Draw the noise of sensor and motor alone."""
    simulated = RIG.simulated
    for entry in programme:
        force = force_noise(simulated.noise, simulated.seed, entry, RATE_HZ)
        motor = motor_noise(simulated.motor, simulated.seed, entry)
        for first, end in chunks(entry):
            force.read(first, end)
            motor.read(first, end)


def signals(programme: list[Acquisition]) -> None:
    """Compute all channels, without stage, clock and blocks."""
    for entry in programme:
        computed = SimulatedChannels(RIG, MODEL, entry, UNDISTURBED)
        for first, end in chunks(entry):
            computed.compute(first, end, RIG.stage.start_mm)


def best_of(work: Callable[[], object]) -> float:
    """Return the shortest time [s] of several rounds, after one to warm up."""
    work()
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return min(times)


def main() -> None:
    """Print the ratio and where the time goes."""
    plan = find_settings(Plan, "plan", "paper")
    runs = build_programme(plan, find_settings(Specimen, "specimen", "jejunum"), 0.0, "paper").runs
    programme = [acquisition(order, run) for order, run in enumerate(runs) if run.follows < 0]
    backend = open_backend(BackendRequest(RIG, MODEL))
    backend.stage.enable()
    samples = whole(backend, programme)
    blocks = sum(-(-entry.profile.samples(RATE_HZ) // round(RIG.sampling.block_s * RATE_HZ)) for entry in programme)
    recorded_s = samples / RATE_HZ

    total = best_of(lambda: whole(backend, programme))
    signals_s = best_of(lambda: signals(programme))
    friction_s = best_of(lambda: friction(programme))
    noise_s = best_of(lambda: noise(programme))

    print(f"{len(programme)} runs, {recorded_s:.0f} s at {RATE_HZ:g} Hz, {samples} samples in {blocks} blocks")
    print(f"whole     {total * 1e3:8.1f} ms  {total / samples * 1e6:6.3f} µs a sample")
    for name, part in (
        ("friction", friction_s),
        ("noise", noise_s),
        ("devices", signals_s - friction_s - noise_s),
        ("blocks", total - signals_s),
    ):
        print(f"  {name:8}{part * 1e3:8.1f} ms  {part / samples * 1e6:6.3f} µs a sample  {part / total:4.0%}")
    print(f"          {(total - signals_s) / blocks * 1e6:8.1f} µs a block")
    print(f"{recorded_s / total:.0f} × real time (at least 2000 asked for)")


if __name__ == "__main__":
    main()
