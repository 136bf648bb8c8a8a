"""Oversampling with its anti-alias filter, and the clock that the card really makes."""

from collections.abc import Sequence
from contextlib import closing
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from card_bench import CardRig, card_rig, indices, joined
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import TripCause
from dragrig.rig.hardware.backend import check_card
from dragrig.rig.hardware.card.oversampling import (
    STOPBAND_DB,
    WINGS,
    AntiAliasFilter,
    OversampledFetcher,
    find_aliases,
    oversampling_factor,
)
from dragrig.rig.hardware.card.scaling import Scaling
from dragrig.rig.hardware.card.tasks import SampleBatch, SampleFetcher
from dragrig.rig.hardware.lines import CardLines
from dragrig.rig.profile import FloatArray
from simulated import PATIENT, rest, settings, stroke

PACE = 3.0
TONE = {"force_tone_mN": 200.0, "force_tone_hz": 16_000.0}
MOTOR = {"name": "motor_force", "channel": "ai1", "unit": "mN", "per_V": 1000.0}
QUIET = {"noise": {"white_mN": 0.0, "slow_mN": 0.0, "zero_mN": 0.0}}


def wired(rate_hz: float = 1000.0, **card: object) -> RigSettings:
    return settings(rate_hz, guard=PATIENT["guard"], simulated=QUIET, hardware={"card": card})


def checks(under_test: CardRig) -> dict[str, tuple[bool, str]]:
    with closing(CardLines(under_test.connection)) as lines:
        scaling = Scaling.from_settings(under_test.rig, {})
        found = check_card(under_test.connection, under_test.rig, under_test.sampler, scaling, lines)
        return {check.name: (check.passed, check.detail) for check in found}


@pytest.mark.parametrize("factor", [2, 8, 25])
def test_the_filter_stops_what_would_fold_into_the_pass_band(factor: int) -> None:
    anti_alias = AntiAliasFilter.of(factor)
    passed = anti_alias.gain(np.linspace(0.0, 0.25, 200))
    stopped = anti_alias.gain(np.linspace(0.75, factor / 2, 2000))
    assert np.abs(20 * np.log10(passed)).max() < 0.002
    assert 20 * np.log10(stopped.max()) < -STOPBAND_DB
    assert anti_alias.gain(np.array([0.5]))[0] == pytest.approx(0.5, abs=0.01)
    np.testing.assert_array_equal(anti_alias.taps, anti_alias.taps[::-1])
    assert anti_alias.taps.sum() == pytest.approx(1.0)


class Delivered:
    """A fetcher that delivers given samples in given portions."""

    def __init__(self, volts: FloatArray, portions: Sequence[int], lost_before: int = 0) -> None:
        self._volts, self._portions = volts, list(portions)
        self.next_index, self.lost, self.acquired = lost_before, 0, len(volts)
        self._lost = lost_before

    def fetch(self, samples: int) -> SampleBatch:
        count = min(samples, self._portions.pop(0) if self._portions else samples, len(self._volts) - self.next_index)
        index = np.arange(self.next_index, self.next_index + count)
        lost, self._lost = (self._lost, 0) if count else (0, self._lost)
        self.next_index += count
        volts = self._volts[None, index]
        return SampleBatch(int(index[0]) if count else self.next_index, lost, volts, index.astype(float), volts[0])


def recorded(volts: FloatArray, factor: int, portions: Sequence[int], lost: int = 0) -> list[SampleBatch]:
    source = cast("SampleFetcher", Delivered(volts, portions, lost))
    fetcher, batches = OversampledFetcher(source, AntiAliasFilter.of(factor), 1), []
    for _ in range(len(portions) + 50):
        batch = fetcher.fetch(7)
        if batch.samples:
            batches.append(batch)
    return batches


