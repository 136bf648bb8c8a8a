"""What effects add to the force of a drag at steady speed."""

import numpy as np

from dragrig.config.capsule import Capsule
from dragrig.config.model import FrictionModelSettings
from dragrig.config.specimen import Fixture, Specimen
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Acquisition, Contact
from dragrig.rig.profile import MotionProfile, Phase, still, trapezoid
from dragrig.sim_backend.devices.course import AffectedCourse, NominalCourse
from dragrig.sim_backend.effects.applied import Chain

TRAVEL_MM = 40.0
RAMP_MM = 1.0
RATE_HZ = 1000.0
DWELL_S = 60.0


def steady_effects(
    speeds_mm_s: FloatArray, model: FrictionModelSettings, capsule: Capsule, wall_thickness_mm: float
) -> FloatArray:
    """Return what the model's effects add to what the force channel shows [mN], shape `(n,)` as the speeds.

    The mean over the last half of a drag of 40 mm that is the first run on its specimen.

    Raises
    ------
    SettingsError
        For effects that cannot be, or a contact that the wall parameters do not reach.
    """
    specimen = Specimen(name="steady", wall_thickness_mm=wall_thickness_mm)
    return np.array([_added(speed, model, capsule, specimen) for speed in speeds_mm_s.tolist()])


def _added(speed_mm_s: float, model: FrictionModelSettings, capsule: Capsule, specimen: Specimen) -> float:
    move = trapezoid(TRAVEL_MM, speed_mm_s, speed_mm_s**2 / (2 * RAMP_MM))
    profile = MotionProfile.from_pieces((still(1.0, Phase.REST), *move))
    drag = Acquisition("", 0, "drag", profile, capsule, specimen, Fixture.FOAM, Contact.SLIDING, DWELL_S)
    half = (TRAVEL_MM - 2 * RAMP_MM) / speed_mm_s / 2
    end = 1.0 + 2 * RAMP_MM / speed_mm_s + 2 * half
    time = np.linspace(end - half, end, 501)
    affected = AffectedCourse.of(drag, model, profile, Chain.of(model), RATE_HZ, 0.0).at(time, time)
    return float(np.mean(affected.force_mN - NominalCourse.of(drag, model, profile).at(time, time).force_mN))
