"""Runs of a stage whose motor ripples along the machine, in motion or only where a position loop holds it."""

from dataclasses import replace

import numpy as np

from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Run

LOOP_MN_MM = 5e4


def cogging(runs: list[Run], amplitude_mN: float, pitch_mm: float) -> list[Run]:
    """Add to the recorded motor force a sine of the place on the machine."""
    changed = []
    for run in runs:
        place = float(str(run.info.header.entry["origin_mm"])) + np.asarray(run.trace.position, dtype=np.float64)
        force = run.trace.channels["motor_force"] + amplitude_mN * np.sin(2 * np.pi * place / pitch_mm + 0.7)
        channels = {**run.trace.channels, "motor_force": force.astype(np.float32)}
        changed.append(replace(run, trace=replace(run.trace, channels=channels)))
    return changed


def held_by_a_loop(runs: list[Run], amplitude_mN: float, pitch_mm: float) -> list[Run]:
    """Let the motor force of rests be a sine of the place, and the position give way to it as under a loop."""
    changed = []
    for run, rippled in zip(runs, cogging(runs, amplitude_mN, pitch_mm), strict=True):
        rests = (run.trace.phase == int(Phase.REST)) | (run.trace.phase == int(Phase.HOLD))
        force = np.where(rests, rippled.trace.channels["motor_force"], run.trace.channels["motor_force"])
        position = np.round(run.trace.command - force / LOOP_MN_MM, 3)
        channels = {**run.trace.channels, "motor_force": force, "position": position}
        changed.append(replace(run, trace=replace(run.trace, channels=channels)))
    return changed
