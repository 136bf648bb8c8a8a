"""A short first plan, the effect that it leaves open, and a gap that is being settled."""

import shutil
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from filelock import FileLock

import dragrig
from diagnosed import OF_SOME
from dragrig.analysis.gap import SettleRecord
from dragrig.api import DiagnosisRequest, SettleHands
from dragrig.config import RIG_FILE
from dragrig.config.plan import Plan
from dragrig.setup import create_lab

FIRST = Plan.model_validate(
    {
        "name": "few",
        "steps": [
            {"kind": "relaxation", "shear_strain": 1.0, "hold_s": 10.0, "wait_s": 5.0},
            {"kind": "drag", "speed_mm_s": [20.0, 5.0, 60.0], "travel_mm": 20.0, "wait_s": 10.0},
        ],
    }
)
EFFECT = "stribeck:ratio=0.3"
MINUTES = 2.0
"""Rig time of the first plan and a batch after it."""
HANDS_MIN = 7.0
"""Not what is usual."""


class StoppedError(Exception):
    pass


def little_lab(folder: Path) -> Path:
    """Make a lab whose rig is short and samples rarely: few runs can be made on it, and each is soon weighed."""
    create_lab(folder)
    rig = folder / RIG_FILE
    text = rig.read_text("utf-8")
    for usual, little in (
        ("[sampling]\nrate_hz = 1000.0", "[sampling]\nrate_hz = 200.0"),
        ("lowest_mm = 0.0\n", "lowest_mm = 40.0\n"),
        ("highest_mm = 150.0\n", "highest_mm = 70.0\n"),
    ):
        assert text.count(usual) == 1, usual
        text = text.replace(usual, little)
    rig.write_text(text, "utf-8")
    return folder


def begun_loop(shared: Path) -> Path:
    """Return a campaign whose first runs are diagnosed and whose next batch is decided, but not made.

    It has a second copy in the folder `mirror` beside it. Nobody's to change: it is made once for all processes of a
    test run.

    Parameters
    ----------
    shared
        Folder that these processes share.
    """
    folder = shared / "begun loop" / "c"
    with FileLock(shared / "begun loop.lock"):
        if not folder.is_dir():
            lab = little_lab(shared / "begun loop in the making")
            (lab / "mirror").mkdir()

            def stop_when_decided(record: SettleRecord) -> None:
                if len(record.batches) == 2:
                    raise StoppedError

            with pytest.MonkeyPatch.context() as patch, suppress(StoppedError):
                patch.setattr(
                    DiagnosisRequest, "options", lambda request: replace(OF_SOME, next_runs=request.next_runs)
                )
                dragrig.gap_settle(
                    FIRST, minutes=MINUTES, hands_min=HANDS_MIN, out=lab / "c", step=stop_when_decided,
                    hands=SettleHands(mirror=lab / "mirror"), effects=[EFFECT], rig=lab / "rig.toml",
                )  # fmt: skip
            shutil.move(lab, folder.parent)
    return folder
