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
from dragrig.rig.operator import Answer, NullOperator, Prompt
from dragrig.rig.profile import BoolArray
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


def lateness_s(first: Run, second: Run) -> float:
    """How much later `one` moved than `other`: where its way is half done."""
    half = 0.5 * (second.trace.position[0] + second.trace.position[-1])
    if abs(second.trace.position[-1] - second.trace.position[0]) < 0.1:
        return 0.0
    return crossing_s(first, half) - crossing_s(second, half)


def crossing_s(run: Run, position_mm: float) -> float:
    """When a run passes a position."""
    position = run.trace.position.astype(float)
    forward = position if position[-1] > position[0] else -position
    return float(np.interp(position_mm if position[-1] > position[0] else -position_mm, forward, run.trace.time))


def quiet(run: Run) -> BoolArray:
    """Which samples are away from changes of phase."""
    changes = run.trace.time[1:][np.diff(run.trace.phase.astype(int)) != 0]
    apart = np.abs(run.trace.time[:, None] - changes[None, :]).min(axis=1) if len(changes) else run.trace.time + 1
    return np.asarray(apart > AWAY_FROM_STEPS_S)


def difference(first: Run, second: Run) -> Difference:
    """Compare a run on the doubles with the simulated one."""
    late = lateness_s(first, second)
    at = second.trace.time
    force = np.interp(at + late, first.trace.time, first.trace.force.astype(float))
    position = np.interp(at + late, first.trace.time, first.trace.position.astype(float))
    here = quiet(second)
    off = (force - second.trace.force)[here]
    return Difference(
        late_ms=1000 * late,
        stated_ms=1000 * float(first.info.header.entry["command_t0_uncertainty_s"]),
        position_um=1000 * float(np.abs(position - second.trace.position).max()),
        rms_mN=float(np.sqrt(np.mean(off**2))),
        noise_mN=float(second.info.checks["rest_noise_mN"]),
        mean_mN=float(abs(off.mean())),
    )


def main() -> None:
    """Make both campaigns and print how they differ."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--pace", type=float, default=5.0)
    options.add_argument("--plan", default="paper")
    arguments = options.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        real = dragrig.run(
            arguments.plan,
            backend="hardware",
            double=True,
            pace=arguments.pace,
            out=Path(folder) / "hardware",
            person=Hands(),
        )
        took = time.perf_counter() - begun
        real.session.require()
        simulated = dragrig.run(arguments.plan, backend="simulated", out=Path(folder) / "simulated")
        pairs = [
            (dragrig.load(run.path), dragrig.load(model_run.path))
            for run, model_run in zip(real.session.runs, simulated.session.runs, strict=True)
            if run.path is not None and model_run.path is not None
        ]
        sampled_s = sum(float(run.trace.time[-1]) for run, _ in pairs)
        complete = sum(run.info.status is RunStatus.COMPLETE for run, _ in pairs)
        print(f"{complete} of {len(pairs)} runs complete, {sampled_s:.0f} s of samples in {took:.0f} s")
        lost = sum(int(run.info.checks["lost_samples"]) for run, _ in pairs)
        same = sum(len(run.trace.time) == len(model_run.trace.time) for run, model_run in pairs)
        print(f"{lost} samples lost; {same} runs of the same length as the simulated ones")
        result = [difference(run, model_run) for run, model_run in pairs]
        for pair, entry in zip(pairs, result, strict=True):
            print(
                f"  {pair[0].info.kind:10} late {entry.late_ms:+7.2f} ms (stated {entry.stated_ms:6.2f})  "
                f"position {entry.position_um:7.1f} µm  force rms {entry.rms_mN:6.2f} mN, "
                f"mean {entry.mean_mN:5.2f} mN, noise {entry.noise_mN:4.2f} mN"
            )
        within = sum(abs(entry.late_ms) <= entry.stated_ms + 1 for entry in result)
        print(f"start within the stated uncertainty: {within} of {len(result)}")
        print(f"worst mean difference {max(entry.mean_mN for entry in result):.2f} mN")
        print(f"median rms over noise {np.median([entry.rms_mN / entry.noise_mN for entry in result]):.2f}")


if __name__ == "__main__":
    main()
