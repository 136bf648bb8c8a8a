"""A short first plan, the effect that it leaves open, and a gap that is being settled."""

import shutil
from pathlib import Path

from filelock import FileLock

import dragrig
from dragrig.analysis.gap import SettleRecord
from dragrig.api import SettleHands
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
            lab = shared / "begun loop in the making"
            create_lab(lab)
            (lab / "mirror").mkdir()

            def stop_when_decided(record: SettleRecord) -> None:
                if len(record.batches) == 2:
                    raise StoppedError

            try:
                dragrig.settle(
                    FIRST, minutes=MINUTES, hands_min=HANDS_MIN, out=lab / "c", step=stop_when_decided,
                    hands=SettleHands(mirror=lab / "mirror"), effects=[EFFECT], rig=lab / "rig.toml",
                )  # fmt: skip
            except StoppedError:
                shutil.move(lab, folder.parent)
    return folder
