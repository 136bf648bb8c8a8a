"""Campaigns prepared by nominal model (capsule in the gut, stage alone, own model), and where a model may be wrong.

No wall follows the published law exactly, and no two programmes integrate it alike. Each direction in which a nominal
model may be slightly wrong without any effect is the change of the prediction when one detail of the model is off by
one prior standard deviation. Where little is known of a model beforehand, the priors of its parameters come from the
runs themselves (`empirical_priors`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
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
    model_reference,
    session_starts,
    solve_joint,
    zero_remarks,
)
from dragrig.analysis.gap.design import (
    ColumnKind,
    Design,
    Study,
    fit_columns,
    linearise,
    problem_of_runs,
    signature,
    variants_of,
)
from dragrig.analysis.gap.run_data import MAX_BLOCK_MM, RunData, run_data_of
from dragrig.analysis.gap.spectral_lines import add_known_hum_to_noise, known_effects, without_hum
from dragrig.config import AmendedModelSettings, AnalysisError, Fixture, FrictionModelSettings
from dragrig.rig import SIGNALS, BoolArray, Contact, FloatArray, IndexArray, Phase
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
    SlipHistory,
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


@dataclass(frozen=True, slots=True)
class ModelErrorDirection:
    """A detail of the nominal model that may be off, with its prior standard deviation."""

    name: str
    sd: float


MODEL_ERROR_DIRECTIONS = (
    *(ModelErrorDirection(f"law_{power}", LAW_SHAPE_SD) for power in LAW_POWERS),
    *(ModelErrorDirection(f"law_of_{element}", ELEMENT_SHAPE_SD) for element in range(ELEMENTS)),
    ModelErrorDirection("ramp_step", INTEGRATION_STEP_S),
    ModelErrorDirection("contact_integral", CONTACT_INTEGRAL_SD),
    ModelErrorDirection("contact_integral_speed", CONTACT_INTEGRAL_SD),
    ModelErrorDirection("contact_sum", 1.0),
)


def model_error_columns(scene: RunState, speed_mm_s: float) -> FloatArray:
    """Return the change of the true force by one prior sd of each of `MODEL_ERROR_DIRECTIONS`, shape `(D, n)`.

    Parameters
    ----------
    scene
        State of the run.
    speed_mm_s
        Speed of the run.
    """
    rows = [*_wall_law_columns(scene)]
    rows.append(INTEGRATION_STEP_S * _ramp_step_error(scene))
    rows.append(CONTACT_INTEGRAL_SD * scene.f_e)
    rows.append(CONTACT_INTEGRAL_SD * scene.f_e * 0.5 * float(np.log(max(speed_mm_s, 0.1) / 5.0)))
    rows.append(_quadrature_error(scene))
    return np.stack(rows)


def _wall_law_columns(scene: RunState) -> Iterator[FloatArray]:
    by_power = {power: _strain_power_by_element(scene, power) for power in LAW_POWERS}
    for power in LAW_POWERS:
        yield LAW_SHAPE_SD * np.sum(by_power[power], axis=0)
    for column in by_power[1]:
        yield ELEMENT_SHAPE_SD * column


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
    """What waves on the machine explain of a campaign's residuals beside the nominal model."""

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


CONFOUNDED_SHARE = 0.8
"""Share of an effect's chi-square, beside the nominal parameters, above which it counts as confounded."""
WAY_LENGTHS = 8
"""Number of lengths over which friction may evolve, from a hundredth of the longest travel on."""
WAY_POWERS = (1, 2, 3)


def confounded_with_friction(design: Design, runs: Sequence[RunData]) -> bool:
    """Whether candidates act like friction that evolves with travel in the same way in all runs.

    Friction has the sign of the motion and vanishes at rest. Runs at several speeds, in both directions or with rests
    separate it from functions of time or of force.
    """
    effect_force = np.concatenate([run.whitening.whiten(run.effect_force) for run in design.runs])
    if not np.any(effect_force):
        return False
    rows = []
    longest = max(float(np.ptp(data.coordinates.position_mm)) for data in runs)
    for run_data, run in zip(runs, design.runs, strict=True):
        columns_of_run = np.hstack(
            (run.columns[:, design.columns_of(ColumnKind.NOMINAL)], _friction_columns(run_data, longest))
        )
        rows.append(run.whitening.whiten(columns_of_run))
    columns = np.concatenate(rows)
    norms = np.linalg.norm(columns, axis=0)
    columns = columns[:, norms > 0] / norms[norms > 0]
    nominal = np.concatenate(
        [run.whitening.whiten(run.columns[:, design.columns_of(ColumnKind.NOMINAL)]) for run in design.runs]
    )
    beside_nominal = _residual_chi2(nominal, effect_force)
    return bool(beside_nominal > 0 and _residual_chi2(columns, effect_force) < (1 - CONFOUNDED_SHARE) * beside_nominal)


