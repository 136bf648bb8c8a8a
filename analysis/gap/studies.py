"""Campaigns prepared by nominal model (capsule in the gut, stage alone, own model), and where a model may be wrong.

No wall follows the published law exactly, and no two programmes integrate it alike. Each direction in which a nominal
model may be slightly wrong without any effect is the change of the prediction when one detail of the model is off by
one prior standard deviation. Where little is known of a model beforehand, the priors of its parameters come from the
runs themselves (`empirical_priors`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property

import numpy as np

from dragrig.analysis import (
    MOTOR_FORCE_CHANNEL,
    TURNING_SPEED_MM_S,
    AmendedModel,
    CapsuleModel,
    DriveModel,
    ForcePart,
    JointProblem,
    NominalModel,
    PriorScales,
    RunSelection,
    join_names,
    model_reference,
    session_starts,
    solve_joint,
    zero_remarks,
)
from dragrig.analysis.gap.design import (
    ColumnKind,
    Design,
    Study,
    linearise,
    problem_of_runs,
    signature,
    variants_of,
)
from dragrig.analysis.gap.naming_limits import (
    PLACE_HARMONICS,
    capsule_limitations,
    confounded_with_friction,
    general_limitations,
    naming_obstacle,
    own_model_limitations,
    sensor_obstacle,
    stage_limitations,
)
from dragrig.analysis.gap.run_data import MAX_BLOCK_MM, RunData, run_data_of
from dragrig.analysis.gap.spectral_lines import add_known_hum_to_noise, known_effects, without_hum
from dragrig.config import AmendedModelSettings, AnalysisError, Fixture, FrictionModelSettings
from dragrig.rig import SIGNALS, Contact, FloatArray
from dragrig.sim_backend.effects import (
    SIMULATED_NOMINAL,
    Channel,
    Coordinate,
    Effect,
    EffectChain,
    EffectParameter,
    Location,
    Role,
    RunState,
    ShearedWall,
    first_order,
)
from dragrig.sim_backend.friction import stress_log_derivatives

LAW_SHAPE_SD = 0.02
"""Shape of the wall law, all elements alike: relative change over a strain of 1."""
ELEMENT_SHAPE_SD = 0.005
"""Shape of a single element's law, in addition."""
INTEGRATION_STEP_S = 0.004
"""Step of a simulation that applies the strain of a ramp at the begin or the end of a step."""
COARSE_STEP_S = 0.006
"""Step between whose ends a simulation may interpolate the force of a ramp linearly."""
CONTACT_INTEGRAL_SD = 0.01
"""Ratio of wall resistance to pressure at the equator, and its trend with speed over a factor of e²."""
ELEMENTS = 5
REFERENCE_STRAIN = 1.0
LAW_POWERS = (1, 2)
PANELS = 8
"""Coarsest plausible quadrature over the contact: midpoints of this many panels on newly touched and on other wall."""


def model_error_columns(scene: RunState, speed_mm_s: float) -> FloatArray:
    """Return the change of the true force by one prior sd of each detail of the model that may be off, shape `(D, n)`.

    Parameters
    ----------
    scene
        State of the run.
    speed_mm_s
        Speed of the run.
    """
    by_power = [_strain_power_by_element(scene, power) for power in LAW_POWERS]
    rows = [LAW_SHAPE_SD * np.sum(columns, axis=0) for columns in by_power]
    rows += [ELEMENT_SHAPE_SD * column for column in by_power[0]]
    rows.append(INTEGRATION_STEP_S * _ramp_step_error(scene))
    rows.append(CONTACT_INTEGRAL_SD * scene.f_e)
    rows.append(CONTACT_INTEGRAL_SD * scene.f_e * 0.5 * float(np.log(max(speed_mm_s, 0.1) / 5.0)))
    rows.append(_quadrature_error(scene))
    return np.stack(rows)


