"""The paper's friction model as a nominal model: the force on a capsule in a gut, without any gap."""

from collections.abc import Callable, Collection, Hashable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.models.nominal_model import Combination, NominalModel, Parameter, Prediction, Predictor, Variation
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Fixture, Specimen
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Acquisition, Contact
from dragrig.rig.profile import MotionProfile
from dragrig.sim_backend.friction import RecordedMotion, prepare
from dragrig.sim_backend.friction.contact import ContactHistory, leading_motion, smooth_intervals
from dragrig.sim_backend.friction.friction_force import ELEMENT_SCALES, GRAVITY_M_S2, NOT_NOMINAL, PreparedForce
from dragrig.sim_backend.friction.wall import HemisphereContact

FORCE_CHANNEL = "force"
SPECIMEN_PRIORS = {
    "stiffness_scale": (0.15, "common scale of E1, E2, E3, η1, η2"),
    "e1_scale": (0.07, "scale of E1 on its own"),
    "e2_scale": (0.07, "scale of E2 on its own"),
    "e3_scale": (0.07, "scale of E3 on its own"),
    "eta1_scale": (0.07, "scale of η1 on its own"),
    "eta2_scale": (0.07, "scale of η2 on its own"),
    "friction_coefficient": (0.12, "Coulomb friction coefficient μ"),
    "mucus_scale": (0.20, "scale of the mucus' apparent viscosity"),
    "force_gain": (0.005, "true gain of the force channel"),
    "insertion_dwell_scale": (0.25, "true over noted age of the contact"),
}
"""Relative standard deviations between specimens and rigs, by name in the model's settings."""
DWELL_PARAMETER = "insertion_dwell_scale"
ANGLE_PARAMETER = "contact_angle_offset_deg"
ANGLE_SD_DEG = 0.7
FORCE_ZERO_SD_MN = 5.0
RUN_VARIATIONS = (Variation("stiffness", 0.02), Variation("friction", 0.015))


def capsule_parameters(settings: FrictionModelSettings) -> tuple[Parameter, ...]:
    """Return the scales, friction coefficient, gain and contact angle, with what is known of any specimen."""
    scales = tuple(
        Parameter(name, "1", float(getattr(settings, name)), sd, meaning=meaning)
        for name, (sd, meaning) in SPECIMEN_PRIORS.items()
    )
    angle = Parameter(
        ANGLE_PARAMETER,
        "deg",
        settings.contact_angle_offset_deg,
        ANGLE_SD_DEG,
        False,
        "contact angle over the capsule's",
    )
    return (*scales, angle)


def _force_combination(name: str, powers: Mapping[str, float], meaning: str) -> Combination:
    return Combination(name, "1", {"force_gain": 1.0, **powers}, f"{meaning} as the force channel shows it")


def _element_combination(name: str, scale: str, symbol: str) -> Combination:
    return _force_combination(name, {"stiffness_scale": 1.0, scale: 1.0}, f"scale of {symbol}")


CAPSULE_COMBINATIONS = (
    _element_combination("e1_shown", "e1_scale", "E1"),
    _element_combination("e2_shown", "e2_scale", "E2"),
    _element_combination("e3_shown", "e3_scale", "E3"),
    _element_combination("eta1_shown", "eta1_scale", "η1"),
    _element_combination("eta2_shown", "eta2_scale", "η2"),
    Combination("fast_time_scale", "1", {"eta1_scale": 1.0, "e1_scale": -1.0}, "scale of the time constant η1/E1"),
    Combination("slow_time_scale", "1", {"eta2_scale": 1.0, "e2_scale": -1.0}, "scale of the time constant η2/E2"),
    _force_combination("friction_shown", {"friction_coefficient": 1.0}, "friction coefficient"),
    _force_combination("mucus_shown", {"mucus_scale": 1.0}, "scale of the viscosity"),
)


DERIVATIVE_STEP = 1e-3
"""Relative step of a derivative by differences."""

RECORDED_PROFILE = MotionProfile.from_pieces(())
"""The profile of a run whose motion comes from the record: one for all, so that alike acquisitions are equal."""


