"""The friction of one acquisition, from settings to force: the capsule slides, sticks, or touches nothing."""

from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from dragrig.config.errors import AnalysisError, SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Fixture
from dragrig.rig.arrays import FloatArray, read_only
from dragrig.rig.devices import Acquisition, Contact
from dragrig.sim_backend.friction.contact_history import ContactHistory, leading_motion
from dragrig.sim_backend.friction.environmental_resistance import quadrature_rule
from dragrig.sim_backend.friction.motion import Motion, ProfileMotion
from dragrig.sim_backend.friction.sliding import Components, SlidingForce
from dragrig.sim_backend.friction.wall import HemisphereContact, MaxwellBranches, model_wall, shear_strain


@dataclass(frozen=True, slots=True, eq=False)
class StickingForce:
    """Shear force of a run whose capsule sticks to the wall, prepared for any sample times.

    `area_mm2` is the capsule's cylindrical surface, `spring` the modulus E3 [kPa], `sheared_from` the
    strain at the first sample, at which the branches are relaxed; `moduli` are E1 and E2 [kPa].
    """

    run_id: str
    duration_s: float
    area_mm2: float
    sheared_from: float
    spring: float
    moduli: FloatArray
    branches: MaxwellBranches

    @classmethod
    def of(cls, acquisition: Acquisition, model: FrictionModelSettings, motion: Motion) -> "StickingForce":
        """Integrate both branches with the parameters of the run's shear strain."""
        strain = abs(acquisition.shear_strain)
        wall = model_wall(model, strain)
        if not wall.positive:
            raise SettingsError(
                f"shear_strain {strain:g} of run {acquisition.run_id!r} is beyond the range in which wall {model.wall} "
                f"of model {model.name!r} has positive parameters; use a smaller strain, Table 1 ends at 2"
            )
        pieces, thickness = motion.pieces(), acquisition.specimen.wall_thickness_mm
        capsule = acquisition.capsule
        return cls(
            run_id=acquisition.run_id,
            duration_s=float(motion.breaks_s[-1]),
            area_mm2=np.pi * capsule.diameter_mm * capsule.length_mm,
            sheared_from=acquisition.sheared_from,
            spring=float(wall.E3),
            moduli=np.array([float(wall.E1), float(wall.E2)]),
            branches=MaxwellBranches.integrate(np.array([float(rate) for rate in wall.rates]), pieces, thickness),
        )

    def total(self, time_s: FloatArray) -> FloatArray:
        """Return the shear force [mN] at any times [s], constant before the motion's start and after its end."""
        time = np.clip(np.asarray(time_s, dtype=float), 0.0, self.duration_s)
        strain = self.sheared_from + shear_strain(self.branches.pieces, self.branches.thickness_mm, time)
        fast, slow = self.branches.stress(time)
        return np.asarray((self.spring * strain + self.moduli[0] * fast + self.moduli[1] * slow) * self.area_mm2)


NOT_NOMINAL = MappingProxyType({"effects": (), "identified": None, "diagnosed": None})
"""Settings of a model without influence on the nominal force, which would spoil it as a cache key."""
CACHE_SIZE = 128
"""Runs of a campaign whose forces are cached: predictions and effects ask for the same ones in turn."""
MAX_CACHED_TIMES = 4096
"""Components are cached for at most so many times: block means need few, a simulated run far more."""


@dataclass(frozen=True, slots=True)
class NoFriction:
    """A blank run: the capsule touches nothing."""

    def total(self, time_s: FloatArray) -> FloatArray:
        """Return zeros."""
        return np.zeros_like(time_s)

    def components(self, time_s: FloatArray) -> Components:
        """Return zeros."""
        return Components(*np.zeros((3, *np.shape(time_s))))


@dataclass(frozen=True, slots=True)
class PreparedForce:
    """The modelled force of one acquisition, without noise, at any sample times.

    The value at a time does not depend on the other times of the call.
    """

    friction: SlidingForce | StickingForce | NoFriction
    force_gain: float

    def force(self, time_s: FloatArray) -> FloatArray:
        """Return the force [mN] that the channel shows, of the shape of `time_s` [s]: friction times force gain."""
        return self.force_gain * self.friction.total(time_s)

    def components(self, time_s: FloatArray) -> Components:
        """Return the parts of the true friction [mN], without gain; AnalysisError where the capsule sticks."""
        if isinstance(self.friction, StickingForce):
            raise AnalysisError(
                f"The capsule sticks to the wall in run {self.friction.run_id!r}, so its force has no parts f_e, f_v "
                "and f_c; use the total force"
            )
        if time_s.ndim == 1 and time_s.size <= MAX_CACHED_TIMES:
            return _cached_components(self.friction, time_s.astype(np.float64, copy=False).tobytes())
        return self.friction.components(time_s)

    def log_derivatives(self, time_s: FloatArray) -> FloatArray:
        """Return derivatives of the shown force by the logarithms of the five elements, shape `(5, n)`.

        Parameters
        ----------
        time_s
            Rising times, shape `(n,)`.

        Raises
        ------
        AnalysisError
            Where the capsule does not slide.
        """
        if not isinstance(self.friction, SlidingForce):
            raise AnalysisError("The capsule does not slide, so its force has no such derivatives; use differences")
        return self.force_gain * self.friction.log_derivatives(time_s)


def prepare(acquisition: Acquisition, model: FrictionModelSettings, motion: Motion | None = None) -> PreparedForce:
    """Prepare the force of an acquisition: compute everything that does not depend on the sample times.

    Parameters
    ----------
    acquisition
        Motion, capsule, specimen, fixture, contact and dwell of the run.
    model
        Parameters and scales of the friction model.
    motion
        A motion to use in place of the acquisition's profile, such as a recorded one.

    Raises
    ------
    SettingsError
        Where the wall parameters are not positive at the strain of the contact or of the shear.
    """
    # Repeats share one force, so the key leaves the run's identity out; messages about a sticking capsule name the run.
    names_run = acquisition.contact is Contact.STICKING
    key = acquisition if names_run else replace(acquisition, run_id="", order=0)
    return _prepared(key, model.model_copy(update=NOT_NOMINAL), motion)


@lru_cache(maxsize=CACHE_SIZE)
def _cached_components(friction: SlidingForce | NoFriction, time_s: bytes) -> Components:
    components = friction.components(np.frombuffer(time_s))
    for part in (components.f_e, components.f_v, components.f_c):
        read_only(part)
    return components


@lru_cache(maxsize=CACHE_SIZE)
def _prepared(acquisition: Acquisition, model: FrictionModelSettings, motion: Motion | None) -> PreparedForce:
    if acquisition.contact is Contact.NONE or acquisition.fixture is Fixture.NONE:
        return PreparedForce(NoFriction(), model.force_gain)
    if motion is None:
        motion = ProfileMotion.of(acquisition.profile)
    if acquisition.contact is Contact.STICKING:
        return PreparedForce(StickingForce.of(acquisition, model, motion), model.force_gain)
    contact = HemisphereContact.of(acquisition.capsule, acquisition.specimen.wall_thickness_mm, model)
    reach = contact.length_mm + model.side_contact_mm
    dwell_s = acquisition.insertion_dwell_s * model.insertion_dwell_scale
    history = ContactHistory.of(leading_motion(motion), reach, dwell_s)
    pressing, mass_g = acquisition.fixture is Fixture.FOAM, acquisition.capsule.mass_g
    friction = SlidingForce.of(contact, history, mass_g, pressing, quadrature_rule(motion), motion)
    return PreparedForce(friction, model.force_gain)
