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


def predicted_scene(run: RunData, predicted: FloatArray, friction: FrictionParts | None = None) -> PredictedScene:
    """Return a run as effects see it, at the nodes of its blocks.

    Parameters
    ----------
    predicted
        The nominal force there, shape `(n,)`.
    friction
        What of it is friction between two surfaces that slide; nothing slides without.
    """
    time_s = run.block_data.blocks.nodes_s
    nothing = np.zeros_like(time_s)
    parts = friction or FrictionParts(0.0, nothing, nothing, 1.0)
    return PredictedScene(
        time_s=time_s,
        session_start_s=run.session_start_s,
        order=run.experiment.run.info.header.order,
        contact=Contact.NONE if friction is None else Contact.SLIDING,
        # Sliding under a given load with no wall around it, which is what the vacuum fixture is.
        fixture=Fixture.NONE if friction is None else Fixture.VACUUM,
        motion=run.experiment.motion,
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
    scenes = [study.scene(number, study.initial_z) for number in range(len(study.runs))]
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


def confounded_with_friction(design: Design, runs: Sequence[RunData]) -> bool:
    """Tell whether the candidates of a design add what a smooth function of the way, the same in all runs, adds too.

    Friction has the sign of the motion and is not there at rest. Runs at several speeds, in both directions or with
    rests tell it from what is a function of time or of the force.
    """
    added = np.concatenate([run.whitening.whiten(run.effect_force) for run in design.runs])
    if not np.any(added):
        return False
    rows = []
    longest = max(float(np.ptp(run_data.coordinates.position_mm)) for run_data in runs)
    for sight, run in zip(runs, design.runs, strict=True):
        own = np.hstack((run.columns[:, design.columns_of(ColumnKind.NOMINAL)], _friction_columns(sight, longest)))
        rows.append(run.whitening.whiten(own))
    columns = np.concatenate(rows)
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 0] / size[size > 0]
    nominal = np.concatenate(
        [run.whitening.whiten(run.columns[:, design.columns_of(ColumnKind.NOMINAL)]) for run in design.runs]
    )
    beside = _residual_chi2(nominal, added)
    return bool(beside > 0 and _residual_chi2(columns, added) < (1 - CONFOUNDED_SHARE) * beside)


def _residual_chi2(columns: FloatArray, values: FloatArray) -> float:
    result = np.linalg.lstsq(columns, values, rcond=1e-10)[0]
    return float(np.sum((values - columns @ result) ** 2))


def _friction_columns(run: RunData, longest_mm: float) -> FloatArray:
    """Return smooth functions of the way with the sign of the motion, shape `(B, K)`."""
    at = run.coordinates
    way = np.abs(at.position_mm - at.position_mm[0]) / max(longest_mm, 1e-12)
    slow = np.sign(run.experiment.velocity(at.time_s))
    # The smallest speeds are rests to an encoder of 1 µm; a steady motion goes its run's way all the same.
    sign = np.where(at.phase == Phase.STEADY, _travel_sign(run), slow)
    shapes = [way**power for power in WAY_POWERS] + [
        np.exp(-way / length) for length in np.geomspace(0.01, 1, WAY_LENGTHS)
    ]
    return np.asarray(sign[:, None] * np.stack(shapes, axis=1))


def _travel_sign(run: RunData) -> float:
    position = run.coordinates.position_mm
    return float(np.sign(position[-1] - position[0])) or 1.0


MIN_RUNS_TO_HOLD_OUT = 4
MIN_SPEEDS = 3
MOVING_MM_S = 0.01


def general_limitations(runs: Sequence[RunData]) -> Iterator[str]:
    """Say what is left open whatever the model."""
    if len({(run.condition, run.direction) for run in runs}) == len(runs):
        yield "No condition was repeated, so that repeatability is assumed and not seen."
    if len(runs) < MIN_RUNS_TO_HOLD_OUT:
        yield "With so few runs none can be kept back, so that no shrink is given."
    if not any(_has_own_command(run) for run in runs):
        yield "No command was recorded, so that nothing is said of the motor."


