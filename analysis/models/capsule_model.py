"""The paper's friction model as a nominal model: the force on a capsule in a gut, without any gap."""

from collections.abc import Collection, Hashable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.models.nominal_model import (
    NominalModel,
    Parameter,
    ParameterCombination,
    Prediction,
    Predictor,
    Variation,
)
from dragrig.config import Fixture, FrictionModelSettings, Specimen
from dragrig.rig import Acquisition, Contact, FloatArray, MotionProfile
from dragrig.sim_backend.friction import (
    ELEMENT_SCALES,
    GRAVITY_M_S2,
    NOT_NOMINAL,
    ContactHistory,
    HemisphereContact,
    PreparedForce,
    ProfileMotion,
    RecordedMotion,
    leading_motion,
    prepare,
    smooth_intervals,
)

FORCE_CHANNEL = "force"
SPECIMEN_PRIORS = {
    "stiffness_scale": (0.15, "common scale of E1, E2, E3, η1, η2"),
    "e1_scale": (0.07, "scale of E1 alone"),
    "e2_scale": (0.07, "scale of E2 alone"),
    "e3_scale": (0.07, "scale of E3 alone"),
    "eta1_scale": (0.07, "scale of η1 alone"),
    "eta2_scale": (0.07, "scale of η2 alone"),
    "friction_coefficient": (0.12, "Coulomb friction coefficient μ"),
    "mucus_scale": (0.20, "scale of the mucus' apparent viscosity"),
    "force_gain": (0.005, "true gain of the force channel"),
    "insertion_dwell_scale": (0.25, "true over recorded contact age"),
}
"""Relative standard deviations between specimens and rigs, by name in the model's settings."""
RIG_PARAMETERS = ("force_gain",)
DWELL_PARAMETER = "insertion_dwell_scale"
ANGLE_PARAMETER = "contact_angle_offset_deg"
ANGLE_SD_DEG = 0.7
FORCE_ZERO_SD_MN = 5.0
STIFFNESS_SCATTER, FRICTION_SCATTER = 0.02, 0.015
"""Relative standard deviations of all stiffness and of μ from run to run on one specimen."""
RUN_VARIATIONS = (Variation("stiffness", STIFFNESS_SCATTER), Variation("friction", FRICTION_SCATTER))


def _force_combination(name: str, powers: Mapping[str, float], meaning: str) -> ParameterCombination:
    return ParameterCombination(name, "1", {"force_gain": 1.0, **powers}, f"{meaning} as the force channel shows it")


CAPSULE_COMBINATIONS = (
    *(
        _force_combination(f"{element}_shown", {"stiffness_scale": 1.0, f"{element}_scale": 1.0}, f"scale of {symbol}")
        for element, symbol in (("e1", "E1"), ("e2", "E2"), ("e3", "E3"), ("eta1", "η1"), ("eta2", "η2"))
    ),
    ParameterCombination(
        "fast_time_scale", "1", {"eta1_scale": 1.0, "e1_scale": -1.0}, "scale of the time constant η1/E1"
    ),
    ParameterCombination(
        "slow_time_scale", "1", {"eta2_scale": 1.0, "e2_scale": -1.0}, "scale of the time constant η2/E2"
    ),
    _force_combination("friction_shown", {"friction_coefficient": 1.0}, "friction coefficient"),
    _force_combination("mucus_shown", {"mucus_scale": 1.0}, "scale of the viscosity"),
)


