"""The min/max pyramid: nothing that sticks out is hidden, whatever the zoom and however the samples came."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dragrig.window import trace_pyramid
from dragrig.window.trace_pyramid import TraceCrossings, TracePath, TracePyramid
from property_tests import examples


@settings(deadline=None, max_examples=examples(80))
@given(
    blocks=st.lists(st.integers(1, 700), min_size=1, max_size=12),
    base=st.integers(1, 9),
    columns=st.integers(2, 50),
    ends=st.tuples(st.floats(0, 1), st.floats(0, 1)),
    seed=st.integers(0, 99),
)
def test_extremes_are_visible_at_every_zoom(
    blocks: list[int], base: int, columns: int, ends: tuple[float, float], seed: int
) -> None:
    values = np.random.default_rng(seed).normal(size=sum(blocks)).astype(np.float32)
    pyramid = TracePyramid(base)
    at = 0
    for count in blocks:
        pyramid.append(values[at : at + count])
        at += count
    start, stop = sorted(end * len(values) for end in ends)
    place, line = pyramid.view(start, stop, columns)
    inside = values[int(start) : int(stop) + 1]
    assert len(line) <= 4 * columns + 4
    assert np.all(np.diff(place) >= 0)
    if len(inside):
        assert line.min() <= inside.min()
        assert line.max() >= inside.max()
    whole, line = pyramid.view(0, len(values), columns)
    assert (line.min(), line.max()) == (values.min(), values.max())
    assert whole[0] == 0


def test_every_sample_is_drawn_when_zoomed_in() -> None:
    values = np.arange(100_000, dtype=np.float32)
    pyramid = TracePyramid()
    pyramid.append(values)
    place, line = pyramid.view(500, 600, 200)
    np.testing.assert_array_equal(place, line)
    assert place[0] == 500


def test_a_gap_hides_no_neighbouring_samples() -> None:
    values = np.ones(5000, np.float32)
    values[100:4000] = np.nan
    values[4500] = 7.0
    pyramid = TracePyramid()
    pyramid.append(values)
    _, line = pyramid.view(0, 5000, 20)
    assert np.nanmax(line) == 7.0
    assert np.isnan(line).any()


@pytest.mark.parametrize("count", [0, 1])
def test_empty_and_single_sample_traces_can_be_drawn(count: int) -> None:
    pyramid = TracePyramid()
    pyramid.append(np.zeros(count, np.float32))
    place, _ = pyramid.view(0, 10, 100)
    assert len(place) == count


def test_a_line_is_drawn_with_short_strokes_between_columns() -> None:
    values = np.random.default_rng(2).normal(size=100_000).astype(np.float32)
    pyramid = TracePyramid()
    pyramid.append(values)
    _, line = pyramid.view(0, len(values), 300)
    across = np.abs(np.diff(line))[1::2]
    assert across.max() < np.abs(np.diff(line))[::2].min()


def test_a_long_trace_along_the_way_keeps_its_peaks_and_its_gaps() -> None:
    count = 3_000_000
    x = np.linspace(0.0, 30.0, count, dtype=np.float32)
    y = np.sin(x)
    y[1_234_567], y[2_000_000:2_100_000] = 50.0, np.nan
    path = TracePath(x, y)
    assert path.ends == pytest.approx((0.0, 30.0))
    for low, high in ((0.0, 30.0), (12.3, 12.4)):
        shown_x, shown_y = path.view(low, high, 800)
        assert len(shown_x) < 10_000
        assert np.nanmax(shown_y) == 50.0
        assert shown_x.min() == pytest.approx(low, abs=0.01)
        assert shown_x.max() == pytest.approx(high, abs=0.01)
    shown_x, shown_y = path.view(19.0, 22.0, 800)
    assert np.isnan(shown_y[(shown_x > 20.01) & (shown_x < 20.99)]).all()


def test_a_way_there_and_back_does_not_jump_across_what_is_not_shown() -> None:
    x = np.concatenate((np.linspace(0, 10, 1000), np.linspace(10, 0, 1000)))
    shown_x, shown_y = TracePath(x, np.arange(2000.0)).view(2.0, 4.0, 800)
    assert np.isnan(shown_y).sum() == 1
    assert len(shown_x) == pytest.approx(400, abs=8)


@given(
    values=st.lists(st.one_of(st.floats(-5.0, 5.0, width=32), st.just(float("nan"))), max_size=60),
    wanted=st.floats(-6.0, 6.0, width=32),
    blocks=st.integers(1, 40),
)
def test_where_a_channel_first_comes_to_a_value_is_found_as_by_going_through_all(
    values: list[float], wanted: float, blocks: int
) -> None:
    known = [(at, value) for at, value in enumerate(values) if not math.isnan(value)]
    beyond = [(at, value >= wanted) for at, value in known]
    expected = next((at for (at, before), (_, after) in pairwise(beyond) if before != after), None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trace_pyramid, "MAX_PATH_BLOCKS", blocks)
        assert TraceCrossings(np.array(values, np.float32)).first(wanted) == expected
