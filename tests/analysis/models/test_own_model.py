"""A nominal model of one's own: the page's example identifies, and mistakes are told in one sentence."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

import dragrig
from dragrig.analysis.identification.identify import fit_jointly
from dragrig.analysis.models.catalogue import find_model, model_names
from dragrig.analysis.selection import select_runs
from dragrig.config.errors import AnalysisError, SettingsError
from dragrig.rig import write_run
from places import DATA, ROOT
from runfiles import header
from simulated import stroke

PAGE = ROOT / "docs" / "own-model.md"
TRUE = {"coulomb_mN": 140.0, "breakaway_mN": 60.0, "stribeck_mm_s": 3.0, "viscous_mN_s_mm": 0.8}
RATE = 500.0


def code_on_the_page() -> str:
    code = re.search(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    assert code is not None
    return code[1]


def measured(folder: Path, seed: int = 0) -> Path:
    """Strokes with the page's plate at seven speeds, forwards and backwards, with a sensor's noise and zeros."""
    rng = np.random.default_rng(seed)
    folder.mkdir()
    for order, speed in enumerate((0.5, 1.0, -2.0, 4.0, 8.0, -20.0, 50.0)):
        profile = stroke(np.copysign(min(20.0, 10 * abs(speed)), speed), abs(speed), 400.0, 1.0, 1.0)
        time = np.arange(profile.samples(RATE)) / RATE
        velocity = profile.velocity(time)
        dry = TRUE["coulomb_mN"] + TRUE["breakaway_mN"] * np.exp(-np.abs(velocity) / TRUE["stribeck_mm_s"])
        force = np.tanh(velocity / 0.05) * dry + TRUE["viscous_mN_s_mm"] * velocity
        force = force * rng.normal(1.0, 0.02) + rng.normal(0.0, 3.0) + rng.normal(0.0, 1.5, len(time))
        columns = {
            "time": time,
            "force": force.astype(np.float32),
            "position": np.round(profile.position(time), 3),
            "motor_force": np.zeros(len(time), np.float32),
            "command": profile.position(time),
            "phase": profile.phase_at(time),
        }
        write_run(folder / f"{order:03d}-drag.h5", header(order, RATE), columns)
    return folder


@pytest.fixture(scope="module")
def plates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return measured(tmp_path_factory.mktemp("own") / "plates")


def own_file(folder: Path, code: str, name: str = "plate.py") -> Path:
    (folder / name).write_text(code, "utf-8")
    return folder / name


def test_the_pages_model_is_identified(plates: Path, tmp_path: Path) -> None:
    before = list(sys.path)
    model = find_model(str(own_file(tmp_path, code_on_the_page())))
    assert sys.path == before
    fit = fit_jointly(select_runs(plates), model)
    assert fit.converged, fit.remarks
    for parameter in fit.parameters:
        assert abs(parameter.value - TRUE[parameter.name]) < 4 * parameter.standard_error
        assert parameter.learnt > 0.8
        assert parameter.standard_error < 0.25 * parameter.value
    assert 0.7 < fit.chi2 / fit.degrees < 1.3
    assert model.document(fit.values) == {"nominal": "plate", "parameters": dict(fit.values)}


def test_a_model_without_scatter_between_runs_says_that_there_is_some(plates: Path, tmp_path: Path) -> None:
    code = code_on_the_page().replace("    run_to_run = 0.02\n", "")
    fit = fit_jointly(select_runs(plates), find_model(str(own_file(tmp_path, code))))
    assert fit.chi2 > 2 * fit.degrees
    assert any("of the model plate is" in remark for remark in fit.remarks)


COGGING = """
import numpy as np
from scipy.signal import savgol_filter

from dragrig.analysis.models import ChannelModel, Parameter

class Cogging(ChannelModel):
    name = "cogging"
    channel = "motor_force"
    zero_sd_mN = 0.0
    follows_s = 0.002
    parameters = tuple(
        Parameter(name, unit, 0.0, 300.0, positive=False)
        for name, unit in (("inertia", "mA s2/rad"), ("mean", "mA"), ("cosine", "mA"), ("sine", "mA"))
    )

    def predict(self, values, at):
        trace = at.experiment.run.trace
        angle = np.interp(at.time_s, trace.time - trace.time[0], trace.channels["Position"])
        bent = savgol_filter(np.asarray(trace.channels["Position"], float), 9, 3, 2, 1e-3)
        bent = np.interp(at.time_s, trace.time - trace.time[0], bent)
        cogs = values["cosine"] * np.cos(72 * angle) + values["sine"] * np.sin(72 * angle)
        return values["mean"] + values["inertia"] * bent + cogs

