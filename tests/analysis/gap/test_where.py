"""Where a gap is: what is planted in one place is found there, and noise is in none."""

import json
from dataclasses import replace

import numpy as np
import pytest

from dragrig.analysis.gap.diagnosis import GapLocation
from dragrig.analysis.gap.excess import BANDS_HZ, ResidualBlocks, band_powers
from dragrig.analysis.gap.localise import attribute_to_effects, localise
from dragrig.rig.profile import FloatArray, Phase
from property_tests import thorough
from residuals import SD, Planted, blocks, campaign


def moving(run: ResidualBlocks, *kinds: str) -> FloatArray:
    inside = (run.phase != Phase.REST) & (run.phase != Phase.HOLD)
    return np.asarray(inside * (run.kind in kinds), dtype=np.float64)


def lift_off(run: ResidualBlocks) -> FloatArray:
    return -30.0 * moving(run, "drag") * (run.speed_mm_s > 25.0)


def stribeck(run: ResidualBlocks) -> FloatArray:
    return 30.0 * moving(run, "drag", "coulomb") * np.exp(-run.speed_mm_s / 3.0)


def tether(run: ResidualBlocks) -> FloatArray:
    return 0.8 * np.maximum(run.position_mm - 20.0, 0.0) * moving(run, "drag")


def folds(run: ResidualBlocks) -> FloatArray:
    return 8.0 * moving(run, "drag") * np.sin(2 * np.pi * run.position_mm / 6.0 + run.session_s)


def ageing(run: ResidualBlocks) -> FloatArray:
    return 20.0 * (run.session_s / 3000.0 - 0.5) * (run.kind in {"drag", "relaxation"}) * (run.phase != Phase.REST)


def pulses(run: ResidualBlocks) -> FloatArray:
    return 8.0 * np.cos(2 * np.pi * (run.session_s + run.time_s) / 4.3) * (run.kind == "drag")


def creep(run: ResidualBlocks) -> FloatArray:
    return 40.0 * run.strain * np.exp(-(run.time_s - 1.2) / 6.0) * (run.phase == Phase.HOLD)


def stiffening(run: ResidualBlocks) -> FloatArray:
    return 15.0 * run.strain**2 * np.exp(-np.maximum(run.time_s - 1.2, 0.0)) * (run.phase != Phase.REST)


def ringing(run: ResidualBlocks) -> FloatArray:
    changing = (run.phase == Phase.ACCELERATE) | (run.phase == Phase.DECELERATE)
    return np.asarray(60.0 * changing * (run.speed_mm_s / 60.0) * (run.strain == 0.0))


def test_a_gap_at_high_speed_is_found_there() -> None:
    location = localise(campaign(1, lift_off))
    assert location.present
    speed = location.location("speed_mm_s")
    assert (speed.low, speed.high) == (30.0, 60.0)
    assert speed.share > 0.95
    assert speed.p < 0.01
    assert location.location("channel").shares["force"] > 0.95
    assert location.location("protocol").shares["drag"] > 0.95
    phases = location.location("phase").shares
    assert phases["rest"] + phases["hold"] < 0.02
    assert location.location("session").p > 0.05


def test_a_gap_late_in_the_stroke_is_found_there() -> None:
    position = localise(campaign(1, tether)).location("position")
    assert (position.low, position.high) == (28.0, 40.0)
    assert position.p < 0.01
    standing_out = [axis_bin.p < 0.05 for axis_bin in position.bins]
    assert not any(standing_out[:5])
    assert all(standing_out[8:])


def test_a_gap_in_the_position_channel_is_told_from_one_in_the_force() -> None:
    location = localise(campaign(1, lambda run: 0.03 * moving(run, "drag", "blank", "coulomb"), channel="position"))
    assert location.location("channel").shares["position"] > 0.95
    assert next(axis_bin for axis_bin in location.location("channel").bins if axis_bin.name == "position").p < 0.01


def test_a_disturbance_is_found_in_its_band() -> None:
    location = localise(campaign(1, lambda run: 10.0 * np.cos(2 * np.pi * 0.2 * run.time_s)))
    band = location.location("band_hz")
    assert (band.low, band.high) == (0.1, 0.3)
    assert band.p < 0.01


@pytest.mark.parametrize(
    ("planted", "domain"),
    [
        thorough(lift_off, "speed"),
        (stribeck, "speed"),
        thorough(tether, "position"),
        (folds, "position"),
        (ageing, "session"),
        thorough(pulses, "session"),
        (creep, "time"),
        (stiffening, "strain"),
        (ringing, "transient"),
    ],
)
@pytest.mark.parametrize("seed", [1, thorough(2)])
def test_what_the_residual_is_a_function_of_is_said(planted: Planted, domain: str, seed: int) -> None:
    assert localise(campaign(seed, planted), present=True).domain == domain


def test_hum_is_seen_in_its_band() -> None:
    time = np.arange(0.0, 4.0, 0.002)
    noise = np.random.default_rng(0).normal(0.0, SD["force"], time.size)
    expected = band_powers(noise, 500.0)
    shown = band_powers(noise + 6.0 * np.sin(2 * np.pi * 50.0 * time), 500.0)
    assert shown[6] - expected[6] == pytest.approx(18.0, rel=0.05)


