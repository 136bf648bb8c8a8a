"""How fast the friction model is: `python bench/friction_speed.py`.

Each profile is prepared and evaluated at 1 kHz, best of several repeats on one core; the last line is the
whole speed sweep of the paper, each speed prepared anew.
"""

import time
from collections.abc import Callable

import numpy as np

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Capsule, Fixture, Specimen
from dragrig.rig.devices import Acquisition, Contact
from dragrig.rig.profile import MotionProfile, Phase, stationary_piece, trapezoid
from dragrig.sim_backend.friction import RecordedMotion, prepare

RATE_HZ = 1000.0
REPEATS = 15
SPEEDS_MM_S = (0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 60.0)
CAPSULE = Capsule(name="rough", surface="rough", diameter_mm=12.9, length_mm=15.2, mass_g=50.1)
MODEL = FrictionModelSettings()


def acquisition(
    *strokes: tuple[float, float], fixture: Fixture = Fixture.FOAM, contact: Contact = Contact.SLIDING
) -> Acquisition:
    """One run of trapezoids of (travel, speed), with a rest before and a hold after."""
    pieces = [stationary_piece(1.0, Phase.REST)]
    for travel, speed in strokes:
        pieces += trapezoid(travel, speed, 400.0)
    profile = MotionProfile.from_pieces(
        [*pieces, stationary_piece(20.0 if contact is Contact.STICKING else 3.0, Phase.HOLD)]
    )
    return Acquisition(
        run_id="bench",
        order=0,
        kind="drag",
        profile=profile,
        capsule=CAPSULE,
        specimen=Specimen(name="bench"),
        fixture=fixture,
        contact=contact,
        insertion_dwell_s=60.0,
        shear_strain=1.0,
    )


def best_of(action: Callable[[], object]) -> float:
    """Least time [s] of several repeats."""
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        action()
        times.append(time.perf_counter() - begin)
    return min(times)


def sample_times(run: Acquisition, samples: int | None = None) -> np.ndarray:
    """Return the times of a run's samples at 1 kHz, or of so many samples."""
    if samples is not None:
        return np.linspace(0.0, run.profile.duration_s, samples)
    return np.arange(run.profile.samples(RATE_HZ)) / RATE_HZ


def report(name: str, run: Acquisition, samples: int | None = None, *, recorded: bool = False) -> None:
    """Print a line of the table."""
    times = sample_times(run, samples)
    motion = None
    if recorded:
        motion = RecordedMotion.of(times, np.round(run.profile.position(times) * 1000) / 1000)
    preparing = best_of(lambda: prepare(run, MODEL, motion))
    prepared = prepare(run, MODEL, motion)
    evaluating = best_of(lambda: prepared.force(times))
    both = preparing + evaluating
    print(
        f"{name:34s}{times.size:9d}{preparing * 1e3:12.2f}{evaluating * 1e3:12.2f}"
        f"{both / times.size * 1e6:13.3f}{run.profile.duration_s / both:15.0f}"
    )


def report_sweep() -> None:
    """Print the line of the whole speed sweep."""
    runs = [acquisition((40.0, speed)) for speed in SPEEDS_MM_S]
    times = [sample_times(run) for run in runs]
    spent = best_of(lambda: [prepare(run, MODEL).force(at) for run, at in zip(runs, times, strict=True)])
    samples, real = sum(at.size for at in times), sum(run.profile.duration_s for run in runs)
    print(f"{'all 11 speeds of the paper':34s}{samples:9d}{'':24s}{spent / samples * 1e6:13.3f}{real / spent:15.0f}")


def main() -> None:
    """Print the table."""
    print(f"{'':34s}{'samples':>9s}{'prepare ms':>12s}{'force ms':>12s}{'µs/sample':>13s}{'× real time':>15s}")
    for speed in (0.5, 2.0, 20.0, 60.0):
        report(f"drag {speed:g} mm/s", acquisition((40.0, speed)))
    report("drag 0.5 mm/s, a million samples", acquisition((40.0, 0.5)), 1_000_000)
    report("drag 20 mm/s, a million samples", acquisition((40.0, 20.0)), 1_000_000)
    report("drag 20 mm/s, measured position", acquisition((40.0, 20.0)), recorded=True)
    report("there and back, 10 mm/s", acquisition((40.0, 10.0), (-40.0, 10.0)))
    report("Coulomb 0.5 mm/s", acquisition((40.0, 0.5), fixture=Fixture.VACUUM))
    report("relaxation 100 %", acquisition((2.5, 20.0), fixture=Fixture.VACUUM, contact=Contact.STICKING))
    report_sweep()


if __name__ == "__main__":
    main()