MODEL = Cogging()
"""


def test_a_measured_motor_shows_its_72_cogs_a_turn(tmp_path: Path) -> None:
    source = DATA / "foreign" / "cogging" / "speed_test.txt"
    maps = {"time": "Time:s", "motor_force": "Iq:A*1000", "position": "Position:rad*1"}
    dragrig.import_run(source, tmp_path, maps, resample_hz=1000.0, from_s=0.3, to_s=0.8)
    selection = select_runs(tmp_path)
    fits = [fit_jointly(selection, find_model(str(own_file(tmp_path, code)))) for code in
            (COGGING, COGGING.replace("72 *", "67 *"))]  # fmt: skip
    amplitudes = [np.hypot(fit.values["cosine"], fit.values["sine"]) for fit in fits]
    assert amplitudes[0] == pytest.approx(125, rel=0.1)
    assert amplitudes[1] < 0.4 * amplitudes[0]
    assert fits[0].chi2 < 0.5 * fits[1].chi2


def test_a_model_sees_what_lies_beside_it_while_it_is_loaded(tmp_path: Path) -> None:
    own_file(tmp_path, "START = 120.0\n", "beside_the_plate.py")
    code = "from beside_the_plate import START\n" + code_on_the_page().replace("100.0", "START")
    before = list(sys.path)
    model = find_model(str(own_file(tmp_path, code)))
    assert model.parameters[0].nominal == 120.0
    assert sys.path == before
    del sys.modules["beside_the_plate"]


def test_two_files_of_one_name_are_two_models(tmp_path: Path) -> None:
    models = []
    for value in ("100.0", "200.0"):
        (tmp_path / value).mkdir()
        models.append(find_model(str(own_file(tmp_path / value, code_on_the_page().replace("100.0", value)))))
    assert [model.parameters[0].nominal for model in models] == [100.0, 200.0]


# What is changed in the page's example, and what is said then.
BROKEN = {
    "syntax": ("return dry +", "return dry + +*", r"plate\.py: line \d+: invalid syntax"),
    "import": ("import numpy as np", "import numpyy as np", r"plate\.py: line 3: ModuleNotFoundError: .*numpyy"),
    "no model": ("MODEL = Plate", "MODLE = Plate", r"holds no MODEL; .* MODLE"),
    "class": ("PlateOnTissue()", "PlateOnTissue", r"is the class PlateOnTissue; write PlateOnTissue\(\)"),
    "another thing": ("PlateOnTissue()", "42", r"MODEL is a int without .*prepare"),
    "abstract": ("def predict", "def predicts", r"line \d+: TypeError: .*abstract"),
    "same names": ('"breakaway_mN", "mN"', '"coulomb_mN", "mN"', r"parameter coulomb_mN is there 2 times"),
    "prior": ('"mN", 50.0, 1.0', '"mN", 50.0, 0.0', r"breakaway_mN has prior_sd = 0\.0, which must be above 0"),
    "nominal": ('"mN", 50.0', '"mN", -50.0', r"breakaway_mN has nominal = -50\.0; .*positive=False"),
    "not a number": ('"mN", 50.0', '"mN", "50"', r"nominal = '50', which is no finite number"),
    "no parameter": ("parameters = (", "parameters = (1,", r"1 among its parameters is no Parameter"),
    "nameless": ('name = "plate"', "name = ''", r"its name is ''"),
    "sd": ("run_to_run = 0.02", "run_to_run = -1", r"variation run_to_run has sd = -1, which must be above 0"),
    "zero": ("run_to_run = 0.02", "zero_sd_mN = float('nan')", r"zero_sd of force is nan"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_is_told_in_one_sentence(case: str, tmp_path: Path) -> None:
    old, new, expected = BROKEN[case]
    code = code_on_the_page()
    assert old in code
    before = list(sys.path), set(sys.modules)
    with pytest.raises(SettingsError, match=expected) as caught:
        find_model(str(own_file(tmp_path, code.replace(old, new))))
    assert str(tmp_path / "plate.py") in str(caught.value)
    assert "\n" not in str(caught.value)
    assert sys.path == before[0]


WRONG = {
    "key": ('values["viscous_mN_s_mm"]', 'values["viscous"]', r"fails at 000-drag\.h5: line 21: KeyError: 'viscous'"),
    "shape": ("return dry", "return 1.0 or dry", r"predict's total has the shape \(\), and must have \(16,\)"),
    "infinity": ("return dry", "return dry / np.zeros_like(dry)", "total holds NaN or infinity"),
    "channel": ("run_to_run = 0.02", 'channel = "thrust"', "predicts nothing"),
    "prepare": ("    def predict", "    def prepare(self, run):\n        return 3\n\n    def predict", "returned 3"),
    "unknown": (
        "    def predict",
        "    def prepare(self, run):\n        return {'thrust': None}\n\n    def predict",
        "predicts 'thrust', which the run did not record .*force",
    ),
}


@pytest.mark.parametrize("case", WRONG)
@pytest.mark.filterwarnings("ignore:.*encountered in.*:RuntimeWarning")
def test_a_model_that_goes_wrong_at_a_run_is_told_in_one_sentence(case: str, plates: Path, tmp_path: Path) -> None:
    old, new, expected = WRONG[case]
    code = code_on_the_page()
    assert old in code
    model = find_model(str(own_file(tmp_path, code.replace(old, new))))
    with pytest.raises(AnalysisError, match=expected) as caught:
        fit_jointly(select_runs(plates), model)
    assert "\n" not in str(caught.value)
    assert "plate" in str(caught.value)


def test_an_installed_model_is_found_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mylab-1.dist-info").mkdir()
    (tmp_path / "mylab-1.dist-info" / "METADATA").write_text("Name: mylab\nVersion: 1\n", "utf-8")
    (tmp_path / "mylab-1.dist-info" / "entry_points.txt").write_text(
        "[dragrig.models]\nplate = plate_of_mylab:MODEL\ngone = nowhere_of_mylab:MODEL\n", "utf-8"
    )
    own_file(tmp_path, code_on_the_page(), "plate_of_mylab.py")
    monkeypatch.syspath_prepend(tmp_path)
    assert {"plate", "drive", "gone"} <= set(model_names())
    assert find_model("plate").name == "plate"
    with pytest.raises(SettingsError, match=r"gone .* cannot be loaded .*installed completely"):
        find_model("gone")
    del sys.modules["plate_of_mylab"]


def test_a_file_is_found_by_its_path_and_one_that_is_missing_is_said(tmp_path: Path) -> None:
    own_file(tmp_path, code_on_the_page())
    assert find_model(str(tmp_path / "plate.py")).name == "plate"
    with pytest.raises(SettingsError, match="no such file"):
        find_model(str(tmp_path / "plates.py"))
