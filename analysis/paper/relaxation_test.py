"""Findings on the relaxation test: its ramp, and the fixture it was made in."""

from collections.abc import Iterator

import numpy as np

from dragrig.analysis.paper.finding import Finding, Number, spelled
from dragrig.analysis.paper.printed import CAPSULE, COULOMB_DIAMETER_MM, MODEL, WALL_THICKNESS_MM
from dragrig.sim_backend.friction.contact import HemisphereContact
from dragrig.sim_backend.friction.wall import TABLE1, TABLE1_STRAIN

RAMP_MM_S = 20.0
"""Speed of the ramp in the shipped plan; the paper prints none."""
KEPT = 0.9
"""Share of the fast branch's stress that a good step keeps."""


def findings() -> Iterator[Finding]:
    """Yield the findings."""
    yield _ramp()
    yield _gap()


def _ramp() -> Finding:
    from scipy.optimize import brentq

    strain, table = np.array(TABLE1_STRAIN), np.array(TABLE1)
    travel, time = strain * WALL_THICKNESS_MM, table[3] / table[0]
    lengths = travel / RAMP_MM_S / time
    left = -np.expm1(-lengths) / lengths
    short = float(brentq(lambda length: -np.expm1(-length) / length - KEPT, 1e-6, 10.0))
    needed = travel / (short * time)
    return Finding(
        "ramp",
        "The relaxation is fitted as an ideal step",
        "Section 3.2, Eq. 3",
        "The parameters come from curve fitting of Eq. 3, which holds for a strain that is there at once. Speed and "
        "duration of the ramp are not given.",
        (
            Number("travel to 50 %", float(travel[0]), "mm"),
            Number("travel to 200 %", float(travel[-1]), "mm"),
            Number(f"fast branch left after a ramp of {RAMP_MM_S:g} mm/s to 50 %", 100 * float(left[0]), "%"),
            Number(f"fast branch left after a ramp of {RAMP_MM_S:g} mm/s to 200 %", 100 * float(left[-1]), "%"),
            Number(f"slowest ramp that leaves {100 * KEPT:.0f} % of it", float(needed.min()), "mm/s"),
            Number(f"fastest ramp needed to leave {100 * KEPT:.0f} %", float(needed.max()), "mm/s"),
        ),
        f"The fast branch relaxes within {spelled(1e3 * time.min(), 2)} to {spelled(1e3 * time.max(), 2)} ms. A ramp "
        "of "
        f"{RAMP_MM_S:g} mm/s would leave {spelled(100 * left[0], 2)} % of its stress at a strain of 50 % and "
        f"{spelled(100 * left[-1], 2)} % at 200 %; to keep {100 * KEPT:.0f} % takes {spelled(needed.min(), 2)} to "
        f"{spelled(needed.max(), 2)} mm/s. What "
        "a step fitted to a ramp calls E1 depends on the ramp.",
        "The identification integrates each branch through the ramp that the encoder saw, not through a step.",
    )


def _gap() -> Finding:
    contact = HemisphereContact.of(CAPSULE, WALL_THICKNESS_MM, MODEL)
    undisturbed = 2 * contact.radius_mm * float(np.cos(contact.angle_rad))
    gap = 0.5 * (COULOMB_DIAMETER_MM - CAPSULE.diameter_mm)
    stretch = COULOMB_DIAMETER_MM / undisturbed - 1
    return Finding(
        "fixture-gap",
        "The dummy of the relaxation test is thinner than the fixture is wide",
        "Sections 3.2 and 3.3",
        "The gut is sucked open in the vacuum fixture, to 13 mm in the Coulomb test; a dummy of 12.9 mm with "
        "asperities "
        "then holds on to the wall without slip.",
        (
            Number("diameter of the opened gut", COULOMB_DIAMETER_MM, "mm"),
            Number("diameter of the relaxation dummy", CAPSULE.diameter_mm, "mm"),
            Number("gap all round", 1e3 * gap, "µm"),
            Number("hoop strain of the opened gut", 100 * stretch, "%"),
        ),
        f"If the opening is the same in both tests, there is a gap of {spelled(1e3 * gap, 2)} µm all round that the "
        f"asperities have to bridge; their height is not given. By Eq. 5 the wall is stretched by {100 * stretch:.0f} "
        "% "
        "before it is sheared, while on the capsule that strain is reached only at the equator.",
        "The simulated dummy sticks, and its area is the cylinder π · 12.9 mm · 15.2 mm, as model and run files say.",
    )
