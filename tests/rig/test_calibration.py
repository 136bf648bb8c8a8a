"""`dragrig calibrate`: lines through known points, what is kept of them, and what makes no line."""

import io
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import add_ons
from dragrig.cli import main
from dragrig.config.errors import SettingsError
from dragrig.rig.calibration import fit_encoder, fit_force, latest_calibration, read_calibrations
from dragrig.rig.runfile import read_campaign
from dragrig.setup import create_lab

pytestmark = pytest.mark.usefixtures("finished_here")

# Volts on the sensor's input, one after the other, whatever hangs on it.
CODE = (
    add_ons.CODE
    + """
from dragrig.rig.devices import RawReading
from dragrig.sim_backend.devices.simulated_sampler import SimulatedSampler

def measure(self, duration_s, cancel=None):
    place = Path(__file__).with_name("volts.json")
    first, *rest = json.loads(place.read_text())
    place.write_text(json.dumps(rest))
    return RawReading(first, 0.001, round(1000 * duration_s), 0, round(1000 * first))

Handed.sampler = property(lambda self: _of(self._sampler))

def _of(sampler):
    sampler.__class__ = type("Weighing", (SimulatedSampler,), {"measure": measure})
    return sampler
"""
)


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    create_lab(tmp_path / "lab")
    monkeypatch.chdir(tmp_path / "lab")
    add_ons.install(tmp_path / "site", monkeypatch, CODE)
    return tmp_path / "lab"


