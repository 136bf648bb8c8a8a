"""Hidden effects of the wall that moves with the capsule: contact, inertia, stiffness, relaxation."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dragrig.sim_backend.blind.effects.base import DRAG, TISSUE, Draw, Effect, Parts, Scene
from dragrig.sim_backend.blind.effects.linear import first_order
from dragrig.sim_backend.blind.motion import Floats


@dataclass(frozen=True, slots=True)
class LiftOffFade(Effect):
    """The front part of the contact carries less as speed grows, and comes back late once the capsule slows down."""

    name, form, kinds = "wall_lift_off", "front fades, comes back late", DRAG
    amplitude: Annotated[float, Draw(0.7, 1.0)]
    speed_mm_s: Annotated[float, Draw(15.0, 30.0)]
    power: Annotated[float, Draw(2.0, 4.0)]
    front: Annotated[float, Draw(0.45, 0.75)]
    back_s: Annotated[float, Draw(0.08, 0.2, log=True)]

    def passing(self, scene: Scene) -> Floats:
        """Return the highest speed so far, faded by the time since."""
        t = scene.motion.t
        log_speed = np.log(np.maximum(scene.speed, 1e-9))
        return np.asarray(np.exp(np.maximum.accumulate(log_speed + t / self.back_s) - t / self.back_s))

    def contact(self, where: Floats, speed: Floats) -> Floats:
        """Return the share of the pressure left."""
        edge = 1 / (1 + np.exp((where - self.front) / 0.04))
        return np.asarray(1 - self.amplitude * edge * (1 - 1 / (1 + (speed / self.speed_mm_s) ** self.power)))


@dataclass(frozen=True, slots=True)
class LiftOffPeel(Effect):
    """The contact peels from the front, over a distance, up to a place that moves back with speed."""

    name, form, kinds = "wall_lift_off", "front peels over a distance", DRAG
    amplitude: Annotated[float, Draw(0.55, 0.9)]
    speed_mm_s: Annotated[float, Draw(8.0, 14.0)]
    power: Annotated[float, Draw(0.6, 1.2)]
    distance_mm: Annotated[float, Draw(1.5, 4.0)]

    def passing(self, scene: Scene) -> Floats:
        """Return the speed as far as the wall has peeled by now."""
        return np.asarray(scene.speed * -np.expm1(-np.maximum(scene.motion.p, 0.0) / self.distance_mm))

    def contact(self, where: Floats, speed: Floats) -> Floats:
        """Return the share of the pressure left."""
        part = np.maximum(speed - self.speed_mm_s, 0.0) / (60.0 - self.speed_mm_s)
        lost = self.amplitude * part**self.power
        return np.asarray(1 - np.clip((lost - where) / 0.06 + 0.5, 0.0, 1.0) * np.minimum(lost / 0.06, 1.0))


@dataclass(frozen=True, slots=True)
class LiftOffHollow(Effect):
    """A hollow opens at the front beyond a speed, deepest where contact begins; it opens and closes sluggishly."""

    name, form, kinds = "wall_lift_off", "sluggish hollow", DRAG
    amplitude: Annotated[float, Draw(0.7, 1.0)]
    begin_mm_s: Annotated[float, Draw(6.0, 12.0)]
    width_mm_s: Annotated[float, Draw(10.0, 20.0)]
    reach: Annotated[float, Draw(0.6, 0.95)]
    time_s: Annotated[float, Draw(0.03, 0.07, log=True)]

    def passing(self, scene: Scene) -> Floats:
        """Return the speed as the wall follows it."""
        return first_order(scene.speed, self.time_s, scene.motion.t)

    def contact(self, where: Floats, speed: Floats) -> Floats:
        """Return the share of the pressure left."""
        opened = 1 - np.exp(-((np.maximum(speed - self.begin_mm_s, 0.0) / self.width_mm_s) ** 2))
        depth = np.sqrt(np.maximum(1 - (where / self.reach) ** 2, 0.0))
        return np.asarray(1 - self.amplitude * opened * depth)


@dataclass(frozen=True, slots=True)
class InertiaPower(Effect):
    """A force that grows faster than the square of speed."""

    name, form, kinds = "wall_inertia", "power above two", DRAG
    amplitude: Annotated[float, Draw(20.0, 50.0)]
    power: Annotated[float, Draw(2.7, 3.4)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the force [mN]."""
        return np.asarray(self.amplitude * scene.direction * (scene.speed / 60.0) ** self.power)


