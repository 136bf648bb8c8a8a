"""Savitzky–Golay, whole and streaming."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from scipy.signal import savgol_filter

from dragrig.analysis.savgol import SavgolSettings, SavgolStream, smooth
from dragrig.analysis.segments import gap_starts, unbroken_slices
from dragrig.config.errors import AnalysisError
from dragrig.rig.profile import FloatArray
from property_tests import examples

RATE = 500.0


def wandering(samples: int, seed: int = 3) -> FloatArray:
    rng = np.random.default_rng(seed)
    return np.asarray(40 + np.cumsum(rng.normal(size=samples)), dtype=np.float64)


def by_least_squares(values: FloatArray, window: int, order: int, derivative: int) -> FloatArray:
    """Fit the definition: a polynomial in each window, at the ends in the first and last one."""
    half = window // 2
    result = np.empty(len(values))
    for k in range(len(values)):
        middle = min(max(k, half), len(values) - 1 - half)
        at = np.arange(middle - half, middle + half + 1)
        fit = Polynomial.fit(at / RATE, values[at], order)
        result[k] = fit.deriv(derivative)(k / RATE) if derivative else fit(k / RATE)
    return result


@pytest.mark.parametrize(
    ("window", "order", "derivative"), [(5, 2, 0), (25, 3, 0), (25, 3, 1), (31, 4, 2), (101, 8, 0)]
)
def test_agrees_with_the_definition_ends_included(window: int, order: int, derivative: int) -> None:
    values = wandering(700)
    settings_ = SavgolSettings(window_samples=window, order=order, derivative=derivative)
    wanted = by_least_squares(values, window, order, derivative)
    result = smooth(values, RATE, settings_).values
    np.testing.assert_allclose(result, wanted, rtol=0, atol=1e-8 * np.abs(wanted).max())


def test_keeps_polynomials_and_their_derivative() -> None:
    time = np.arange(200) / RATE
    cubic = 1 + 2 * time - 30 * time**2 + 400 * time**3
    remaining = smooth(cubic, RATE, SavgolSettings(window_s=0.05, order=3))
    slope = smooth(cubic, RATE, SavgolSettings(window_s=0.05, order=3, derivative=1))
    np.testing.assert_allclose(remaining.values, cubic, atol=1e-10)
    np.testing.assert_allclose(slope.values, 2 - 60 * time + 1200 * time**2, atol=1e-7)


def test_a_gap_is_not_crossed_and_a_short_piece_becomes_nan_with_an_event() -> None:
    values = np.concatenate((wandering(100, 1), wandering(10, 2) + 500, wandering(80, 3) - 500))
    time = np.concatenate((np.arange(100), 110 + np.arange(10), 150 + np.arange(80))) / RATE
    gaps = gap_starts(time, RATE)
    assert gaps.tolist() == [100, 110]
    setting = SavgolSettings(window_samples=25)
    result = smooth(values, RATE, setting, gaps, time)
    np.testing.assert_array_equal(result.values[:100], smooth(values[:100], RATE, setting).values)
    assert np.isnan(result.values[100:110]).all()
    np.testing.assert_array_equal(result.values[110:], smooth(values[110:], RATE, setting).values)
    (event,) = result.events
    assert event.time_s == time[100]
    assert "10 samples" in event.message
    assert "25" in event.message


def test_a_missing_value_parts_a_trace_as_a_gap_does() -> None:
    values = wandering(100)
    values[60] = np.nan
    setting = SavgolSettings(window_samples=11)
    result = smooth(values, RATE, setting).values
    assert np.flatnonzero(np.isnan(result)).tolist() == [60]
    np.testing.assert_array_equal(result[:60], smooth(values[:60], RATE, setting).values)


@st.composite
def cases(draw: st.DrawFn) -> tuple[int, SavgolSettings, list[int], list[int], list[int]]:
    order = draw(st.integers(0, 6))
    half = draw(st.integers(max(1, (order + 1) // 2), 40))
    derivative = draw(st.integers(0, min(order, 2)))
    samples = draw(st.integers(2 * half + 1, 400))
    inside = st.integers(0, samples)
    gaps = sorted(set(draw(st.lists(inside, max_size=3))) - {0, samples})
    cuts = sorted({*draw(st.lists(inside, max_size=12)), *gaps, 0, samples})
    missing = draw(st.lists(st.integers(0, samples - 1), max_size=2))
    return samples, SavgolSettings(window_samples=2 * half + 1, order=order, derivative=derivative), gaps, cuts, missing


@settings(max_examples=examples(150), deadline=None)
@given(cases())
@example((30, SavgolSettings(window_samples=5, order=2), [10, 12], [0, 10, 12, 13, 30], []))
def test_the_stream_gives_what_the_whole_trace_gives(
    case: tuple[int, SavgolSettings, list[int], list[int], list[int]],
) -> None:
    samples, setting, gaps, cuts, missing = case
    values = wandering(samples)
    values[missing] = np.nan
    whole = smooth(values, RATE, setting, gaps)
    stream = SavgolStream(RATE, setting)
    parts = []
    for start, stop in pairwise(cuts):
        lost = 7 * sum(gap <= start for gap in gaps)
        parts.append(stream.push(values[start:stop], first_index=start + lost))
    parts.append(stream.flush())
    streamed = np.concatenate(parts)
    scale = np.abs(whole.values[np.isfinite(whole.values)]).max(initial=1e-300)
    np.testing.assert_allclose(streamed, whole.values, rtol=0, atol=1e-12 * scale)
    assert len(stream.events) == len(whole.events)


def test_a_window_of_thousands_of_samples_streams_and_stays_exact() -> None:
    time = np.arange(40_000) / 250_000
    quartic = 40 + time - 3e2 * time**3 + 2e3 * time**4
    setting = SavgolSettings(window_s=0.05, order=4)
    whole = smooth(quartic, 250_000, setting).values
    stream = SavgolStream(250_000, setting)
    streamed = np.concatenate([*(stream.push(block) for block in np.array_split(quartic, 7)), stream.flush()])
    np.testing.assert_allclose(whole, quartic, rtol=1e-12)
    np.testing.assert_allclose(streamed, whole, rtol=1e-12)


def test_agrees_with_scipy_where_scipy_is_well_conditioned() -> None:
    values = wandering(400)
    for derivative in (0, 1, 2):
        result = smooth(values, RATE, SavgolSettings(window_samples=25, derivative=derivative)).values
        wanted = savgol_filter(values, 25, 3, derivative, 1 / RATE, mode="interp")
        np.testing.assert_allclose(result, wanted, rtol=0, atol=1e-12 * np.abs(wanted).max())


def test_the_stream_lags_half_a_window_and_no_more() -> None:
    stream = SavgolStream(RATE, SavgolSettings(window_samples=25))
    values = wandering(200)
    assert len(stream.push(values[:24])) == 0
    assert len(stream.push(values[24:25])) == 13
    for sample in values[25:]:
        assert len(stream.push([sample])) == 1
    assert len(stream.flush()) == 12


def test_the_stream_refuses_samples_from_the_past() -> None:
    stream = SavgolStream(RATE, SavgolSettings(window_samples=5))
    stream.push(wandering(50), first_index=10)
    with pytest.raises(AnalysisError, match="Sample 30 was pushed after sample 59"):
        stream.push(wandering(5), first_index=30)


@pytest.mark.parametrize(
    ("given_", "message"),
    [
        ({}, "either in seconds or in samples"),
        ({"window_s": 0.1, "window_samples": 11}, "either in seconds or in samples"),
        ({"window_samples": 24}, "odd number, 23 or 25"),
        ({"window_samples": 3, "order": 3}, "at least 5 samples"),
        ({"window_samples": 25, "order": 9}, "choose 0 to 8"),
        ({"window_samples": 25, "order": 2, "derivative": 3}, "from 0 to 2"),
        ({"window_s": -0.1}, "above 0 s"),
        ({"window_s": float("nan")}, "above 0 s"),
    ],
)
def test_impossible_settings_are_refused_in_one_sentence(given_: dict[str, float], message: str) -> None:
    with pytest.raises(AnalysisError, match=message):
        SavgolSettings(**given_)  # type: ignore[arg-type]


def test_a_window_that_does_not_suit_rate_or_run_is_refused() -> None:
    with pytest.raises(AnalysisError, match=r"at 20 Hz.*at least 5 samples \(0\.25 s\)"):
        SavgolSettings(window_s=0.05).samples(20.0)
    with pytest.raises(AnalysisError, match="longer than the whole run of 20 samples"):
        smooth(np.zeros(20), RATE, SavgolSettings(window_samples=21))
    with pytest.raises(AnalysisError, match="lies outside"):
        list(unbroken_slices(np.zeros(5), [9]))


@pytest.mark.parametrize(
    ("seconds", "rate", "samples"), [(0.05, 500, 25), (0.05, 1000, 51), (0.1, 100, 11), (1, 7.4, 7), (0.29, 100, 29)]
)
def test_a_window_in_seconds_becomes_the_nearest_odd_number(seconds: float, rate: float, samples: int) -> None:
    assert SavgolSettings(window_s=seconds).samples(rate) == samples


@pytest.mark.parametrize("window", [5, 51, 501, 4001])
@pytest.mark.parametrize("derivative", [0, 1])
def test_a_long_trace_is_shown_as_it_is_filtered(window: int, derivative: int) -> None:
    samples = np.random.default_rng(3).normal(100.0, 3.0, 90_001)
    samples[40_000] = np.nan
    how = SavgolSettings(window_samples=window, order=3, derivative=derivative)
    exact = smooth(samples, 1000.0, how, gaps=[70_000])
    shown = smooth(samples, 1000.0, how, gaps=[70_000], for_display=True)
    largest = float(np.nanmax(np.abs(exact.values)))
    np.testing.assert_allclose(shown.values, exact.values, rtol=0, atol=1e-11 * max(largest, 100.0))
    assert shown.events == exact.events
