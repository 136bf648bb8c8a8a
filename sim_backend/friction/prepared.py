"""The friction of one acquisition, from settings to force."""

from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from dragrig.config.errors import AnalysisError
from dragrig.config.model import FrictionModelSettings
from dragrig.config.specimen import Fixture
from dragrig.rig.arrays import FloatArray, read_only
from dragrig.rig.devices import Acquisition, Contact
from dragrig.sim_backend.friction.contact import HemisphereContact
from dragrig.sim_backend.friction.history import ContactHistory
from dragrig.sim_backend.friction.leading import leading_motion
from dragrig.sim_backend.friction.motion import Motion, ProfileMotion
from dragrig.sim_backend.friction.quadrature import rule_of
from dragrig.sim_backend.friction.sliding import Components, SlidingForce
from dragrig.sim_backend.friction.sticking import StickingForce

BARE = MappingProxyType({"effects": (), "identified": None, "diagnosed": None})
"""What of a model has no part in the nominal force, and would make it no key."""
LATELY = 128
"""What a prediction prepared for each run of a campaign, the effects' scenes of the same parameters ask for again."""
FEW = 4096
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
        if time_s.ndim == 1 and time_s.size <= FEW:
            return _parts(self.friction, time_s.astype(np.float64, copy=False).tobytes())
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
    return _prepared(alike, model.model_copy(update=BARE), motion)


@lru_cache(maxsize=LATELY)
def _parts(friction: SlidingForce | NoFriction, time_s: bytes) -> Components:
    found = friction.components(np.frombuffer(time_s))
    for one in (found.f_e, found.f_v, found.f_c):
        read_only(one)
    return found


@lru_cache(maxsize=LATELY)
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
    friction = SlidingForce.of(contact, history, mass_g, pressing, rule_of(motion), motion)
    return PreparedForce(friction, model.force_gain)
