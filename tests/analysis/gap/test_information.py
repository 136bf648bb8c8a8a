"""What a run is expected to tell: bits between nothing and all that is open, and none of what shows nothing."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dragrig.analysis.gap.diagnosis import UNEXPLAINED
from dragrig.analysis.gap.information import EVIDENCE_WEIGHT, BudgetForecast, entropy_bits, expected_bits
from property_tests import examples

SIZES = st.integers(1, 7)


def mixture(seed: int, count: int, directions: int = 3) -> BudgetForecast:
    random = np.random.default_rng(seed)
    roots = 0.5 * random.standard_normal((count, directions, directions))
    names = [("stribeck",), (), ("adhesion",), ("stribeck", "folds"), (UNEXPLAINED,), ("folds",), ("stribeck",)]
    return BudgetForecast(
        tuple(names[:count]),
        random.dirichlet(np.ones(count)),
        2.0 * random.standard_normal((count, directions)),
        roots @ np.swapaxes(roots, 1, 2),
        np.zeros((directions, directions)),
    )


@settings(max_examples=examples(60), deadline=None)
@given(seed=st.integers(0, 10_000), count=SIZES, scale=st.floats(0.0, 1e4))
def test_a_run_tells_something_between_nothing_and_all_that_is_open(seed: int, count: int, scale: float) -> None:
    forecast = mixture(seed, count)
    seen = forecast.with_run(scale * np.eye(3))
    assert -1e-9 <= seen.bits <= forecast.open_bits + 1e-9
    for cause in forecast.names:
        assert -1e-9 <= seen.bits_about(cause) <= 1.0 + 1e-9
    assert forecast.bits == pytest.approx(0.0, abs=1e-9)


@settings(max_examples=examples(40), deadline=None)
@given(seed=st.integers(0, 10_000), count=SIZES)
def test_a_better_look_tells_no_less(seed: int, count: int) -> None:
    forecast = mixture(seed, count)
    told = [forecast.with_run(scale * np.diag([1.0, 0.5, 0.1])).bits for scale in (0.1, 1.0, 10.0, 1e6)]
    assert all(later >= earlier - 1e-9 for earlier, later in pairwise(told))


def test_what_cannot_be_told_apart_is_not_expected_to_be() -> None:
    forecast = mixture(3, 5)
    blind = replace(forecast, means=np.zeros_like(forecast.means), covariances=np.tile(np.eye(3), (5, 1, 1)))
    assert blind.with_run(1e6 * np.eye(3)).bits == pytest.approx(0.0, abs=1e-6)
    sure = replace(forecast, weights=np.array([1.0, 0.0, 0.0, 0.0, 0.0]) * (1 - 1e-12) + 2e-13)
    assert sure.with_run(1e6 * np.eye(3)).bits < 1e-6


def test_explanations_that_name_the_same_causes_are_one_answer() -> None:
    forecast = mixture(1, 7)
    same = replace(forecast, causes=(("stribeck",),) * 7)
    assert same.open_bits == pytest.approx(0.0, abs=1e-12)
    assert same.with_run(1e6 * np.eye(3)).bits == pytest.approx(0.0, abs=1e-6)
    # Whichever of two that predict the same is meant, all that is open is told.
    weights, apart = np.array([0.3, 0.2, 0.5]), 50.0 * np.array([[0, 0, 1], [0, 0, 1], [1, 1, 0]])
    assert expected_bits(weights, apart, ("folds", "folds", "none")) == pytest.approx(1.0)
    # An explanation whose probability is zero, far from all others, changes nothing.
    more = np.pad(apart, ((0, 1), (0, 1)), constant_values=2000.0)
    assert expected_bits(np.append(weights, 0.0), more, ("folds", "folds", "none", "drift")) == pytest.approx(1.0)


@pytest.mark.parametrize("apart", [1.0, 2.0, 4.0, 8.0])
def test_the_estimate_is_near_the_information_that_sampling_finds(apart: float) -> None:
    """Of two Gaussians, a distance apart, either as likely: the estimate never exceeds it, and has at least half."""
    random = np.random.default_rng(20261125)
    side = random.integers(0, 2, 200_000)
    values = random.standard_normal(side.size) + apart * side
    densities = np.exp(-0.5 * (values[:, None] - np.array([0.0, apart])) ** 2)
    own = densities[np.arange(side.size), side] / densities.sum(axis=1)
    sampled = 1.0 + float(np.mean(np.log2(own)))
    distance = apart**2 / 8
    estimated = expected_bits(np.full(2, 0.5), distance * (1 - np.eye(2)), ("here", "not"))
    assert 0.5 * sampled < estimated < sampled + 0.01
    forecast = BudgetForecast(
        (("stribeck",), ()), np.full(2, 0.5), np.array([[0.0], [apart]]), np.zeros((2, 1, 1)), np.zeros((1, 1))
    )
    halved = expected_bits(np.full(2, 0.5), EVIDENCE_WEIGHT * distance * (1 - np.eye(2)), ("here", "not"))
    assert forecast.with_run(np.eye(1)).bits == pytest.approx(halved)


def test_entropy_is_that_of_the_labels() -> None:
    assert entropy_bits(np.array([0.25, 0.25, 0.5]), ("a", "a", "b")) == pytest.approx(1.0)
    assert entropy_bits(np.array([1.0]), ("a",)) == pytest.approx(0.0)
