"""What happens during one acquisition, noise and converters aside: motion, load, and what the channels make of them."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from dragrig.config.model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Acquisition
from dragrig.rig.profile import MotionProfile
from dragrig.sim_backend.devices.kinematics import Motion, evaluate
from dragrig.sim_backend.effects.applied import Chain, computing_rate_hz, even_times
from dragrig.sim_backend.effects.scene import gut_scene
from dragrig.sim_backend.friction import prepare
from dragrig.sim_backend.friction.motion import ProfileMotion
from dragrig.sim_backend.friction.prepared import PreparedForce
from dragrig.sim_backend.friction.recorded import RecordedMotion


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """What happens at `n` times, new arrays of shape `(n,)`.

    Attributes
    ----------
    motion
        Of the stage.
    counted_mm
        Position that the encoder is to count.
    force_mN
        What the force channel shows, noise aside.
    load_mN
        The true force on the capsule.
    """

    motion: Motion
    counted_mm: FloatArray
    force_mN: FloatArray
    load_mN: FloatArray


class Course(Protocol):
    """An acquisition's course."""

    def at(self, time_s: FloatArray, counted_s: FloatArray) -> Moments:
        """Return what happens at rising times, with the position at others, where the encoder is stuck."""
        ...


@dataclass(frozen=True, slots=True)
class NominalCourse:
    """The stage follows its profile, and the gut is the model's."""

    profile: MotionProfile
    friction: PreparedForce

    @classmethod
    def of(cls, acquisition: Acquisition, model: FrictionModelSettings, profile: MotionProfile) -> "NominalCourse":
        """Prepare the friction for a profile."""
        return cls(profile, prepare(replace(acquisition, profile=profile), model))

    def at(self, time_s: FloatArray, counted_s: FloatArray) -> Moments:
        """Return the profile's motion and the model's force."""
        motion = evaluate(self.profile, time_s)
        counted = motion if counted_s is time_s else evaluate(self.profile, counted_s)
        force = self.friction.force(time_s)
        return Moments(motion, counted.position, force, force / self.friction.force_gain)


@dataclass(frozen=True, slots=True, eq=False)
class AffectedCourse:
    """A course with effects, computed once at fixed times from the first sample on, so that blocks do not matter.

    Attributes
    ----------
    path
        The stage's motion.
    time_s, counted_mm, force_mN, load_mN
        Times, and the channels at them, shape `(n,)`.
    """

    path: ProfileMotion | RecordedMotion
    time_s: FloatArray
    counted_mm: FloatArray
    force_mN: FloatArray
    load_mN: FloatArray

    @classmethod
    def of(
        cls,
        acquisition: Acquisition,
        model: FrictionModelSettings,
        profile: MotionProfile,
        chain: Chain,
        rate_hz: float,
        session_start_s: float,
    ) -> "AffectedCourse":
        """Compute what happens when a profile is commanded; the times depend on nothing but the acquisition."""
        time = even_times(profile.duration_s, computing_rate_hz(rate_hz, acquisition.profile.duration_s))
        path: ProfileMotion | RecordedMotion = ProfileMotion.of(profile)
        position = path.position(time)
        if chain.motor:
            position = chain.moved(time, position)
            path = RecordedMotion.exact(time, position)
        scene = gut_scene(replace(acquisition, profile=profile), model, path, time, session_start_s)
        load = chain.load(scene)
        return cls(
            path=path,
            time_s=time,
            counted_mm=chain.recorded(time, position),
            force_mN=chain.shown(scene, load, model.force_gain),
            load_mN=load,
        )

    def at(self, time_s: FloatArray, counted_s: FloatArray) -> Moments:
        """Return what was computed, straight from one time to the next."""
        pieces = self.path.pieces()
        index = np.maximum(np.searchsorted(pieces.start_s, time_s, side="right") - 1, 0)
        acceleration = np.asarray(pieces.acceleration_mm_s2[index])
        return Moments(
            motion=Motion(self.path.position(time_s), self.path.velocity(time_s), acceleration),
            counted_mm=np.asarray(np.interp(counted_s, self.time_s, self.counted_mm)),
            force_mN=np.asarray(np.interp(time_s, self.time_s, self.force_mN)),
            load_mN=np.asarray(np.interp(time_s, self.time_s, self.load_mN)),
        )
