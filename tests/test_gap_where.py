"""Where a gap is: what is planted in one place is found there, and noise is in none."""

import json
from dataclasses import replace

import numpy as np
import pytest
from residuals import SD, Planted, blocks, campaign

from dragrig.analysis.gap.diagnosis import GapLocation
from dragrig.analysis.gap.excess import BANDS_HZ, BandPowers, ResidualBlocks, band_powers
from dragrig.analysis.gap.localise import attribute_to_effects, localise
from dragrig.rig.arrays import FloatArray
from dragrig.rig.profile import Phase


def moving(one: ResidualBlocks, *kinds: str) -> FloatArray:
    inside = (one.phase != Phase.REST) & (one.phase != Phase.HOLD)
    return np.asarray(inside * (one.kind in kinds), dtype=np.float64)


def lift_off(one: ResidualBlocks) -> FloatArray:
    return -30.0 * moving(one, "drag") * (one.speed_mm_s > 25.0)


def stribeck(one: ResidualBlocks) -> FloatArray:
    return 30.0 * moving(one, "drag", "coulomb") * np.exp(-one.speed_mm_s / 3.0)


def tether(one: ResidualBlocks) -> FloatArray:
    return 0.8 * np.maximum(one.position_mm - 20.0, 0.0) * moving(one, "drag")


def folds(one: ResidualBlocks) -> FloatArray:
    return 8.0 * moving(one, "drag") * np.sin(2 * np.pi * one.position_mm / 6.0 + one.session_s)


def ageing(one: ResidualBlocks) -> FloatArray:
    return 20.0 * (one.session_s / 3000.0 - 0.5) * (one.kind in {"drag", "relaxation"}) * (one.phase != Phase.REST)


def pulses(one: ResidualBlocks) -> FloatArray:
    return 8.0 * np.cos(2 * np.pi * (one.session_s + one.time_s) / 4.3) * (one.kind == "drag")


def creep(one: ResidualBlocks) -> FloatArray:
    return 40.0 * one.strain * np.exp(-(one.time_s - 1.2) / 6.0) * (one.phase == Phase.HOLD)


def stiffening(one: ResidualBlocks) -> FloatArray:
    return 15.0 * one.strain**2 * np.exp(-np.maximum(one.time_s - 1.2, 0.0)) * (one.phase != Phase.REST)


def ringing(one: ResidualBlocks) -> FloatArray:
    changing = (one.phase == Phase.ACCELERATE) | (one.phase == Phase.DECELERATE)
    return np.asarray(60.0 * changing * (one.speed_mm_s / 60.0) * (one.strain == 0.0))


def test_a_gap_at_high_speed_is_found_there() -> None:
    found = localise(campaign(1, lift_off))
    assert found.present
    speed = found.location("speed_mm_s")
    assert (speed.low, speed.high) == (30.0, 60.0)
    assert speed.share > 0.95
    assert speed.p < 0.01
    assert found.location("channel").shares["force"] > 0.95
    assert found.location("protocol").shares["drag"] > 0.95
    phases = found.location("phase").shares
    assert phases["rest"] + phases["hold"] < 0.02
    assert found.location("session").p > 0.05


def test_a_gap_late_in_the_stroke_is_found_there() -> None:
    position = localise(campaign(1, tether)).location("position")
    assert (position.low, position.high) == (28.0, 40.0)
    assert position.p < 0.01
    standing_out = [one.p < 0.05 for one in position.bins]
    assert not any(standing_out[:5])
    assert all(standing_out[8:])


def test_a_gap_in_the_position_channel_is_told_from_one_in_the_force() -> None:
    found = localise(campaign(1, lambda one: 0.03 * moving(one, "drag", "blank", "coulomb"), channel="position"))
    assert found.location("channel").shares["position"] > 0.95
    assert next(one for one in found.location("channel").bins if one.name == "position").p < 0.01


def test_a_disturbance_is_found_in_its_band() -> None:
    found = localise(campaign(1, lambda one: 10.0 * np.cos(2 * np.pi * 0.2 * one.time_s)))
    band = found.location("band_hz")
    assert (band.low, band.high) == (0.1, 0.3)
    assert band.p < 0.01