def _has_own_command(run: RunData) -> bool:
    """Tell whether a run has a command of its own, and not the position in its place."""
    trace = run.experiment.run.trace
    return not np.array_equal(np.asarray(trace.command), np.asarray(trace.position), equal_nan=True)


def capsule_limitations(runs: Sequence[RunData]) -> Iterator[str]:
    """Say what is left open of capsule and gut."""
    kinds = {run.experiment.kind for run in runs}
    speeds = {run.condition[1] for run in runs if run.experiment.kind == "drag"}
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


def stage_limitations(runs: Sequence[RunData]) -> Iterator[str]:
    """Say what is left open of the stage alone."""
    yield "The simulated stage takes no effects, so that no amended model is written."
    velocity = np.concatenate([run.experiment.velocity(run.block_data.blocks.nodes_s) for run in runs])
    speeds = {round(float(run.coordinates.top_speed_mm_s[0]), 1) for run in runs}
    if velocity.min(initial=0.0) >= -MOVING_MM_S or velocity.max(initial=0.0) <= MOVING_MM_S:
        yield "All runs go one way, so that friction which differs with direction cannot be told from any other."
    if len(speeds) < MIN_SPEEDS:
        yield "With fewer than three speeds, effects of speed cannot be told apart."
    if all(run.experiment.contact is not Contact.NONE for run in runs):
        yield "Without blank runs the stage is known no better than what hangs on it."


def own_model_limitations(runs: Sequence[RunData], other_channels: Sequence[str]) -> Iterator[str]:
    """Say what is left open of a model of one's own, of which one channel is explained and `other_channels` are not."""
    rests = any(np.any(run.coordinates.phase == Phase.REST) for run in runs)
    if len({(run.condition, run.direction) for run in runs}) == 1 and not rests:
        yield (
            "All runs go one way at one speed and none rests, so that what a sensor does in time cannot be told from "
            "friction that changes along the way."
        )
    yield (
        "The model does not say which parts its force has, so that only effects of sensor and acquisition were tried; "
        "none of wall, interface, specimen or drive was."
    )
    yield "No amended model is written: the simulator does not know the model."
    for name in other_channels:
        yield f"The model predicts {name} too, which was not looked at."


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
        own = tuple(effect for effect in effects if effect.nominal in {"", SIMULATED_NOMINAL})
        return cls(problem, run_data_of(problem.channels), own, nominal)

    @cached_property
    def chain(self) -> EffectChain:
        """Effects that the nominal model has already, but for the hum of the mains."""
        return without_hum(EffectChain.of(self.nominal.settings))

    def amended_settings(self, z: FloatArray) -> FrictionModelSettings:
        """Return the friction model of this specimen."""
        return self.nominal.settings_of(self.values(z))

    def scene(self, number: int, z: FloatArray) -> tuple[RunState, float]:
        """Return what effects see of a run, and the gain of the force sensor."""
        settings = self.amended_settings(z)
        return self.runs[number].scene(settings), settings.force_gain

    def model_errors(self, number: int, scene: RunState) -> FloatArray:
        """Return what each of `DETAILS` changes of the true force, shape `(D, n)`."""
        return model_error_columns(scene, self.runs[number].condition[1])

    def prediction_sds(self, z: FloatArray) -> list[FloatArray]:
        """Return what the motion leaves uncertain, and of sheared walls what steps of a programme do."""
        result = super().prediction_sds(z)
        for number, run in enumerate(self.runs):
            if run.acquisition.contact is Contact.STICKING:
                scene, gain = self.scene(number, z)
                result[number] = np.hypot(result[number], gain * run.block_means(ramp_integration_sd(scene)))
        return result

    def limitations(self) -> Iterator[str]:
        """Say what these runs leave open, a sentence each."""
        yield from capsule_limitations(self.runs)
        yield from general_limitations(self.runs)