def _residual_chi2(columns: FloatArray, values: FloatArray) -> float:
    return float(np.sum(_beside(columns, values) ** 2))


def _beside(columns: FloatArray, values: FloatArray) -> FloatArray:
    """Return what columns cannot represent of values, shape `(B,)` or `(B, m)`."""
    return np.asarray(values - columns @ np.linalg.lstsq(columns, values, rcond=1e-10)[0])


def _friction_columns(run: RunData, longest_mm: float) -> FloatArray:
    """Return smooth functions of travel with the sign of the motion, shape `(B, K)`."""
    blocks = run.coordinates
    travel = np.abs(blocks.position_mm - blocks.position_mm[0]) / max(longest_mm, 1e-12)
    measured_sign = np.sign(run.experiment.velocity(blocks.time_s))
    # An encoder of 1 µm shows the slowest motions as rest; in steady motion the run's direction is taken.
    direction = float(np.sign(blocks.position_mm[-1] - blocks.position_mm[0])) or 1.0
    sign = np.where(blocks.phase == Phase.STEADY, direction, measured_sign)
    shapes = [travel**power for power in WAY_POWERS] + [
        np.exp(-travel / length) for length in np.geomspace(0.01, 1, WAY_LENGTHS)
    ]
    return np.asarray(sign[:, None] * np.stack(shapes, axis=1))


HISTORY_S = np.geomspace(0.03, 30.0, 7)
"""Time constants of a force that changes since the last start or stop, whatever it is."""
FRICTION_SPEEDS_MM_S = np.geomspace(0.3, 100.0, 7)
"""Speeds over which friction may change."""
MIN_SIZE_SIGMAS = 3.0
"""A size that is less certain is not determined."""
MIN_FREE_BLOCKS = 20
"""With fewer blocks beyond the free functions, nothing is told apart."""
CONSISTENT_SIZES = 0.5, 2.0
"""Size of an effect beside free functions of the motion over its size in the fit, where the runs tell both apart."""


PLACE_HARMONICS = 3


@dataclass(frozen=True, slots=True)
class SizeBesideMotion:
    """Size of an effect beside any force that depends on speed, or on time or travel in motion, relative to the fit."""

    size: float
    standard_error: float
    """Scatter that nothing explains included."""

    @property
    def is_separable(self) -> bool:
        """Whether the effect shows at its size beside such a force."""
        low, high = CONSISTENT_SIZES
        return low < self.size < high and self.size > MIN_SIZE_SIGMAS * self.standard_error

    @property
    def is_contradicted(self) -> bool:
        """Whether the runs would show the effect beside such a force, and do not."""
        return self.size < CONSISTENT_SIZES[0] and MIN_SIZE_SIGMAS * self.standard_error < 1.0


def size_beside_motion(
    design: Design, runs: Sequence[RunData], number: int, periods_mm: Sequence[float] = ()
) -> SizeBesideMotion | None:
    """Return what is left of a candidate beside free functions of the motion; None where nothing can be left.

    A relaxation or a friction law that the nominal model misses depends on the motion alone. Such a force is added as
    free functions that all runs share; what an effect explains beside these is its own.

    Parameters
    ----------
    number
        Number of the candidate.
    periods_mm
        Periods on the machine, of which the force may be any function, too.
    """
    longest = max(float(np.ptp(data.coordinates.position_mm)) for data in runs)
    columns_of_runs, pairs = [], []
    own, others = _columns_of_candidate(design, number)
    for run_data, run in zip(runs, design.runs, strict=True):
        force = run.effect_force if len(design.candidates) == 1 else run.columns[:, own] * _size_of(design, number)
        nominal = run.columns[:, np.concatenate((design.columns_of(ColumnKind.NOMINAL), others))]
        free_functions = _friction_columns(run_data, longest), _history_columns(run_data)
        columns = np.hstack((nominal, *free_functions, _periodic_columns(run_data, periods_mm)))
        columns_of_runs.append(run.whitening.whiten(columns))
        pairs.append(run.whitening.whiten(np.column_stack((run.residual + force, force))))
    columns = np.concatenate(columns_of_runs)
    norms = np.linalg.norm(columns, axis=0)
    columns = columns[:, norms > 0] / norms[norms > 0]
    free = len(columns) - columns.shape[1]
    residual, effect = _beside(columns, np.concatenate(pairs)).T
    power = float(effect @ effect)
    if free < MIN_FREE_BLOCKS or power <= 0:
        return None
    size = float(residual @ effect) / power
    # What neither explains makes the size less certain.
    scatter = max(float(np.sum((residual - size * effect) ** 2)) / free, 1.0)
    return SizeBesideMotion(size, float(np.sqrt(scatter / power)))


