"""How much faster than real time the `paper` plan runs, with guard, checks and session around it, and with files.

    python bench/dry_run.py

Rests between runs are not counted as time of the rig. The process, and with it the one that repacks, is kept on one
core where the system lets it.
"""

import os
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

from dragrig.config.library import find
from dragrig.config.model import FrictionModelSettings
from dragrig.config.plan import Plan
from dragrig.config.rig import RigSettings
from dragrig.config.specimen import Specimen
from dragrig.rig.devices import BackendRequest
from dragrig.rig.memory import MemoryStore
from dragrig.rig.people import Nobody
from dragrig.rig.programme import build
from dragrig.rig.record import SessionRecord
from dragrig.rig.runfile import FolderStore
from dragrig.rig.session import Session
from dragrig.rig.store import Store
from dragrig.sim_backend.devices import open_backend

ROUNDS = 3


def main() -> None:
    """Run the plan in turn in memory and into files, and print the fastest of each."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    results: dict[str, list[tuple[float, float]]] = {"memory": [], "files": []}
    for _ in range(ROUNDS):
        results["memory"].append(_session(MemoryStore()))
        with tempfile.TemporaryDirectory() as folder:
            results["files"].append(_session(FolderStore(Path(folder), flush_s=0.2, reserve_mb=64)))
    for where, runs in results.items():
        rig_s, wall_s = min(runs, key=lambda one: one[1])
        spread = max(one[1] for one in runs) / wall_s
        print(
            f"guarded, into {where:7} {rig_s:.0f} s of rig time in {wall_s:.2f} s: {rig_s / wall_s:.0f} × real time "
            f"(slowest of {ROUNDS}: {spread:.2f} times as long)"
        )
    print("asked for with guard and files: 200 × real time, repack included")


def _session(store: Store) -> tuple[float, float]:
    rig, model, specimen = RigSettings(), FrictionModelSettings(), Specimen(name="jejunum")
    plan = find(Plan, "plan", "paper")
    programme = build(plan, specimen, rig.stage.start_mm, "paper")
    now = datetime.now(UTC)
    record = SessionRecord(begun_at=now, backend="simulated", plan=plan, specimen=specimen, model=model, rig=rig)
    backend = open_backend(BackendRequest(rig, model))
    began = time.perf_counter()
    Session(backend, programme, record, store, Nobody(), Nobody()).run().require()
    wall_s = time.perf_counter() - began
    return sum(run.duration_s for run in programme.runs), wall_s


if __name__ == "__main__":
    main()