@dataclass(frozen=True, eq=False)
class StageStudy(Study):
    """The recorded motor force: guides that slide, without wall or specimen."""

    @classmethod
    def of(cls, selection: RunSelection, nominal: DriveModel, effects: Sequence[Effect]) -> "StageStudy":
        """Prepare all runs; raises `AnalysisError` where none recorded a motor force."""
        problem = empirical_priors(JointProblem.of(selection, nominal, MAX_BLOCK_MM))
        bare = cls(problem, run_data_of(problem.channels), ())
        return replace(
            bare, effects=effects_that_act(bare, [effect for effect in effects if effect.nominal in {"", nominal.name}])
        )

    def scene(self, number: int, z: FloatArray) -> tuple[RunState, float]:
        """Return what effects see of a run; the motor force has no gain of its own."""
        run, values = self.runs[number], self.problem.scales.values(z)
        predictor, time_s = run.block_data.predictor, run.block_data.blocks.nodes_s
        friction = None
        if isinstance(predictor, DrivePredictor):
            viscous, coulomb = predictor.friction(values, time_s)
            friction = FrictionParts(self.values(z)["coulomb_mN"], coulomb, viscous, TURNING_SPEED_MM_S)
        return predicted_scene(run, predictor.predict(values, time_s).total, friction), 1.0

    def informative_blocks(self, number: int, motion_sd: FloatArray) -> BoolArray:
        """Return the blocks of which the motion tells more than a single sample's noise hides."""
        return motion_sd <= self.problem.noises[number].white

    def limitations(self) -> Iterator[str]:
        """Say what these runs leave open, a sentence each."""
        yield from stage_limitations(self.runs)
        yield from general_limitations(self.runs)


FORCE_UNIT = "mN"


@dataclass(frozen=True, eq=False)
class OwnModelStudy(Study):
    """One channel of a model that says nothing of its parts: effects of the sensor can act on it.

    Attributes
    ----------
    other_channels
        Channels that the model predicts too.
    untried_effects
        How many effects would act between what slides, of which the model does not tell the force.
    """

    other_channels: tuple[str, ...] = ()
    untried_effects: int = 0

    @classmethod
    def of(cls, selection: RunSelection, nominal: NominalModel, effects: Sequence[Effect]) -> "OwnModelStudy":
        """Prepare all runs by the first force that is predicted, the force sensor's before others.

        Raises
        ------
        AnalysisError
            Where the model predicts no force of any run, or fails.
        """
        whole = JointProblem.of(selection, nominal, MAX_BLOCK_MM)
        channels = tuple(dict.fromkeys(data.channel for data in whole.channels))
        forces = _force_channels(selection)
        channel = next((name for name in (*SIGNALS, *channels) if name in channels and name in forces), None)
        if channel is None:
            raise AnalysisError(
                f"the model {nominal.name} predicts {', '.join(channels)} and no force in mN, which is what a "
                "diagnosis explains; name another model with --nominal."
            )
        problem = empirical_priors(
            problem_of_runs(whole, [at for at, data in enumerate(whole.channels) if data.channel == channel])
        )
        others = tuple(name for name in channels if name != channel)
        untried = sum(isinstance(effect, ForceEffect) for effect in effects)
        bare = cls(problem, run_data_of(problem.channels), (), others, untried)
        sensor = [effect for effect in effects if isinstance(effect, SensorEffect) and not effect.nominal]
        return replace(bare, effects=effects_that_act(bare, sensor))

    def scene(self, number: int, z: FloatArray) -> tuple[RunState, float]:
        """Return what effects see of a run: its motion, and the force as predicted."""
        run = self.runs[number]
        prediction = run.block_data.predictor.predict(self.problem.scales.values(z), run.block_data.blocks.nodes_s)
        return predicted_scene(run, prediction.total), 1.0

    def informative_blocks(self, number: int, motion_sd: FloatArray) -> BoolArray:
        """Return the blocks of which the motion tells more than a single sample's noise hides."""
        return motion_sd <= self.problem.noises[number].white

    def untried_lookalikes(self, design: Design) -> int:
        """Return the number of effects that were not tried where candidates look like friction along the way."""
        return self.untried_effects if confounded_with_friction(design, self.runs) else 0

    def limitations(self) -> Iterator[str]:
        """Say what these runs and this model leave open, a sentence each."""
        yield from own_model_limitations(self.runs, self.other_channels)
        yield from general_limitations(self.runs)


def _force_channels(selection: RunSelection) -> set[str]:
    """Return the channels that are forces."""
    headers = [experiment.run.info.header for experiment in selection.experiments]
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
