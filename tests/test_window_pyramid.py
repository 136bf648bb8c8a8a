"""The min/max pyramid: nothing that sticks out is hidden, whatever the zoom and however the samples came."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dragrig.window.trace_pyramid import TracePyramid


@settings(deadline=None, max_examples=80)
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
