"""Campaigns prepared by nominal model: capsule in the gut, stage alone, or an own model; with their limitations."""

from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property

import numpy as np

from dragrig.analysis.gap.candidates import signature, variants_of
from dragrig.analysis.gap.design import ColumnKind, Design, Study, problem_of_runs
from dragrig.analysis.gap.model_uncertainty import empirical_priors, model_error_columns, ramp_integration_sd
from dragrig.analysis.gap.run_data import MAX_BLOCK_MM, RunData, run_data_of
from dragrig.analysis.gap.spectral_lines import add_known_hum_to_noise, without_hum
from dragrig.analysis.inference.linear_gaussian import JointProblem
from dragrig.analysis.models.capsule_model import CapsuleModel
from dragrig.analysis.models.drive_model import TURNING_SPEED_MM_S, DriveModel, DrivePredictor
from dragrig.analysis.models.nominal_model import NominalModel
from dragrig.analysis.selection import RunSelection
from dragrig.config.errors import AnalysisError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Fixture
from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.rig.devices import Contact
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.schema import SIGNALS
from dragrig.sim_backend.effects.base import SIMULATED_NOMINAL, Effect, EffectChain, ForceEffect, SensorEffect
from dragrig.sim_backend.effects.run_state import RunState

MIN_SIGNATURE_MN = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class FrictionParts:
    """Friction by its parts, at the times of a scene, shape `(n,)`.

    Attributes
    ----------
    coulomb_mN
        Coulomb friction at speed.
    coulomb, viscous
        Both parts with their signs [mN].
    turning_mm_s
        Speed over which the first turns its sign.
    """

    coulomb_mN: float
    coulomb: FloatArray
    viscous: FloatArray
    turning_mm_s: float


@dataclass(frozen=True, eq=False)
class PredictedScene(RunState):
    """A run without wall or specimen: friction that does not depend on any stiffness, in a force as predicted.

    Attributes
    ----------
    predicted
        The whole nominal force, shape `(n,)`.
    """

    _: KW_ONLY
    predicted: FloatArray

    @property
    def nominal(self) -> FloatArray:
        """The nominal force."""
        return self.predicted

    @property
    def stiffness_force(self) -> FloatArray:
        """Nothing grows with the stiffness of a wall."""
        return np.zeros_like(self.time_s)


def predicted_scene(sight: RunData, predicted: FloatArray, friction: FrictionParts | None = None) -> PredictedScene:
    """Return a run as effects see it, at the nodes of its blocks.

    Parameters
    ----------
    predicted
        The nominal force there, shape `(n,)`.
    friction
        What of it is friction between two surfaces that slide; nothing slides without.
    """
    time_s = sight.evidence.blocks.nodes_s
    nothing = np.zeros_like(time_s)
    parts = friction or FrictionParts(0.0, nothing, nothing, 1.0)
    return PredictedScene(
        time_s=time_s,
        session_start_s=sight.session_start_s,
        order=sight.experiment.run.info.header.order,
        contact=Contact.NONE if friction is None else Contact.SLIDING,
        # Sliding under a given load with no wall around it, which is what the vacuum fixture is.
        fixture=Fixture.NONE if friction is None else Fixture.VACUUM,
        motion=sight.experiment.motion,
        regularisation_mm_s=parts.turning_mm_s,
        f_e=nothing,
        f_v=parts.viscous,
        f_c=parts.coulomb,
        weight_mN=parts.coulomb_mN,
        friction_coefficient=1.0,
        shear=nothing,
        predicted=predicted,
    )


