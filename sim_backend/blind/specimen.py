"""The hidden specimen, and what varies from run to run."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Specimen:
    """Scales of a specimen against the published values, and what the rig does not know about it.

    `five` scales E1, E2, E3, η1 and η2 on top of `stiffness`; `gain` is the force calibration's; `dwell_s` the true
    contact age at the first sample.
    """

    stiffness: float
    five: tuple[float, float, float, float, float]
    mu: float
    mucus: float
    angle_deg: float
    gain: float
    dwell_s: float


@dataclass(frozen=True, slots=True)
class Rough:
    """How the nominal equations are slightly wrong; zeros where they are not.

    `blunt_s`: jerk-limited motion over that time. `shape` and `shape_form`: part by which the moduli differ at the ends
    of the strain axis. `ramp_step_s`: step of a first-order rule for the relaxation's ramp. `panels`: midpoints of a
    coarse rule for the contact. `angle_deg`: added to the contact angle.
    """

    blunt_s: float = 0.0
    shape: float = 0.0
    shape_form: str = "linear"
    ramp_step_s: float = 0.0
    panels: int = 0
    angle_deg: float = 0.0


@dataclass(frozen=True, slots=True)
class Variation:
    """What one run has of its own: factors on stiffness and μ, and the zero offset [mN]."""

    stiffness: float
    mu: float
    zero_mN: float


@dataclass(frozen=True, slots=True)
class Noise:
    """White and slow force noise: standard deviations [mN] and the slow one's correlation time [s]."""

    white_mN: float
    slow_mN: float
    correlation_s: float


def draw_specimen(random: np.random.Generator) -> Specimen:
    """Draw a specimen with the spread that specimens have."""

    def about(value: float, part: float) -> float:
        return float(value * (1 + part * np.clip(random.standard_normal(), -2.5, 2.5)))

    return Specimen(
        stiffness=about(1.0, 0.15),
        five=(about(1, 0.07), about(1, 0.07), about(1, 0.07), about(1, 0.07), about(1, 0.07)),
        mu=about(0.082, 0.12),
        mucus=about(1.0, 0.20),
        angle_deg=60.0 + about(0.7, 1.0) - 0.7,
        gain=about(1.0, 0.005),
        dwell_s=about(60.0, 0.25),
    )


def draw_rough(random: np.random.Generator) -> Rough:
    """Draw one to all of the ways in which the nominal equations can be slightly wrong."""
    ways = ("motion", "shape", "quadrature", "angle")
    chosen = set(random.permutation(ways)[: random.integers(1, len(ways) + 1)].tolist())
    sign = float(random.choice([-1.0, 1.0]))
    in_ramp, at_contact = bool(random.random() < 0.7), bool(random.random() < 0.5)
    return Rough(
        blunt_s=float(random.uniform(0.010, 0.040)) if "motion" in chosen else 0.0,
        shape=sign * float(random.uniform(0.015, 0.025)) if "shape" in chosen else 0.0,
        shape_form=str(random.choice(["linear", "arched", "wave"])),
        ramp_step_s=float(random.choice([0.002, 0.004, 0.006, 0.008])) if "quadrature" in chosen and in_ramp else 0.0,
        panels=int(random.integers(5, 11)) if "quadrature" in chosen and (at_contact or not in_ramp) else 0,
        angle_deg=float(random.choice([-1.0, 1.0]) * random.uniform(0.7, 1.1)) if "angle" in chosen else 0.0,
    )


def draw_variation(random: np.random.Generator) -> Variation:
    """Draw what one run has of its own."""
    stiffness, mu, zero = random.standard_normal(3).tolist()
    return Variation(1 + 0.02 * stiffness, 1 + 0.015 * mu, 3.0 * zero)


def draw_noise(random: np.random.Generator) -> Noise:
    """Draw how noisy the sensor is in a campaign."""
    white = float(random.uniform(1.0, 2.0))
    return Noise(white, white / 3, float(random.uniform(0.1, 0.4)))