def _periodic_columns(run: RunData, periods_mm: Sequence[float]) -> FloatArray:
    """Return the first harmonics of periods on the machine, shape `(B, K)`."""
    place = run.experiment.origin_mm + run.coordinates.position_mm
    waves = np.outer(1.0 / np.array(periods_mm, dtype=np.float64), np.arange(1, PLACE_HARMONICS + 1)).ravel()
    angle = 2 * np.pi * place[:, None] * waves
    return np.hstack((np.cos(angle), np.sin(angle)))


def _columns_of_candidate(design: Design, number: int) -> tuple[int, IndexArray]:
    """Return the column of a candidate's size, and the columns of all other candidates."""
    counts = [len(candidate.fitted_parameters) for candidate in design.candidates]
    owners = np.repeat(np.arange(len(counts)), counts)
    columns = design.columns_of(ColumnKind.EFFECT)
    candidate = design.candidates[number]
    names = [parameter.name for parameter in candidate.fitted_parameters]
    own = columns[owners == number][names.index(candidate.effect.size.name)]
    return int(own), columns[owners != number]


def _size_of(design: Design, number: int) -> float:
    candidate = design.candidates[number]
    return candidate.values[candidate.effect.size.name]


def _history_columns(run: RunData) -> FloatArray:
    """Return smooth functions of time since start and stop, with the sign of the motion and without, and of speed."""
    blocks = run.coordinates
    slip = SlipHistory.of(run.experiment.motion, blocks.time_s)
    moves = slip.heading * slip.moving
    since_start = np.exp(-slip.since_start_s[:, None] / HISTORY_S) * (slip.heading != 0)[:, None]
    since_stop = np.exp(-slip.since_stop_s[:, None] / HISTORY_S) * (slip.since_stop_s > 0)[:, None]
    history = np.hstack((since_start, since_stop, (slip.heading != 0)[:, None], (slip.since_stop_s > 0)[:, None]))
    speed = moves[:, None] * np.exp(-blocks.speed_mm_s[:, None] / FRICTION_SPEEDS_MM_S)
    return np.hstack((history, slip.heading[:, None] * history, speed, (moves * blocks.speed_mm_s)[:, None]))


SENSOR_PLACES = (Location.FORCE_SENSOR, Location.ACQUISITION)


def naming_obstacle(design: Design, runs: Sequence[RunData], periods_mm: Sequence[float] = ()) -> str:
    """Say why runs do not establish the candidates of a design, though they fit; empty where nothing stands against it.

    Half a sentence that follows "not established:".

    Parameters
    ----------
    periods_mm
        Periods on the machine that the runs show.
    """
    of_sensor = any(candidate.effect.location in SENSOR_PLACES for candidate in design.candidates)
    too_few = len(runs) < MIN_RUNS_TO_HOLD_OUT or len({run.condition for run in runs}) == 1
    if len(runs) == 1 or (of_sensor and too_few):
        return "nothing can be held out of so few runs or conditions"
    if any(candidate.at_limit for candidate in design.candidates):
        return "its size is at the limit of what is possible"
    added = max(float(np.abs(run.effect_force).max(initial=0.0)) for run in design.runs)
    range_mN = max(float(np.ptp(run.block_data.blocks.mean)) for run in runs)
    if added > range_mN:
        return f"it would add {added:.3g} mN, and no measured force varies by more than {range_mN:.3g} mN"
    if not _sizes_determined(design):
        return "its size is not determined"
    return sensor_obstacle(design, runs, periods_mm)


NOT_SEPARABLE = (
    "these runs do not tell it from a force that changes with speed or place, or with time or travel in motion"
)


def sensor_obstacle(
    design: Design, runs: Sequence[RunData], periods_mm: Sequence[float] = (), *, knows_specimen: bool = False
) -> str:
    """Say why runs do not establish the effects of the sensor in a design; empty where nothing stands against them.

    Parameters
    ----------
    knows_specimen
        Whether the nominal model knows how its specimen relaxes. A drift is a function of time like any other; with
        such a model it counts unless the runs show that a force that changes in motion takes its place.
    """
    for number, candidate in enumerate(design.candidates):
        effect = candidate.effect
        if effect.location not in SENSOR_PLACES:
            continue
        left = size_beside_motion(design, runs, number, periods_mm)
        if knows_specimen and effect.coordinate is Coordinate.TIME:
            if left is not None and left.is_contradicted:
                return f"beside a force that changes in motion these runs show no {effect.name}"
        elif left is None or not left.is_separable:
            return NOT_SEPARABLE
    return ""