def acquisition_of(experiment: Experiment) -> Acquisition:
    """Return what the friction model must know of a run; its motion comes from the record.

    Raises
    ------
    AnalysisError
        Where the run does not say enough of its capsule.
    """
    header = experiment.run.info.header
    specimen = Specimen(
        name=str(header.specimen.get("name") or "specimen"), wall_thickness_mm=experiment.wall_thickness_mm
    )
    return Acquisition(
        run_id=header.run_id,
        order=header.order,
        kind=experiment.kind,
        profile=RECORDED_PROFILE,
        capsule=experiment.capsule,
        specimen=specimen,
        fixture=experiment.fixture,
        contact=experiment.contact,
        insertion_dwell_s=experiment.insertion_dwell_s,
        shear_strain=experiment.shear_strain,
    )


def without_run_identity(acquisition: Acquisition) -> Acquisition:
    """Return what a run shares with those that are alike: all but which one it is."""
    return replace(acquisition, run_id="", order=0)


@dataclass(frozen=True, eq=False)
class BlankPredictor(Predictor):
    """A blank run: nothing but the sensor's zero and noise."""

    parameters: int

    @property
    def events_s(self) -> FloatArray:
        """No time stands out."""
        return np.zeros(0)

    def predict(self, values: FloatArray, time_s: FloatArray) -> Prediction:
        """Return zeros."""
        del values
        return Prediction(np.zeros_like(time_s), np.zeros((len(RUN_VARIATIONS), len(time_s))))

    def sensitivities(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return zeros."""
        del values
        return np.zeros((self.parameters, len(time_s)))


@dataclass(frozen=True, eq=False)
class StickingPredictor(Predictor):
    """A relaxation: a capsule that sticks to the wall and shears it."""

    acquisition: Acquisition
    experiment: Experiment
    settings: FrictionModelSettings
    names: tuple[str, ...]

    @property
    def events_s(self) -> FloatArray:
        """Where the motion bends."""
        return self.experiment.motion.breaks_s

    @property
    def equivalence_key(self) -> Hashable:
        """All but which run it is."""
        bare = self.settings.model_copy(update=NOT_NOMINAL)
        return without_run_identity(self.acquisition), self.experiment.unsmoothed_motion, bare, self.names

    def predict(self, values: FloatArray, time_s: FloatArray) -> Prediction:
        """Predict the shear force, all of which is stiffness."""
        total = self._force(dict(zip(self.names, values.tolist(), strict=True)), time_s)
        return Prediction(total, np.stack((total, np.zeros_like(total))))

    def sensitivities(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return exact derivatives where the force is proportional, differences for the elements."""
        given = dict(zip(self.names, values.tolist(), strict=True))
        total = self._force(given, time_s)
        rows = {name: total / given[name] for name in ("force_gain", "stiffness_scale")}
        rows |= _element_derivatives(lambda changed: self._force(changed, time_s), given, rows["stiffness_scale"])
        return stack_sensitivities(self.names, rows, len(time_s))

    def _force(self, values: Mapping[str, float], time_s: FloatArray) -> FloatArray:
        return prepare(
            self.acquisition, self.settings.model_copy(update=values), self.experiment.unsmoothed_motion
        ).force(time_s)


def _element_derivatives(
    total: Callable[[Mapping[str, float]], FloatArray], given: Mapping[str, float], by_common: FloatArray
) -> dict[str, FloatArray]:
    """Return derivatives by the five scales; the last follows, as all five scaled alike are the common scale."""
    before = total(given)
    rows: dict[str, FloatArray] = {}
    left = by_common * given["stiffness_scale"]
    for name in ELEMENT_SCALES[:-1]:
        step = DERIVATIVE_STEP * given[name]
        rows[name] = (total({**given, name: given[name] + step}) - before) / step
        left = left - rows[name] * given[name]
    rows[ELEMENT_SCALES[-1]] = left / given[ELEMENT_SCALES[-1]]
    return rows


def stack_sensitivities(names: tuple[str, ...], rows: Mapping[str, FloatArray], samples: int) -> FloatArray:
    """Return derivatives in the order of the parameters, shape `(P, samples)`; zeros by what has none."""
    nothing = np.zeros(samples)
    return np.stack([rows.get(name, nothing) for name in names])


ANGLE_STEP_DEG = 0.2
"""Step of a derivative by the angle, which says when a bend of the motion comes to the equator and the force jumps."""
MOTION_TIMING_S, COMMAND_TIMING_S = 0.005, 0.001
"""So long a stage takes over the last counts of a stop at 400 mm/s², which its encoder cannot show; and how well the
start of a motion is known that follows its command."""
MOVING_VELOCITY_ERROR_MM_S, CREEP_VELOCITY_ERROR_MM_S = 0.15, 0.05
"""So well 1 µm counts tell the velocity within some 30 ms: of a stage that moves, and of one that creeps."""
RELAXED_SHARE = 1e-9
"""A contact whose wall has relaxed to this share no longer knows its age."""


@dataclass(frozen=True, slots=True, eq=False)
class _ForceComponents:
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
    follows_command: bool = True
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
    def equivalence_key(self) -> Hashable:
        """All but which run it is."""
        bare = self.settings.model_copy(update=NOT_NOMINAL)
        return without_run_identity(self.acquisition), self.motion, bare, self.names, self.follows_command

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
            by_element = zip(ELEMENT_SCALES, prepared.log_derivatives(time_s), strict=True)
            rows |= {name: by_log / given[name] for name, by_log in by_element}
            if ANGLE_PARAMETER not in names:
                rows[ANGLE_PARAMETER] = self._by_angle(given, time_s)
            if self._knows_its_age(given):
                rows[DWELL_PARAMETER] = self._slope(
                    DWELL_PARAMETER, DERIVATIVE_STEP * given[DWELL_PARAMETER], given, time_s
                )
        return stack_sensitivities(self.names, rows, len(time_s))

    def _slope(self, name: str, step: float, given: Mapping[str, float], time_s: FloatArray) -> FloatArray:
        ahead, behind = (self._parts({**given, name: given[name] + side * step}, time_s).total for side in (1.0, -1.0))
        return (ahead - behind) / (2 * step)

    def _by_angle(self, given: Mapping[str, float], time_s: FloatArray) -> FloatArray:
        turns = (given[ANGLE_PARAMETER] + ANGLE_STEP_DEG, given[ANGLE_PARAMETER] - ANGLE_STEP_DEG)
        more, less = (self._parts({**given, ANGLE_PARAMETER: turn}, time_s) for turn in turns)
        # Friction jumps when a bend comes to the equator; the jump over the step would be no slope, and is left out.
        ahead, behind = (np.searchsorted(self._begins(turn), time_s, side="right") for turn in turns)
        change = np.where(ahead == behind, more.total - less.total, more.elastic - less.elastic)
        return np.asarray(change / (2 * ANGLE_STEP_DEG))

    def uncertainty(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return by how much friction differs a little earlier or later: it turns on the last µm of a motion."""
        given = dict(zip(self.names, values.tolist(), strict=True))
        last = float(self.motion.breaks_s[-1])
        timing = COMMAND_TIMING_S if self.follows_command else MOTION_TIMING_S
        shifted = np.concatenate([np.clip(time_s + shift, 0.0, last) for shift in (-timing, 0.0, timing)])
        before, now, after = np.split(self._friction(given, shifted), 3)
        early_or_late = np.maximum(np.abs(before - now), np.abs(after - now))
        return early_or_late if self.follows_command else np.hypot(early_or_late, self._creeping(now, time_s))

    def _creeping(self, friction: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return how much friction may differ where the stage creeps more slowly than its encoder can tell."""
        velocity, over = self.motion.velocity(time_s), self.settings.regularisation_mm_s
        begun = time_s >= self.motion.breaks_s[np.argmax(self.motion.signs != 0)]
        unsure = np.where(velocity == 0, CREEP_VELOCITY_ERROR_MM_S, MOVING_VELOCITY_ERROR_MM_S)
        sides = [np.abs(np.tanh((velocity + side * unsure) / over) - np.tanh(velocity / over)) for side in (-1.0, 1.0)]
        return np.asarray(np.where(begun, np.maximum(*sides), 0.0) * np.abs(friction).max(initial=0.0))

    def _friction(self, values: Mapping[str, float], time_s: FloatArray) -> FloatArray:
        parts = self._parts(values, time_s)
        return parts.viscous + parts.coulomb

    def _prepared(self, values: Mapping[str, float]) -> PreparedForce:
        return prepare(self.acquisition, self.settings.model_copy(update=values), self.motion)

    def _parts(self, values: Mapping[str, float], time_s: FloatArray) -> _ForceComponents:
        return self._split(self._prepared(values), values, time_s)

    def _split(self, prepared: PreparedForce, values: Mapping[str, float], time_s: FloatArray) -> _ForceComponents:
        gain = values["force_gain"]
        shown = prepared.components(time_s)
        turning = np.tanh(self.motion.velocity(time_s) / self.settings.regularisation_mm_s)
        weight = values["friction_coefficient"] * self.acquisition.capsule.mass_g * GRAVITY_M_S2 * turning
        return _ForceComponents(gain * shown.f_e, gain * shown.f_v, gain * shown.f_c, gain * weight)

    def _contact(self, values: Mapping[str, float]) -> HemisphereContact:
        acquisition, model = self.acquisition, self.settings.model_copy(update=values)
        return HemisphereContact.of(acquisition.capsule, acquisition.specimen.wall_thickness_mm, model)

    def _begins(self, turn_deg: float) -> FloatArray:
        contact = self._contact({ANGLE_PARAMETER: turn_deg})
        history = ContactHistory.of(leading_motion(self.motion), contact.length_mm + self.settings.side_contact_mm, 1.0)
        return np.array([one.begin_s for one in smooth_intervals(history, contact.length_mm)])

    def _knows_its_age(self, values: Mapping[str, float]) -> bool:
        slowest = self._contact(values).side_pressure().slow_rate
        dwell_s = self.acquisition.insertion_dwell_s * values[DWELL_PARAMETER]
        return float(np.exp(-slowest * dwell_s)) > RELAXED_SHARE


@dataclass(frozen=True)
class CapsuleModel(NominalModel):
    """The friction model of `settings`, whose scales, friction coefficient and contact angle runs determine."""

    settings: FrictionModelSettings

    @property
    def name(self) -> str:
        """Name in settings and reports."""
        return "capsule"

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Scales, friction coefficient, gain and contact angle, with what is known of any specimen."""
        return capsule_parameters(self.settings)

    @property
    def variations(self) -> tuple[Variation, ...]:
        """How runs on one specimen differ."""
        return RUN_VARIATIONS

    @property
    def combinations(self) -> tuple[Combination, ...]:
        """What the force channel shows of each scale, the gain in it, and the time constants."""
        return CAPSULE_COMBINATIONS

    @property
    def zero_sd(self) -> Mapping[str, float]:
        """The force sensor's zero [mN]."""
        return {FORCE_CHANNEL: FORCE_ZERO_SD_MN}

    def prepare(self, experiment: Experiment) -> Mapping[str, Predictor]:
        """Prepare the force of a run; raises `AnalysisError` where the run does not say its capsule or fixture."""
        if FORCE_CHANNEL not in experiment.run.trace.channels:
            return {}
        if experiment.contact is Contact.NONE:
            return {FORCE_CHANNEL: BlankPredictor(len(self.parameters))}
        names = tuple(one.name for one in self.parameters)
        if experiment.contact is Contact.STICKING:
            return {FORCE_CHANNEL: StickingPredictor(acquisition_of(experiment), experiment, self.settings, names)}
        acquisition, motion = acquisition_of(experiment), experiment.motion
        return {FORCE_CHANNEL: SlidingPredictor(acquisition, motion, self.settings, names, experiment.follows_command)}

    def settings_of(self, values: Mapping[str, float]) -> FrictionModelSettings:
        """Return the model's settings with identified values in place."""
        return self.settings.model_copy(update=dict(values))

    def document(self, values: Mapping[str, float]) -> Mapping[str, object]:
        """Return the settings as the simulated backend loads them."""
        return self.settings_of(values).model_dump(mode="json", exclude_defaults=False)


MODEL = CapsuleModel(FrictionModelSettings())
"""The model with the paper's values."""
