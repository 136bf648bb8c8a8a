"""Steady friction, skew resistance, and the two published parameter sets."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dragrig.config.errors import SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.sim_backend.friction import parameter_set_differences, skew_resistance, steady_forces, wall_parameters
from friction_cases import ROUGH
from property_tests import examples

MODEL = FrictionModelSettings()
LENGTH = 6.45 * np.sin(np.radians(60))


def largest(parameter: str) -> tuple[float, float]:
    rows = [row for row in parameter_set_differences() if row.parameter == parameter]
    assert [row.strain for row in rows] == [0.5, 1.0, 1.5, 2.0]
    return max(abs(row.eq14_difference) for row in rows), max(abs(row.quadratic_difference) for row in rows)


@pytest.mark.parametrize(
    ("parameter", "eq14", "quadratic"),
    [("E1", 0.20, 0.004), ("E2", 0.27, 0.04), ("E3", 0.07, 0.023), ("eta1", 0.14, 0.09), ("eta2", 0.11, 0.094)],
)
def test_eq14_and_table1_disagree_by_as_much_as_they_do(parameter: str, eq14: float, quadratic: float) -> None:
    of_polynomial, of_quadratic = largest(parameter)
    assert of_polynomial == pytest.approx(eq14, abs=0.006)
    assert of_quadratic == pytest.approx(quadratic, abs=0.005)


def test_disagreement_quotes_both_sides() -> None:
    row = next(row for row in parameter_set_differences() if row.parameter == "E1" and row.strain == 2.0)
    assert row.table1 == 1.726
    assert row.eq14 == pytest.approx(-0.1617 * 4 - 0.3175 * 2 + 3.348)
    assert row.eq14_difference == pytest.approx(row.eq14 / 1.726 - 1)
    assert row.quadratic == float(wall_parameters("table1", 2.0).E1)


def test_the_quadratic_is_the_least_squares_one() -> None:
    """Residuals of a least-squares quadratic are orthogonal to 1, ε and ε²."""
    strain = np.array([0.5, 1.0, 1.5, 2.0])
    table = np.array([row.table1 for row in parameter_set_differences() if row.parameter == "eta2"])
    residual = wall_parameters("table1", strain).eta2 - table
    assert np.abs(np.vander(strain, 3).T @ residual).max() < 1e-12
    assert np.abs(residual).max() > 0.01


def test_steady_forces_differ_between_the_parameter_sets() -> None:
    speeds = [0.5, 20.0, 60.0]
    eq14, table1 = (
        steady_forces(speeds, MODEL.model_copy(update={"wall": wall}), ROUGH, 2.5) for wall in ("eq14", "table1")
    )
    assert np.abs(table1.f_e / eq14.f_e - 1).max() > 0.02
    np.testing.assert_array_equal(table1.f_v, eq14.f_v)


def test_skew_resistance_peaks_inside_the_contact_keeps_its_side_value_and_ends() -> None:
    x = np.linspace(-1.0, 30.0, 3101)
    skew = skew_resistance(x, 20.0, MODEL, ROUGH, 2.5)
    steady = steady_forces([20.0], MODEL, ROUGH, 2.5)
    assert skew.max() == pytest.approx(steady.max_skew[0], rel=1e-4)
    assert x[skew.argmax()] == pytest.approx(steady.x_of_max_skew[0], abs=0.02)
    side = (x >= LENGTH) & (x < LENGTH + 20.0)
    np.testing.assert_allclose(skew[side], steady.side_pressure_force[0], rtol=1e-12)
    assert not skew[(x < -1e-9) | (x >= LENGTH + 20.0)].any()


def test_skew_resistance_broadcasts() -> None:
    x, speeds = np.linspace(0.0, 5.0, 7), np.array([[1.0], [10.0]])
    curves = skew_resistance(x, speeds, MODEL, ROUGH, 2.5)
    assert curves.shape == (2, 7)
    np.testing.assert_array_equal(curves[1], skew_resistance(x, 10.0, MODEL, ROUGH, 2.5))


@settings(max_examples=examples(40), deadline=None, derandomize=True)
@given(speed=st.floats(1e-3, 1e3), factor=st.floats(1.01, 10.0))
def test_every_part_rises_with_speed(speed: float, factor: float) -> None:
    steady = steady_forces([speed, speed * factor], MODEL, ROUGH, 2.5)
    for part in (steady.f_e, steady.f_v, steady.f_c, steady.total):
        assert part[1] > part[0] * (1 - 1e-12)
    np.testing.assert_array_equal(steady.total, steady.f_e + steady.f_v + steady.f_c)


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan")])
def test_a_speed_that_is_not_positive_is_refused(speed: float) -> None:
    with pytest.raises(SettingsError, match="above 0 mm/s"):
        steady_forces([1.0, speed], MODEL, ROUGH, 2.5)