def effects_that_act(study: Study, effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return the effects that change anything in any of the runs."""
    scenes = [study.scene(number, study.start) for number in range(len(study.sights))]
    return tuple(
        effect
        for effect in effects
        if any(
            np.abs(signature(shape, *scene)).max(initial=0.0) > MIN_SIGNATURE_MN
            for shape in variants_of([effect])
            for scene in scenes
        )
    )


CONFOUNDED_SHARE = 0.8
"""Part of an effect's whitened squares, the model's own parameters free, from which on it is the same."""
WAY_LENGTHS = 8
"""Ways, from a hundredth of the longest on, over which friction may evolve."""
WAY_POWERS = (1, 2, 3)


def confounded_with_friction(design: Design, sights: Sequence[RunData]) -> bool:
    """Tell whether the candidates of a design add what a smooth function of the way, the same in all runs, adds too.

    Friction has the sign of the motion and is not there at rest. Runs at several speeds, in both directions or with
    rests tell it from what is a function of time or of the force.
    """
    added = np.concatenate([part.whitening.whiten(part.added) for part in design.parts])
    if not np.any(added):
        return False
    rows = []
    longest = max(float(np.ptp(one.coordinates.position_mm)) for one in sights)
    for sight, part in zip(sights, design.parts, strict=True):
        own = np.hstack((part.columns[:, design.of(ColumnKind.NOMINAL)], _friction_columns(sight, longest)))
        rows.append(part.whitening.whiten(own))
    columns = np.concatenate(rows)
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 0] / size[size > 0]
    nominal = np.concatenate(
        [part.whitening.whiten(part.columns[:, design.of(ColumnKind.NOMINAL)]) for part in design.parts]
    )
    beside = _residual_chi2(nominal, added)
    return bool(beside > 0 and _residual_chi2(columns, added) < (1 - CONFOUNDED_SHARE) * beside)


def _residual_chi2(columns: FloatArray, values: FloatArray) -> float:
    found = np.linalg.lstsq(columns, values, rcond=1e-10)[0]
    return float(np.sum((values - columns @ found) ** 2))


def _friction_columns(sight: RunData, longest_mm: float) -> FloatArray:
    """Return smooth functions of the way with the sign of the motion, shape `(B, K)`."""
    at = sight.coordinates
    way = np.abs(at.position_mm - at.position_mm[0]) / max(longest_mm, 1e-12)
    slow = np.sign(sight.experiment.velocity(at.time_s))
    # The smallest speeds are rests to an encoder of 1 µm; a steady motion goes its run's way all the same.
    sign = np.where(at.phase == Phase.STEADY, _travel_sign(sight), slow)
    shapes = [way**power for power in WAY_POWERS] + [
        np.exp(-way / length) for length in np.geomspace(0.01, 1, WAY_LENGTHS)
    ]
    return np.asarray(sign[:, None] * np.stack(shapes, axis=1))


def _travel_sign(sight: RunData) -> float:
    position = sight.coordinates.position_mm
    return float(np.sign(position[-1] - position[0])) or 1.0


MIN_RUNS_TO_HOLD_OUT = 4
MIN_SPEEDS = 3
MOVING_MM_S = 0.01


def general_limitations(sights: Sequence[RunData]) -> Iterator[str]:
    """Say what is left open whatever the model."""
    if len({(one.condition, one.heading) for one in sights}) == len(sights):
        yield "No condition was repeated, so that repeatability is assumed and not seen."
    if len(sights) < MIN_RUNS_TO_HOLD_OUT:
        yield "With so few runs none can be kept back, so that no shrink is given."
    if not any(_has_own_command(one) for one in sights):
        yield "No command was recorded, so that nothing is said of the motor."


def _has_own_command(one: RunData) -> bool:
    """Tell whether a run has a command of its own, and not the position in its place."""
    trace = one.experiment.run.trace
    return not np.array_equal(np.asarray(trace.command), np.asarray(trace.position), equal_nan=True)


def capsule_limitations(sights: Sequence[RunData]) -> Iterator[str]:
    """Say what is left open of capsule and gut."""
    kinds = {one.experiment.kind for one in sights}
    speeds = {one.condition[1] for one in sights if one.experiment.kind == "drag"}
    if "relaxation" not in kinds:
        yield "Without relaxations nothing is said of a further relaxation or of stiffening with strain."
    if "drag" not in kinds:
        yield "Without drag runs nothing is said of what needs a closed gut: adhesion, folds, lift-off, inertia."
    elif len(speeds) < MIN_SPEEDS:
        yield "With fewer than three speeds of drag, effects of speed cannot be told apart."
    if "blank" not in kinds:
        yield "Without blank runs the rig's own effects are known through the gut alone."
    if "coulomb" not in kinds:
        yield "Without Coulomb runs adhesion cannot be told from friction that falls with speed."


def stage_limitations(sights: Sequence[RunData]) -> Iterator[str]:
    """Say what is left open of the stage alone."""
    yield "The simulated stage takes no effects, so that no amended model is written."
    velocity = np.concatenate([one.experiment.velocity(one.evidence.blocks.nodes_s) for one in sights])
    speeds = {round(float(one.coordinates.top_speed_mm_s[0]), 1) for one in sights}
    if velocity.min(initial=0.0) >= -MOVING_MM_S or velocity.max(initial=0.0) <= MOVING_MM_S:
        yield "All runs go one way, so that friction which differs with direction cannot be told from any other."
    if len(speeds) < MIN_SPEEDS:
        yield "With fewer than three speeds, effects of speed cannot be told apart."
    if all(one.experiment.contact is not Contact.NONE for one in sights):
        yield "Without blank runs the stage is known no better than what hangs on it."


def own_model_limitations(sights: Sequence[RunData], others: Sequence[str]) -> Iterator[str]:
    """Say what is left open of a model of one's own, of which one channel is explained and `others` are not."""
    rests = any(np.any(one.coordinates.phase == Phase.REST) for one in sights)
    if len({(one.condition, one.heading) for one in sights}) == 1 and not rests:
        yield (
            "All runs go one way at one speed and none rests, so that what a sensor does in time cannot be told from "
            "friction that changes along the way."
        )
    yield (
        "The model does not say which parts its force has, so that only effects of sensor and acquisition were tried; "
        "none of wall, interface, specimen or drive was."
    )
    yield "No amended model is written: the simulator does not know the model."
    for other in others:
        yield f"The model predicts {other} too, which was not looked at."


@dataclass(frozen=True, eq=False)
class CapsuleStudy(Study):
    """The force sensor's channel; effects that the model's settings have belong to the nominal model."""

    nominal: CapsuleModel

    @classmethod
    def of(cls, selection: RunSelection, nominal: CapsuleModel, effects: Sequence[Effect]) -> "CapsuleStudy":
        """Prepare all runs; raises `AnalysisError` where the model predicts nothing of any of them."""
        problem = add_known_hum_to_noise(
            JointProblem.of(selection, nominal, MAX_BLOCK_MM), EffectChain.of(nominal.settings)
        )
        own = tuple(one for one in effects if one.nominal in {"", SIMULATED_NOMINAL})
        return cls(problem, run_data_of(problem.channels), own, nominal)

    @cached_property
    def chain(self) -> EffectChain:
        """Effects that the nominal model has already, but for the hum of the mains."""
        return without_hum(EffectChain.of(self.nominal.settings))

    def simulator(self, z: FloatArray) -> FrictionModelSettings:
        """Return the friction model of this specimen."""
        return self.nominal.settings_of(self.values(z))

    def scene(self, number: int, z: FloatArray) -> tuple[RunState, float]:
        """Return what effects see of a run, and the gain of the force sensor."""
        settings = self.simulator(z)
        return self.sights[number].scene(settings), settings.force_gain

    def details(self, number: int, scene: RunState) -> FloatArray:
        """Return what each of `DETAILS` changes of the true force, shape `(D, n)`."""
        return model_error_columns(scene, self.sights[number].condition[1])

    def doubts(self, z: FloatArray) -> list[FloatArray]:
        """Return what the motion leaves uncertain, and of sheared walls what steps of a programme do."""
        found = super().doubts(z)
        for number, sight in enumerate(self.sights):
            if sight.acquisition.contact is Contact.STICKING:
                scene, gain = self.scene(number, z)
                found[number] = np.hypot(found[number], gain * sight.of_blocks(ramp_integration_sd(scene)))
        return found

    def open_questions(self) -> Iterator[str]:
        """Say what these runs leave open, a sentence each."""
        yield from capsule_limitations(self.sights)
        yield from general_limitations(self.sights)


@dataclass(frozen=True, eq=False)
class StageStudy(Study):
    """The recorded motor force: guides that slide, without wall or specimen."""

    @classmethod
    def of(cls, selection: RunSelection, nominal: DriveModel, effects: Sequence[Effect]) -> "StageStudy":
        """Prepare all runs; raises `AnalysisError` where none recorded a motor force."""
        problem = empirical_priors(JointProblem.of(selection, nominal, MAX_BLOCK_MM))
        bare = cls(problem, run_data_of(problem.channels), ())
        return replace(
            bare, effects=effects_that_act(bare, [one for one in effects if one.nominal in {"", nominal.name}])
        )

    def scene(self, number: int, z: FloatArray) -> tuple[RunState, float]:
        """Return what effects see of a run; the motor force has no gain of its own."""
        sight, values = self.sights[number], self.problem.scales.values(z)
        predictor, time_s = sight.evidence.predictor, sight.evidence.blocks.nodes_s
        friction = None
        if isinstance(predictor, DrivePredictor):
            viscous, coulomb = predictor.friction(values, time_s)
            friction = FrictionParts(self.values(z)["coulomb_mN"], coulomb, viscous, TURNING_SPEED_MM_S)
        return predicted_scene(sight, predictor.predict(values, time_s).total, friction), 1.0

    def counted(self, number: int, motion_sd: FloatArray) -> BoolArray:
        """Return the blocks of which the motion tells more than a single sample's noise hides."""
        return motion_sd <= self.problem.noises[number].white

    def open_questions(self) -> Iterator[str]:
        """Say what these runs leave open, a sentence each."""
        yield from stage_limitations(self.sights)
        yield from general_limitations(self.sights)


FORCE_UNIT = "mN"


@dataclass(frozen=True, eq=False)
class OwnModelStudy(Study):
    """One channel of a model that says nothing of its parts: effects of the sensor can act on it.

    Attributes
    ----------
    others
        Channels that the model predicts too.
    untried
        How many effects would act between what slides, of which the model does not tell the force.
    """

    others: tuple[str, ...] = ()
    untried: int = 0

    @classmethod
    def of(cls, selection: RunSelection, nominal: NominalModel, effects: Sequence[Effect]) -> "OwnModelStudy":
        """Prepare all runs by the first force that is predicted, the force sensor's before others.

        Raises
        ------
        AnalysisError
            Where the model predicts no force of any run, or fails.
        """
        whole = JointProblem.of(selection, nominal, MAX_BLOCK_MM)
        channels = tuple(dict.fromkeys(one.channel for one in whole.channels))
        forces = _force_channels(selection)
        channel = next((one for one in (*SIGNALS, *channels) if one in channels and one in forces), None)
        if channel is None:
            raise AnalysisError(
                f"the model {nominal.name} predicts {', '.join(channels)} and no force in mN, which is what a "
                "diagnosis explains; name another model with --nominal."
            )
        problem = empirical_priors(
            problem_of_runs(whole, [at for at, one in enumerate(whole.channels) if one.channel == channel])
        )
        others = tuple(one for one in channels if one != channel)
        untried = sum(isinstance(one, ForceEffect) for one in effects)
        bare = cls(problem, run_data_of(problem.channels), (), others, untried)
        sensor = [one for one in effects if isinstance(one, SensorEffect) and not one.nominal]
        return replace(bare, effects=effects_that_act(bare, sensor))

    def scene(self, number: int, z: FloatArray) -> tuple[RunState, float]:
        """Return what effects see of a run: its motion, and the force as predicted."""
        sight = self.sights[number]
        prediction = sight.evidence.predictor.predict(self.problem.scales.values(z), sight.evidence.blocks.nodes_s)
        return predicted_scene(sight, prediction.total), 1.0

    def counted(self, number: int, motion_sd: FloatArray) -> BoolArray:
        """Return the blocks of which the motion tells more than a single sample's noise hides."""
        return motion_sd <= self.problem.noises[number].white

    def untold(self, design: Design) -> int:
        """Return the number of effects that were not tried where candidates look like friction along the way."""
        return self.untried if confounded_with_friction(design, self.sights) else 0

    def open_questions(self) -> Iterator[str]:
        """Say what these runs and this model leave open, a sentence each."""
        yield from own_model_limitations(self.sights, self.others)
        yield from general_limitations(self.sights)


def _force_channels(selection: RunSelection) -> set[str]:
    """Return the channels that are forces."""
    headers = [one.run.info.header for one in selection.experiments]
    return {channel.name for header in headers for channel in header.channels if channel.units == FORCE_UNIT}


def prepare_study(selection: RunSelection, nominal: NominalModel, effects: Sequence[Effect]) -> Study:
    """Prepare a campaign; raises `AnalysisError` where the model predicts nothing of any run.

    Parameters
    ----------
    effects
        Candidates of the force channel, of which those are kept that can act.
    """
    match nominal:
        case CapsuleModel():
            return CapsuleStudy.of(selection, nominal, effects)
        case DriveModel():
            return StageStudy.of(selection, nominal, effects)
        case _:
            return OwnModelStudy.of(selection, nominal, effects)
