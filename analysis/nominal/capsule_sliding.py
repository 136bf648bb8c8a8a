"""What the force channel shows of a capsule that slides, by the friction model."""

from collections.abc import Collection, Hashable, Mapping
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.nominal.capsule_forces import STEP, stacked, unnamed
from dragrig.analysis.nominal.capsule_parameters import ANGLE, ANGLE_SD_DEG, DWELL
from dragrig.analysis.nominal.protocol import Prediction, Predictor
from dragrig.config.model import FrictionModelSettings
from dragrig.config.specimen import Fixture
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Acquisition
from dragrig.sim_backend.friction import RecordedMotion, prepare
from dragrig.sim_backend.friction.contact import HemisphereContact
from dragrig.sim_backend.friction.history import ContactHistory
from dragrig.sim_backend.friction.leading import leading_motion
from dragrig.sim_backend.friction.prepared import BARE, PreparedForce
from dragrig.sim_backend.friction.sliding import ELEMENTS, GRAVITY_M_S2
from dragrig.sim_backend.friction.stretches import stretches

ANGLE_STEP_DEG = 0.2
"""Step of a derivative by the angle, which says when a bend of the motion comes to the equator and the force jumps."""
TIMING_S, OBEYED_TIMING_S = 0.005, 0.001
"""So long a stage takes over the last counts of a stop at 400 mm/s², which its encoder cannot show; and how well the
start of a motion is known that follows its command."""
MOVING_MM_S, RESTING_MM_S = 0.15, 0.05
"""So well 1 µm counts tell the velocity within some 30 ms: of a stage that moves, and of one that creeps."""
RELAXED = 1e-9
"""A contact whose wall has relaxed to this share no longer knows its age."""


@dataclass(frozen=True, slots=True, eq=False)
class _Parts:
    """What the force channel shows of a sliding capsule, part by part [mN]."""

    elastic: FloatArray
    viscous: FloatArray
    coulomb: FloatArray
    weight: FloatArray

    @property
    def total(self) -> FloatArray:
        return self.elastic + self.viscous + self.coulomb

    @property
    def stiff(self) -> FloatArray:
        """What grows with the wall's stiffness: f_e, and Coulomb friction without the weight's."""
        return self.elastic + self.coulomb - self.weight


