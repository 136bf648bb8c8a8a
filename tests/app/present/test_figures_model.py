"""The friction model in pictures and on the command line."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from matplotlib.figure import Figure

from dragrig.cli import main
from dragrig.cli.commands import dragrig_group
from dragrig.config.errors import SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.settings import find_settings
from dragrig.config.specimen import Capsule
from dragrig.present.identification_figures import wall_figure
from dragrig.present.model_figures import MAX_CURVES, forces_figure, skew_figure, spread_selection
from dragrig.sim_backend.friction import parameter_set_differences, steady_forces
from places import REFERENCE

MODEL = FrictionModelSettings()
CAPSULE = find_settings(Capsule, "capsule", "drag")
REFERENCE = REFERENCE / "steady.csv"


def texts(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(lambda first: hasattr(first, "get_text")))


def run(*arguments: str) -> Result:
    done = CliRunner().invoke(dragrig_group, ["model", *arguments], catch_exceptions=False, standalone_mode=False)
    assert done.exit_code == 0
    return done


def test_figure_9_shows_every_part_and_their_sum() -> None:
    figure = forces_figure(MODEL, CAPSULE, 2.5, (0.5, 10.0))
    (axes,) = figure.axes
    curves = [line for line in axes.lines if len(line.get_xdata()) > 10]
    speed = curves[0].get_xdata()
    steady = steady_forces(speed, MODEL, CAPSULE, 2.5)
    for line, expected in zip(curves, (steady.total, steady.f_c, steady.f_e, steady.f_v), strict=True):
        np.testing.assert_array_equal(line.get_ydata(), expected)
    assert axes.get_xscale() == "log"
    assert "Speed (mm/s)" in texts(figure)
    assert "Force (mN)" in texts(figure)


def test_figure_7_keeps_its_value_beside_the_capsule_and_drops_behind_it() -> None:
    figure = skew_figure(MODEL, CAPSULE, 2.5, (0.5, 60.0))
    front, side = figure.axes
    curves = [line for line in side.lines if len(line.get_xdata()) > 1]
    assert len(curves) == 2
    for line in curves:
        x, y = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
        on = x < 6.45 * np.sin(np.radians(60)) + 20
        assert (y[on] == y[0]).all()
        assert (y[~on] == 0).all()
        assert (~on).any()
    tops = [line.get_ydata()[0] for line in front.lines if len(line.get_xdata()) == 1]
    assert tops == pytest.approx([93.9142, 228.7087], rel=5e-3)
    assert "60 mm/s" in texts(figure)


def test_of_many_speeds_a_few_are_drawn_from_end_to_end() -> None:
    chosen = spread_selection([3.0, *range(1, 60), 0.5])
    assert len(chosen) == MAX_CURVES
    assert chosen[0] == 0.5
    assert chosen[-1] == 59
    assert spread_selection([2.0, 1.0, 2.0]) == (1.0, 2.0)


def test_the_wall_is_drawn_by_table_1_and_eq_14_beside_each_other() -> None:
    figure = wall_figure()
    assert len(figure.axes) == 5
    for axes in figure.axes:
        table1, eq14, quadratic = (np.asarray(line.get_ydata(), dtype=float) for line in axes.lines)
        assert (len(table1), eq14[0] != pytest.approx(table1[0])) == (4, True)
        assert abs(quadratic[0] - table1[0]) < abs(eq14[0] - table1[0])


def test_the_picture_names_what_was_chosen() -> None:
    model = MODEL.model_copy(update={"wall": "table1", "stiffness_scale": 1.2})
    shown = texts(forces_figure(model, CAPSULE, 2.5))
    assert "wall Table 1" in shown
    assert "stiffness × 1.2" in shown


def test_a_standstill_has_no_steady_force() -> None:
    with pytest.raises(SettingsError):
        forces_figure(MODEL, CAPSULE, 2.5, (0.0,))


def test_json_has_the_reference_numbers_under_the_agreed_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with REFERENCE.open(newline="") as file:
        expected = list(csv.DictReader(file))
    rows = json.loads(run("--json", "--speeds", ",".join(row["speed_mm_s"] for row in expected)).stdout)
    for row, want in zip(rows, expected, strict=True):
        assert list(row) == ["speed_mm_s", "f_e_mN", "f_v_mN", "f_c_mN", "total_mN"]
        assert row == pytest.approx({key: float(want[key]) for key in row}, rel=5e-3)
    assert list(tmp_path.iterdir()) == []


def test_the_command_prints_draws_and_says_where_the_sources_disagree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model-skew.png").write_text("mine", "utf-8")
    shown = run("--speeds", "0.5,20").stdout
    assert "82.41" in shown
    assert all(f"{entry.eq14:.4g}" in shown for entry in parameter_set_differences())
    pictures = {"model-forces.png", "model-skew-2.png", "model-wall.png"}
    assert {path.name for path in tmp_path.iterdir()} == {*pictures, "model-skew.png"}
    assert all(name in shown for name in pictures)
    assert (tmp_path / "model-skew.png").read_text("utf-8") == "mine"


def test_choices_change_the_numbers() -> None:
    def total(*arguments: str) -> float:
        return float(json.loads(run("--json", "--speeds", "20", *arguments).stdout)[0]["total_mN"])

    paper = total()
    assert total("--wall", "table1") == pytest.approx(total("--model", "table1"), rel=1e-12)
    assert abs(total("--wall", "table1") - paper) > 0.5
    assert total("--viscous", "newtonian") > paper + 10


@pytest.mark.parametrize("speeds", ["", "a", "1,-2", "0", "nan", "1,2", "inf"])
def test_impossible_speeds_are_refused_in_a_sentence(speeds: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["model", "--speeds", speeds, "--json"]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "--speeds" in message
