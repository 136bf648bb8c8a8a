"""The run file: one run, one HDF5 file. h5py is loaded when a function is first asked for."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dragrig.rig.runfile.campaigns import Campaign, campaign, specimen_key
    from dragrig.rig.runfile.finisher import Finished, Finisher
    from dragrig.rig.runfile.marks import Mark, mark_bad, read_mark, unmark
    from dragrig.rig.runfile.naming import run_file_name
    from dragrig.rig.runfile.reader import read_info, read_run, read_tail
    from dragrig.rig.runfile.recorder import Recorder
    from dragrig.rig.runfile.recovery import Outcome, Recovered, left_recordings, recover
    from dragrig.rig.runfile.repack import finish
    from dragrig.rig.runfile.rewriting import VerifyResult, rewrite, store_filtered, verify
    from dragrig.rig.runfile.store import FolderStore
    from dragrig.rig.runfile.whole import write_run

__all__ = [
    "Campaign",
    "Finished",
    "Finisher",
    "FolderStore",
    "Mark",
    "Outcome",
    "Recorder",
    "Recovered",
    "VerifyResult",
    "campaign",
    "finish",
    "left_recordings",
    "mark_bad",
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

_HOME = {
    "campaigns": ("Campaign", "campaign", "specimen_key"),
    "finisher": ("Finished", "Finisher"),
    "marks": ("Mark", "mark_bad", "read_mark", "unmark"),
    "naming": ("run_file_name",),
    "repack": ("finish",),
    "reader": ("read_info", "read_run", "read_tail"),
    "recorder": ("Recorder",),
    "recovery": ("Outcome", "Recovered", "left_recordings", "recover"),
    "rewriting": ("VerifyResult", "rewrite", "store_filtered", "verify"),
    "store": ("FolderStore",),
    "whole": ("write_run",),
}


def __getattr__(name: str) -> object:
    for module, names in _HOME.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