@dataclass(frozen=True, eq=False)
class SlidingPredictor(Predictor):
    """A capsule that slides, on foam or in the vacuum fixture."""

    acquisition: Acquisition
    motion: RecordedMotion
    settings: FrictionModelSettings
    names: tuple[str, ...]
    obeyed: bool = True
    """Whether the motion is known exactly."""

    @property
    def events_s(self) -> FloatArray:
        """Where the motion bends, and where wall passed at such a moment comes to the equator, for likely angles."""
        found = [self.motion.breaks_s]
        if self.acquisition.fixture is Fixture.FOAM:
            nominal = self.settings.contact_angle_offset_deg
            found += [self._begins(nominal + turn * ANGLE_SD_DEG) for turn in (-2.0, 0.0, 2.0)]
        return np.unique(np.concatenate(found))

    @property
    def likeness(self) -> Hashable:
        """All but which run it is."""
        bare = self.settings.model_copy(update=BARE)
        return unnamed(self.acquisition), self.motion, bare, self.names, self.obeyed

    def predict(self, values: FloatArray, time_s: FloatArray) -> Prediction:
        """Predict f_e + f_v + f_c as the force channel shows them."""
        parts = self._parts(dict(zip(self.names, values.tolist(), strict=True)), time_s)
        return Prediction(parts.total, np.stack((parts.stiff, parts.coulomb)))

    def sensitivities(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return exact derivatives; differences for dwell and angle."""
        return self.sensitivities_without((), values, time_s)

    def sensitivities_without(self, names: Collection[str], values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return `sensitivities`, zeros by the angle where it is named: its differences cost the most."""
        given = dict(zip(self.names, values.tolist(), strict=True))
        prepared = self._prepared(given)
        parts = self._split(prepared, given, time_s)
        rows = {
            "force_gain": parts.total / given["force_gain"],
            "stiffness_scale": parts.stiff / given["stiffness_scale"],
            "friction_coefficient": parts.coulomb / given["friction_coefficient"],
            "mucus_scale": parts.viscous / given["mucus_scale"],
        }
        if self.acquisition.fixture is Fixture.FOAM:
            by_element = zip(ELEMENTS, prepared.by_element(time_s), strict=True)
            rows |= {name: by_log / given[name] for name, by_log in by_element}
            if ANGLE not in names:
                rows[ANGLE] = self._by_angle(given, time_s)
            if self._knows_its_age(given):
                rows[DWELL] = self._slope(DWELL, STEP * given[DWELL], given, time_s)
        return stacked(self.names, rows, len(time_s))

    def _slope(self, name: str, step: float, given: Mapping[str, float], time_s: FloatArray) -> FloatArray:
        ahead, behind = (self._parts({**given, name: given[name] + side * step}, time_s).total for side in (1.0, -1.0))
        return (ahead - behind) / (2 * step)

    def _by_angle(self, given: Mapping[str, float], time_s: FloatArray) -> FloatArray:
        turns = (given[ANGLE] + ANGLE_STEP_DEG, given[ANGLE] - ANGLE_STEP_DEG)
        more, less = (self._parts({**given, ANGLE: turn}, time_s) for turn in turns)
        # Friction jumps when a bend comes to the equator; the jump over the step would be no slope, and is left out.
        ahead, behind = (np.searchsorted(self._begins(turn), time_s, side="right") for turn in turns)
        change = np.where(ahead == behind, more.total - less.total, more.elastic - less.elastic)
        return np.asarray(change / (2 * ANGLE_STEP_DEG))

    def uncertainty(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return by how much friction differs a little earlier or later: it turns on the last µm of a motion."""
        given = dict(zip(self.names, values.tolist(), strict=True))
        last = float(self.motion.breaks_s[-1])
        timing = OBEYED_TIMING_S if self.obeyed else TIMING_S
        shifted = np.concatenate([np.clip(time_s + shift, 0.0, last) for shift in (-timing, 0.0, timing)])
        before, now, after = np.split(self._friction(given, shifted), 3)
        early_or_late = np.maximum(np.abs(before - now), np.abs(after - now))
        return early_or_late if self.obeyed else np.hypot(early_or_late, self._creeping(now, time_s))

    def _creeping(self, friction: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return how much friction may differ where the stage creeps more slowly than its encoder can tell."""
        velocity, over = self.motion.velocity(time_s), self.settings.regularisation_mm_s
        begun = time_s >= self.motion.breaks_s[np.argmax(self.motion.signs != 0)]
        unsure = np.where(velocity == 0, RESTING_MM_S, MOVING_MM_S)
        sides = [np.abs(np.tanh((velocity + side * unsure) / over) - np.tanh(velocity / over)) for side in (-1.0, 1.0)]
        return np.asarray(np.where(begun, np.maximum(*sides), 0.0) * np.abs(friction).max(initial=0.0))

    def _friction(self, values: Mapping[str, float], time_s: FloatArray) -> FloatArray:
        parts = self._parts(values, time_s)
        return parts.viscous + parts.coulomb

    def _prepared(self, values: Mapping[str, float]) -> PreparedForce:
        return prepare(self.acquisition, self.settings.model_copy(update=values), self.motion)

    def _parts(self, values: Mapping[str, float], time_s: FloatArray) -> _Parts:
        return self._split(self._prepared(values), values, time_s)

    def _split(self, prepared: PreparedForce, values: Mapping[str, float], time_s: FloatArray) -> _Parts:
        gain = values["force_gain"]
        shown = prepared.components(time_s)
        turning = np.tanh(self.motion.velocity(time_s) / self.settings.regularisation_mm_s)
        weight = values["friction_coefficient"] * self.acquisition.capsule.mass_g * GRAVITY_M_S2 * turning
        return _Parts(gain * shown.f_e, gain * shown.f_v, gain * shown.f_c, gain * weight)

    def _contact(self, values: Mapping[str, float]) -> HemisphereContact:
        acquisition, model = self.acquisition, self.settings.model_copy(update=values)
        return HemisphereContact.of(acquisition.capsule, acquisition.specimen.wall_thickness_mm, model)

    def _begins(self, turn_deg: float) -> FloatArray:
        contact = self._contact({ANGLE: turn_deg})
        history = ContactHistory.of(leading_motion(self.motion), contact.length_mm + self.settings.side_contact_mm, 1.0)
        return np.array([one.begin_s for one in stretches(history, contact.length_mm)])

    def _knows_its_age(self, values: Mapping[str, float]) -> bool:
        slowest = self._contact(values).side_pressure().slow_rate
        dwell_s = self.acquisition.insertion_dwell_s * values[DWELL]
        return float(np.exp(-slowest * dwell_s)) > RELAXED
