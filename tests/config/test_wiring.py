"""What `[hardware]` of a rig file may say of the card's terminals."""

import pytest

from dragrig.cli import main
from dragrig.config.rig import RigSettings
from dragrig.config.settings import parse

CARD = "rig.hardware.card"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (f"{CARD}.force.channel='ai8'", "positive input of a differential pair"),
        (f"{CARD}.force.channel='Dev1/ai0'", "without the device's name"),
        (f"{CARD}.inputs=[{{name='t', channel='ai24', unit='degC'}}]", "ai16 to ai23"),
        (f"{CARD}.encoder.counter='ctr2'", "ctr0 or ctr1"),
        (f"{CARD}.encoder.a='PFI16'", "PFI0 to PFI15"),
        (f"{CARD}.encoder.b=''", "PFI0 to PFI15"),
        (f"{CARD}.lines.e_stop='port1/line8'", "such as port1/line0"),
        (f"{CARD}.lines.e_stop='line1'", "such as port1/line0"),
        (f"{CARD}.lines.e_stop='port1/line0'", "port1/line0 is wired to two signals"),
        (f"{CARD}.lines.heartbeat='port2/line0'", "port2/line0 and PFI8 under lines and encoder are the same pin"),
        ("rig.hardware.drive.velocity.channel='ao4'", "ao0 to ao3"),
        ("rig.hardware.drive.port=''", "hardware.drive.port"),
        (f"{CARD}.device=''", "hardware.card.device"),
        ("rig.hardware.drive.mode='velocity'", "hardware: drive.mode = 'velocity' needs a heartbeat relay"),
    ],
)
def test_wiring_that_cannot_be_is_refused_in_one_sentence(
    change: str, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", "--rig", "bench", "--backend", "hardware", "--double", "--set", change]) == 2
    errors = capsys.readouterr().err
    assert sentence in errors
    assert errors.count("\n") == 1


def test_velocity_mode_needs_a_counter_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["rig.hardware.drive.mode='velocity'", f"{CARD}.lines.heartbeat='port1/line4'"]
    changes = [*words, "rig.hardware.drive.velocity.counter='ctr0'"]
    assert main(["check", "drag", "--rig", "bench", *(word for change in changes for word in ("--set", change))]) == 2
    assert "must differ" in capsys.readouterr().err


def test_a_rig_file_of_before_the_rail_keeps_its_overload_voltage() -> None:
    rig = parse(RigSettings, {"hardware": {"card": {"force": {"overload_V": 4.95, "open_V": 9.99}}}}, "rig.toml")
    force = rig.hardware.card.force
    assert (force.rail_V, force.overload_V) == (5.0, pytest.approx(4.95))


def test_a_line_that_is_not_wired_is_empty() -> None:
    unwired = [f"{CARD}.{entry}=''" for entry in ("encoder.z", "lines.limit_low", "lines.limit_high", "lines.e_stop")]
    assert main(["check", "drag", "--rig", "bench", *(word for entry in unwired for word in ("--set", entry))]) == 0