def _strain_power_by_element(scene: RunState, power: int) -> list[FloatArray]:
    """Return the force change when each element in turn is scaled by a power of strain minus the reference strain."""
    wall, sheared = scene.wall, scene.sheared
    if wall is not None:
        factor = (wall.strain - REFERENCE_STRAIN) ** power * wall.strain
        equator_factor = (wall.strain_at_equator - REFERENCE_STRAIN) ** power * wall.strain_at_equator
        stresses = stress_log_derivatives(wall.parameters, wall.age_s) * factor
        equator_stresses = stress_log_derivatives(wall.equator_parameters, wall.equator_age_s) * equator_factor
        friction, sign = scene.friction_coefficient * scene.coulomb_sign, np.sign(scene.f_e)
        pairs = zip(stresses, equator_stresses, strict=True)
        return [
            np.asarray(sign * wall.resistance(stress) + friction * wall.side_force(equator_stress))
            for stress, equator_stress in pairs
        ]
    if sheared is not None:
        scale = (sheared.target_strain - REFERENCE_STRAIN) ** power
        return [np.asarray(scale * force) for force in _sheared_force_by_element(sheared)]
    return [np.zeros_like(scene.time_s)] * ELEMENTS


def _sheared_force_by_element(sheared: ShearedWall) -> list[FloatArray]:
    forces = [np.asarray(stress * sheared.area_mm2) for stress in sheared.stresses]
    step = 1e-3
    for rate, modulus in zip(sheared.rates, sheared.moduli[:2], strict=True):
        changed = sheared.branch(rate * (1 - step)) - sheared.branch(rate * (1 + step))
        forces.append(np.asarray(sheared.area_mm2 * modulus * changed / (2 * step)))
    return forces


def _quadrature_error(scene: RunState) -> FloatArray:
    """Return the error of a coarse quadrature over the contact, which misses the fast branch at first touch."""
    if scene.wall is None:
        return np.zeros_like(scene.time_s)
    return np.asarray(np.sign(scene.f_e) * (scene.wall.coarse_resistance(PANELS) - np.abs(scene.f_e)))


def _ramp_step_error(scene: RunState) -> FloatArray:
    """Return the error of the fast branch per second of step, all strain applied at its begin, not its middle."""
    sheared = scene.sheared
    if sheared is None:
        return np.zeros_like(scene.time_s)
    return np.asarray(0.5 * sheared.rates[0] * sheared.stresses[0] * sheared.area_mm2)


def ramp_integration_sd(scene: RunState) -> FloatArray:
    """Return the standard deviation of a ramp's force that is integrated in coarse steps [mN].

    Linear interpolation between steps cuts off its curvature. The phase of the steps is unknown, hence noise.
    """
    sheared = scene.sheared
    if sheared is None:
        return np.zeros_like(scene.time_s)
    stiffness = sum(sheared.moduli) * sheared.area_mm2 / sheared.force.branches.thickness_mm
    return np.asarray(COARSE_STEP_S**2 / 8.0 * stiffness * np.abs(scene.acceleration_mm_s2))


MAX_PRIOR_SHARE = 0.2
"""One standard deviation of an empirical prior changes the channel by at most this share of its rms."""


def empirical_priors(problem: JointProblem) -> tuple[JointProblem, str]:
    """Return a problem with priors around a fit of the model alone, no wider than effects can mislead that fit.

    Also return why that fit did not converge, a few words; empty where it did. An amended model was fitted
    together with its effects, to other runs: the priors are around its values.

    A diagnosis linearises. With a prior as wide as all conceivable stages, a step beside a strong effect would end at
    impossible parameters, where the next linearisation does not hold.
    """
    values, why_not = problem.scales.values(np.zeros(len(problem.nominal.parameters))), ""
    if not isinstance(problem.nominal, AmendedModel):
        solution = solve_joint(problem)
        values = problem.scales.values(solution.z)
        why_not = "" if solution.converged else solution.why or "too many steps"
    measured = np.concatenate([data.blocks.mean for data in problem.channels])
    by_value = np.concatenate([data.sensitivities(values) for data in problem.channels], axis=1)
    rms = np.sqrt(np.mean(measured**2))
    parameters = []
    for parameter, value, slope in zip(problem.nominal.parameters, values.tolist(), by_value, strict=True):
        rms_slope = float(np.sqrt(np.mean(slope**2))) * (value if parameter.positive else 1.0)
        sd = (
            min(parameter.prior_sd, MAX_PRIOR_SHARE * float(rms) / rms_slope)
            if rms_slope > 0 and rms > 0
            else parameter.prior_sd
        )
        parameters.append(replace(parameter, nominal=value, prior_sd=sd))
    fitted = replace(problem, scales=PriorScales.of(tuple(parameters)))
    return add_known_hum_to_noise(fitted, known_effects(problem.nominal)), why_not


MIN_SIGNATURE_MN = 1e-9
"""An effect with a smaller signature in all runs cannot act."""