def _sizes_determined(design: Design) -> bool:
    fit = fit_columns(design, design.total_gram(), ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR, ColumnKind.EFFECT)
    errors = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    effect_errors = errors[np.searchsorted(fit.columns, design.columns_of(ColumnKind.EFFECT))].tolist()
    for candidate in design.candidates:
        names = [parameter.name for parameter in candidate.fitted_parameters]
        error, effect_errors = effect_errors[names.index(candidate.effect.size.name)], effect_errors[len(names) :]
        if abs(candidate.values[candidate.effect.size.name]) < MIN_SIZE_SIGMAS * error:
            return False
    return True


MIN_RUNS_TO_HOLD_OUT = 4
MIN_SPEEDS = 3
MOVING_MM_S = 0.01
CLEARLY_MOVING = 10.0
"""Top speed over `MOVING_MM_S` above which a slower moment is a rest."""


def general_limitations(runs: Sequence[RunData]) -> Iterator[str]:
    """Yield limitations that hold for any model."""
    if len({(run.condition, run.direction) for run in runs}) == len(runs):
        yield "No condition was repeated: repeatability is assumed, not measured."
    if len(runs) < MIN_RUNS_TO_HOLD_OUT:
        yield "Too few runs to hold any out: the share of the gap that closes is not given."
    if not any(_has_own_command(run) for run in runs):
        yield "No command was recorded: nothing is known of motor effects."


def _has_own_command(run: RunData) -> bool:
    """Whether a run has a recorded command, not the position in its place."""
    trace = run.experiment.run.trace
    return not np.array_equal(np.asarray(trace.command), np.asarray(trace.position), equal_nan=True)


def capsule_limitations(runs: Sequence[RunData]) -> Iterator[str]:
    """Yield limitations of runs with capsule and gut."""
    kinds = {run.experiment.kind for run in runs}
    speeds = {run.condition[1] for run in runs if run.experiment.kind == "drag"}
    if "relaxation" not in kinds:
        yield "No relaxation runs: nothing is known of further relaxation modes or of stiffening with strain."
    if "drag" not in kinds:
        yield "No drag runs: nothing is known of effects in a closed gut (adhesion, folds, lift-off, inertia)."
    elif len(speeds) < MIN_SPEEDS:
        yield "Fewer than three drag speeds: effects of speed cannot be separated."
    if "blank" not in kinds:
        yield "No blank runs: effects of the rig itself are seen only through the gut."
    if "coulomb" not in kinds:
        yield "No Coulomb runs: adhesion cannot be separated from friction that falls with speed."


def goes_one_way(runs: Sequence[RunData]) -> bool:
    """Whether no two moments of any runs move in opposite directions."""
    velocity = np.concatenate([run.experiment.velocity(run.block_data.blocks.nodes_s) for run in runs])
    return bool(velocity.min(initial=0.0) >= -MOVING_MM_S or velocity.max(initial=0.0) <= MOVING_MM_S)


def _rests(run: RunData) -> bool:
    """Whether the stage stands still at any time; phases need not be known, but slow motion is no rest."""
    blocks = run.coordinates
    moves = float(blocks.top_speed_mm_s[0]) > CLEARLY_MOVING * MOVING_MM_S
    return bool(np.any(blocks.phase == Phase.REST) or (moves and np.any(blocks.speed_mm_s <= MOVING_MM_S)))


def stage_limitations(runs: Sequence[RunData]) -> Iterator[str]:
    """Yield limitations of runs of the stage alone."""
    speeds = {round(float(run.coordinates.top_speed_mm_s[0]), 1) for run in runs}
    if goes_one_way(runs):
        yield "All runs go one way: friction that depends on direction cannot be separated from other friction."
    if len(speeds) < MIN_SPEEDS:
        yield "Fewer than three speeds: effects of speed cannot be separated."
    if all(run.experiment.contact is not Contact.NONE for run in runs):
        yield "No blank runs: the stage is known no better than the load that it moves."


PLACES_OF_PART = {
    "friction": ((ForcePart.DRY_FRICTION, ForcePart.VISCOUS_FRICTION), (Location.INTERFACE, Location.MOTOR)),
    "relaxation": ((ForcePart.RELAXATION,), (Location.WALL, Location.SPECIMEN)),
}
"""Parts of a force that a model may declare, and the places whose effects act on them."""


