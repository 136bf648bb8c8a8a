"""The checks right after a run see what they should, and nothing where there is nothing."""

import numpy as np
import pytest

from dragrig.analysis.measures import table_row
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.config.specimen import Specimen
from dragrig.rig.devices import Block, Contact
from dragrig.rig.profile import AnyFloatArray, MotionProfile
from dragrig.rig.protocols.kinds import DragProtocol, MotionProtocol, Move, RelaxationProtocol
from dragrig.rig.reading import BlockExtremes, CheckReport, RunChecks, SetpointSampler
from property_tests import thorough

RATE = 1000.0
SPECIMEN = Specimen(name="jejunum")
RANGE = (-10_000.0, 10_000.0)


def report(
    profile: MotionProfile,
    force: AnyFloatArray,
    *,
    contact: Contact = Contact.NONE,
    lost: slice | None = None,
    late_s: float = 0.0,
) -> CheckReport:
    checks = RunChecks(RATE, RANGE, 5.0, contact, 0.001)
    tape = SetpointSampler(profile, RATE)
    position = profile.position(np.maximum(np.arange(len(force)) / RATE - late_s, 0.0)).astype(np.float32)
    for start in range(0, len(force), 50):
        if lost is not None and lost.start <= start < lost.stop:
            continue
        channels = {"force": force[start : start + 50], "position": position[start : start + 50]}
        block = Block(start, channels)
        reading = tape.with_setpoint(block)
        checks.add(reading, BlockExtremes.of(block, reading.command), block.channels["force"])
    return checks.report()


def relaxing(
    seed: int,
    strain: float = 1.0,
    slips_at_s: float = np.inf,
    drop: float = 0.0,
    hold_s: float = 20.0,
    white_mN: float = 1.5,
    relaxes_from_s: float | None = 1.15,
) -> CheckReport:
    profile = RelaxationProtocol(shear_strain=strain, hold_s=hold_s).profile(SPECIMEN)
    time = np.arange(profile.samples(RATE)) / RATE
    since = np.maximum(time - (profile.motion_ends_s if relaxes_from_s is None else relaxes_from_s), 0.0)
    held = 650 * strain * (1 + 1.1 * np.exp(-since / 0.46) + 2.9 * np.exp(-since / 0.025))
    rng = np.random.default_rng(seed)
    slow = np.convolve(rng.normal(0, 0.5, len(time) + 199), np.ones(200) / np.sqrt(200), "valid")
    force = np.where(time < 1.0, 0.0, held) + rng.normal(0, white_mN, len(time)) + slow
    force[time >= slips_at_s] *= 1 - drop
    return report(profile, force.astype(np.float32), contact=Contact.STICKING)


def test_a_clean_drag_warns_of_nothing() -> None:
    profile = DragProtocol(speed_mm_s=20.0).profile(SPECIMEN)
    noise = np.random.default_rng(1).normal(2.5, 1.5, profile.samples(RATE)).astype(np.float32)
    seen = report(profile, noise)
    assert seen.warnings == ()
    assert seen.values["rest_offset_mN"] == pytest.approx(2.5, abs=0.2)
    assert seen.values["rest_noise_mN"] == pytest.approx(1.5, rel=0.1)
    assert seen.values["following_error_mm"] < 1e-4
    assert "slip_time_s" not in seen.values


def test_clipped_and_lost_samples_are_counted() -> None:
    profile = DragProtocol(speed_mm_s=20.0).profile(SPECIMEN)
    force = np.zeros(profile.samples(RATE), np.float32)
    force[2000:2007] = 10_000.0
    force[2100:2103] = -10_000.0
    seen = report(profile, force, lost=slice(3000, 3200))
    assert seen.values["clipped_samples"] == 10
    assert seen.values["lost_samples"] == 200
    assert len(seen.warnings) == 2


@pytest.mark.parametrize(("sign", "response"), [(1, "resists the motion"), (-1, "along the motion")])
def test_a_stage_that_sets_out_late_does_not_turn_the_force_round(sign: int, response: str) -> None:
    profile, late_s = DragProtocol(speed_mm_s=20.0, travel_mm=10.0).profile(SPECIMEN), 0.4
    time = np.arange(profile.samples(RATE)) / RATE
    # A gut that was just closed still relaxes while it waits: below the mean at rest before the stage sets out.
    moving = (time >= 1.0 + late_s) & (time < 1.5 + late_s)
    force = sign * (100 * np.exp(-time / 0.5) + 80 * moving) + np.random.default_rng(2).normal(0, 1.0, len(time))
    seen = report(profile, force.astype(np.float32), contact=Contact.SLIDING, late_s=late_s)
    assert seen.values["force_response"] == response


@pytest.mark.parametrize("strain", [thorough(0.5), 1.0, thorough(2.0)])
@pytest.mark.parametrize("hold_s", [0.25, 0.5, 20.0])
def test_a_wall_that_relaxes_is_not_taken_for_noise_that_began(strain: float, hold_s: float) -> None:
    for seed in range(10):
        assert relaxing(seed, strain, hold_s=hold_s, white_mN=0.3, relaxes_from_s=None).warnings == ()