@dataclass(frozen=True, eq=False)
class PredictedScene(RunState):
    """State of a run without wall or capsule, with a force predicted by any nominal model."""

    _: KW_ONLY
    predicted: FloatArray
    """Nominal force, shape `(n,)`."""

    @property
    def nominal(self) -> FloatArray:
        """The nominal force."""
        return self.predicted

    @property
    def stiffness_force(self) -> FloatArray:
        """The part of the force that a specimen's stiffness causes; zero where the model declares none."""
        return self.shear

    def relaxing_branch(self, rate: float) -> FloatArray:
        """Return a further Maxwell branch as stiff as the declared relaxation is at its largest travel."""
        travel_mm = float(np.abs(self.position_mm).max(initial=0.0))
        if not travel_mm:
            return np.zeros_like(self.time_s)
        stiffness = float(np.abs(self.shear).max(initial=0.0)) / travel_mm
        return np.asarray(stiffness * (self.position_mm - first_order(self.time_s, self.position_mm, 1.0 / rate)))


def predicted_scene(run: RunData, predicted: FloatArray, parts: Mapping[ForcePart, FloatArray]) -> PredictedScene:
    """Return the state of a run at the nodes of its blocks.

    Parameters
    ----------
    predicted
        Nominal force there, shape `(n,)`.
    parts
        Its parts whose place is known. Without friction among them nothing slides, without relaxation nothing is
        deformed.
    """
    time_s = run.block_data.blocks.nodes_s
    zeros = np.zeros_like(time_s)
    dry, viscous = parts.get(ForcePart.DRY_FRICTION, zeros), parts.get(ForcePart.VISCOUS_FRICTION, zeros)
    slides = ForcePart.DRY_FRICTION in parts or ForcePart.VISCOUS_FRICTION in parts
    return PredictedScene(
        time_s=time_s,
        session_start_s=run.session_start_s,
        order=run.experiment.run.info.header.order,
        origin_mm=run.experiment.origin_mm,
        contact=Contact.SLIDING if slides else Contact.NONE,
        # Sliding under a given load without a surrounding wall, as in the vacuum fixture.
        fixture=Fixture.VACUUM if slides else Fixture.NONE,
        motion=run.experiment.motion,
        regularisation_mm_s=TURNING_SPEED_MM_S,
        f_e=zeros,
        f_v=viscous,
        f_c=dry,
        weight_mN=float(np.abs(dry).max(initial=0.0)),
        friction_coefficient=1.0,
        shear=parts.get(ForcePart.RELAXATION, zeros),
        predicted=predicted,
    )


SHARES_OF_REACH = (0.003, 0.01, 0.03, 0.1, 0.3)
"""Lengths and speeds, relative to the longest travel and the highest speed, from which a search starts, too. A fit
moves by a factor of two and a half, so that none between two of them is out of reach."""
SHORTEST_SHARE = 1e-4
"""Shortest length, and lowest speed, relative to the longest travel and the highest speed, that a search may find."""


def scaled_to_runs(effects: Sequence[Effect], runs: Sequence[RunData]) -> list[Effect]:
    """Return effects whose lengths and speeds are searched around those of the runs, too.

    A drive may turn or creep, and an import may count its travel in any unit: a distance of friction is a share of the
    travel as often as it is tenths of a millimetre. The search starts from both.
    """
    travel = max(float(np.ptp(run.coordinates.position_mm)) for run in runs)
    speed = max(float(run.coordinates.top_speed_mm_s[0]) for run in runs)
    return [_with_scaled_shapes(effect, {"mm": travel, "mm/s": speed}) for effect in effects]


def _with_scaled_shapes(effect: Effect, reach: Mapping[str, float]) -> Effect:
    parameters = []
    for parameter in effect.parameters:
        longest = reach.get(parameter.unit, 0.0)
        if parameter.role is Role.SHAPE and parameter.grid and longest > 0 and parameter != effect.period:
            parameters.append(
                replace(
                    parameter,
                    low=min(parameter.low, SHORTEST_SHARE * longest),
                    high=max(parameter.high, longest),
                    grid=tuple(sorted({*parameter.grid, *(share * longest for share in SHARES_OF_REACH)})),
                )
            )
        else:
            parameters.append(parameter)
    return effect if tuple(parameters) == effect.parameters else _with_parameters(effect, tuple(parameters))


