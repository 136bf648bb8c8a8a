"""The friction coefficient from Coulomb runs."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dragrig.analysis.identification.steady_sliding import identify_coulomb, measure_sliding, pool_estimates
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.selection import select_runs
from dragrig.config.specimen import Fixture
from dragrig.rig.runfile.model import Run
from places import CAMPAIGN, REFERENCE
from property_tests import thorough
from sliding_runs import PAPER, selected, slid, with_capsule, with_force, without_rest

WEIGHT_MN = 50.1 * 9.80665


def reference_run() -> Run:
    """The reference Coulomb run at 0.5 mm/s, from its own file."""
    with (REFERENCE / "coulomb-0.5.csv").open(encoding="utf-8") as file:
        rows = [list(map(float, row.values())) for row in csv.DictReader(file)]
    time, position, force, phase = np.array(rows).T
    run = slid("coulomb", 0.5, travel_mm=1.0)
    trace = replace(
        run.trace, sample_rate_hz=20.0, time=time, command=position, phase=phase.astype(np.uint8),
        channels={"force": force, "position": position},
    )  # fmt: skip
    return replace(run, trace=trace)


def test_the_papers_mean_force_gives_the_papers_coefficient() -> None:
    run = reference_run()
    steady = float(run.trace.force[run.trace.phase == 2].mean())
    result = identify_coulomb(selected([with_force(run, run.trace.force * (40.07 / steady))]), PAPER)
    (entry,) = result.runs
    assert entry.force.value == pytest.approx(40.07, abs=1e-3)
    assert entry.mu.value == pytest.approx(0.0816, abs=5e-5)
    assert f"{entry.mu.value:.3f}" == "0.082"
    assert entry.mu_without_viscous.value == pytest.approx(0.0801, abs=5e-5)
    assert entry.viscous_mN == pytest.approx(0.73, abs=5e-3)
    assert entry.viscous_share == pytest.approx(0.73 / 40.07, rel=0.01)
    assert result.mu.value == pytest.approx(40.07 / WEIGHT_MN, rel=1e-4)
    assert result.mu.standard_error == pytest.approx(0.0816 * np.hypot(0.015, 0.005), rel=0.01)


def test_the_reference_runs_coefficient_comes_back() -> None:
    result = identify_coulomb(selected([reference_run()]), PAPER)
    assert result.mu_without_viscous.value == pytest.approx(0.082, rel=1e-3)


def test_filtering_changes_the_mean_by_nothing_that_matters() -> None:
    for speed, seed in ((2.0, 1), (5.0, 2), (40.0, 3)):
        experiment = Experiment(slid("coulomb", speed, seed))
        raw, filtered = measure_sliding(experiment).steady, measure_sliding(experiment, filtered=True).steady
        assert raw.value is not None
        assert filtered.value is not None
        assert raw.standard_error is not None
        assert abs(filtered.value - raw.value) < 0.2 * raw.standard_error
        assert filtered.value != raw.value


# At 95 %, fewer than 25 of 30 come 3 times in 1000, fewer than 6 of 8 come 6 times.
@pytest.mark.parametrize(("seeds", "least"), [(8, 6), thorough(30, 25)])
def test_intervals_hold_the_coefficient_of_the_specimen(seeds: int, least: int) -> None:
    """Each campaign has three speeds, a zero and a friction of its own in each run, and a mucus of its own."""
    held = 0
    for seed in range(seeds):
        mucus = float(np.exp(0.2 * np.random.default_rng(seed).standard_normal()))
        model = PAPER.model_copy(update={"mucus_scale": mucus})
        runs = [slid("coulomb", speed, seed, model, travel_mm=20.0) for speed in (2.0, 8.0, 40.0)]
        result = identify_coulomb(selected(runs), PAPER)
        interval = result.mu_without_viscous.interval
        assert interval is not None
        held += interval[0] < 0.082 < interval[1]
    assert held >= least


def test_a_run_backward_says_the_same() -> None:
    there, back = (slid("coulomb", 5.0, 4, travel_mm=travel) for travel in (20.0, -20.0))
    result = identify_coulomb(selected([there, back]), PAPER)
    forward, backward = result.runs
    assert (forward.speed_mm_s, backward.speed_mm_s) == pytest.approx((5.0, -5.0), rel=1e-3)
    assert forward.mu.value is not None
    assert backward.mu.value is not None
    assert backward.force.value == pytest.approx(forward.force.value, abs=4)
    assert result.mu.value == pytest.approx((forward.mu.value + backward.mu.value) / 2, rel=0.02)


def test_what_a_run_does_not_support_has_a_reason() -> None:
    good = slid("coulomb", 5.0, 1, travel_mm=20.0)
    limit = float(np.quantile(good.trace.force, 0.95))
    clipped = with_force(good, np.minimum(good.trace.force, limit))
    count = int(np.count_nonzero(clipped.trace.force == limit))
    clipped = replace(clipped, info=replace(clipped.info, checks={"clipped_samples": count}))
    for run, reason in (
        (without_rest(good), "no rest phase"),
        (clipped, "clipped"),
        (with_capsule(good, mass_g=None), "mass_g"),
        (with_capsule(good, mass_g=0.0), "mass_g"),
        (slid("coulomb", 5.0, 1, travel_mm=20.0, fixture=Fixture.FOAM), "fixture is foam"),
    ):
        result = identify_coulomb(selected([run]), PAPER)
        for estimate in (result.runs[0].mu, result.runs[0].mu_without_viscous, result.mu, result.mu_without_viscous):
            assert estimate.value is None
            assert reason in estimate.reason
    without_mass = identify_coulomb(selected([with_capsule(good, mass_g=None)]), PAPER)
    assert without_mass.runs[0].force.value == pytest.approx(42, abs=4)
    assert "no usable Coulomb run" in identify_coulomb(selected([slid("drag", 20.0)]), PAPER).mu.reason


def test_a_stage_that_creeps_off_before_its_phase_says_so_shifts_no_zero() -> None:
    runs = [slid("coulomb", speed, 3, travel_mm=10.0) for speed in (2.0, 5.0, 10.0)]
    early = []
    for run in runs:
        phase = run.trace.phase.copy()
        phase[np.flatnonzero(phase == 1)[0] :][:20] = 0
        early.append(replace(run, trace=replace(run.trace, phase=phase)))
    as_labelled, mislabelled = identify_coulomb(selected(runs), PAPER), identify_coulomb(selected(early), PAPER)
    assert mislabelled.mu.value == pytest.approx(as_labelled.mu.value, rel=0.003)
    assert mislabelled.mu.standard_error == pytest.approx(as_labelled.mu.standard_error, rel=0.1)


def test_one_bad_run_does_not_spoil_the_others() -> None:
    good = slid("coulomb", 5.0, 1, travel_mm=20.0)
    bad = without_rest(slid("coulomb", 8.0, 2, travel_mm=20.0))
    alone, both = identify_coulomb(selected([good]), PAPER), identify_coulomb(selected([good, bad]), PAPER)
    assert both.mu == alone.mu
    assert both.runs[1].mu.reason


def test_the_viscous_share_follows_the_reading_of_eq_10() -> None:
    newtonian = PAPER.model_copy(update={"viscous": "newtonian"})
    run = slid("coulomb", 5.0, 1, newtonian, travel_mm=20.0)
    result = identify_coulomb(selected([run]), newtonian)
    assert result.runs[0].viscous_mN > 10
    assert result.mu_without_viscous.value == pytest.approx(0.082, rel=0.1)
    blind = identify_coulomb(selected([with_capsule(run, contact_angle_deg=None)]), newtonian)
    assert blind.mu.value is not None
    assert "viscous friction is not known" in blind.mu_without_viscous.reason


def test_a_coefficient_that_falls_with_speed_is_said() -> None:
    def campaign(falling: float) -> tuple[str, ...]:
        runs = []
        for speed in (0.5, 5.0, 40.0):
            mu = 0.082 * (1 - falling * np.log10(speed / 0.5))
            runs.append(
                slid("coulomb", speed, 5, PAPER.model_copy(update={"friction_coefficient": mu}), travel_mm=10.0)
            )
        return identify_coulomb(selected(runs), PAPER).remarks

    assert any("falls with speed" in remark for remark in campaign(0.2))
    assert not any("with speed" in remark for remark in campaign(0.0))


def test_the_thin_campaign_has_one_fast_run() -> None:
    result = identify_coulomb(select_runs(CAMPAIGN), PAPER)
    (run,) = result.runs
    assert run.speed_mm_s == pytest.approx(40.0, rel=1e-3)
    interval = result.mu_without_viscous.interval
    assert interval is not None
    assert interval[0] < 0.09 < interval[1]  # its specimen's answer
    assert run.viscous_share == pytest.approx(6.55 / 51.4, rel=0.03)
    assert any("of the force at 40 mm/s" in remark for remark in result.remarks)


@given(
    st.lists(st.tuples(st.floats(-10, 10), st.floats(0.1, 5)), min_size=1, max_size=8),
    st.floats(0.01, 2),
)
def test_a_pooled_mean_lies_among_the_values_and_holds_the_scatter(
    runs: list[tuple[float, float]], usual: float
) -> None:
    values, errors = np.array(runs).T
    result = pool_estimates(values, np.diag(errors**2), usual)
    assert result.mean.value is not None
    assert result.mean.standard_error is not None
    assert values.min() - 1e-9 <= result.mean.value <= values.max() + 1e-9
    assert result.scatter >= usual
    assert result.mean.standard_error >= usual / np.sqrt(len(values)) * 0.999


def test_a_pooled_means_interval_covers_also_when_runs_scatter_more_than_usual() -> None:
    rng = np.random.default_rng(8)
    covered = 0
    for _ in range(400):
        values = rng.normal(5.0, np.hypot(1.0, 3.0), 8)
        interval = pool_estimates(values, np.eye(8), 0.5).mean.interval
        assert interval is not None
        covered += interval[0] < 5.0 < interval[1]
    assert 0.88 <= covered / 400 <= 0.98
