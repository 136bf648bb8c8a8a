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
from dragrig.sim_backend.friction.contact import HemisphereContact
from dragrig.sim_backend.friction.contact_history import ContactHistory, leading_motion
from dragrig.sim_backend.friction.environmental_resistance import quadrature_rule
from dragrig.sim_backend.friction.motion import Motion, ProfileMotion
from dragrig.sim_backend.friction.sliding import Components, SlidingForce
from dragrig.sim_backend.friction.wall import MaxwellBranches, model_wall, shear_strain


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
                f"shear_strain {strain:g} of run {acquisition.run_id!r} is beyond where wall {model.wall} of model "
                f"{model.name!r} has positive parameters; use a smaller strain, Table 1 ends at 2"
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
            branches=MaxwellBranches.through(np.array([float(rate) for rate in wall.rates]), pieces, thickness),
        )

    def total(self, time_s: FloatArray) -> FloatArray:
        """Shear force [mN] at any times [s]; before the motion's start and after its end it stays as there."""
        time = np.clip(np.asarray(time_s, dtype=float), 0.0, self.duration_s)
        strain = self.sheared_from + shear_strain(self.branches.pieces, self.branches.thickness_mm, time)
        fast, slow = self.branches.at(time)
        return np.asarray((self.spring * strain + self.moduli[0] * fast + self.moduli[1] * slow) * self.area_mm2)


NOT_NOMINAL = MappingProxyType({"effects": (), "identified": None, "diagnosed": None})
"""What of a model has no part in the nominal force, and would make it no key."""
CACHE_SIZE = 128
"""What a prediction prepared for each run of a campaign, the effects' scenes of the same parameters ask for again."""
MAX_CACHED_TIMES = 4096
"""Of so many times at most the parts are kept too: block means ask for these, a simulated run for far more."""


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
    """The force of one acquisition as the model has it, without noise, at any sample times.

    The value at a time does not depend on what other times are asked for in the same call.
    """

    friction: SlidingForce | StickingForce | NoFriction
    force_gain: float

    def force(self, time_s: FloatArray) -> FloatArray:
        """Force [mN] that the channel shows, of the shape of `time_s` [s]: the friction times the force gain."""
        return self.force_gain * self.friction.total(time_s)

    def components(self, time_s: FloatArray) -> Components:
        """Return the true friction's parts [mN], no gain applied; AnalysisError where the capsule sticks."""
        if isinstance(self.friction, StickingForce):
            raise AnalysisError(
                f"The capsule sticks to the wall in run {self.friction.run_id!r}, so that its force has no parts "
                "f_e, f_v and f_c; ask for the force"
            )
        if time_s.ndim == 1 and time_s.size <= MAX_CACHED_TIMES:
            return _cached_components(self.friction, time_s.astype(np.float64, copy=False).tobytes())
        return self.friction.components(time_s)

    def by_element(self, time_s: FloatArray) -> FloatArray:
        """Return derivatives of the force shown by the logarithms of the five elements, shape `(5, n)`.

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
            raise AnalysisError(
                "The capsule does not slide, so that its force has no such derivatives; take differences"
            )
        return self.force_gain * self.friction.by_element(time_s)


def prepare(acquisition: Acquisition, model: FrictionModelSettings, motion: Motion | None = None) -> PreparedForce:
    """Prepare the force of an acquisition: all that does not depend on the sample times is computed here.

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
        Where the published wall parameters do not reach the strain of the contact or of the shear.
    """
    # Repeats are one and the same to the force; the run is named only where a capsule sticks, in what is told of it.
    named = acquisition.contact is Contact.STICKING
    alike = acquisition if named else replace(acquisition, run_id="", order=0)
    return _prepared(alike, model.model_copy(update=NOT_NOMINAL), motion)


@lru_cache(maxsize=CACHE_SIZE)
def _cached_components(friction: SlidingForce | NoFriction, time_s: bytes) -> Components:
    found = friction.components(np.frombuffer(time_s))
    for one in (found.f_e, found.f_v, found.f_c):
        read_only(one)
    return found


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
