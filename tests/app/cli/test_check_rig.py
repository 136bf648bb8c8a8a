"""`dragrig check` without a plan, and `--double` with everything that opens a rig."""

import io
import json
import sys
from datetime import datetime, timedelta
from pathlib import Path

import pytest

import add_ons
from dragrig.cli import main
from dragrig.config.rig import Calibration, CardSettings, EncoderInputSettings, HardwareSettings, RigSettings
from dragrig.rig import calibration
from dragrig.rig import programme as sanity
from dragrig.rig.runfile import read_campaign
from dragrig.setup import create_lab, resolve_rig

NOW = datetime.now().astimezone()


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    create_lab(tmp_path / "lab")
    monkeypatch.chdir(tmp_path / "lab")
    return tmp_path / "lab"


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return add_ons.install(tmp_path / "site", monkeypatch)


def calibrated(lab: Path, *, age_days: float = 1.0, serial: str = "") -> None:
    for quantity in ("force", "encoder"):
        entry = Calibration(
            id=f"{quantity}-a",
            made_at=NOW - timedelta(days=age_days),
            quantity=quantity,
            sensor_serial=serial,
            gain=1000.0,
        )
        calibration.append_calibration(lab, entry)


def opened(site: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (site / "opened.jsonl").read_text("utf-8").splitlines()]