DERIVATIVE_STEP = 1e-3
"""Relative step of a derivative by differences."""
ANGLE_STEP_DEG = 0.2
"""Step of a derivative by the angle, on which it depends when a bend of the motion reaches the equator and the force
jumps."""
MOTION_TIMING_S, COMMAND_TIMING_S = 0.005, 0.001
"""Uncertainty of the start and stop of a measured motion, and of one that follows its command: a stage takes so long
over the last counts of a stop at 400 mm/s², which its encoder cannot show."""
MOVING_VELOCITY_ERROR_MM_S, CREEP_VELOCITY_ERROR_MM_S = 0.15, 0.05
"""Error of the velocity from 1 µm counts within some 30 ms: of a stage that moves, and of one that creeps."""
SETTLING_S, SOFT_SETTLING_S = 0.008, 0.03
"""Time in which the error of the velocity decays before and after a start or stop that follows its command: a position
loop gives way to friction by a fraction of a count, so that friction sets in and fades gradually. Under a loop that
gives way visibly, friction of 90 mN that turns over 0.05 mm/s fades in 40 ms: 2.8 kg held at 20 Hz."""
RELAXED_SHARE = 1e-9
"""The force of a wall that has relaxed to this share no longer depends on the contact's age."""

RECORDED_PROFILE = MotionProfile.from_pieces(())
"""Profile of a run whose motion comes from the record: the same for all, so that equivalent acquisitions are equal."""


def acquisition_of(experiment: Experiment) -> Acquisition:
    """Return the friction model's input of a run; its motion comes from the record.

    Raises
    ------
    AnalysisError
        Where the run does not state enough of its capsule.
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
    """Return the key of equivalent runs: all but the run's identity."""
    return replace(acquisition, run_id="", order=0)


@dataclass(frozen=True, eq=False)
class BlankPredictor(Predictor):
    """A blank run: nothing but the sensor's zero and noise."""

    @property
    def events_s(self) -> FloatArray:
        """No events."""
        return np.zeros(0)

    def predict(self, values: FloatArray, time_s: FloatArray) -> Prediction:
        """Return zeros."""
        del values
        return Prediction(np.zeros_like(time_s), np.zeros((len(RUN_VARIATIONS), len(time_s))))


