"""The whole `paper` plan through the real rig's code on doubles of card and drive, beside the simulated rig's files.

Run `python bench/hardware_paper.py [--pace 5]`. Every pair of runs is put side by side after the start's jitter, seen
by the encoder, is taken out; what is left is compared with the noise of the force sensor.
"""

import argparse
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import dragrig
from dragrig.rig.arrays import FloatArray
from dragrig.rig.operator import Answer, NullOperator, Prompt
from dragrig.rig.runfile.model import Run, RunStatus

AWAY_FROM_STEPS_S = 0.1
"""Around a change of phase a force a millisecond off in time differs by more than noise."""


class Hands(NullOperator):
    """A person whose hands do whatever is asked for."""

    def ask(self, prompt: Prompt) -> Answer:
        """Say done."""
        del prompt
        return Answer.DONE


@dataclass(frozen=True)
class Difference:
    """How far one run on the doubles is off the simulated one."""

    late_ms: float
    stated_ms: float
    position_um: float
    rms_mN: float
    noise_mN: float
    mean_mN: float


def lateness_s(one: Run, other: Run) -> float:
    """How much later `one` moved than `other`: where its way is half done."""
    half = 0.5 * (other.trace.position[0] + other.trace.position[-1])
    if abs(other.trace.position[-1] - other.trace.position[0]) < 0.1:
        return 0.0
    return crossing_s(one, half) - crossing_s(other, half)


def crossing_s(run: Run, position_mm: float) -> float:
    """When a run passes a position."""
    position = run.trace.position.astype(float)
    forward = position if position[-1] > position[0] else -position
    return float(np.interp(position_mm if position[-1] > position[0] else -position_mm, forward, run.trace.time))


def quiet(run: Run) -> FloatArray:
    """Which samples are away from changes of phase."""
    changes = run.trace.time[1:][np.diff(run.trace.phase.astype(int)) != 0]
    apart = np.abs(run.trace.time[:, None] - changes[None, :]).min(axis=1) if len(changes) else run.trace.time + 1
    return apart > AWAY_FROM_STEPS_S


def difference(one: Run, other: Run) -> Difference:
    """Compare a run on the doubles with the simulated one."""
    late = lateness_s(one, other)
    at = other.trace.time
    force = np.interp(at + late, one.trace.time, one.trace.force.astype(float))
    position = np.interp(at + late, one.trace.time, one.trace.position.astype(float))
    here = quiet(other)
    off = (force - other.trace.force)[here]
    return Difference(
        late_ms=1000 * late,
        stated_ms=1000 * float(one.info.header.entry["command_t0_uncertainty_s"]),
        position_um=1000 * float(np.abs(position - other.trace.position).max()),
        rms_mN=float(np.sqrt(np.mean(off**2))),
        noise_mN=float(other.info.checks["rest_noise_mN"]),
        mean_mN=float(abs(off.mean())),
    )


def main() -> None:
    """Make both campaigns and print how they differ."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--pace", type=float, default=5.0)
    options.add_argument("--plan", default="paper")
    given = options.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        real = dragrig.run(
            given.plan, backend="hardware", double=True, pace=given.pace, out=Path(folder) / "hardware", person=Hands()
        )
        took = time.perf_counter() - begun
        real.session.require()
        simulated = dragrig.run(given.plan, backend="simulated", out=Path(folder) / "simulated")
        pairs = [
            (dragrig.load(one.path), dragrig.load(other.path))
            for one, other in zip(real.session.runs, simulated.session.runs, strict=True)
            if one.path is not None and other.path is not None
        ]
        sampled_s = sum(float(one.trace.time[-1]) for one, _ in pairs)
        complete = sum(one.info.status is RunStatus.COMPLETE for one, _ in pairs)
        print(f"{complete} of {len(pairs)} runs complete, {sampled_s:.0f} s of samples in {took:.0f} s")
        lost = sum(int(one.info.checks["lost_samples"]) for one, _ in pairs)
        same = sum(len(one.trace.time) == len(other.trace.time) for one, other in pairs)
        print(f"{lost} samples lost; {same} runs of the same length as the simulated ones")
        found = [difference(one, other) for one, other in pairs]
        for pair, one in zip(pairs, found, strict=True):
            print(
                f"  {pair[0].info.kind:10} late {one.late_ms:+7.2f} ms (stated {one.stated_ms:6.2f})  "
                f"position {one.position_um:7.1f} µm  force rms {one.rms_mN:6.2f} mN, "
                f"mean {one.mean_mN:5.2f} mN, noise {one.noise_mN:4.2f} mN"
            )
        within = sum(abs(one.late_ms) <= one.stated_ms + 1 for one in found)
        print(f"start within the stated uncertainty: {within} of {len(found)}")
        print(f"worst mean difference {max(one.mean_mN for one in found):.2f} mN")
        print(f"median rms over noise {np.median([one.rms_mN / one.noise_mN for one in found]):.2f}")


if __name__ == "__main__":
    main()
