"""What the friction model says of a drag run: its steady phase and the rest before it, as the channel shows it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.nominal.capsule_parameters import ANGLE, ANGLE_SD_DEG, BETWEEN_SPECIMENS
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.config.capsule import Capsule
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.contact import HemisphereContact
from dragrig.sim_backend.friction.quadrature import gauss_legendre
from dragrig.sim_backend.friction.steady import steady_forces

NODES = 24
STEP = 1e-3


@dataclass(frozen=True, slots=True)
class Setup:
    """Capsule and wall of a drag run."""

    capsule: Capsule
    wall_thickness_mm: float

    @classmethod
    def of(cls, experiment: Experiment) -> "Setup":
        """Take them from a run; raises `AnalysisError` where it does not say enough of its capsule."""
        capsule = experiment.capsule.model_copy(update={"name": "capsule"})
        return cls(capsule, experiment.wall_thickness_mm)


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """Parts of the steady force [mN], shape `(n,)`; `wall` is what the wall's stiffness multiplies, in f_e and f_c."""

    f_e: FloatArray
    f_v: FloatArray
    f_c: FloatArray
    wall: FloatArray

    @property
    def total(self) -> FloatArray:
        """Their sum."""
        return self.f_e + self.f_v + self.f_c


def parts(setup: Setup, model: FrictionModelSettings, speed_mm_s: FloatArray) -> Parts:
    """Return the model's parts at steady speeds; raises `SettingsError` as `steady_forces`."""
    steady, gain = steady_forces(speed_mm_s, model, setup.capsule, setup.wall_thickness_mm), model.force_gain
    pressed = steady.f_e + model.friction_coefficient * steady.side_pressure_force
    return Parts(gain * steady.f_e, gain * steady.f_v, gain * steady.f_c, gain * pressed)


def resting_force(setup: Setup, model: FrictionModelSettings, age_s: float) -> float:
    """Return the axial force [mN] of wall that has all been in contact for one time, as before a drag test."""
    contact = HemisphereContact.of(setup.capsule, setup.wall_thickness_mm, model)
    nodes, weights = gauss_legendre(NODES)
    load = contact.axial_load(contact.length_mm * nodes, np.full(NODES, age_s * model.insertion_dwell_scale))
    return model.force_gain * contact.length_mm * float(load @ weights)


def freedom(model: FrictionModelSettings, expected: Callable[[FrictionModelSettings], FloatArray]) -> FloatArray:
    """Return how far one standard deviation of each of a specimen's parameters moves a prediction, shape `(K, n)`."""
    nominal = expected(model)
    rows = []
    for name, (sd, _) in BETWEEN_SPECIMENS.items():
        value = float(getattr(model, name))
        if value:
            moved = model.model_copy(update={name: value * (1 + STEP)})
            rows.append((expected(moved) - nominal) * (sd / STEP))
    turned = model.model_copy(update={ANGLE: getattr(model, ANGLE) + STEP})
    rows.append((expected(turned) - nominal) * (ANGLE_SD_DEG / STEP))
    return np.array(rows)