@dataclass(frozen=True, eq=False)
class StickingPredictor(Predictor):
    """A relaxation: a capsule that sticks to the wall and shears it."""

    acquisition: Acquisition
    experiment: Experiment
    settings: FrictionModelSettings
    names: tuple[str, ...]

    @property
    def events_s(self) -> FloatArray:
        """Times at which the motion bends."""
        return self.experiment.motion.breaks_s

    @property
    def jumps(self) -> bool:
        """False: the wall's force follows the position without jumps, and its peak is sharper than a sample."""
        return False

    @property
    def equivalence_key(self) -> Hashable:
        """All but the run's identity."""
        bare = self.settings.model_copy(update=NOT_NOMINAL)
        return without_run_identity(self.acquisition), self.experiment.unsmoothed_motion, bare, self.names

    def predict(self, values: FloatArray, time_s: FloatArray) -> Prediction:
        """Predict the shear force, all of which is stiffness."""
        total = self._force(dict(zip(self.names, values.tolist(), strict=True)), time_s)
        return Prediction(total, np.stack((total, np.zeros_like(total))))

    def sensitivities(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return exact derivatives where the force is proportional, differences for the elements."""
        named = dict(zip(self.names, values.tolist(), strict=True))
        total = self._force(named, time_s)
        rows = {name: total / named[name] for name in ("force_gain", "stiffness_scale")}
        # All five elements scaled together are the common scale, from which the last derivative follows.
        remainder = rows["stiffness_scale"] * named["stiffness_scale"]
        *differenced, last = ELEMENT_SCALES
        for name in differenced:
            step = DERIVATIVE_STEP * named[name]
            rows[name] = (self._force({**named, name: named[name] + step}, time_s) - total) / step
            remainder = remainder - rows[name] * named[name]
        rows[last] = remainder / named[last]
        return _stack_sensitivities(self.names, rows, len(time_s))

    def uncertainty(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return by how much the force differs with straight lines from sample to sample: between them it is unknown.

        Of a ramp that begins and ends within few samples, the fast branch remembers the way.
        """
        named = dict(zip(self.names, values.tolist(), strict=True))
        chords = _straight_between_samples(self.experiment.unsmoothed_motion, self._step_s)
        return np.abs(self._force(named, time_s, chords) - self._force(named, time_s))

    @property
    def _step_s(self) -> float:
        return 1.0 / self.experiment.run.trace.sample_rate_hz

    def _force(
        self, values: Mapping[str, float], time_s: FloatArray, motion: ProfileMotion | None = None
    ) -> FloatArray:
        settings = self.settings.model_copy(update=values)
        return prepare(self.acquisition, settings, motion or self.experiment.unsmoothed_motion).force(time_s)


def _straight_between_samples(motion: ProfileMotion, step_s: float) -> ProfileMotion:
    """Return a motion through the same positions at the samples where it bends, of constant velocity between them."""
    samples = motion.breaks_s / step_s
    at_sample = np.abs(samples - np.round(samples)) < 0.25
    at_sample[[0, -1]] = True
    time_s = motion.breaks_s[at_sample]
    position_mm = motion.position(time_s)
    velocity = np.diff(position_mm) / np.diff(time_s)
    return ProfileMotion.of_means(time_s, position_mm[:-1], velocity)


def _stack_sensitivities(names: tuple[str, ...], rows: Mapping[str, FloatArray], samples: int) -> FloatArray:
    """Order derivatives by parameter, shape `(P, samples)`; zeros for parameters without a row."""
    zeros = np.zeros(samples)
    return np.stack([rows.get(name, zeros) for name in names])


@dataclass(frozen=True, slots=True, eq=False)
class _ForceComponents:
    """Force of a sliding capsule in the force channel, part by part [mN]."""

    elastic: FloatArray
    viscous: FloatArray
    coulomb: FloatArray
    weight: FloatArray

    @property
    def total(self) -> FloatArray:
        return self.elastic + self.viscous + self.coulomb

    @property
    def stiff(self) -> FloatArray:
        """The part that scales with the wall's stiffness: f_e, and Coulomb friction without the weight's."""
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
    settling_s: float = SETTLING_S
    """Time in which friction sets in and fades."""
    step_s: float = 0.0
    """Time between samples: half of it may lie between the instants of position and force."""

    @property
    def events_s(self) -> FloatArray:
        """Times at which the motion bends, and at which wall passed at a bend reaches the equator for likely angles."""
        events = [self.motion.breaks_s]
        if self.acquisition.fixture is Fixture.FOAM:
            nominal = self.settings.contact_angle_offset_deg
            events += [self._interval_starts(nominal + sds * ANGLE_SD_DEG) for sds in (-2.0, 0.0, 2.0)]
        return np.unique(np.concatenate(events))

    @property
    def equivalence_key(self) -> Hashable:
        """All but the run's identity."""
        bare = self.settings.model_copy(update=NOT_NOMINAL)
        return without_run_identity(self.acquisition), self.motion, bare, self.names, self.follows_command, self.step_s

    def predict(self, values: FloatArray, time_s: FloatArray) -> Prediction:
        """Predict f_e + f_v + f_c in the force channel."""
        parts = self._parts(dict(zip(self.names, values.tolist(), strict=True)), time_s)
        return Prediction(parts.total, np.stack((parts.stiff, parts.coulomb)))

    def sensitivities(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return exact derivatives; differences for dwell and angle."""
        return self.sensitivities_without((), values, time_s)

    def sensitivities_without(self, names: Collection[str], values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return `sensitivities`, zeros by the angle if it is among the names: its differences cost the most."""
        named = dict(zip(self.names, values.tolist(), strict=True))
        prepared = self._prepared(named)
        parts = self._split(prepared, named, time_s)
        rows = {
            "force_gain": parts.total / named["force_gain"],
            "stiffness_scale": parts.stiff / named["stiffness_scale"],
            "friction_coefficient": parts.coulomb / named["friction_coefficient"],
            "mucus_scale": parts.viscous / named["mucus_scale"],
        }
        if self.acquisition.fixture is Fixture.FOAM:
            by_element = zip(ELEMENT_SCALES, prepared.log_derivatives(time_s), strict=True)
            rows |= {name: by_log / named[name] for name, by_log in by_element}
            if ANGLE_PARAMETER not in names:
                rows[ANGLE_PARAMETER] = self._by_angle(named, time_s)
            slowest = self._contact(named).side_pressure().slow_rate
            age_s = self.acquisition.insertion_dwell_s * named[DWELL_PARAMETER]
            if float(np.exp(-slowest * age_s)) > RELAXED_SHARE:
                dwell = named[DWELL_PARAMETER]
                step = DERIVATIVE_STEP * dwell
                longer, shorter = (
                    self._parts({**named, DWELL_PARAMETER: dwell + side * step}, time_s).total for side in (1.0, -1.0)
                )
                rows[DWELL_PARAMETER] = (longer - shorter) / (2 * step)
        return _stack_sensitivities(self.names, rows, len(time_s))

    def _by_angle(self, named: Mapping[str, float], time_s: FloatArray) -> FloatArray:
        offsets = (named[ANGLE_PARAMETER] + ANGLE_STEP_DEG, named[ANGLE_PARAMETER] - ANGLE_STEP_DEG)
        more, less = (self._parts({**named, ANGLE_PARAMETER: offset}, time_s) for offset in offsets)
        # Friction jumps when a bend reaches the equator; a jump within the step is no slope, and is excluded.
        ahead, behind = (np.searchsorted(self._interval_starts(offset), time_s, side="right") for offset in offsets)
        change = np.where(ahead == behind, more.total - less.total, more.elastic - less.elastic)
        return np.asarray(change / (2 * ANGLE_STEP_DEG))

    def uncertainty(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return by how much friction differs a little earlier or later: it changes within the last µm of a motion."""
        last = float(self.motion.breaks_s[-1])
        timing = max(COMMAND_TIMING_S if self.follows_command else MOTION_TIMING_S, 0.5 * self.step_s)
        shifted = np.concatenate([np.clip(time_s + shift, 0.0, last) for shift in (-timing, 0.0, timing)])
        parts = self._parts(dict(zip(self.names, values.tolist(), strict=True)), shifted)
        before, now, after = np.split(parts.viscous + parts.coulomb, 3)
        by_timing = np.maximum(np.abs(before - now), np.abs(after - now))
        return np.hypot(by_timing, self._creep_uncertainty(now, time_s))

    def _creep_uncertainty(self, friction: FloatArray, time_s: FloatArray) -> FloatArray:
        """Uncertainty of friction where the stage creeps more slowly than its encoder can show."""
        velocity, width = self.motion.velocity(time_s), self.settings.regularisation_mm_s
        moves = np.concatenate(([False], self.motion.signs != 0, [False]))
        turns_s = self.motion.breaks_s[moves[1:] != moves[:-1]]
        error = np.where(velocity == 0, CREEP_VELOCITY_ERROR_MM_S, MOVING_VELOCITY_ERROR_MM_S)
        if self.follows_command:
            since_turn_s = np.abs(time_s[:, None] - turns_s).min(axis=1, initial=np.inf)
            error = error * np.exp(-since_turn_s / self.settling_s)
        sides = [np.abs(np.tanh((velocity + side * error) / width) - np.tanh(velocity / width)) for side in (-1.0, 1.0)]
        has_started = time_s >= turns_s.min(initial=np.inf)
        return np.asarray(np.where(has_started, np.maximum(*sides), 0.0) * np.abs(friction).max(initial=0.0))

    def _prepared(self, values: Mapping[str, float]) -> PreparedForce:
        return prepare(self.acquisition, self.settings.model_copy(update=values), self.motion)

    def _parts(self, values: Mapping[str, float], time_s: FloatArray) -> _ForceComponents:
        return self._split(self._prepared(values), values, time_s)

    def _split(self, prepared: PreparedForce, values: Mapping[str, float], time_s: FloatArray) -> _ForceComponents:
        gain = values["force_gain"]
        forces = prepared.components(time_s)
        direction = np.tanh(self.motion.velocity(time_s) / self.settings.regularisation_mm_s)
        weight = values["friction_coefficient"] * self.acquisition.capsule.mass_g * GRAVITY_M_S2 * direction
        return _ForceComponents(gain * forces.f_e, gain * forces.f_v, gain * forces.f_c, gain * weight)

    def _contact(self, values: Mapping[str, float]) -> HemisphereContact:
        acquisition, model = self.acquisition, self.settings.model_copy(update=values)
        return HemisphereContact.of(acquisition.capsule, acquisition.specimen.wall_thickness_mm, model)

    def _interval_starts(self, angle_offset_deg: float) -> FloatArray:
        contact = self._contact({ANGLE_PARAMETER: angle_offset_deg})
        history = ContactHistory.of(leading_motion(self.motion), contact.length_mm + self.settings.side_contact_mm, 1.0)
        return np.array([interval.begin_s for interval in smooth_intervals(history, contact.length_mm)])


@dataclass(frozen=True)
class CapsuleModel(NominalModel):
    """The friction model of `settings`; runs determine its scales, friction coefficient and contact angle."""

    settings: FrictionModelSettings

    @property
    def name(self) -> str:
        """Name in settings and reports."""
        return "capsule"

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Scales, friction coefficient, gain and contact angle, with their priors over specimens."""
        scales = tuple(
            Parameter(name, "1", float(getattr(self.settings, name)), sd, True, meaning, name in RIG_PARAMETERS)
            for name, (sd, meaning) in SPECIMEN_PRIORS.items()
        )
        offset_deg = self.settings.contact_angle_offset_deg
        angle = Parameter(ANGLE_PARAMETER, "deg", offset_deg, ANGLE_SD_DEG, False, "contact angle minus the capsule's")
        return (*scales, angle)

    @property
    def variations(self) -> tuple[Variation, ...]:
        """Run-to-run variations of stiffness and friction."""
        return RUN_VARIATIONS

    @property
    def combinations(self) -> tuple[ParameterCombination, ...]:
        """The scales as the force channel shows them, with its gain, and the time constants."""
        return CAPSULE_COMBINATIONS

    @property
    def zero_sd(self) -> Mapping[str, float]:
        """The force sensor's zero [mN]."""
        return {FORCE_CHANNEL: FORCE_ZERO_SD_MN}

    def prepare(self, experiment: Experiment) -> Mapping[str, Predictor]:
        """Prepare the force of a run; raises `AnalysisError` where the run does not state its capsule or fixture."""
        if FORCE_CHANNEL not in experiment.run.trace.channels:
            return {}
        if experiment.contact is Contact.NONE:
            return {FORCE_CHANNEL: BlankPredictor()}
        names = tuple(parameter.name for parameter in self.parameters)
        if experiment.contact is Contact.STICKING:
            return {FORCE_CHANNEL: StickingPredictor(acquisition_of(experiment), experiment, self.settings, names)}
        acquisition, motion = acquisition_of(experiment), experiment.motion
        follows, step_s = experiment.follows_command, 1.0 / experiment.run.trace.sample_rate_hz
        settling_s = SOFT_SETTLING_S if experiment.soft_loop else SETTLING_S
        return {FORCE_CHANNEL: SlidingPredictor(acquisition, motion, self.settings, names, follows, settling_s, step_s)}

    def settings_of(self, values: Mapping[str, float]) -> FrictionModelSettings:
        """Return the model's settings with identified values."""
        return self.settings.model_copy(update=dict(values))

    def document(self, values: Mapping[str, float]) -> Mapping[str, object]:
        """Return the settings in the form that the simulated backend loads."""
        return self.settings_of(values).model_dump(mode="json", exclude_defaults=False)


MODEL = CapsuleModel(FrictionModelSettings())
"""The model with the paper's values."""