@dataclass(frozen=True, slots=True)
class InertiaBending(Effect):
    """A force of the square of speed that bends over to a straight line."""

    name, form, kinds = "wall_inertia", "square that bends over", DRAG
    amplitude: Annotated[float, Draw(20.0, 50.0)]
    speed_mm_s: Annotated[float, Draw(12.0, 40.0)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the force [mN]."""
        v, bend = scene.speed, self.speed_mm_s
        return np.asarray(self.amplitude * scene.direction * (v / 60.0) ** 2 * (1 + 60.0 / bend) / (1 + v / bend))


@dataclass(frozen=True, slots=True)
class HyperelasticLock(Effect):
    """Moduli grow with a power of strain, fast branches more than the spring."""

    name, form, kinds = "hyperelastic_wall", "power of strain", TISSUE
    amplitude: Annotated[float, Draw(0.3, 0.7)]
    power: Annotated[float, Draw(1.6, 3.5)]
    slower: Annotated[float, Draw(0.2, 0.7)]

    def branches(self, strain: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the factors on the moduli."""
        more = self.amplitude * (np.maximum(strain, 0.0) / 2) ** self.power
        return 1 + more, 1 + more * self.slower, 1 + more * self.slower**2


@dataclass(frozen=True, slots=True)
class HyperelasticKink(Effect):
    """Moduli grow while fibres straighten, between two strains."""

    name, form, kinds = "hyperelastic_wall", "straightened fibres", TISSUE
    amplitude: Annotated[float, Draw(0.25, 0.55)]
    strain: Annotated[float, Draw(0.5, 0.9)]
    span: Annotated[float, Draw(0.4, 0.8)]
    slower: Annotated[float, Draw(0.2, 0.7)]

    def branches(self, strain: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the factors on the moduli."""
        low, high = (np.logaddexp(0.0, (strain - at) / 0.05) * 0.05 for at in (self.strain, self.strain + self.span))
        more = self.amplitude * (low - high) / self.span
        return 1 + more, 1 + more * self.slower, 1 + more * self.slower**2


@dataclass(frozen=True, slots=True)
class HyperelasticBent(Effect):
    """Moduli that grow steeply about one strain and less beyond it, in the fast branches alone."""

    name, form, kinds = "hyperelastic_wall", "steep about one strain", TISSUE
    amplitude: Annotated[float, Draw(0.3, 0.6)]
    strain: Annotated[float, Draw(1.0, 1.7)]
    power: Annotated[float, Draw(2.5, 5.0)]
    slower: Annotated[float, Draw(0.2, 0.7)]

    def branches(self, strain: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the factors on the moduli."""
        risen = (np.maximum(strain, 0.0) / self.strain) ** self.power
        more = self.amplitude * risen / (1 + risen)
        return 1 + more, 1 + more * self.slower, np.ones_like(strain)


@dataclass(frozen=True, slots=True)
class RelaxationStretched(Effect):
    """Stress that fades as a stretched exponential of age, the faster the further the wall is strained."""

    name, form, kinds = "extra_relaxation", "stretched, faster with strain", TISSUE
    amplitude: Annotated[float, Draw(0.2, 0.6)]
    time_s: Annotated[float, Draw(4.0, 15.0, log=True)]
    power: Annotated[float, Draw(0.45, 0.8)]
    faster: Annotated[float, Draw(0.6, 1.2)]

    def tail(self, age_s: Floats, strain: Floats) -> Floats:
        """Return the stress beyond the model as a part of E3."""
        time_s = self.time_s * np.clip(strain, 0.2, 2.5) ** -self.faster
        return np.asarray(self.amplitude * np.exp(-((np.maximum(age_s, 0.0) / time_s) ** self.power)))


@dataclass(frozen=True, slots=True)
class RelaxationPower(Effect):
    """Stress that fades as a power of age, of a share that grows with strain."""

    name, form, kinds = "extra_relaxation", "power law, grows with strain", TISSUE
    amplitude: Annotated[float, Draw(0.15, 0.45)]
    time_s: Annotated[float, Draw(1.5, 6.0, log=True)]
    power: Annotated[float, Draw(0.5, 1.2)]
    grows: Annotated[float, Draw(0.35, 0.65)]

    def tail(self, age_s: Floats, strain: Floats) -> Floats:
        """Return the stress beyond the model as a part of E3."""
        share = self.amplitude * (np.maximum(strain, 0.0) / 1.2) ** self.grows
        return np.asarray(share * (1 + np.maximum(age_s, 0.0) / self.time_s) ** -self.power)


@dataclass(frozen=True, slots=True)
class RelaxationLog(Effect):
    """Stress that fades with the logarithm of age, to nothing at a last age, in wall strained beyond some strain."""

    name, form, kinds = "extra_relaxation", "logarithm, beyond a strain", TISSUE
    amplitude: Annotated[float, Draw(0.2, 0.5)]
    time_s: Annotated[float, Draw(0.8, 3.0, log=True)]
    last_s: Annotated[float, Draw(60.0, 400.0, log=True)]
    strain: Annotated[float, Draw(0.03, 0.12)]

    def tail(self, age_s: Floats, strain: Floats) -> Floats:
        """Return the stress beyond the model as a part of E3."""
        fall = np.log1p(np.maximum(age_s, 0.0) / self.time_s) / np.log1p(self.last_s / self.time_s)
        share = self.amplitude * np.maximum(strain - self.strain, 0.0) / (1.5 - self.strain)
        return np.asarray(share * np.maximum(1 - fall, 0.0))


FORMS: tuple[type[Effect], ...] = (
    LiftOffFade, LiftOffPeel, LiftOffHollow, InertiaPower, InertiaBending, HyperelasticLock, HyperelasticKink,
    HyperelasticBent, RelaxationStretched, RelaxationPower, RelaxationLog,
)  # fmt: skip