def strokes_with_cable_pulled(
    at_s: float, hum_mN: float = 0.0, drift_mN_s: float = 0.0, late_s: float = 0.0
) -> CheckReport:
    """Three strokes against a dry friction, whose sensor's cable comes off at a time."""
    strokes = tuple(Move(travel_mm=sign * 20.0, speed_mm_s=20.0, pause_s=0.5) for sign in (1, -1, 1))
    profile = MotionProtocol(strokes=strokes).profile(SPECIMEN)
    time = np.arange(profile.samples(RATE)) / RATE
    off = time >= at_s
    noise = np.random.default_rng(4).normal(0, 1.0, len(time))
    friction = 60.0 * np.sign(np.round(profile.velocity(np.maximum(time - late_s, 0.0)), 6))
    floating = 350.0 + drift_mN_s * (time - 1.0) + hum_mN * np.sin(2 * np.pi * 50.0 * time)
    force = np.where(off, floating, friction) + noise
    return report(profile, force.astype(np.float32), contact=Contact.SLIDING, late_s=late_s)


@pytest.mark.parametrize("late_s", [0.0, 0.05, 0.2])
def test_a_stage_that_comes_late_to_its_stops_is_followed_too(late_s: float) -> None:
    assert strokes_with_cable_pulled(np.inf, late_s=late_s).warnings == ()


@pytest.mark.parametrize("at_s", [1.5, 2.6, 4.5])
@pytest.mark.parametrize("drift_mN_s", [0.0, 30.0, -30.0])
def test_a_force_that_follows_the_stops_of_the_stage_no_more_is_said(at_s: float, drift_mN_s: float) -> None:
    seen = strokes_with_cable_pulled(at_s, drift_mN_s=drift_mN_s)
    assert seen.values["force_response"] == "none to a stop"
    (warning,) = seen.warnings
    assert "cable pulled" in warning


@pytest.mark.parametrize("hum_mN", [6.0, 50.0])
def test_hum_that_begins_within_a_run_is_said(hum_mN: float) -> None:
    seen = strokes_with_cable_pulled(1.5, hum_mN=hum_mN)
    assert seen.values["noise_after_mN"] == pytest.approx(np.hypot(hum_mN / np.sqrt(2), 1.0), rel=0.1)
    assert any("hum began within the run" in warning for warning in seen.warnings)


def test_hum_that_was_there_before_the_motion_did_not_begin_in_it() -> None:
    profile = DragProtocol(speed_mm_s=20.0).profile(SPECIMEN)
    time = np.arange(profile.samples(RATE)) / RATE
    hum = 12.0 * np.sin(2 * np.pi * 50.0 * time) + np.random.default_rng(1).normal(0, 1.0, len(time))
    (warning,) = report(profile, hum.astype(np.float32)).warnings
    assert "noise at rest is 8.6 mN, over the sensor's accuracy" in warning


def test_a_loud_sensor_is_reported() -> None:
    profile = DragProtocol(speed_mm_s=20.0).profile(SPECIMEN)
    noise = np.random.default_rng(1).normal(0, 8.0, profile.samples(RATE)).astype(np.float32)
    assert any("noise at rest" in warning for warning in report(profile, noise).warnings)


@pytest.mark.parametrize(("at_s", "drop"), [(2.0, 0.15), (5.0, 0.05), (15.0, 0.05)])
def test_a_capsule_that_slips_is_reported_with_its_time(at_s: float, drop: float) -> None:
    seen = relaxing(1, slips_at_s=at_s, drop=drop)
    assert seen.values["slip_time_s"] == pytest.approx(at_s, abs=0.25)
    assert any("slipped" in warning for warning in seen.warnings)


@pytest.mark.parametrize("strain", [thorough(0.5), thorough(1.0), thorough(1.5), 2.0])
def test_a_wall_that_relaxes_is_not_taken_for_slip(strain: float) -> None:
    for seed in range(10):
        assert relaxing(seed, strain).values["slip_time_s"] == -1.0


@pytest.mark.parametrize("plan", ["first", thorough("drag-sweep")])
def test_the_shipped_plans_on_the_simulated_rig_are_marked_by_nothing(plan: str) -> None:
    import dragrig

    runs = dragrig.simulate(plan, assignments=["rig.data.root='.'"])
    assert {table_row(run).checks for run in runs} == {"ok"}
    assert all("noise_after_mN" in run.info.checks for run in runs)


def test_the_simulated_walls_relaxation_is_not_taken_for_slip() -> None:
    import dragrig

    runs = dragrig.simulate("relaxation", assignments=["rig.data.root='.'"])
    slips = [run.info.checks["slip_time_s"] for run in runs if run.info.kind == "relaxation"]
    assert slips == [-1.0] * 4
    assert RigSettings().sampling.rate_hz == RATE
    assert FrictionModelSettings().wall == "eq14"
