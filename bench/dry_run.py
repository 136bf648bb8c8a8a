"""How much faster than real time the `paper` plan runs, with guard, checks and session around it, and with files.

    python bench/dry_run.py

Rests between runs are not counted as time of the rig. Everything is measured on one core, the process that repacks
included, where the system lets a process be kept on one, and the files once more on all of them.
"""

import os
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from statistics import median

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.plan import Plan
from dragrig.config.rig import RigSettings
from dragrig.config.settings import find_settings
from dragrig.config.specimen import Specimen
from dragrig.rig import FolderStore
from dragrig.rig.devices import BackendRequest
from dragrig.rig.engine import Store
from dragrig.rig.operator import NullOperator
from dragrig.rig.programme import build_programme
from dragrig.rig.runfile.campaigns import SessionRecord
from dragrig.rig.runfile.store import MemoryStore
from dragrig.rig.session import Session
from dragrig.sim_backend.devices import open_backend

ROUNDS = 5


def main() -> None:
    """Run the plan in turn in memory and into files, and print the median of each."""
    _session(MemoryStore())
    results: dict[str, list[float]] = {"memory, one core": [], "files, one core": [], "files, all cores": []}
    for _ in range(ROUNDS):
        _keep_to_one_core()
        results["memory, one core"].append(_session(MemoryStore()))
        results["files, one core"].append(_into_files())
        _use_all_cores()
        results["files, all cores"].append(_into_files())
    for where, speeds in results.items():
        print(f"guarded, {where:17} {median(speeds):5.0f} × real time ({min(speeds):.0f} to {max(speeds):.0f})")
    print("asked for with guard and files: 200 × real time; the files' figures hold the wait for the last repack")


def _keep_to_one_core() -> None:
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def _use_all_cores() -> None:
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, range(os.cpu_count() or 1))


def _into_files() -> float:
    with tempfile.TemporaryDirectory() as folder:
        return _session(FolderStore(Path(folder), flush_s=0.1, reserve_mb=64))


def _session(store: Store) -> float:
    rig, model, specimen = RigSettings(), FrictionModelSettings(), Specimen(name="jejunum")
    plan = find_settings(Plan, "plan", "paper")
    programme = build_programme(plan, specimen, rig.stage.start_mm, "paper")
    now = datetime.now(UTC)
    record = SessionRecord(begun_at=now, backend="simulated", plan=plan, specimen=specimen, model=model, rig=rig)
    backend = open_backend(BackendRequest(rig, model))
    began = time.perf_counter()
    Session(backend, programme, record, store, NullOperator(), NullOperator()).run().require()
    wall_s = time.perf_counter() - began
    return sum(run.duration_s for run in programme.runs) / wall_s


if __name__ == "__main__":
    main()
