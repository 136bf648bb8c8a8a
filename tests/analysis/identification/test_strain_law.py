"""Laws of the elements over strain: fitted with honest errors, and simulated again as the polynomials that they are."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import dragrig
from dragrig.analysis.estimates import NORMAL_95, EstimatedQuantity
from dragrig.analysis.identification.identification import RelaxationFit
from dragrig.analysis.identification.relaxation_elements import (
    evaluate_strain_law,
    identify_relaxation,
    strain_laws,
    wall_polynomials,
)
from dragrig.analysis.selection import select_loaded_runs
from dragrig.cli.commands import dragrig_group
from dragrig.config.errors import AnalysisError, SettingsError
from dragrig.config.friction_model import FrictionModelSettings, WallPolynomials
from dragrig.config.settings import parse, read_settings_file, to_toml
from dragrig.present.identification_figures import relaxation_fit_figure
from dragrig.sim_backend.friction import prepare, steady_forces, wall_parameters
from dragrig.sim_backend.friction.wall import EQ14, TABLE1, TABLE1_STRAIN
from friction_cases import ROUGH, moves, sliding, sticking

NAMES = ("E1", "E2", "E3", "eta1", "eta2")
EQ14_LAWS = WallPolynomials.model_validate(dict(zip(NAMES, EQ14, strict=True)))


def polynomial(**laws: tuple[float, ...]) -> FrictionModelSettings:
    return FrictionModelSettings(
        name="own", wall="polynomial", wall_polynomials=EQ14_LAWS.model_copy(update=laws), e1_scale=1.3
    )


@pytest.mark.parametrize("acquisition", [sliding(moves((20.0, 10.0))), sticking(moves((2.5, 20.0)), 1.0)])
def test_polynomials_with_the_numbers_of_eq_14_are_eq_14(acquisition) -> None:
    time = np.linspace(0.0, 4.0, 500)
    published = prepare(acquisition, FrictionModelSettings(e1_scale=1.3)).force(time)
    np.testing.assert_allclose(prepare(acquisition, polynomial()).force(time), published, rtol=1e-12, atol=1e-9)


def test_any_degree_up_to_the_fourth_counts_from_the_highest_power() -> None:
    flat, quartic = polynomial(E3=(1.0,)), polynomial(E3=(0.1, 0.0, 0.0, 0.0, 1.0))
    time = np.array([3.0])
    acquisition = sticking(moves((5.0, 20.0)), 2.0)
    grown = prepare(acquisition, quartic).force(time) - prepare(acquisition, flat).force(time)
    # E3 is 0.1 · 2⁴ = 1.6 kPa more at 200 %, on π · 12.9 · 15.2 mm².
    assert grown == pytest.approx(1.6 * 2.0 * np.pi * 12.9 * 15.2)


def test_a_model_file_keeps_its_polynomials_and_the_command_takes_it(tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    file.write_text(to_toml(polynomial()), encoding="utf-8")
    assert read_settings_file(FrictionModelSettings, file) == polynomial()
    published = tmp_path / "published.toml"
    published.write_text("name = 'published'\ne1_scale = 1.3\n", encoding="utf-8")
    of_own, of_eq14 = (forces_told(path) for path in (file, published))
    assert of_own == pytest.approx(of_eq14)


def forces_told(model: Path) -> dict[str, float]:
    """Return what `dragrig model` says of a speed."""
    words = ["model", "--model", str(model), "--speeds", "20", "--json"]
    result = CliRunner().invoke(dragrig_group, words)
    assert result.exit_code == 0, result.output
    (row,) = json.loads(result.stdout)
    return dict(row)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"wall": "polynomial"}, "wall_polynomials"),
        ({"wall": "polynomial", "wall_polynomials": {"E1": [1.0]}}, "E2"),
        ({"wall_polynomials": {**dict.fromkeys(NAMES, (1.0,)), "E1": [1.0] * 6}}, "E1"),
        ({"wall_polynomials": {**dict.fromkeys(NAMES, (1.0,)), "eta1": []}}, "eta1"),
    ],
)
def test_settings_that_say_no_wall_are_refused_by_name(data: dict[str, object], message: str) -> None:
    with pytest.raises(SettingsError, match=message) as refused:
        parse(FrictionModelSettings, data, "own.toml")
    assert "own.toml" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_wall_that_softens_to_nothing_is_refused_where_it_is_used() -> None:
    softens = polynomial(eta1=(-0.1, 0.05))
    with pytest.raises(SettingsError, match="wall_polynomials") as refused:
        steady_forces([1.0], softens, ROUGH, 2.5)
    assert "\n" not in str(refused.value)
    with pytest.raises(SettingsError, match="polynomial"):
        prepare(sticking(moves((2.5, 20.0)), 1.0), softens)


def made(strain: float, values, file: str = "run.h5", error: float = 0.003) -> RelaxationFit:
    units = ("kPa", "kPa", "kPa", "kPa·s", "kPa·s")
    elements = tuple(
        EstimatedQuantity(name, unit, value, error * value, (value * (1 - 2 * error), value * (1 + 2 * error)))
        for name, unit, value in zip(NAMES, units, (float(value) for value in values), strict=True)
    )
    return RelaxationFit(file, strain, elements)


def eq14(strain: float) -> list[float]:
    return [float(np.polyval(row, strain)) for row in EQ14]


def test_a_quadratic_over_many_strains_is_eq_14() -> None:
    laws, remarks = strain_laws([made(strain, eq14(strain)) for strain in (0.5, 0.8, 1.0, 1.5, 2.0)])
    assert remarks == ()
    for law, published in zip(laws, EQ14, strict=True):
        assert law.coefficients == pytest.approx(published)
        assert law.r2 == pytest.approx(1.0)
        assert law.strains == (0.5, 0.8, 1.0, 1.5, 2.0)


def test_three_strains_are_interpolated_two_joined_one_told() -> None:
    laws, remarks = strain_laws([made(strain, eq14(strain)) for strain in (0.5, 1.0, 2.0)])
    assert [law.r2 for law in laws] == [None] * 5
    assert laws[0].coefficients == pytest.approx(EQ14[0])
    assert "exactly" in remarks[0]
    laws, remarks = strain_laws([made(strain, eq14(strain)) for strain in (0.5, 2.0)])
    assert [len(law.coefficients) for law in laws] == [2] * 5
    assert evaluate_strain_law(laws[2], np.array([2.0]))[0] == pytest.approx(eq14(2.0)[2])
    assert "straight" in remarks[0]
    laws, remarks = strain_laws([made(1.0, eq14(1.0)), RelaxationFit("empty.h5", 2.0, remark="clipped")])
    assert laws == ()
    assert "only the strain of 100 %" in remarks[0]
    assert "no run" in strain_laws([])[1][0]


def test_table_1_by_least_squares_is_the_wall_table1_and_its_lack_of_fit_is_in_the_errors() -> None:
    tight, _ = strain_laws([made(strain, eq14(strain)) for strain in TABLE1_STRAIN])
    laws, _ = strain_laws([made(s, column) for s, column in zip(TABLE1_STRAIN, np.transpose(TABLE1), strict=True)])
    published = wall_parameters("table1", 1.2)
    for law, name, narrow in zip(laws, NAMES, tight, strict=True):
        value, error = evaluate_strain_law(law, np.array([1.2]))
        assert value == pytest.approx(float(getattr(published, name)), rel=0.05)
        if name in {"eta1", "eta2"}:
            assert error > 2 * evaluate_strain_law(narrow, np.array([1.2]))[1]
    assert laws[3].r2 is not None
    assert laws[3].r2 < 0.9


def test_repeats_are_averaged_first_and_their_scatter_counts() -> None:
    alike = [made(strain, eq14(strain), error=1e-4) for strain in (0.5, 1.0, 1.0, 1.0, 1.0, 1.5, 2.0)]
    low, high = (made(1.0, [factor * entry for entry in eq14(1.0)]) for factor in (0.8, 1.2))
    apart = [made(strain, eq14(strain), error=1e-4) for strain in (0.5, 1.5, 2.0)] + [low, high, low, high]
    (agreed, _), (scattered, _) = strain_laws(alike), strain_laws(apart)
    at = np.array([1.0])
    assert agreed[0].strains == (0.5, 1.0, 1.5, 2.0)
    assert evaluate_strain_law(scattered[0], at)[0] == pytest.approx(eq14(1.0)[0], rel=0.01)
    assert evaluate_strain_law(scattered[0], at)[1] > 1.5 * evaluate_strain_law(agreed[0], at)[1]


def test_a_laws_interval_covers_the_truth_when_runs_scatter_by_two_per_cent() -> None:
    random = np.random.default_rng(3)
    at, inside, total = np.linspace(0.5, 2.0, 5), 0, 0
    for _ in range(150):
        fits = []
        for strain in (0.5, 0.8, 1.1, 1.4, 1.7, 2.0):
            stiffer = 1 + 0.02 * random.standard_normal()
            fits.append(
                made(strain, [entry * stiffer * (1 + 0.003 * random.standard_normal()) for entry in eq14(strain)])
            )
        for law, published in zip(strain_laws(fits)[0], EQ14, strict=True):
            value, error = evaluate_strain_law(law, at)
            inside += np.count_nonzero(np.abs(value - np.polyval(published, at)) < NORMAL_95 * error)
            total += len(at)
    assert 0.92 < inside / total < 0.995


def test_laws_make_a_wall_unless_one_is_lacking_or_not_positive() -> None:
    laws, _ = strain_laws([made(strain, eq14(strain)) for strain in TABLE1_STRAIN])
    assert pytest.approx(EQ14[0]) == wall_polynomials(laws).E1
    with pytest.raises(AnalysisError, match="eta1"):
        wall_polynomials([law for law in laws if law.element != "eta1"])
    dipping = [made(strain, [*eq14(strain)[:4], 0.5 * (strain - 1.2) ** 2 - 0.05]) for strain in (0.5, 0.8, 1.6, 2.0)]
    with pytest.raises(AnalysisError, match="eta2 is not positive"):
        wall_polynomials(strain_laws(dipping)[0])


def test_identified_saved_and_simulated_again_the_same_elements_come_back(tmp_path: Path) -> None:
    common = ["rig.sampling.rate_hz=250", "rig.simulated.variation.run_stiffness=0"]
    selection = select_loaded_runs(dragrig.simulate("relaxation", assignments=[*common, "model.wall='table1'"]))
    first = identify_relaxation(selection)
    model = FrictionModelSettings(wall="polynomial", wall_polynomials=wall_polynomials(first.laws))
    file = tmp_path / "own.toml"
    file.write_text(to_toml(model), encoding="utf-8")
    runs = dragrig.simulate("relaxation", model=file, assignments=[*common, "rig.simulated.seed=11"])
    again = identify_relaxation(select_loaded_runs(runs))
    for entry, second in zip(first.fits, again.fits, strict=True):
        values = [element.value for element in entry.elements]
        assert [element.value for element in second.elements] == pytest.approx(values, rel=0.02)
    for entry, second in zip(first.laws, again.laws, strict=True):
        at = np.linspace(0.5, 2.0, 7)
        assert evaluate_strain_law(second, at)[0] == pytest.approx(evaluate_strain_law(entry, at)[0], rel=0.02)
    words = [text.get_text() for axes in relaxation_fit_figure(first, selection).axes for text in axes.texts]
    assert sum("five suffice" in word for word in words) >= 3
