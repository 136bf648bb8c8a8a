"""Measures of a run and their errors."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from dragrig.analysis.estimates import correlated_mean
from dragrig.analysis.measures import measure, minutes_since_excision, table_row
from dragrig.present.campaign import campaign_table_document
from dragrig.rig.profile import FloatArray, MotionProfile, Phase, stationary_piece, trapezoid
from dragrig.rig.runfile.model import Attribute, RecordedChannel, Run, RunHeader, RunInfo, RunStatus, Trace
from property_tests import thorough

RATE = 500.0
CAPSULE: dict[str, Attribute] = {"diameter_mm": 12.9, "length_mm": 15.2, "mass_g": 50.1, "contact_angle_deg": 60.0}


def noise(rng: np.random.Generator, samples: int, white: float, slow: float, correlation_s: float) -> FloatArray:
    phi = np.exp(-1 / (correlation_s * RATE))
    drawn = rng.normal(size=samples) * slow * np.sqrt(1 - phi**2)
    drawn[0] = rng.normal() * slow
    return np.asarray(lfilter([1], [1, -phi], drawn) + white * rng.normal(size=samples), dtype=np.float64)


def sliding(kind: str = "drag", speed: float = 5.0, travel: float = 40.0) -> Run:
    """A noisy run whose force rises from 3 mN to 83 mN over the first 5.6 mm and decays to 33 mN in the hold."""
    profile = MotionProfile.from_pieces(
        (stationary_piece(1.0, Phase.REST), *trapezoid(travel, speed, 400.0), stationary_piece(3.0, Phase.HOLD))
    )
    time = np.arange(profile.samples(RATE)) / RATE
    position, phase = profile.position(time), profile.phase_at(time)
    rise = np.clip(np.abs(position) / (6.45 * np.sin(np.pi / 3)), 0, 1)
    force = 3 + np.sign(travel) * 80 * rise + noise(np.random.default_rng(7), len(time), 1.5, 0.5, 0.2)
    force[phase == Phase.HOLD] -= np.sign(travel) * 50.0
    header = RunHeader(
        run_id="0" * 32, start_time=datetime(2026, 1, 1, tzinfo=UTC), order=0, backend="simulated", kind=kind,
        sample_rate_hz=RATE, capsule=CAPSULE,
        channels=(RecordedChannel("force", "mN"), RecordedChannel("position", "mm")),
    )  # fmt: skip
    info = RunInfo(Path("run.h5"), 1, RunStatus.COMPLETE, header, len(time))
    channels = {"force": force, "position": np.round(position, 3)}
    units = {"time": "s", "command": "mm", "force": "mN", "position": "mm"}
    return Run(info, Trace(RATE, "force", time, position, phase, channels, units))


def with_force(run: Run, force: FloatArray) -> Run:
    return replace(run, trace=replace(run.trace, channels={**run.trace.channels, "force": force}))


@pytest.mark.parametrize(
    ("trials", "correlation_s", "white", "slow", "seed"),
    [
        (300, 0.2, 1.5, 0.5, 1),
        thorough(1000, 0.2, 1.5, 0.5, 1),
        thorough(1000, 0.05, 1.5, 0.5, 2),
        thorough(1000, 0.2, 0.5, 1.5, 1),
    ],
)
def test_the_95_percent_interval_holds_the_mean_in_95_percent_of_records(
    trials: int, correlation_s: float, white: float, slow: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    held = 0
    for _ in range(trials):
        interval = correlated_mean(10 + noise(rng, 4000, white, slow, correlation_s), 2 * RATE).interval
        assert interval is not None
        held += interval[0] <= 10 <= interval[1]
    assert held / trials == pytest.approx(0.95, abs=0.02 * np.sqrt(1000 / trials))


def test_white_noise_counts_its_samples_and_slow_noise_its_correlation_times() -> None:
    rng = np.random.default_rng(4)
    white = correlated_mean(rng.normal(size=20_000))
    slow = correlated_mean(noise(rng, 20_000, 0.0, 1.0, 0.2))
    assert white.effective_samples is not None
    assert slow.effective_samples is not None
    assert 4_000 < white.effective_samples <= 20_000
    assert 50 < slow.effective_samples < 200  # 40 s hold 100 stretches of two correlation times


def test_long_records_give_what_short_ones_promise() -> None:
    record = noise(np.random.default_rng(5), 400_000, 1.5, 0.5, 0.2)
    estimate = correlated_mean(record)
    assert estimate.value == pytest.approx(record.mean(), rel=1e-12)
    assert estimate.standard_error == pytest.approx(0.5 * np.sqrt(2 * 0.2 / 800), rel=0.25)


def test_a_mean_without_support_says_why() -> None:
    assert correlated_mean([1.0] * 7).reason == "only 7 samples, fewer than 8"
    assert "NaN" in correlated_mean([1.0] * 20 + [float("nan")]).reason
    assert correlated_mean([2.0] * 100).standard_error == 0.0


@pytest.mark.parametrize("direction", [1, -1])
def test_a_drag_run_is_measured(direction: int) -> None:
    measured = measure(sliding("drag", travel=direction * 40.0))
    interval = measured.steady_force.interval
    assert interval is not None
    assert interval[0] < 3 + direction * 80 < interval[1]
    assert interval[1] - interval[0] < 2
    assert measured.rest_offset.value == pytest.approx(3, abs=1.5)
    assert measured.peak_force.value == pytest.approx(3 + direction * 80, abs=6)
    assert measured.hold_force.value == pytest.approx(3 + direction * 30, abs=1.5)
    assert measured.speed.value == pytest.approx(direction * 5, abs=1e-4)
    assert measured.speed.standard_error is not None
    assert 0 < measured.speed.standard_error < 1e-3


def test_the_start_up_is_left_out_of_a_drag_run_only() -> None:
    drag, coulomb = measure(sliding("drag")), measure(sliding("coulomb"))
    assert drag.steady_force.value is not None
    assert coulomb.steady_force.value is not None
    assert drag.steady_force.value - coulomb.steady_force.value > 3
    assert "5.59 mm" in drag.steady_from
    assert "0.1 s" in coulomb.steady_from


def test_a_relaxation_has_a_peak_and_a_hold_but_no_steady_force() -> None:
    measured = measure(sliding("relaxation"))
    assert "no steady sliding" in measured.steady_force.reason
    assert measured.peak_force.value is not None
    assert measured.hold_force.value is not None


def test_a_run_too_short_for_the_contact_has_no_steady_force() -> None:
    measured = measure(sliding("drag", travel=5.0))
    assert measured.steady_force.value is None
    assert measured.steady_force.reason == "no sample is left in the steady phase after 5.59 mm of travel"


def test_a_capsule_without_measures_has_no_steady_drag_force() -> None:
    run = sliding("drag")
    unknown = replace(run.info.header, capsule={**CAPSULE, "diameter_mm": float("nan")})
    measured = measure(replace(run, info=replace(run.info, header=unknown)))
    assert "diameter or contact angle" in measured.steady_force.reason


def test_clipped_samples_give_no_mean_and_no_peak() -> None:
    run = sliding("drag")
    measured = measure(with_force(run, np.minimum(run.trace.force, 83.0)))
    assert "clipped" in measured.steady_force.reason
    assert "clipped" in measured.peak_force.reason
    assert measured.rest_offset.value is not None


def test_checks_are_believed_about_clipping() -> None:
    run = sliding("drag")
    force = np.minimum(run.trace.force, 87.0)
    force[200] = 87.0
    counted = replace(run, info=replace(run.info, checks={"clipped_samples": 3}))
    assert "clipped" in measure(with_force(counted, force)).rest_offset.reason
    sound = replace(run, info=replace(run.info, checks={"clipped_samples": 0}))
    assert measure(with_force(sound, np.minimum(run.trace.force, 83.0))).steady_force.value is not None


def test_a_noise_free_trace_is_not_taken_for_clipped() -> None:
    run = sliding("coulomb")
    measured = measure(with_force(run, np.where(run.trace.phase == Phase.STEADY, 40.0, 0.0)))
    assert measured.steady_force.value == pytest.approx(40)
    assert measured.steady_force.standard_error == 0


def test_missing_samples_are_said() -> None:
    run = sliding("drag")
    force = np.array(run.trace.force)
    force[3000] = np.nan
    measured = measure(with_force(run, force))
    assert measured.steady_force.value is None
    assert "NaN" in measured.steady_force.reason
    assert measured.peak_force.value is None
    assert measured.hold_force.value is not None


def test_a_run_without_phases_is_measured_as_far_as_it_goes() -> None:
    run = sliding("motion")
    steady = np.full(len(run.trace.time), int(Phase.STEADY), dtype=np.uint8)
    measured = measure(replace(run, trace=replace(run.trace, phase=steady)))
    assert measured.rest_offset.reason == "the run has no rest phase"
    assert measured.hold_force.reason == "the run has no hold phase"
    assert measured.steady_force.value is not None


def test_the_age_of_a_specimen_is_told_where_its_excision_is_known() -> None:
    run = sliding()
    for stated, minutes in (("2025-12-31T23:18:00+00:00", 42.0), ("unknown", None), ("2025-12-31T23:18:00", None)):
        info = replace(run.info, header=replace(run.info.header, specimen={"excised_at": stated}))
        assert minutes_since_excision(info) == minutes
    aged = replace(run, info=replace(info, header=replace(info.header, specimen={"excised_at": "2025-12-31T23:18Z"})))
    document = campaign_table_document([table_row(aged)])
    assert "min since excision" in [column.heading for column in next(document.tables()).columns]


def test_a_value_that_nothing_measures_is_no_number_of_a_mean_or_a_peak() -> None:
    run = sliding()
    force = np.array(run.trace.force, dtype=np.float64)
    force[len(force) // 2] = 1e300
    row = table_row(with_force(run, force))
    assert (row.steady_force_mN, row.peak_force_mN) == (None, None)
    assert row.rest_offset_mN is not None
    assert correlated_mean(force).value is None


def test_a_steady_force_is_given_with_the_force_at_rest_taken_off() -> None:
    row = table_row(sliding())
    assert row.steady_above_rest_mN == pytest.approx(80.0, abs=1.0)
    assert row.steady_force_error_mN is not None
    assert row.rest_offset_error_mN is not None
    assert row.steady_above_rest_error_mN == pytest.approx(
        np.hypot(row.steady_force_error_mN, row.rest_offset_error_mN)
    )
