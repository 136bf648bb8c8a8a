"""The friction model agrees with the reference numbers of another implementation."""

from pathlib import Path

import numpy as np
import pytest

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Fixture
from dragrig.rig.devices import Acquisition
from dragrig.sim_backend.friction import prepare, steady_forces
from friction_cases import ROUGH, SMOOTH, moves, sliding, sticking
from places import REFERENCE

AGREEMENT = 0.002
MODEL = FrictionModelSettings()
TRACES = sorted(REFERENCE.glob("*-*.csv"))


def acquisition_of(trace: Path) -> Acquisition:
    kind, number = trace.stem.split("-")
    if kind == "drag":
        return sliding(moves((40.0, float(number))))
    if kind == "coulomb":
        return sliding(moves((40.0, float(number))), SMOOTH, Fixture.VACUUM)
    strain = float(number) / 100
    return sticking(moves((2.5 * strain, 20.0), acceleration=2000.0, hold=20.0), strain)


def test_all_reference_traces_are_there() -> None:
    assert len(TRACES) == 7


@pytest.mark.parametrize("trace", TRACES, ids=lambda path: path.stem)
def test_trace_agrees_away_from_the_first_two_samples_of_a_phase(trace: Path) -> None:
    reference = np.genfromtxt(trace, delimiter=",", names=True)
    acquisition = acquisition_of(trace)
    np.testing.assert_array_equal(acquisition.profile.phase_at(reference["time_s"]), reference["phase"])
    force = prepare(acquisition, MODEL).force(reference["time_s"])
    first = np.flatnonzero(np.diff(reference["phase"], prepend=-1.0))
    away = np.setdiff1d(np.arange(force.size), np.concatenate((first, first + 1)))
    error = np.abs(force - reference["force_mN"])[away] / np.ptp(reference["force_mN"])
    assert error.max() < AGREEMENT


def test_steady_forces_agree() -> None:
    reference = np.genfromtxt(REFERENCE / "steady.csv", delimiter=",", names=True)
    steady = steady_forces(reference["speed_mm_s"], MODEL, ROUGH, 2.5)
    for name in ("f_e", "f_v", "f_c", "total", "side_pressure_force", "max_skew"):
        np.testing.assert_allclose(getattr(steady, name), reference[f"{name}_mN"], rtol=AGREEMENT, err_msg=name)
    np.testing.assert_allclose(steady.x_of_max_skew, reference["x_of_max_skew_mm"], rtol=AGREEMENT)


@pytest.mark.parametrize("speed", [0.5, 5.0, 60.0])
def test_a_long_drag_settles_at_the_steady_forces(speed: float) -> None:
    profile = moves((40.0, speed))
    parts = prepare(sliding(profile), MODEL).components(np.array([profile.duration_s - 3.2 - speed / 400]))
    steady = steady_forces([speed], MODEL, ROUGH, 2.5)
    np.testing.assert_allclose(parts.f_e, steady.f_e, rtol=1e-7)
    np.testing.assert_allclose(parts.f_v, steady.f_v, rtol=1e-12)
    np.testing.assert_allclose(parts.f_c, steady.f_c, rtol=1e-9)