def _with_parameters(effect: Effect, parameters: tuple[EffectParameter, ...]) -> Effect:
    kind = type(effect)
    changed: Effect = type(kind.__name__, (kind,), {"parameters": parameters})()
    return changed


STARTS_OF_PERIOD, WAVES_AT_ONCE, MAX_WAVES, FINER_WAVES = 6, 200, 4000, 17
"""Best periods on the machine from which a search starts, how many are tried, and how many near each of the best."""
BLOCKS_PER_PERIOD, LONG_STEPS = 3.0, 0.9
"""Shorter periods, in steps from block to block that nearly all others do not exceed, pass for longer ones."""


def with_periods_of_runs(bare: Study, effects: Sequence[Effect]) -> list[Effect]:
    """Return effects, those that are periodic on the machine with start values that the runs show.

    Over hundreds of periods a fit finds the nearest of many optima. All periods are therefore tried beside the nominal
    model, a quarter of a period apart over the whole reach of the runs, and a fit starts from the best.

    Parameters
    ----------
    bare
        The campaign, prepared without effects.
    """
    if not any(effect.origin_parameter for effect in effects):
        return list(effects)
    design = linearise(bare, bare.initial_z)
    scenes = [scene for scene, _ in bare.scenes(bare.initial_z)]
    places = [scene.origin_mm + scene.position_mm for scene in scenes]
    lowest, highest = min(float(place.min()) for place in places), max(float(place.max()) for place in places)
    if highest <= lowest:
        return list(effects)
    middle = round(0.5 * (lowest + highest), 3)
    result = []
    for effect in effects:
        period = effect.period if effect.origin_parameter else None
        if period is None:
            result.append(effect)
            continue
        longest_step = max(float(np.quantile(np.abs(np.diff(place[::2])), LONG_STEPS)) for place in places)
        shortest = max(period.low, BLOCKS_PER_PERIOD * longest_step)
        from_per_mm, to_per_mm = 1.0 / min(period.high, highest - lowest), 1.0 / shortest
        count = int(np.clip(2.0 * (highest - lowest) * (to_per_mm - from_per_mm), 2, MAX_WAVES))
        waves = np.linspace(from_per_mm, to_per_mm, count)
        centred = [place - middle for place in places]
        best = _WaveSearch(bare, design, centred).strongest(waves)
        # Overtones of the strongest are other variants of the same effect, and so its error of form.
        overtones = best[:1] * np.arange(2, PLACE_HARMONICS + 1)
        tried = np.union1d(best, overtones[overtones <= to_per_mm])
        starts = {period.name: tuple(sorted((1.0 / tried).tolist()))}
        parameters = tuple(
            replace(parameter, grid=starts[parameter.name])
            if parameter.name in starts
            else replace(parameter, default=middle)
            if parameter.name == effect.origin_parameter
            else parameter
            for parameter in effect.parameters
        )
        result.append(_with_parameters(effect, parameters))
    return result