def test_the_simulated_rig_is_fine(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check"]) == 0
    answer, _, _, *rows = capsys.readouterr().out.splitlines()
    assert answer == "The rig is ready: every check passed."
    assert [row.split()[:2] for row in rows] == [["ok", "limits"], ["ok", "rig"]]


def test_every_device_limit_and_calibration_is_told_without_connecting(
    lab: Path, site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibrated(lab)
    assert main(["check", "--backend", "handed", "--json"]) == 0
    assert [check["what"] for check in json.loads(capsys.readouterr().out)] == [
        "limits",
        "force limit",
        "encoder filter",
        "way without program",
        "calibration of force",
        "calibration of encoder",
        "card",
    ]
    (request,) = opened(site)
    assert request["connect"] is False
    assert request["calibrations"] == {"force": "force-a", "encoder": "encoder-a"}


def test_what_is_not_fine_is_marked_and_the_rest_is_looked_at(
    lab: Path, site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (site / "findings.json").write_text('[["card", false, "Dev1 is not there"], ["drive", true, "answers"]]', "utf-8")
    assert main(["check", "--backend", "handed", "--json"]) == 5
    result = {load["what"]: load for load in json.loads(capsys.readouterr().out)}
    assert not result["card"]["fine"]
    assert result["drive"]["fine"]
    assert "calibrate force" in result["calibration of force"]["detail"]
    assert not result["calibration of encoder"]["fine"]


@pytest.mark.parametrize(
    ("age_days", "serial", "rig", "word"),
    [(91.0, "", {}, "more than 90"), (1.0, "A1", {"force_sensor": {"serial": "A2"}}, "the rig has A2")],
)
def test_a_calibration_can_be_too_old_or_anothers(
    lab: Path, age_days: float, serial: str, rig: dict[str, object], word: str
) -> None:
    calibrated(lab, age_days=age_days, serial=serial)
    finding = sanity.check_calibration(
        "force", calibration.latest_calibration(lab), RigSettings.model_validate(rig), NOW
    )
    assert not finding.passed
    assert word in finding.detail


def test_limits_that_make_no_sense_together_are_found() -> None:
    fast = RigSettings.model_validate({"stage": {"max_speed_mm_s": 400.0}})
    assert not sanity.check_limits(RigSettings.model_validate({"stage": {"max_speed_mm_s": 2000.0}})).passed
    assert sanity.check_limits(fast).passed
    assert all(check.passed for check in sanity.check_wiring(fast, {}))
    slow_filter = HardwareSettings(card=CardSettings(encoder=EncoderInputSettings(filter_ns=6425)))
    filtered = fast.model_copy(update={"hardware": slow_filter})
    assert [check.passed for check in sanity.check_wiring(filtered, {})] == [True, False]
    weak = Calibration(id="a", made_at=NOW, quantity="force", gain=-500.0)
    assert [check.passed for check in sanity.check_wiring(fast, {"force": weak})] == [False, True]


def run(monkeypatch: pytest.MonkeyPatch, *words: str, typed: str = "") -> int:
    monkeypatch.setattr(sys, "stdin", io.StringIO(typed))
    return main(["run", *words])


QUICK = ("drag", "--set", "travel_mm=10", "--set", "way_back=stay", "--out", "c")


def test_a_double_is_told_its_pace_and_a_campaign_stays_with_it(
    finished_here: None, lab: Path, site: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calibrated(lab)
    stopped = ("--set", "rig.guard.force_limit_mN=100")
    assert run(monkeypatch, *QUICK, *stopped, "--backend", "handed", "--double", "--pace", "20", typed="\n" * 9) == 4
    raised = ("--set", "rig.guard.force_limit_mN=8000")
    assert run(monkeypatch, "--resume", "c", *raised, "--yes", typed="\n" * 9) == 0
    first, again = opened(site)
    assert (first["which"], first["pace"], again["which"], again["pace"]) == ("double", 20.0, "double", 1.0)
    for element in read_campaign(lab / "c").runs:
        entry = element.header.entry
        assert entry["double"] == "handed"
        assert (entry["calibration_id"], entry["encoder_calibration_id"]) == ("force-a", "encoder-a")
    assert run(monkeypatch, *QUICK[:-1], "d", "--backend", "handed", "--yes", typed="\n" * 9) == 0
    assert opened(site)[-1]["which"] == "hardware"
    assert "double" not in read_campaign(lab / "d").runs[0].header.entry


def test_yes_does_not_stand_for_hands_at_the_double_either(
    lab: Path, site: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, *QUICK, "--backend", "handed", "--double", "--yes") == 3
    errors = capsys.readouterr().err
    assert "Check the rig" in errors
    assert "hands" in errors
    assert read_campaign(lab / "c").runs == ()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--double",), "has no double; choose none, or a backend that has one: handed, hardware"),
        (("--backend", "handd", "--double"), "did you mean handed?"),
        (("--pace", "20"), "only a double runs a number of times faster"),
        (("--pace", "fast", "--backend", "handed", "--double"), "that of a double is real"),
        (("--pace", "-3", "--backend", "handed", "--double"), "that of a double is real"),
        (("--pace", "nan", "--backend", "handed", "--double"), "is neither fast, real, nor a number"),
        (("--pace", "slow"), "is neither fast, real, nor a number"),
    ],
)
def test_what_has_no_double_or_no_such_pace_is_told(
    lab: Path,
    site: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
    sentence: str,
) -> None:
    assert run(monkeypatch, *QUICK, "--yes", *words) == 2
    errors = capsys.readouterr().err
    assert sentence in errors
    assert errors.count("\n") == 1
    assert not (lab / "c").exists()


@pytest.mark.parametrize("words", [["--specimen", "jejunum"], ["--capsule", "drag"], ["--set", "speed_mm_s=3"]])
def test_a_look_at_the_rig_takes_nothing_of_a_plan(
    lab: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", *words]) == 2
    assert capsys.readouterr().out == ""


def test_the_calibration_of_another_sensor_holds_for_nothing(lab: Path) -> None:
    calibrated(lab, serial="A1")
    rig = "rig.force_sensor.serial={}".format
    assert set(resolve_rig(assignments=[rig("A1")]).calibrations()) == {"force", "encoder"}
    assert set(resolve_rig(assignments=[rig("A2")]).calibrations()) == {"encoder"}
    assert set(resolve_rig().calibrations()) == {"force", "encoder"}
