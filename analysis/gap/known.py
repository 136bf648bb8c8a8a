"""What the nominal model's own effects make of positions and of the noise: it is expected, and no gap."""

from dataclasses import replace

import numpy as np

from dragrig.analysis.gap.lines import WITHIN_HZ, Lines
from dragrig.analysis.identification.joint.problem import Problem
from dragrig.analysis.identification.selection import Selection
from dragrig.analysis.nominal.capsule import CapsuleModel
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.analysis.nominal.protocol import NominalModel
from dragrig.sim_backend.effects.applied import Chain

HUM = "mains_hum"
LOUDER = 1.5
"""A line is a gap beside the known one if it is so many times as large."""
LEAKED = 0.02
"""Share of a line's gain that may show at other frequencies."""


def known_effects(nominal: NominalModel) -> Chain:
    """Return the effects that a nominal model has already; only the friction model can have any."""
    return Chain.of(nominal.settings) if isinstance(nominal, CapsuleModel) else Chain((), (), (), ())


def with_known_motion(selection: Selection, chain: Chain) -> Selection:
    """Let the command be where the motor's known effects take the stage, and the record what the stage did.

    The stage then goes where it is told to unless there is a gap: what the encoder's known effects add to a record is
    taken out of it.
    """
    if not chain.motor and not chain.encoder:
        return selection
    return replace(selection, experiments=tuple(_known(one, chain) for one in selection.experiments))


def beyond_known(lines: Lines, chain: Chain) -> Lines:
    """Leave the mains' line out where the nominal model has it, unless it is much larger, and what leaks from it."""
    for effect, values in chain.sensor:
        near = abs(values.get("frequency_hz", 0.0) - lines.mains.frequency_hz) <= WITHIN_HZ
        if effect.id == HUM and near and lines.mains.amplitude <= LOUDER * values["amplitude_mN"]:
            other = replace(lines.other, gain=max(lines.other.gain - LEAKED * lines.mains.gain, 0.0))
            return Lines(replace(lines.mains, gain=0.0, amplitude=0.0), other)
    return lines


def with_known_hum(problem: Problem, chain: Chain) -> Problem:
    """Count hum that the nominal model has as noise: no run starts in step with the mains."""
    noises = problem.noises
    for effect, values in chain.sensor:
        if effect.id == HUM:
            noises = tuple(replace(one, hum=values["amplitude_mN"], hum_hz=values["frequency_hz"]) for one in noises)
    return replace(problem, noises=noises)


def without_hum(chain: Chain) -> Chain:
    """Return the effects without the hum, whose phase in a run nobody knows."""
    return replace(chain, sensor=tuple(one for one in chain.sensor if one[0].id != HUM))


def _known(experiment: Experiment, chain: Chain) -> Experiment:
    trace, time = experiment.run.trace, experiment.time_s
    command = np.asarray(trace.command, dtype=np.float64)
    if "position" not in trace.channels or not np.isfinite(command).all():
        return experiment
    moved = chain.moved(time, command - command[0])
    counted = chain.recorded(time, moved)
    there = moved + command[0]
    position = np.asarray(trace.position, dtype=np.float64) - (counted - moved)
    for array in (there, position):
        array.setflags(write=False)
    known = replace(trace, command=there, channels={**trace.channels, "position": position})
    return replace(experiment, run=replace(experiment.run, trace=known), computes_command=bool(chain.motor))