@dataclass(frozen=True, eq=False)
class _WaveSearch:
    """The part of a campaign's residuals that waves on the machine explain beside the nominal model."""

    bare: Study
    design: Design
    places: Sequence[FloatArray]
    """Places at the nodes of each run's blocks."""

    @cached_property
    def _basis_and_residual(self) -> tuple[FloatArray, FloatArray]:
        nominal = self.design.columns_of(ColumnKind.NOMINAL)
        rows = [
            run.whitening.whiten(np.column_stack((run.residual, run.columns[:, nominal]))) for run in self.design.runs
        ]
        residual, columns = np.split(np.concatenate(rows), [1], axis=1)
        basis = np.asarray(np.linalg.svd(columns, full_matrices=False)[0], dtype=np.float64)
        return basis, residual[:, 0] - basis @ (basis.T @ residual[:, 0])

    def powers(self, waves: FloatArray) -> FloatArray:
        """Return the chi-square that each wave number explains, shape `(W,)`."""
        basis, residual = self._basis_and_residual
        powers = []
        for few in np.array_split(waves, max(1, waves.size // WAVES_AT_ONCE)):
            columns = []
            for run_data, run, place in zip(self.bare.runs, self.design.runs, self.places, strict=True):
                angle = 2 * np.pi * few[:, None] * place
                both = np.concatenate((np.cos(angle), np.sin(angle)))
                columns.append(run.whitening.whiten(run_data.block_means(both).T))
            white = np.concatenate(columns)
            white -= basis @ (basis.T @ white)
            pairs = white.reshape(len(white), 2, few.size)
            grams = np.einsum("nap,nbp->pab", pairs, pairs, optimize=True) + 1e-9 * np.eye(2)
            moments = np.einsum("nap,n->pa", pairs, residual)
            powers.append(np.einsum("pa,pa->p", moments, np.linalg.solve(grams, moments[:, :, None])[:, :, 0]))
        return np.concatenate(powers)

    def strongest(self, waves: FloatArray) -> FloatArray:
        """Return the evenly spaced wave numbers that explain most, none next to another, each made more exact."""
        power = self.powers(waves)
        neighbours = np.maximum(np.append(power[1:], 0.0), np.append(0.0, power[:-1]))
        peaks = np.flatnonzero(power >= neighbours)
        best = waves[peaks[np.argsort(-power[peaks])[:STARTS_OF_PERIOD]]]
        nearby = best[:, None] + (waves[1] - waves[0]) * np.linspace(-1.0, 1.0, FINER_WAVES)
        finer = self.powers(nearby.ravel()).reshape(nearby.shape)
        return np.asarray(nearby[np.arange(best.size), finer.argmax(axis=1)])


def effects_that_act(study: Study, effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return the effects with a signature in any of the runs."""
    scenes = [study.scene(number, study.initial_z) for number in range(len(study.runs))]
    return tuple(
        effect
        for effect in effects
        if any(
            np.abs(signature(variant, *scene)).max(initial=0.0) > MIN_SIGNATURE_MN
            for variant in variants_of([effect])
            for scene in scenes
        )
    )


@dataclass(frozen=True, eq=False)
class CapsuleStudy(Study):
    """Capsule in the gut, channel of the force sensor; effects in the model's settings count as nominal."""

    nominal: CapsuleModel

    @classmethod
    def of(cls, selection: RunSelection, nominal: CapsuleModel, effects: Sequence[Effect]) -> "CapsuleStudy":
        """Prepare all runs; raises `AnalysisError` where the model predicts none of them."""
        problem = add_known_hum_to_noise(JointProblem.of(selection, nominal, MAX_BLOCK_MM), known_effects(nominal))
        own = tuple(effect for effect in effects if effect.nominal in {"", SIMULATED_NOMINAL})
        return cls(problem, run_data_of(problem.channels), own, nominal)

    @cached_property
    def chain(self) -> EffectChain:
        """Effects that the nominal model already contains, without hum, which counts as noise."""
        return without_hum(known_effects(self.nominal))

    def amended_settings(self, z: FloatArray) -> FrictionModelSettings:
        """Return the friction model of this specimen."""
        return self.nominal.settings_of(self.values(z))

    def scene(self, number: int, z: FloatArray) -> tuple[RunState, float]:
        """Return the state of a run that effects act on, and the gain of the force sensor."""
        settings = self.amended_settings(z)
        return self.runs[number].scene(settings), settings.force_gain

    def model_errors(self, number: int, scene: RunState) -> FloatArray:
        """Return the change of the true force by each detail of the model that may be off, shape `(D, n)`."""
        return model_error_columns(scene, self.runs[number].condition[1])

    def naming_obstacle(self, design: Design) -> str:
        """Return why these runs do not establish a design's effects of the sensor."""
        return sensor_obstacle(design, self.runs, knows_specimen=True)

    def prediction_sds(self, z: FloatArray) -> list[FloatArray]:
        """Return the uncertainty from the measured motion, and for sheared walls from integration steps."""
        sds = super().prediction_sds(z)
        for number, run in enumerate(self.runs):
            if run.acquisition.contact is Contact.STICKING:
                scene, gain = self.scene(number, z)
                sds[number] = np.hypot(sds[number], gain * run.block_means(ramp_integration_sd(scene)))
        return sds

    def limitations(self) -> Iterator[str]:
        """Yield the questions that these runs cannot answer, a sentence each."""
        yield from capsule_limitations(self.runs)
        yield from general_limitations(self.runs)


@dataclass(frozen=True, eq=False)
class PredictedStudy(Study):
    """Runs whose force any nominal model predicts, without capsule and gut."""

    why_not_converged: str = ""
    """Why the fit of the nominal model did not converge; empty where it did."""
    untried: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Effects that were not tried, by reason."""

    def telling_what_is_untried(self, effects: Sequence[Effect], undeclared: Sequence[str] = ()) -> "PredictedStudy":
        """Return the study with what it does not try of these effects; of `undeclared` parts where others are."""
        tried, untried = {effect.id for effect in self.effects}, dict[str, tuple[str, ...]]()
        part_at = {place: part for part in undeclared for place in PLACES_OF_PART[part][1]}
        for effect in effects:
            if effect.id in tried or effect.nominal == SIMULATED_NOMINAL:
                continue
            reason = "nothing in these runs would show it"
            if effect.location in part_at:
                reason = f"the model declares no {part_at[effect.location]}"
            elif effect.nominal and self.channel != MOTOR_FORCE_CHANNEL:
                reason = "the force is not the motor's"
            elif effect.coordinate is Coordinate.SESSION and not self.runs[0].has_clock:
                reason = "it is not known when the runs were made"
            untried[reason] = (*untried.get(reason, ()), effect.name)
        return replace(self, untried=untried)

    @cached_property
    def chain(self) -> EffectChain:
        """Effects that an amended model contains, without hum, which counts as noise."""
        return without_hum(known_effects(self.problem.nominal))

    def amended_settings(self, z: FloatArray) -> AmendedModelSettings | None:
        """Return the model with fitted values; None where nothing says how to find it again."""
        reference, nominal = model_reference(self.problem.nominal), self.problem.nominal
        if not reference:
            return None
        effects = nominal.settings.effects if isinstance(nominal, AmendedModel) else ()
        return AmendedModelSettings(nominal=reference, parameters=self.values(z), effects=effects)

    def scene(self, number: int, z: FloatArray) -> tuple[RunState, float]:
        """Return the state of a run that effects act on, its predicted force and the parts of it that are known."""
        run, values = self.runs[number], self.problem.scales.values(z)
        predictor, time_s = run.block_data.predictor, run.block_data.blocks.nodes_s
        return predicted_scene(run, predictor.predict(values, time_s).total, predictor.parts(values, time_s)), 1.0

    def naming_obstacle(self, design: Design) -> str:
        """Return why these runs do not establish a design's candidates."""
        if self.why_not_converged:
            return "the fit of the nominal model did not converge"
        on_machine = (effect.period for effect in self.effects if effect.origin_parameter)
        periods = [value for period in on_machine if period is not None for value in period.start_values]
        return naming_obstacle(design, self.runs, periods)

    def limitations(self) -> Iterator[str]:
        """Yield the questions that these runs cannot answer, a sentence each."""
        if self.why_not_converged:
            yield f"The fit of the nominal model did not converge ({self.why_not_converged}): no effect is named."
        if not model_reference(self.problem.nominal):
            yield "No amended model is written: the model has neither a file nor a name by which it could be found."
        for reason, names in self.untried.items():
            yield f"Not tried, as {reason}: {join_names(names)}."
        for remark in zero_remarks(self.problem):
            yield f"{remark[0].upper()}{remark[1:]}."
        yield from general_limitations(self.runs)


@dataclass(frozen=True, eq=False)
class StageStudy(PredictedStudy):
    """The stage alone, recorded motor force: sliding guides without wall or specimen."""

    @classmethod
    def of(cls, selection: RunSelection, nominal: NominalModel, effects: Sequence[Effect]) -> "StageStudy":
        """Prepare all runs with the drive's model or one amended; raises `AnalysisError` without any motor force."""
        problem, why_not = empirical_priors(JointProblem.of(selection, nominal, MAX_BLOCK_MM))
        bare = cls(problem, run_data_of(problem.channels), (), why_not)
        own = [effect for effect in effects if effect.nominal in {"", DriveModel().name}]
        return replace(bare, effects=effects_that_act(bare, with_periods_of_runs(bare, scaled_to_runs(own, bare.runs))))

    def limitations(self) -> Iterator[str]:
        """Yield the questions that these runs cannot answer, a sentence each."""
        if any(run.experiment.drive_holds for run in self.runs):
            yield "At rest a position loop holds the stage: nothing was read from the motor force there."
        yield from stage_limitations(self.runs)
        yield from super().limitations()


PLACES_OF_PART = {
    "friction": ((ForcePart.DRY_FRICTION, ForcePart.VISCOUS_FRICTION), (Location.INTERFACE, Location.MOTOR)),
    "relaxation": ((ForcePart.RELAXATION,), (Location.WALL, Location.SPECIMEN)),
}
"""Parts of a force that a model may declare, and the places whose effects act on them."""
FORCE_UNIT = "mN"


@dataclass(frozen=True, eq=False)
class OwnModelStudy(PredictedStudy):
    """A user's nominal model, one channel: effects of the sensor, and of the places of the parts that it declares."""

    other_channels: tuple[str, ...] = ()
    """Other channels that the model predicts."""
    undeclared: tuple[str, ...] = ()
    """Parts of the force that the model does not declare, of `PLACES_OF_PART`."""
    untried_effects: int = 0
    """Number of effects at their places, which were not tried."""

    @classmethod
    def of(cls, selection: RunSelection, nominal: NominalModel, effects: Sequence[Effect]) -> "OwnModelStudy":
        """Prepare all runs by the first force that is predicted, the force sensor's preferred.

        Raises
        ------
        AnalysisError
            Where the model predicts no force of any run, or fails.
        """
        all_channels = JointProblem.of(selection, nominal, MAX_BLOCK_MM)
        channels = tuple(dict.fromkeys(data.channel for data in all_channels.channels))
        headers = [experiment.run.info.header for experiment in selection.experiments]
        forces = {channel.name for header in headers for channel in header.channels if channel.units == FORCE_UNIT}
        channel = next((name for name in (*SIGNALS, *channels) if name in channels and name in forces), None)
        if channel is None:
            raise AnalysisError(
                f"the model {nominal.name} predicts {', '.join(channels)} and no force in mN, which is what a "
                "diagnosis explains; name another model with --nominal."
            )
        problem, why_not = empirical_priors(
            problem_of_runs(
                all_channels, [index for index, data in enumerate(all_channels.channels) if data.channel == channel]
            )
        )
        runs = run_data_of(problem.channels)
        values = problem.scales.values(np.zeros(len(problem.nominal.parameters)))
        declared = {part for run in runs for part in run.block_data.predictor.parts(values, np.zeros(1))}
        undeclared = {
            name: places for name, (parts, places) in PLACES_OF_PART.items() if not declared.intersection(parts)
        }
        untried = {place for places in undeclared.values() for place in places}
        bare = cls(
            problem,
            runs,
            (),
            why_not,
            other_channels=tuple(name for name in channels if name != channel),
            undeclared=tuple(undeclared),
            untried_effects=sum(effect.in_gut and effect.location in untried for effect in effects),
        )
        # The motor's own effects show in its force, whoever models it.
        belongs_to = {"", DriveModel().name} if channel == MOTOR_FORCE_CHANNEL else {""}
        tried = [effect for effect in effects if effect.channel is Channel.FORCE and effect.nominal in belongs_to]
        return replace(bare, effects=effects_that_act(bare, with_periods_of_runs(bare, scaled_to_runs(tried, runs))))

    @property
    def declares_any(self) -> bool:
        """Whether the model declares a part of its force."""
        return len(self.undeclared) < len(PLACES_OF_PART)

    def untried_lookalikes(self, design: Design) -> int:
        """Return the number of untried effects if the candidates look like friction along the stroke."""
        return self.untried_effects if confounded_with_friction(design, self.runs) else 0

    def limitations(self) -> Iterator[str]:
        """Yield what these runs and this model cannot answer, a sentence each."""
        yield from own_model_limitations(self.runs, self.other_channels, declares_any=self.declares_any)
        yield from super().limitations()


def prepare_study(selection: RunSelection, nominal: NominalModel, effects: Sequence[Effect]) -> Study:
    """Prepare a campaign; raises `AnalysisError` where the model predicts none of its runs.

    Parameters
    ----------
    effects
        Candidate effects on the force channel; those that cannot act are dropped, and without a clock those of session
        time.
    """
    has_clock = session_starts(selection.experiments) is not None
    tried = [effect for effect in effects if has_clock or effect.coordinate is not Coordinate.SESSION]
    match nominal:
        case CapsuleModel():
            return CapsuleStudy.of(selection, nominal, tried)
        case DriveModel() | AmendedModel(own=DriveModel()):
            of_rig = [effect for effect in effects if not effect.belongs_to_gut]
            return StageStudy.of(selection, nominal, tried).telling_what_is_untried(of_rig)
        case _:
            study = OwnModelStudy.of(selection, nominal, tried)
            return study.telling_what_is_untried(effects, study.undeclared) if study.declares_any else study