@given(
    portions=st.lists(st.integers(0, 60), max_size=30), factor=st.integers(2, 9), lost=st.integers(0, 40),
    seed=st.integers(0, 9),
)  # fmt: skip
def test_however_the_samples_come_the_record_is_the_same(
    portions: list[int], factor: int, lost: int, seed: int
) -> None:
    volts = np.random.default_rng(seed).normal(size=300)
    taps = AntiAliasFilter.of(factor).taps
    got = recorded(volts, factor, portions, lost)
    first = -(-lost // factor)
    assert got[0].first_index == first
    assert got[0].lost == first
    counts = np.concatenate([batch.counts for batch in got])
    complete = (len(volts) - 1 - WINGS * factor) // factor + 1 - first
    np.testing.assert_array_equal(counts, (first + np.arange(complete)) * factor)
    padded = np.concatenate([np.full(len(taps), volts[lost]), volts[lost:]])
    filtered = np.convolve(padded, taps)[len(taps) + len(taps) // 2 :]
    force = np.concatenate([batch.volts[0] for batch in got])
    np.testing.assert_allclose(force, filtered[np.arange(first, first + complete) * factor - lost], atol=1e-12)


def test_a_slow_force_is_recorded_when_it_was_and_as_high_as_it_was() -> None:
    with card_rig(wired(), pace=PACE) as under_test:
        under_test.bench.faults.inject(force_tone_mN=500.0, force_tone_hz=40.0)
        got = under_test.record(rest(0.6))
        assert under_test.sampler.timing.rate_hz == 25_000.0
    assert indices(got).tolist() == list(range(600))
    time = indices(got)[20:] / 1000.0
    parts = np.column_stack((np.sin(2 * np.pi * 40.0 * time), np.cos(2 * np.pi * 40.0 * time), np.ones_like(time)))
    amplitude, shifted, _ = np.linalg.lstsq(parts, joined(got, "force")[20:], rcond=None)[0]
    assert amplitude == pytest.approx(500.0, rel=1e-3)
    # A sample late would be 125 mN.
    assert abs(shifted) < 1.0


def test_force_and_position_stay_the_same_instants() -> None:
    with card_rig(wired(inputs=[MOTOR]), pace=PACE) as under_test:
        got = under_test.record(stroke(travel_mm=5.0))
        instants = indices(got) * 25
        counts = under_test.bench.at("encoder_counts", instants)
        motor = under_test.bench.at("motor_force", instants)
    assert indices(got).tolist() == list(range(stroke(travel_mm=5.0).samples(1000.0)))
    np.testing.assert_array_equal(joined(got, "position"), counts * 0.001)
    assert np.corrcoef(joined(got, "motor_force"), motor)[0, 1] > 0.95


def test_a_tone_beyond_the_recorded_band_leaves_no_line_in_it() -> None:
    lines = {}
    for oversampling in (0, 1):
        with card_rig(wired(oversampling=oversampling), pace=PACE) as under_test:
            under_test.bench.faults.inject(**{**TONE, "force_tone_hz": 16_100.0})
            force = joined(under_test.record(rest(0.5)), "force")[20:]
            lines[oversampling] = float(np.abs(np.fft.rfft(force - force.mean())).max()) * 2 / len(force)
    assert lines[1] > 150.0
    assert lines[0] < 0.1


def test_the_check_tells_a_tone_beyond_the_recorded_band_and_what_is_recorded_of_it() -> None:
    with card_rig(wired(oversampling=1), pace=PACE) as under_test:
        assert checks(under_test)["aliases"][0]
        under_test.bench.faults.inject(**TONE)
        passed, detail = checks(under_test)["aliases"]
        assert not passed
        assert "141." in detail
        assert "from 16000 Hz" in detail
    with card_rig(wired(), pace=PACE) as under_test:
        passed, detail = checks(under_test)["aliases"]
        assert passed
        assert "multiple of 25000 Hz" in detail
        under_test.bench.faults.inject(**TONE)
        passed, detail = checks(under_test)["aliases"]
        assert not passed
        assert "a tone of 16000 Hz, which the digital filter keeps out" in detail
        under_test.bench.faults.inject(force_tone_hz=25_200.0)
        passed, detail = checks(under_test)["aliases"]
        assert not passed
        assert "a line at 200 Hz from 25200 Hz" in detail


@pytest.mark.parametrize("samples", [50_000, 49_999])
def test_aliases_are_found_with_their_height(samples: int) -> None:
    time = np.arange(samples) / 250_000.0
    volts = 0.3 * np.sin(2 * np.pi * 16_130.0 * time) + 2.0 * np.sin(2 * np.pi * 100.0 * time)
    found = find_aliases(volts, 250_000.0, AntiAliasFilter.of(1), 1000.0)
    assert found.recorded_V == pytest.approx(0.3 / np.sqrt(2), rel=0.01)
    assert found.folded.rms_V == pytest.approx(0.3 / np.sqrt(2), rel=0.01)
    assert found.folded.recorded_hz == pytest.approx(130.0, abs=5.0)
    assert find_aliases(volts, 250_000.0, AntiAliasFilter.of(1), 250_000.0).input_V < 1e-3


def test_wide_noise_that_the_filter_keeps_out_is_no_tone() -> None:
    noise = np.random.default_rng(8).normal(0, 0.02, 50_000)
    found = find_aliases(noise, 250_000.0, AntiAliasFilter.of(25), 1000.0)
    assert found.input_V == pytest.approx(0.02, rel=0.02)
    assert found.strongest.rms_V < 0.001
    assert found.recorded_V < 0.004


def test_a_gap_in_the_cards_samples_is_a_gap_of_known_length_in_the_recorded() -> None:
    profile = stroke(travel_mm=20.0)
    with card_rig(wired(), pace=PACE) as under_test:
        faults = under_test.bench.faults
        got = under_test.record(profile, lambda _: faults.inject(overwritten_samples=2000))
        index = indices(got)
        counts = under_test.bench.at("encoder_counts", index * 25)
    steps = np.diff(index)
    gap = int(steps.max()) - 1
    assert np.count_nonzero(steps != 1) == 1
    assert gap >= 80
    assert index[-1] >= profile.samples(1000.0) - 1  # more where a busy computer starts the stage late
    (fault,) = (block.fault for block in got if block.fault is not None)
    assert fault.cause is TripCause.OVERRUN
    assert f"{gap} samples" in fault.message
    np.testing.assert_array_equal(joined(got, "position"), counts * 0.001)


@pytest.mark.parametrize(("rate_hz", "real_hz"), [(1000.0, 1000.0), (30_000.0, 20e6 / 667), (3000.0, 20e6 / 833 / 8)])
def test_the_rate_is_what_the_card_makes_of_its_time_base(rate_hz: float, real_hz: float) -> None:
    with card_rig(wired(rate_hz), pace=PACE) as under_test:
        assert under_test.sampler.sample_rate_hz == pytest.approx(real_hz, rel=1e-12)


def test_a_speed_is_right_although_the_card_cannot_make_the_rate() -> None:
    profile = stroke(travel_mm=10.0, speed_mm_s=20.0, accel_mm_s2=2000.0)
    with card_rig(wired(rate_hz=30_000.0), pace=PACE) as under_test:
        got = under_test.record(profile)
        rate_hz = under_test.sampler.sample_rate_hz
        position, time_s = joined(got, "position"), indices(got) / rate_hz
        detail = checks(under_test)["sampling rate"][1]
    assert "29985.01 Hz where 30000 are asked" in detail
    moving = (position > 2.0) & (position < 8.0)
    speed = np.polyfit(time_s[moving], position[moving], 1)[0]
    assert speed == pytest.approx(20.0, rel=2e-5)


def test_how_the_inputs_follow_each_other_and_whether_they_settle_is_told() -> None:
    with card_rig(wired(inputs=[MOTOR]), pace=PACE) as under_test:
        passed, detail = checks(under_test)["scan"]
        assert passed
        assert "force, motor_force: each is converted 14 µs after" in detail
    with card_rig(wired(rate_hz=125_000.0, inputs=[MOTOR]), pace=PACE) as under_test:
        passed, detail = checks(under_test)["scan"]
        assert not passed
        assert "90 ppm" in detail
        assert "analog filter" in checks(under_test)["aliases"][1]


@pytest.mark.parametrize(
    ("rate_hz", "inputs", "factor"),
    [(1000.0, 0, 25), (1000.0, 2, 23), (1000.0, 7, 8), (100.0, 0, 1), (12_500.0, 0, 2), (83_333.0, 2, 1)],
)
def test_as_many_samples_as_settle_make_a_recorded_one(rate_hz: float, inputs: int, factor: int) -> None:
    further = [{**MOTOR, "name": f"input_{place}", "channel": f"ai{place}"} for place in range(1, inputs + 1)]
    assert oversampling_factor(wired(rate_hz=rate_hz, inputs=further)) == factor
