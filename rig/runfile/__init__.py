"""The run file: one run, one HDF5 file. h5py is loaded when a function is first used."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dragrig.rig.runfile.campaigns import (
        Campaign,
        RunMark,
        mark_bad,
        read_campaign,
        read_mark,
        specimen_key,
        unmark,
    )
    from dragrig.rig.runfile.finisher import (
        Finisher,
        FinishResult,
        RecoveredRecording,
        RecoveryOutcome,
        finish,
        left_recordings,
        recover,
    )
    from dragrig.rig.runfile.reader import read_info, read_run, read_tail
    from dragrig.rig.runfile.recorder import Recorder
    from dragrig.rig.runfile.schema import run_file_name
    from dragrig.rig.runfile.store import FolderStore, Mirror, MirrorReport
    from dragrig.rig.runfile.writer import Verification, rewrite, store_filtered, verify, write_run

_MODULE_OF = {
    name: module
    for module, names in {
        "campaigns": "Campaign RunMark mark_bad read_campaign read_mark specimen_key unmark",
        "finisher": "FinishResult Finisher RecoveredRecording RecoveryOutcome finish left_recordings recover",
        "reader": "read_info read_run read_tail",
        "recorder": "Recorder",
        "schema": "run_file_name",
        "store": "FolderStore Mirror MirrorReport",
        "writer": "Verification rewrite store_filtered verify write_run",
    }.items()
    for name in names.split()
}

__all__ = [
    "Campaign",
    "FinishResult",
    "Finisher",
    "FolderStore",
    "Mirror",
    "MirrorReport",
    "Recorder",
    "RecoveredRecording",
    "RecoveryOutcome",
    "RunMark",
    "Verification",
    "finish",
    "left_recordings",
    "mark_bad",
    "read_campaign",
    "read_info",
    "read_mark",
    "read_run",
    "read_tail",
    "recover",
    "rewrite",
    "run_file_name",
    "specimen_key",
    "store_filtered",
    "unmark",
    "verify",
    "write_run",
]


def __getattr__(name: str) -> object:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