def own_model_limitations(
    runs: Sequence[RunData], undeclared: Sequence[str], other_channels: Sequence[str]
) -> Iterator[str]:
    """Yield limitations of a user's model, of which one channel is explained and `other_channels` are not."""
    speeds = {round(float(run.coordinates.top_speed_mm_s[0]), 1) for run in runs}
    if len(speeds) == 1 and goes_one_way(runs) and not any(_rests(run) for run in runs):
        yield (
            "All runs go one way at one speed without a rest: sensor effects in time cannot be separated from "
            "friction that changes along the stroke."
        )
    if len(undeclared) == len(PLACES_OF_PART):
        yield (
            "The model does not declare the parts of its force: only effects of sensor and acquisition were tried, "
            "none of wall, interface, specimen or drive."
        )
    else:
        for part in undeclared:
            places = " and ".join(PLACES_OF_PART[part][1])
            yield f"The model declares no {part}: effects of {places} were not tried."
    for name in other_channels:
        yield f"The model also predicts {name}, which was not diagnosed."


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
        """Return the change of the true force by each of `MODEL_ERROR_DIRECTIONS`, shape `(D, n)`."""
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
        """Yield what these runs cannot answer, a sentence each."""
        yield from capsule_limitations(self.runs)
        yield from general_limitations(self.runs)


@dataclass(frozen=True, eq=False)
class PredictedStudy(Study):
    """Runs whose force any nominal model predicts, without capsule and gut."""

    why_not_converged: str = ""
    """Why the fit of the nominal model did not converge; empty where it did."""

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

    def informative_blocks(self, number: int, motion_sd: FloatArray) -> BoolArray:
        """Return blocks whose uncertainty from the motion is below the noise of a single sample.

        Where no block is that certain, as in a motion that is nowhere steady, those that are as certain as usual count.
        """
        noise = float(np.hypot(self.problem.noises[number].white, self.runs[number].block_data.moving_white))
        known = motion_sd <= noise
        return known if known.any() else motion_sd <= float(np.median(motion_sd))

    def naming_obstacle(self, design: Design) -> str:
        """Return why these runs do not establish a design's candidates."""
        if self.why_not_converged:
            return "the fit of the nominal model did not converge"
        on_machine = (effect.period for effect in self.effects if effect.origin_parameter)
        periods = [value for period in on_machine if period is not None for value in period.start_values]
        return naming_obstacle(design, self.runs, periods)

    def limitations(self) -> Iterator[str]:
        """Yield what these runs cannot answer, a sentence each."""
        if self.why_not_converged:
            yield f"The fit of the nominal model did not converge ({self.why_not_converged}): no effect is named."
        if not model_reference(self.problem.nominal):
            yield "No amended model is written: the model has neither a file nor a name by which it could be found."
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
        """Yield what these runs cannot answer, a sentence each."""
        yield from stage_limitations(self.runs)
        yield from super().limitations()


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
            tuple(name for name in channels if name != channel),
            tuple(undeclared),
            sum(effect.in_gut and effect.location in untried for effect in effects),
        )
        # The motor's own effects show in its force, whoever models it.
        belongs_to = {"", DriveModel().name} if channel == MOTOR_FORCE_CHANNEL else {""}
        tried = [effect for effect in effects if effect.channel is Channel.FORCE and effect.nominal in belongs_to]
        return replace(bare, effects=effects_that_act(bare, with_periods_of_runs(bare, scaled_to_runs(tried, runs))))

    def untried_lookalikes(self, design: Design) -> int:
        """Return the number of untried effects if the candidates look like friction along the stroke."""
        return self.untried_effects if confounded_with_friction(design, self.runs) else 0

    def limitations(self) -> Iterator[str]:
        """Yield what these runs and this model cannot answer, a sentence each."""
        yield from own_model_limitations(self.runs, self.undeclared, self.other_channels)
        yield from super().limitations()


def prepare_study(selection: RunSelection, nominal: NominalModel, effects: Sequence[Effect]) -> Study:
    """Prepare a campaign; raises `AnalysisError` where the model predicts none of its runs.

    Parameters
    ----------
    effects
        Candidate effects on the force channel; those that cannot act are dropped, and without a clock those of session
        time.
    """
    if session_starts(selection.experiments) is None:
        effects = [effect for effect in effects if effect.coordinate is not Coordinate.SESSION]
    match nominal:
        case CapsuleModel():
            return CapsuleStudy.of(selection, nominal, effects)
        case DriveModel() | AmendedModel(own=DriveModel()):
            return StageStudy.of(selection, nominal, effects)
        case _:
            return OwnModelStudy.of(selection, nominal, effects)
