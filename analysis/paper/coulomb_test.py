"""Findings on the Coulomb test and on what the force sensor can tell."""

from collections.abc import Iterator

import numpy as np

from dragrig.analysis.paper import printed
from dragrig.analysis.paper.finding import Finding, Number, percent, spelled
from dragrig.analysis.paper.printed import CAPSULE, MODEL, WALL_THICKNESS_MM
from dragrig.sim_backend.friction import steady_forces
from dragrig.sim_backend.friction.contact import HemisphereContact
from dragrig.sim_backend.friction.sliding import GRAVITY_M_S2
from dragrig.sim_backend.friction.viscous import viscous_force


def findings() -> Iterator[Finding]:
    """Yield the findings."""
    yield _coefficient()
    yield _not_returned()
    yield _accuracy()


def weight_mN() -> float:
    """Weight of the Coulomb test's capsule."""
    return printed.COULOMB_MASS_G * GRAVITY_M_S2


def viscous_mN(reading: str = "published") -> float:
    """Viscous friction of the Coulomb test by Eqs. 10 and 11; `newtonian` is the other reading."""
    model = MODEL.model_copy(update={"viscous": reading})
    wide = CAPSULE.model_copy(update={"diameter_mm": printed.COULOMB_DIAMETER_MM})
    area = HemisphereContact.of(wide, WALL_THICKNESS_MM, model).area_mm2
    return float(viscous_force(np.array(printed.COULOMB_SPEED_MM_S), model, area))


def coefficient(viscous_part_mN: float = 0.0) -> float:
    """Friction coefficient from the printed force with a viscous part taken off."""
    return (printed.COULOMB_FORCE_MN - viscous_part_mN) / weight_mN()


def _coefficient() -> Finding:
    whole, published, newtonian = coefficient(), coefficient(viscous_mN()), coefficient(viscous_mN("newtonian"))
    return Finding(
        "coefficient",
        "0.082 is rounded, and holds the viscous friction too",
        "Section 3.3, Fig. 8",
        "40.07 mN at 0.5 mm/s with 50.1 g gives μ = 0.082, all of it taken for Coulomb friction.",
        (
            Number("weight", weight_mN(), "mN", 4),
            Number("μ from the whole force", whole),
            Number("f_v at 0.5 mm/s", viscous_mN(), "mN", 2),
            Number("μ without f_v", published),
            Number("μ without f_v read as δ (v/d) S", newtonian),
        ),
        f"The force over the weight is {spelled(whole)}; without the model's own viscous friction of "
        f"{spelled(viscous_mN(), 2)} mN it is {spelled(published)} ({percent(published / whole - 1)}), and "
        f"{spelled(newtonian)} with the dimensionally consistent one. The model then adds f_v to f_c once more.",
        "The model's default is the printed 0.082; the identification gives μ with and without the viscous share.",
    )


def _not_returned() -> Finding:
    f_c = printed.FRICTION_COEFFICIENT * weight_mN()
    force = f_c + viscous_mN()
    return Finding(
        "not-returned",
        "The model does not return the force that its μ came from",
        "Section 3.3, Fig. 8, Eqs. 1, 10 and 12",
        "μ is taken from a mean force of 40.07 mN.",
        (
            Number("f_c with μ = 0.082", f_c, "mN", 4),
            Number("f_v at 0.5 mm/s", viscous_mN(), "mN", 2),
            Number("the model's force", force, "mN", 4),
            Number("printed force", printed.COULOMB_FORCE_MN, "mN", 4),
        ),
        f"For the same run the model with μ = 0.082 says {spelled(force, 4)} mN, "
        f"{spelled(100 * force / printed.COULOMB_FORCE_MN - 100, 2)} % more than was measured: rounding and the "
        "viscous friction "
        "that is counted twice.",
        "The simulated run shows that force; what was put in comes back as μ without the viscous share.",
    )


def _accuracy() -> Finding:
    from scipy.optimize import brentq

    accuracy = printed.SENSOR_ACCURACY_MN
    total = steady_forces(printed.SPEEDS_MM_S, MODEL, CAPSULE, WALL_THICKNESS_MM).total
    steps = np.diff(total)
    within = int(np.searchsorted(total - total[0], accuracy))
    slowest = " and ".join(f"{speed:g}" for speed in printed.SPEEDS_MM_S[:within])

    def lacking(speed: float) -> float:
        return float(viscous_force(np.array(speed), MODEL, 1.0)) - accuracy

    enough = float(brentq(lacking, 1e-3, 1e3))
    return Finding(
        "accuracy",
        "The sensor's accuracy is as large as what is told apart",
        "Sections 3.1 and 3.3, Figs. 8, 9 and 11",
        "The force sensor is accurate to 5 mN; forces are given to 0.01 mN, and the parts of the model are compared.",
        (
            Number("accuracy over the Coulomb force", 100 * accuracy / printed.COULOMB_FORCE_MN, "%", 2),
            Number("accuracy as a friction coefficient", accuracy / weight_mN(), "", 2),
            Number("f_v at 0.5 mm/s", viscous_mN(), "mN", 2),
            Number("speed at which f_v reaches the accuracy", enough, "mm/s", 2),
            *(
                Number(f"the model from {low:g} to {high:g} mm/s", float(step), "mN")
                for low, high, step in zip(printed.SPEEDS_MM_S, printed.SPEEDS_MM_S[1:], steps, strict=False)
            ),
        ),
        f"5 mN are {spelled(100 * accuracy / printed.COULOMB_FORCE_MN, 2)} % of 40.07 mN, or ±"
        f"{spelled(accuracy / weight_mN(), 2)} in μ. f_v stays below them up to {spelled(enough, 2)} mm/s, and the "
        f"model's whole rise over the slowest speeds ({slowest} mm/s) is smaller. "
        "A mean over many samples is more precise than that, but a zero that is off by 5 mN is not averaged "
        "out.",
        "Each run has a zero of its own in the joint fit, means carry errors that know of correlated noise, and a tare "
        "can be planned before each run.",
    )