@pytest.fixture
def calibrate(lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> "Calibrate":
    return Calibrate(tmp_path / "site" / "volts.json", monkeypatch)


class Calibrate:
    """Calls `dragrig calibrate` at a rig whose sensor shows given volts, with somebody who answers every prompt."""

    def __init__(self, volts: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._volts, self._monkeypatch = volts, monkeypatch

    def __call__(self, *words: str, volts: list[float], typed: str = "\n" * 20) -> int:
        self._volts.write_text(json.dumps(volts), "utf-8")
        self._monkeypatch.setattr(sys, "stdin", io.StringIO(typed))
        return main(["calibrate", *words, "--backend", "handed"])


def volts_of(weights_g: list[float], gain: float = 950.0, zero: float = -12.0) -> list[float]:
    return [(9.80665 * weight - zero) / gain for weight in weights_g]


def test_weights_make_a_stored_line(calibrate: Calibrate, lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights = [0.0, 20.0, 50.0, 100.0]
    words = (
        "force",
        "--weights",
        "0,20,50,100",
        "--repeats",
        "2",
        "--operator",
        "Ada",
        "--set",
        "rig.force_sensor.serial='S7'",
    )
    assert calibrate(*words, volts=volts_of([*weights, *weights[::-1]])) == 0
    printed = capsys.readouterr()
    prompts = [line for line in printed.err.splitlines() if "sensor" in line]
    assert [prompts[place].split(" and ")[0] for place in (0, 1, 3, 4, 7)] == [
        "Take every weight off the sensor", "Hang 20 g on the sensor", "Hang 100 g on the sensor",
        "Hang 100 g on the sensor", "Take every weight off the sensor",
    ]  # fmt: skip
    assert "Gain 950" in printed.out
    assert "NOTE" not in printed.out
    entry = latest_calibration(lab, "force")
    assert entry is not None
    assert (entry.operator, entry.sensor_serial, entry.points, entry.made_on) == ("Ada", "S7", 8, "handed")
    assert (entry.gain, entry.zero) == (pytest.approx(950.0), pytest.approx(-12.0))
    assert entry.residual == pytest.approx(0.0, abs=1e-6)


def test_runs_refer_to_the_calibration_of_their_own_rig(
    calibrate: Calibrate, lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert calibrate("force", "--weights", "0,20,50", volts=volts_of([0, 20, 50])) == 0
    entry = latest_calibration(lab, "force")
    assert entry is not None
    short = ["--set", "travel_mm=10", "--set", "way_back=stay"]
    assert main(["run", "drag", *short, "--yes", "--out", "a"]) == 0
    assert "calibration_id" not in read_campaign(lab / "a").runs[0].header.entry
    assert calibrate("force", "--weights", "0,20,50", "--double", volts=volts_of([0, 20, 50], gain=1000.0)) == 0
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n" * 9))
    assert main(["run", "drag", *short, "--out", "b", "--backend", "handed"]) == 0
    assert read_campaign(lab / "b").runs[0].header.entry["calibration_id"] == entry.id


def test_a_residual_beyond_the_sensors_accuracy_is_noted(
    calibrate: Calibrate, lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    volts = [volt + off for volt, off in zip(volts_of([0, 20, 50, 100]), (0.0, 0.02, -0.02, 0.0), strict=True)]
    assert calibrate("force", "--weights", "0,20,50,100", "--json", volts=volts) == 0
    printed = json.loads(capsys.readouterr().out)
    assert "accuracy of 5 mN" in printed["notes"][0]
    assert printed["notes"][0] in printed["entry"]["note"]


@pytest.mark.parametrize(
    ("weights", "volts", "code", "sentence"),
    [
        ("0, 20", [0.0, 0.2], 2, "at least 3 distinct"),
        ("0,20,20,0", [0.0, 0.2, 0.2, 0.0], 2, "at least 3 distinct"),
        ("0,20,inf", [], 2, "'inf' is not a number"),
        ("0,20", [], 2, "is 0.20 or 0, 20?"),
        ("0,20,heavy", [], 2, "'heavy' is not a number"),
        ("0,20,50", [0.1, 0.1, 0.1], 2, "do not change"),
        ("0,20,50,100", [0.1, 0.12, 0.09, 0.11], 2, "do not follow"),
        ("0,20,2000", [0.0, 0.2, 9.95], 5, "overloaded"),
        ("0,20,2000", [0.0, 0.2, -9.95], 5, "overloaded"),
    ],
)
def test_invalid_readings_are_refused_and_nothing_is_stored(
    calibrate: Calibrate,
    lab: Path,
    weights: str,
    volts: list[float],
    code: int,
    sentence: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert calibrate("force", "--weights", weights, volts=volts) == code
    printed = capsys.readouterr()
    assert sentence in printed.err
    assert printed.out == ""
    assert read_calibrations(lab) == ()


def test_yes_hangs_no_weight_and_an_end_keeps_nothing(
    calibrate: Calibrate, lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert calibrate("force", "--weights", "0,20,50", "--yes", volts=[0.0, 0.2, 0.5], typed="") == 3
    assert calibrate("force", "--weights", "0,20,50", volts=[0.0, 0.2, 0.5], typed="\n\na\n") == 3
    assert read_calibrations(lab) == ()


def test_a_driven_travel_gives_the_length_of_a_count(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    measured = [word for travel in ("40.04", "40.05", "40.03") for word in ("--measured", travel)]
    assert main(["calibrate", "encoder", "--travel", "40", *measured, "--yes", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["entry"]["gain"] == pytest.approx(40.04 / 40_000, rel=1e-6)
    assert printed["entry"]["residual"] == pytest.approx(0.01, rel=1e-3)
    assert printed["notes"] == []
    entry = latest_calibration(lab, "encoder", "simulated")
    assert entry is not None
    assert entry.points == 3
    assert main(["calibrate", "encoder", "--travel", "20", "--yes"]) == 0
    assert "! the travel is that of the drive" in capsys.readouterr().out


def test_a_pushed_travel_does_too(calibrate: Calibrate, lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("encoder", "--travel", "10", "--by-hand", "--repeats", "2")
    assert calibrate(*words, volts=[8.0, -8.0]) == 0
    printed = capsys.readouterr()
    assert "push it 10 mm up" in printed.err
    assert "push it 10 mm down" in printed.err
    entry = latest_calibration(lab, "encoder")
    assert entry is not None
    assert entry.gain == pytest.approx(10 / 8000)
    assert "! a count of 1.25 µm is not encoder.resolution_um = 1" in printed.out


@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        (["--travel", "0"], 2, "a distance other than 0"),
        (["--travel", "40", "--measured", "40"], 2, "each of 3 repeats"),
        (["--travel", "40", "--repeats", "1", "--measured", "-40"], 2, "travel's sign"),
        (["--travel", "200"], 2, "0 to 150 mm"),
        (["--travel", "40", "--repeats", "0"], 2, "1 to 100 repeats"),
        (["--travel", "40", "--repeats", "2", "--measured", "40", "--measured", "20"], 2, "do not follow"),
    ],
)
def test_travels_that_make_no_sense_are_refused(
    lab: Path, words: list[str], code: int, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", "encoder", *words, "--yes"]) == code
    assert sentence in capsys.readouterr().err
    assert read_calibrations(lab) == ()


def test_an_encoder_that_counts_nothing_is_told() -> None:
    with pytest.raises(SettingsError, match="counted nothing: check its cable"):
        fit_encoder((40.0, -40.0), (0.0, 0.0))


def test_calibrating_needs_a_lab(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["calibrate", "force", "--weights", "0,20,50", "--yes"]) == 2
    assert "dragrig init" in capsys.readouterr().err


def test_calibrate_alone_tells_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate"]) == 0
    printed = capsys.readouterr().out
    assert "force" in printed
    assert "encoder" in printed


@given(
    gain=st.floats(10, 1e4).flatmap(lambda size: st.sampled_from([size, -size])),
    zero=st.floats(-500, 500),
    loads=st.lists(st.floats(0, 5000), min_size=3, max_size=20, unique=True).filter(lambda many: np.ptp(many) > 1),
)
def test_a_line_without_noise_is_found_exactly(gain: float, zero: float, loads: list[float]) -> None:
    line = fit_force(loads, [(load - zero) / gain for load in loads])
    assert line.gain == pytest.approx(gain, rel=1e-6)
    assert line.zero == pytest.approx(zero, abs=1e-3)
    assert line.residual < 1e-3


def test_standard_errors_are_what_repeated_calibrations_scatter_by() -> None:
    rng = np.random.default_rng(5)
    loads = np.repeat([0.0, 200.0, 500.0, 1000.0], 3)
    lines = [fit_force(loads, (loads + rng.normal(0, 4.0, 12)) / 1000.0) for _ in range(400)]
    assert np.std([line.gain for line in lines]) == pytest.approx(np.mean([line.gain_error for line in lines]), rel=0.1)
    assert np.std([line.zero for line in lines]) == pytest.approx(np.mean([line.zero_error for line in lines]), rel=0.1)
    assert np.mean([line.residual for line in lines]) == pytest.approx(4.0, rel=0.1)
    counts = [fit_encoder([40.0, -40.0] * 3, 4e4 * np.array([1, -1] * 3) + rng.normal(0, 20, 6)) for _ in range(400)]
    assert np.std([line.gain for line in counts]) == pytest.approx(
        np.sqrt(np.mean([line.gain_error**2 for line in counts])), rel=0.1
    )


def test_counts_the_wrong_way_are_reported() -> None:
    with pytest.raises(SettingsError, match="reversed"):
        fit_encoder([40.0, -40.0], [-40_000, 40_000])
