"""An add-on as a user would install one: a backend `handed` that asks for hands, and its double."""

from pathlib import Path

import pytest

CODE = '''
"""Simulated rigs that pass for the real one."""
import json

from pathlib import Path
from dragrig.rig.devices import RigCheck
from dragrig.sim_backend.devices import SimulatedBackend
from dragrig.sim_backend.devices.simulated_backend import VirtualClock

class Handed(SimulatedBackend):
    needs_hands = True


    def examine(self):
        note = json.loads(Path(__file__).with_name("findings.json").read_text())
        for name, passed, detail in note:
            yield RigCheck(name, passed, detail)

def _opened(request, which):
    told = {"which": which, "pace": request.pace, "real_time": request.real_time, "connect": request.connect,
            "calibrations": {key: one.id for key, one in request.calibrations.items()}}
    with Path(__file__).with_name("opened.jsonl").open("a") as log:
        log.write(json.dumps(told) + chr(10))
    return Handed(request.rig, request.model, VirtualClock(request.origin))

def hardware(request):
    return _opened(request, "hardware")

def double(request):
    return _opened(request, "double")
'''


def install(site: Path, monkeypatch: pytest.MonkeyPatch, code: str = CODE) -> Path:
    """Install the add-on into a folder of its own; return that folder, with `findings.json` and `opened.jsonl`."""
    (site / "handed-1.dist-info").mkdir(parents=True)
    (site / "handed-1.dist-info" / "METADATA").write_text("Name: handed\nVersion: 1\n", "utf-8")
    (site / "handed-1.dist-info" / "entry_points.txt").write_text(
        "[dragrig.backends]\nhanded = handed_rig:hardware\n[dragrig.doubles]\nhanded = handed_rig:double\n", "utf-8"
    )
    (site / "handed_rig.py").write_text(code, "utf-8")
    (site / "findings.json").write_text('[["card", true, "there"]]', "utf-8")
    monkeypatch.syspath_prepend(site)
    monkeypatch.delitem(__import__("sys").modules, "handed_rig", raising=False)
    return site
