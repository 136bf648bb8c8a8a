"""`dragrig jog`, `home` and `touch-off`, and plans that count from a contact."""

import io
import json
import sys
import threading
from pathlib import Path

import pytest

import add_ons
from dragrig.cli import main
from dragrig.config.rig import ContactPoint
from dragrig.config.settings import read_settings_file
from dragrig.rig.calibration import write_contact
from dragrig.rig.devices import Block
from dragrig.rig.runfile import read_campaign
from dragrig.setup import create_lab
from dragrig.sim_backend.devices.simulated_sampler import SimulatedSampler
from ending import press


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    create_lab(tmp_path / "lab")
    monkeypatch.chdir(tmp_path / "lab")
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    return tmp_path / "lab"


def test_a_jog_asks_and_tells_where_the_stage_is(
    lab: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n"))
    assert main(["jog", "5", "--speed", "20"]) == 0
    printed = capsys.readouterr()
    assert printed.out == "5.000 mm\n"
    assert "The stage moves by +5 mm at 20 mm/s, from 0.000 to 5.000 mm." in printed.err
    assert main(["jog", "2.5", "--yes", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"position_mm": 2.5, "trip": None}


def test_a_jog_may_go_down(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["jog", "-5", "--yes", "--set", "rig.stage.lowest_mm=-20"]) == 0
    assert capsys.readouterr().out == "-5.000 mm\n"


@pytest.mark.parametrize("command", [["jog", "5"], ["home"], ["touch-off"]])
def test_nobody_answering_is_no_consent(lab: Path, command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(command) == 3
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "The stage moves" in printed.err
    assert "--yes" in printed.err
    assert not (lab / "contact.toml").exists()


@pytest.mark.parametrize("command", [["jog", "5"], ["home"], ["touch-off"]])
def test_at_a_real_rig_yes_does_not_look(
    lab: Path, tmp_path: Path, command: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    add_ons.install(tmp_path / "site", monkeypatch)
    handed = [*command, "--backend", "handed", "--double", "--yes"]
    assert main(handed) == 3
    assert "hands" in capsys.readouterr().err
    monkeypatch.setattr(sys, "stdin", io.StringIO("d\n" * 4))
    assert main(handed) == 0
    printed = capsys.readouterr().err
    assert printed.index("Check the rig") < printed.index("origin")
    # The jog itself needs no hands, so --yes answers for it.
    assert "goes from 0.000 to 5.000 mm" not in printed


@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        (["jog", "200"], 2, "0 to 150 mm"),
        (["jog", "1e300"], 2, "0 to 150 mm"),
        (["jog", "five"], 2, "'five' is not a number"),
        (["jog", "5", "--sped", "3"], 2, "--sped"),
        (["jog", "5", "--override-limit", "low"], 5, "not pressed"),
        (["home", "--override-limit", "up"], 2, "--override-limit"),
        (["touch-off", "--force", "5000"], 5, "no contact within 20 mm"),
        (["touch-off", "--force", "0"], 2, "force_mN"),
        (["touch-off", "--back", "-1"], 2, "back_mm"),
        (["touch-off", "--speed", "101"], 2, "100 at most"),
        (["jog", "5", "--speed", "101"], 2, "100 at most"),
        (["jog", "0"], 2, "a distance other than 0"),
        (["jog", "nan"], 2, "'nan' is not a number"),
        (["jog", "1.234,5"], 2, "mark of thousands; write 1234.5"),
        (["jog", "1_5"], 2, "is not a number"),
        (["jog", "-151,5"], 2, "distance_mm = -151.5"),
        (["jog", "5", "--speed", "100,5"], 2, "speed_mm_s = 100.5"),
        (["jog", "151"], 2, "travels 150 mm at most"),
        (["touch-off", "--most", "-151"], 2, "travels 150 mm at most"),
        (["jog", "5", "--set", "speed_mm_s=3"], 2, "only rig"),
        (["jog", "5", "--set", "guard.stale_data_s=1"], 2, "write rig.guard.stale_data_s=1"),
        (["jog", "5", "--double"], 2, "has no double"),
    ],
)
def test_invalid_values_are_reported_in_one_sentence(
    lab: Path, words: list[str], code: int, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, "--yes"]) == code
    printed = capsys.readouterr()
    assert sentence in printed.err
    assert printed.err.count("\n") == 1


@pytest.mark.parametrize(
    "words", [["jog", "5", "--speed", "101"], ["jog", "0"], ["touch-off", "--force", "-20"], ["touch-off", "--back=-5"]]
)
def test_invalid_values_are_refused_before_any_prompt(
    lab: Path, tmp_path: Path, words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    add_ons.install(tmp_path / "site", monkeypatch)
    assert main([*words, "--backend", "handed"]) == 2
    assert "Check the rig" not in capsys.readouterr().err


@pytest.mark.parametrize("command", [["jog", "5"], ["run", "drag", "--out", "c"]])
def test_a_closed_standard_input_is_nobody(
    lab: Path, command: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # What Python makes of a standard input that was closed before it began.
    monkeypatch.setattr(sys, "stdin", None)
    assert main(command) == 3
    assert "Nobody answers on standard input" in capsys.readouterr().err


def test_a_trip_ends_a_jog_with_its_reason(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["jog", "50", "--yes", "--set", "rig.guard.force_limit_mN=0.5"]) == 4
    assert "over the limit" in capsys.readouterr().err


def test_ctrl_c_ends_a_jog(lab: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    read = SimulatedSampler.read
    blocks: list[int] = []

    def interrupted(self: SimulatedSampler, cancel: threading.Event) -> Block | None:
        blocks.append(len(blocks))
        if len(blocks) == 5:
            press()
            # The handler runs on the main thread; the block after this one must find its word.
            cancel.wait(10.0)
        return read(self, cancel)

    monkeypatch.setattr(SimulatedSampler, "read", interrupted)
    assert main(["jog", "100", "--speed", "1", "--yes"]) == 3
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "ended early (Ctrl-C)" in printed.err
    assert len(blocks) < 50


def test_a_contact_is_stored_and_plans_count_from_it(
    finished_here: None, lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["touch-off", "--yes", "--operator", "Ada"]) == 0
    contact = read_settings_file(ContactPoint, lab / "contact.toml")
    assert contact.operator == "Ada"
    assert abs(contact.force_mN) >= 20.0
    moved = contact.model_copy(update={"position_mm": 61.5})
    write_contact(lab, moved)
    from_contact = ["--set", "rig.stage.start_from='contact'", "--set", "rig.stage.start_mm=-10"]
    short = ["--set", "travel_mm=10", "--set", "way_back=stay"]
    assert main(["check", "drag", *from_contact, *short, "--json"]) == 0
    capsys.readouterr()
    assert main(["run", "drag", "--yes", "--out", "c", *from_contact, *short]) == 0
    (info,) = read_campaign(lab / "c").runs
    assert info.header.entry["origin_mm"] == pytest.approx(51.5, abs=0.001)
    assert info.header.entry["contact_mm"] == 61.5
    capsys.readouterr()
    assert main(["check", str(info.path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["runs"][0]["lowest_mm"] == 51.5


def test_limits_stay_absolute_when_plans_count_from_a_contact(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (lab / "contact.toml").write_text(
        'position_mm = 120.0\nmade_at = "2026-05-04T09:00:00Z"\nforce_mN = 20.0\n', "utf-8"
    )
    assert main(["check", "drag", "--set", "rig.stage.start_from='contact'", "--set", "rig.stage.start_mm=0"]) == 2
    assert "from 120 to 160 mm, outside the stage's travel of 0 to 150 mm" in capsys.readouterr().err


def test_without_a_contact_nothing_counts_from_it(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "drag", "--yes", "--set", "rig.stage.start_from='contact'"]) == 2
    printed = capsys.readouterr().err
    assert "dragrig touch-off" in printed
    assert printed.count("\n") == 1


def test_a_resumed_campaign_takes_the_contact_that_holds_now(
    finished_here: None, lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    contact_file = lab / "contact.toml"
    contact_file.write_text('position_mm = 50.0\nmade_at = "2026-05-04T09:00:00Z"\nforce_mN = 20.0\n', "utf-8")
    from_contact = ["--set", "rig.stage.start_from='contact'", "--set", "rig.stage.start_mm=0"]
    words = ["run", "drag", "--yes", "--out", str(lab / "runs" / "c"), "--set", "way_back=stay"]
    assert main([*words, *from_contact, "--set", "rig.guard.force_limit_mN=60"]) == 4
    contact_file.write_text('position_mm = 60.0\nmade_at = "2026-05-05T09:00:00Z"\nforce_mN = 20.0\n', "utf-8")
    assert main(["run", "--resume", "runs/c", "--yes", "--set", "rig.guard.force_limit_mN=8000"]) == 0
    contact_file.unlink()
    origins = [run.header.entry["origin_mm"] for run in read_campaign(lab / "runs" / "c").runs]
    assert origins == [pytest.approx(50.0, abs=0.001), pytest.approx(60.0, abs=0.001)]


def test_touching_off_needs_a_lab(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["touch-off", "--yes"]) == 2
    assert "dragrig init" in capsys.readouterr().err
