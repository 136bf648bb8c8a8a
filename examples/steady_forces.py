"""Steady force against speed on the simulated rig: `python examples/steady_forces.py`.

Two drags at each speed, with a way back after each, filtered, tabulated and drawn.
"""

import sys
from pathlib import Path

import dragrig

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/steady")
steps = [{"kind": "drag", "speed_mm_s": [2.0, 10.0, 40.0], "travel_mm": 20.0, "repeats": 2}]
dragrig.simulate({"name": "steady", "steps": steps}, out=folder)
table = dragrig.table(folder)
steady = table[table["kind"] == "drag"].groupby("speed_mm_s")["steady_force_mN"].agg(["mean", "std", "count"])
print(steady.round(1))
dragrig.show(folder).savefig(folder / "overview.pdf")
