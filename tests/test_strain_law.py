"""Wall parameters as polynomials of one's own: evaluated everywhere, refused where they cannot be a wall."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from friction_cases import ROUGH, moves, sliding, sticking

from dragrig.cli.lazy import group
from dragrig.config.errors import SettingsError
from dragrig.config.loading import load, parse, to_toml
from dragrig.config.model import FrictionModelSettings, WallPolynomials
from dragrig.sim_backend.friction import prepare, steady_forces
from dragrig.sim_backend.friction.wall import EQ14

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
    assert load(FrictionModelSettings, file) == polynomial()
    told = CliRunner().invoke(group, ["model", "--model", str(file), "--out", str(tmp_path)])
    assert told.exit_code == 0, told.output
    assert "polynomials" in told.output


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ({"wall": "polynomial"}, "wall_polynomials"),
        ({"wall": "polynomial", "wall_polynomials": {"E1": [1.0]}}, "E2"),
        ({"wall_polynomials": {**dict.fromkeys(NAMES, (1.0,)), "E1": [1.0] * 6}}, "E1"),
        ({"wall_polynomials": {**dict.fromkeys(NAMES, (1.0,)), "eta1": []}}, "eta1"),
    ],
)
def test_settings_that_say_no_wall_are_refused_by_name(data: dict[str, object], said: str) -> None:
    with pytest.raises(SettingsError, match=said) as refused:
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
