"""Residuals of a made-up campaign: noise, and what a test plants in it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dragrig.analysis.gap.excess import ResidualBlocks
from dragrig.rig.devices import Contact
from dragrig.rig.profile import FloatArray, Phase

Planted = Callable[[ResidualBlocks], FloatArray]
SPEEDS = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0)
SD = {"force": 2.0, "position": 0.002}


def nothing(run: ResidualBlocks) -> FloatArray:
    return np.zeros_like(run.residual)


def campaign(seed: int, planted: Planted = nothing, channel: str = "force") -> list[ResidualBlocks]:
    """Relaxations, blanks, Coulomb runs and two drags at each speed in a random order, with white and run noise."""
    generator = np.random.default_rng(seed)
    plan = [("relaxation", 20.0, strain) for strain in (0.5, 1.0, 1.5, 2.0) * 2]
    plan += [("blank", 5.0, 0.0), ("blank", 40.0, 0.0), *(("coulomb", v, 0.0) for v in (0.5, 5.0, 40.0))]
    plan += [("drag", v, 0.0) for v in generator.permutation(np.repeat(SPEEDS, 2)).tolist()]
    made = []
    for order, (kind, speed, strain) in enumerate(plan):
        for name, sd in SD.items():
            empty = blocks(f"{order:03d}-{kind}", name, kind, speed, strain, 100.0 * order)
            count = empty.residual.size
            noise = sd * (0.8 * generator.standard_normal(count) + 0.6 * generator.standard_normal())
            extra = planted(empty) if name == channel else 0.0
            made.append(replace(empty, residual=noise + extra))
    return made


def blocks(run_id: str, channel: str, kind: str, speed: float, strain: float, session_s: float) -> ResidualBlocks:
    travel, acceleration = (2.5 * strain, 2000.0) if kind == "relaxation" else (40.0, 400.0)
    ramp, hold = speed / acceleration, 20.0 if kind == "relaxation" else 3.0
    steady = travel / speed - ramp
    durations, counts = (1.0, ramp, steady, ramp, hold), (10, 3, 120, 3, 60)
    width = np.concatenate([np.full(count, value / count) for value, count in zip(durations, counts, strict=True)])
    phase = np.repeat(np.array(Phase, dtype=np.uint8), counts)
    time = np.cumsum(width) - 0.5 * width
    position = np.interp(time, [1.0 + ramp / 2, 1.0 + 1.5 * ramp + steady], [0.0, travel])
    contact = {"relaxation": Contact.STICKING, "blank": Contact.NONE}.get(kind, Contact.SLIDING)
    return ResidualBlocks(
        run_id, channel, kind, contact, speed, strain, session_s, np.zeros_like(time),
        np.full(time.size, SD[channel]), width, time, phase, position,
    )  # fmt: skip