@pytest.mark.parametrize(
    ("planted", "domain"),
    [
        (lift_off, "speed"),
        (stribeck, "speed"),
        (tether, "position"),
        (folds, "position"),
        (ageing, "session"),
        (pulses, "session"),
        (creep, "time"),
        (stiffening, "strain"),
        (ringing, "transient"),
    ],
)
def test_what_the_residual_is_a_function_of_is_said(planted: Planted, domain: str) -> None:
    for seed in (1, 2):
        assert localise(campaign(seed, planted), present=True).domain == domain


def test_hum_is_seen_in_the_powers_of_the_whole_trace() -> None:
    time = np.arange(0.0, 4.0, 0.002)
    noise = np.random.default_rng(0).normal(0.0, SD["force"], time.size)
    expected = band_powers(noise, 500.0)
    shown = band_powers(noise + 6.0 * np.sin(2 * np.pi * 50.0 * time), 500.0)
    assert shown[6] - expected[6] == pytest.approx(18.0, rel=0.05)
    power = BandPowers(shown, expected)
    hummed = [replace(one, bands=power, residual=one.residual + 1.0) for one in campaign(1) if one.channel == "force"]
    found = localise(hummed, present=True)
    assert (found.location("band_hz").low, found.location("band_hz").high) == (30.0, 100.0)
    assert found.domain_scores["frequency"] > 0.4


def test_powers_add_up_to_the_variance() -> None:
    signal = np.random.default_rng(1).normal(3.0, 2.0, 1001)
    assert band_powers(signal, 500.0).sum() == pytest.approx(signal.var())
    assert band_powers(signal, 500.0).size == len(BANDS_HZ) - 1


def test_noise_is_nowhere_and_its_p_values_are_what_they_say() -> None:
    campaigns = [localise(campaign(seed), seed=seed) for seed in range(40)]
    assert sum(one.present for one in campaigns) <= 5
    assert all(share == 0.0 for one in campaigns if not one.present for share in shares_of(one))
    for axis in ("protocol", "speed_mm_s", "session", "strain"):
        p = np.array([one.location(axis).least_p for one in campaigns])
        assert 0.25 < np.mean(p < 0.5) < 0.75
    for axis in ("channel", "protocol", "phase", "speed_mm_s", "position", "session", "band_hz"):
        assert np.mean([one.location(axis).least_p < 0.05 for one in campaigns]) < 0.15


def shares_of(found: GapLocation) -> list[float]:
    return [one.share for location in found.locations for one in location.bins]


def test_shares_along_an_axis_sum_to_1_or_are_all_0() -> None:
    found = localise(campaign(1, stribeck))
    sums = {one.name: sum(each.share for each in one.bins) for one in found.locations}
    assert sums.pop("strain") == 0.0
    assert sums.pop("band_hz") == 0.0
    assert list(sums.values()) == pytest.approx([1.0] * len(sums))
    assert not any(shares_of(localise(campaign(1, stribeck), present=False)))


def test_every_run_counts_alike_however_long_it_is() -> None:
    found = localise(campaign(1, lambda one: 200.0 * moving(one, "drag") * np.isin(one.speed_mm_s, (0.5, 60.0))))
    share = {one.low: one.share for one in found.location("speed_mm_s").bins}
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
    noise = campaign(1, lambda one: 0.0 * one.time_s)
    quiet = [replace(one, residual=0.5 * one.residual) for one in noise]
    found = localise(quiet, present=True)
    assert not any(found.location("channel").shares.values())
    added = [np.full_like(one.residual, 2.0 * (one.kind == "relaxation") * (one.channel == "force")) for one in quiet]
    shown = attribute_to_effects(found, quiet, added)
    assert shown.location("channel").shares["force"] == pytest.approx(1.0)
    assert shown.location("protocol").shares["relaxation"] == pytest.approx(1.0)
    assert shown.p == found.p


def test_what_stands_out_is_not_asked_of_the_effect() -> None:
    loud = campaign(1, tether)
    found = localise(loud, present=True)
    assert attribute_to_effects(found, loud, [np.zeros_like(one.residual) for one in loud]) is found
