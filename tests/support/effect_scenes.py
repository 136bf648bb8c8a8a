"""Scenes that the tests of effects share, and what an effect changes in them."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Capsule, Fixture, Specimen
from dragrig.rig.devices import Acquisition, Contact
from dragrig.rig.profile import FloatArray, MotionProfile, Phase, stationary_piece, trapezoid
from dragrig.sim_backend.effects.base import Channel, Effect
from dragrig.sim_backend.effects.run_state import RunState, gut_run_state
from dragrig.sim_backend.friction.motion import ProfileMotion

KINDS = ("drag", "coulomb", "relaxation", "blank")
SESSION_S = 1234.5
"""Some way into a session, for what drifts along it."""

_CAPSULE = Capsule(name="c", surface="smooth", diameter_mm=12.9, length_mm=15.2, mass_g=50.1)
_MET = {
    "drag": (Fixture.FOAM, Contact.SLIDING),
    "coulomb": (Fixture.VACUUM, Contact.SLIDING),
    "relaxation": (Fixture.FOAM, Contact.STICKING),
    "blank": (Fixture.NONE, Contact.NONE),
}


def acquisition(kind: str, stopped_s: float | None = None) -> Acquisition:
    """A run of a kind; at `stopped_s` the stage brakes to a standstill for the rest of its time."""
    travel, speed, hold = (2.5, 20.0, 6.0) if kind == "relaxation" else (15.0, 10.0, 2.0)
    profile = MotionProfile.from_pieces(
        (stationary_piece(1.0, Phase.REST), *trapezoid(travel, speed, 400.0), stationary_piece(hold, Phase.HOLD))
    )
    if stopped_s is not None:
        profile = profile.stopped(stopped_s, 3000.0, hold_s=profile.duration_s)
    fixture, contact = _MET[kind]
    made = Acquisition(kind, 3, kind, profile, _CAPSULE, Specimen(name="jejunum"), fixture, contact, 60.0)
    return replace(made, shear_strain=1.0) if kind == "relaxation" else made


def scene(kind: str, stopped_s: float | None = None, until_s: float | None = None) -> RunState:
    """The scene of a run of a kind, every 2 ms of the first `until_s`."""
    made = acquisition(kind, stopped_s)
    time = np.arange(0.0, made.profile.duration_s if until_s is None else until_s, 0.002)
    return gut_run_state(made, FrictionModelSettings(), ProfileMotion.of(made.profile), time, SESSION_S)


def changed(effect: Effect, seen: RunState, values: Mapping[str, float]) -> FloatArray:
    """What an effect changes in the channel that it shows in."""
    if effect.channel is Channel.FORCE:
        return effect.force_change(seen, values)
    return effect.position_change(seen.time_s, seen.position_mm, values)


def sized(effect: Effect, share: float) -> dict[str, float]:
    """Usual values with the size scaled."""
    return {**effect.defaults, effect.size.name: share * effect.size.default}