def test_powers_add_up_to_the_variance() -> None:
    signal = np.random.default_rng(1).normal(3.0, 2.0, 1001)
    assert band_powers(signal, 500.0).sum() == pytest.approx(signal.var())
    assert band_powers(signal, 500.0).size == len(BANDS_HZ) - 1


@pytest.mark.parametrize(("seeds", "most"), [(20, 2), thorough(40, 5)])
def test_noise_is_nowhere_and_its_p_values_are_what_they_say(seeds: int, most: int) -> None:
    campaigns = [localise(campaign(seed), seed=seed) for seed in range(seeds)]
    assert sum(location.present for location in campaigns) <= most
    assert all(share == 0.0 for location in campaigns if not location.present for share in shares_of(location))
    for axis in ("protocol", "speed_mm_s", "session", "strain"):
        p = np.array([location.location(axis).p for location in campaigns])
        assert 0.25 < np.mean(p < 0.5) < 0.75
    for axis in ("channel", "protocol", "phase", "speed_mm_s", "position", "session", "band_hz"):
        assert np.mean([location.location(axis).p < 0.05 for location in campaigns]) < 0.15


def shares_of(where: GapLocation) -> list[float]:
    return [axis_bin.share for location in where.locations for axis_bin in location.bins]


def test_shares_along_an_axis_sum_to_1_or_are_all_0() -> None:
    location = localise(campaign(1, stribeck))
    sums = {entry.name: sum(axis_bin.share for axis_bin in entry.bins) for entry in location.locations}
    assert sums.pop("strain") == 0.0
    assert sums.pop("band_hz") == 0.0
    assert list(sums.values()) == pytest.approx([1.0] * len(sums))
    assert not any(shares_of(localise(campaign(1, stribeck), present=False)))


def test_every_run_counts_alike_however_long_it_is() -> None:
    location = localise(campaign(1, lambda run: 200.0 * moving(run, "drag") * np.isin(run.speed_mm_s, (0.5, 60.0))))
    share = {axis_bin.low: axis_bin.share for axis_bin in location.location("speed_mm_s").bins}
    in_motion = (80.0 / 84.0) / (0.82 / 4.82)
    assert share[0.5] / share[60.0] == pytest.approx(in_motion, rel=0.05)


def test_the_same_seed_gives_the_same_answer_whatever_the_order_of_the_runs() -> None:
    runs = campaign(1, stribeck)
    assert localise(runs, seed=3).document() == localise(runs[::-1], seed=3).document()


def test_the_report_s_form_is_kept() -> None:
    document = json.loads(json.dumps(localise(campaign(1, stribeck)).document()))
    assert set(document["channel"]) == {"force", "position"}
    assert set(document["protocol"]) == {"drag", "relaxation", "coulomb", "blank"}
    assert set(document["phase"]) == {"rest", "accelerate", "steady", "decelerate", "hold"}
    assert {"low", "high", "share"} <= set(document["speed_mm_s"])
    assert {"position", "session", "strain", "band_hz"} <= set(document)
    assert document["domain"] == "speed"
    assert {"low", "high", "share", "p"} == set(document["position"]["bins"][0])


def test_blocks_that_do_not_fit_together_are_refused() -> None:
    good = blocks("a", "force", "drag", 5.0, 0.0, 0.0)
    with pytest.raises(ValueError, match="differ in their number"):
        replace(good, residual=good.residual[1:])
    with pytest.raises(ValueError, match="positive noise"):
        replace(good, noise_sd=np.zeros_like(good.noise_sd))
    with pytest.raises(ValueError, match="no residuals"):
        localise([])


def test_a_named_effect_says_where_it_acts_when_no_block_stands_out() -> None:
    noise = campaign(1, lambda run: 0.0 * run.time_s)
    quiet = [replace(run, residual=0.5 * run.residual) for run in noise]
    location = localise(quiet, present=True)
    assert not any(location.location("channel").shares.values())
    added = [np.full_like(run.residual, 2.0 * (run.kind == "relaxation") * (run.channel == "force")) for run in quiet]
    shown = attribute_to_effects(location, quiet, added)
    assert shown.location("channel").shares["force"] == pytest.approx(1.0)
    assert shown.location("protocol").shares["relaxation"] == pytest.approx(1.0)
    assert shown.p == location.p


def test_what_stands_out_is_not_asked_of_the_effect() -> None:
    loud = campaign(1, tether)
    location = localise(loud, present=True)
    assert attribute_to_effects(location, loud, [np.zeros_like(run.residual) for run in loud]) is location


def test_speeds_that_differ_by_rounding_are_one_set_value() -> None:
    exact = campaign(1, stribeck)
    rounded = [replace(run, speed_mm_s=run.speed_mm_s * (1 - 2e-8 * (number % 3))) for number, run in enumerate(exact)]
    location_exact, location_off = map(localise, (exact, rounded))
    assert location_off.domain_scores == pytest.approx(location_exact.domain_scores)
    whole, off = (location.location("speed_mm_s") for location in (location_exact, location_off))
    assert [axis_bin.low for axis_bin in off.bins] == [axis_bin.low for axis_bin in whole.bins]
    assert [axis_bin.share for axis_bin in off.bins] == pytest.approx([axis_bin.share for axis_bin in whole.bins])
    assert (off.low, off.high, off.p) == (whole.low, whole.high, whole.p)
