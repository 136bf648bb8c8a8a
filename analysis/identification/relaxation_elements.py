"""The five elements of every relaxation run of a specimen, and their dependence on strain as in Eq. 14.

Maxwell branches driven by the measured ramp are fitted to the force of each run. The force is linear in zero and
moduli: all pairs of time constants on a logarithmic grid are solved at once from one matrix of products, and the best
pair with positive moduli starts the refinement, in logarithms.

Whether five elements suffice is tested by the gain of a third branch of any time constant. The gain of
a branch is the squared projection of the whitened residuals on its addition beyond all small changes of
the five elements. Its largest value over a grid of time constants has a distribution of its own, as the search
looks at many: it is drawn from the projections of white noise, which follow from the branches alone.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from dragrig.analysis import (
    NORMAL_95,
    STIFFNESS_SCATTER,
    BlockMeans,
    Estimate,
    EstimatedQuantity,
    Experiment,
    NoiseModel,
    RunSelection,
    average_in_blocks,
    estimate_noise,
    mask_spans,
    single_blas_thread,
    solve_lower,
)
from dragrig.analysis.identification.identification import RelaxationFit, RelaxationResult, StrainLaw, ThirdBranchTest
from dragrig.analysis.paper import WALL_UNITS
from dragrig.config import AnalysisError, WallPolynomials
from dragrig.rig import Contact, FloatArray
from dragrig.sim_backend.friction import MaxwellBranches, ProfileMotion

MIN_VALID_PEAK_SHARE = 0.5
"""Smallest share of valid samples about the peak."""
PEAK_WINDOW_S = 0.02
MIN_SAMPLES_AFTER_RAMP = 50
MIN_TRAVEL_MM = 0.01
"""A shorter travel between rests is jitter of the encoder, not a motion."""
GRID_POINTS = 60
MIN_TIME_CONSTANT_S = 5e-4
MAX_TIME_CONSTANT_HOLDS = 3.0
"""Slowest branch searched, in lengths of the hold; a slower one acts as a spring in such a run."""
UNKNOWN_ZERO_SD_MN = 5.0
"""Prior of the sensor's zero where no rest shows it."""
LOG_STEP = 1e-4
MAX_EVALUATIONS = 100
NULL_DRAWS = 4000
NULL_SEED = 1912
SIGNIFICANCE = 0.01
"""Five elements suffice unless the p-value is below: one clean run in a hundred is misjudged."""
GRID_EXTENSION = 4.0
"""A third branch is searched up to this many times the slowest time constant of the fit."""
MIN_RELEVANT_FORCE_MN = 5.0
"""Accuracy of the rig's sensor: a branch whose force stays below does not matter, however significant."""
POOR_FIT_CHI2 = 2.0
"""χ² per degree of freedom above which something else than relaxation is in a run."""
MIN_INDEPENDENT_SHARE = 1e-6
"""Branches with a smaller share beyond the five elements add nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class ShearRecord:
    """A relaxation: measured motion, block means of the force, and the response of a branch of 1 kPa to that motion."""

    file: str
    shear_strain: float
    area_mm2: float
    thickness_mm: float
    motion: ProfileMotion
    blocks: BlockMeans
    ramp_s: tuple[float, float]
    """Start and end of the ramp."""
    rested: bool
    """Whether a rest before it shows the sensor's zero."""
    hold_s: float
    """Time from the ramp's end to the last valid sample."""
    step_s: float
    noise_factor: FloatArray
    """Lower Cholesky factor of the covariance of the block means, which whitens them."""

    @classmethod
    def of(cls, experiment: Experiment, noise: NoiseModel) -> "ShearRecord":
        """Prepare a run; raises `AnalysisError` with the reason where it shows nothing of the wall."""
        if experiment.contact is not Contact.STICKING:
            raise AnalysisError(f"{experiment.file}: nothing was sheared, the specimen's fixture is none")
        capsule = experiment.capsule
        breaks_s = _motion_breaks(experiment)
        if breaks_s.size < 2:
            raise AnalysisError(f"{experiment.file}: it has no ramp, the position does not change")
        ramp = float(breaks_s[0]), float(breaks_s[-1])
        hold_s = _hold_duration(experiment, ramp)
        blocks = average_in_blocks(experiment, "force", breaks_s, jumps=False)
        covariance = noise.covariance(blocks.start_s, blocks.end_s, blocks.samples)
        return cls(
            file=experiment.file,
            shear_strain=experiment.shear_strain,
            area_mm2=float(np.pi) * capsule.diameter_mm * capsule.length_mm,
            thickness_mm=experiment.wall_thickness_mm,
            motion=experiment.unsmoothed_motion,
            blocks=blocks,
            ramp_s=ramp,
            rested=bool(experiment.valid[experiment.time_s < ramp[0]].any()),
            hold_s=hold_s,
            step_s=1 / experiment.run.trace.sample_rate_hz,
            noise_factor=np.asarray(np.linalg.cholesky(covariance), dtype=np.float64),
        )

    def spring(self) -> FloatArray:
        """Mean force of a spring of 1 kPa in each block [mN], shape `(n,)`."""
        return self.area_mm2 * self.blocks.of(self.motion.position(self.blocks.nodes_s) / self.thickness_mm)

    def branches(self, times_s: FloatArray) -> FloatArray:
        """Mean force of Maxwell branches of 1 kPa and these time constants [mN], shape `(B, n)`."""
        return self.area_mm2 * self.blocks.of(self._prepared(times_s).stress(self.blocks.nodes_s))

    def forces_at(self, times_s: FloatArray, moduli: FloatArray, spring: float, time_s: FloatArray) -> FloatArray:
        """Force of spring and branches [mN] at any times of the run."""
        branches = np.tensordot(moduli, self._prepared(times_s).stress(time_s), axes=1)
        return np.asarray(self.area_mm2 * (spring * (self.motion.position(time_s) / self.thickness_mm) + branches))

    def rows(self, signals: FloatArray) -> FloatArray:
        """Whiten signals of shape `(B, n)`; one more column holds the prior of the zero."""
        return np.hstack((solve_lower(self.noise_factor, signals.T).T, np.zeros((len(signals), 1))))

    def zero(self) -> FloatArray:
        """Row of a zero of 1 mN."""
        row = self.rows(np.ones((1, self.blocks.samples.size)))
        row[:, -1] = 0.0 if self.rested else 1 / UNKNOWN_ZERO_SD_MN
        return row

    def target(self) -> FloatArray:
        """Row of the measured means, shape `(n + 1,)`."""
        return np.asarray(self.rows(self.blocks.mean[None])[0])

    @property
    def grid_s(self) -> FloatArray:
        """Time constants that the run could show."""
        slowest = MAX_TIME_CONSTANT_HOLDS * self.hold_s
        return np.geomspace(min(MIN_TIME_CONSTANT_S, 0.1 * slowest), slowest, GRID_POINTS)

    def _prepared(self, times_s: FloatArray) -> MaxwellBranches:
        return MaxwellBranches.integrate(1 / times_s, self.motion, self.thickness_mm)


def _motion_breaks(experiment: Experiment) -> FloatArray:
    """Return the times at which the motion starts, bends and ends; empty where it does not move."""
    motion = experiment.motion
    position = motion.position(motion.breaks_s)
    moves = mask_spans(motion.signs != 0)
    ways = [
        motion.breaks_s[start : stop + 1]
        for start, stop in moves
        if np.ptp(position[start : stop + 1]) >= MIN_TRAVEL_MM
    ]
    return np.concatenate([np.zeros(0), *ways])


def _hold_duration(experiment: Experiment, ramp_s: tuple[float, float]) -> float:
    time, valid = experiment.time_s, experiment.valid
    start, end = ramp_s
    after = np.flatnonzero(valid & (time > end))
    if after.size < MIN_SAMPLES_AFTER_RAMP:
        raise AnalysisError(
            f"{experiment.file}: only {after.size} usable samples follow the ramp, too few to show the relaxation"
        )
    peak = (time > end - min(0.5 * (end - start), PEAK_WINDOW_S)) & (time < end + PEAK_WINDOW_S)
    if np.mean(valid[peak]) < MIN_VALID_PEAK_SHARE:
        raise AnalysisError(f"{experiment.file}: the samples about the peak are clipped or missing (NaN)")
    return float(time[after[-1]]) - end


@dataclass(frozen=True, slots=True, eq=False)
class BranchFit:
    """Spring and `B` branches, the fastest first."""

    values: FloatArray
    """Zero [mN], then logarithms of E3, of the branches' moduli and of their time constants, shape `(2 + 2 B,)`."""
    residual: FloatArray
    jacobian: FloatArray
    """`residual`, `jacobian`: whitened residuals and their derivatives by the values, shapes `(N,)` and `(N, 2 + 2 B)`.
    """
    converged: bool

    @property
    def count(self) -> int:
        """Number of branches."""
        return self.values.size // 2 - 1

    @property
    def moduli(self) -> FloatArray:
        """Moduli of the branches [kPa]."""
        return np.exp(self.values[2 : 2 + self.count])

    @property
    def times_s(self) -> FloatArray:
        """Time constants of the branches."""
        return np.exp(self.values[2 + self.count :])

    @property
    def chi2(self) -> float:
        """Squared whitened residuals."""
        return float(self.residual @ self.residual)

    @property
    def degrees(self) -> int:
        """Degrees of freedom."""
        return self.residual.size - 1 - self.values.size

    @property
    def reduced_chi2(self) -> float:
        """χ² per degree of freedom."""
        return self.chi2 / max(self.degrees, 1)

    def covariance(self) -> FloatArray:
        """Covariance of the values, widened where residuals are larger than the noise."""
        _, triangle = np.linalg.qr(self.jacobian)
        inverse = np.linalg.pinv(triangle)
        return np.asarray(max(1.0, self.reduced_chi2) * inverse @ inverse.T)


def _start_values(record: ShearRecord) -> list[FloatArray]:
    """Start values for two branches: the best pair of time constants, and the best pairs further apart.

    A time constant between two of the grid is described best by both of them, at the expense of the second branch;
    hence the pairs further apart.
    """
    grid = record.grid_s
    rows = np.vstack((record.zero(), record.rows(np.vstack((record.spring(), record.branches(grid))))))
    size = np.sqrt((rows**2).sum(axis=1))
    unit_rows = rows / size[:, None]
    products, right = unit_rows @ unit_rows.T, unit_rows @ record.target()
    pairs = np.array([(0, 1, 2 + i, 2 + j) for i, j in combinations(range(grid.size), 2) if j > i + 1])
    matrices = products[pairs[:, :, None], pairs[:, None, :]] + 1e-12 * np.eye(4)
    solved = np.linalg.solve(matrices, right[pairs][..., None])[..., 0]
    gain = (solved * right[pairs]).sum(axis=1)
    gain[(solved[:, 1:] <= 0).any(axis=1)] = -np.inf
    apart = pairs[:, 3] - pairs[:, 2]
    best = {
        int(np.where(apart >= distance, gain, -np.inf).argmax()) for distance in (2, GRID_POINTS // 8, GRID_POINTS // 3)
    }
    best = {pair for pair in best if np.isfinite(gain[pair])}
    if not best:
        raise AnalysisError(
            f"{record.file}: its force does not relax as a spring and two Maxwell branches would, for no time constants"
        )
    starts = []
    for pair in sorted(best):
        zero, *moduli = (solved[pair] / size[pairs[pair]]).tolist()
        starts.append(np.array([zero, *np.log([*moduli, *grid[pairs[pair, 2:] - 2]])]))
    return starts


def _refine_branches(record: ShearRecord, start: FloatArray) -> BranchFit:
    """Fit from start values, and sort the branches by their time constants."""
    from scipy.optimize import least_squares

    count = start.size // 2 - 1
    zero, spring = record.zero(), record.rows(record.spring()[None])
    target = record.target()
    grid = np.log(record.grid_s)

    def residual(values: FloatArray) -> FloatArray:
        moduli, times = np.exp(values[2 : 2 + count]), np.exp(values[2 + count :])
        branches = record.rows(record.branches(times))
        return np.asarray(values[0] * zero[0] + np.exp(values[1]) * spring[0] + moduli @ branches - target)

    def jacobian(values: FloatArray) -> FloatArray:
        moduli, logs = np.exp(values[2 : 2 + count]), values[2 + count :]
        times = np.exp(np.concatenate((logs, logs + LOG_STEP, logs - LOG_STEP)))
        here, ahead, behind = np.split(record.rows(record.branches(times)), 3)
        by_time = moduli[:, None] * (ahead - behind) / (2 * LOG_STEP)
        return np.vstack((zero, np.exp(values[1]) * spring, moduli[:, None] * here, by_time)).T

    low, high = np.full(start.size, -np.inf), np.full(start.size, np.inf)
    low[2 + count :], high[2 + count :] = grid[0] - 1.0, grid[-1] + 2.0
    low[1 : 2 + count], high[1 : 2 + count] = -20.0, 20.0
    inside = np.clip(start, low + 1e-6, high - 1e-6)
    optimum = least_squares(residual, inside, jacobian, (low, high), x_scale="jac", max_nfev=MAX_EVALUATIONS)
    order = np.argsort(optimum.x[2 + count :])
    by_speed = np.concatenate(([0, 1], 2 + order, 2 + count + order))
    converged = bool(optimum.success) and not optimum.active_mask.any()
    return BranchFit(optimum.x[by_speed], optimum.fun, jacobian(optimum.x)[:, by_speed], converged)


def third_branch_test(record: ShearRecord, fit: BranchFit) -> ThirdBranchTest:
    """Test a fit of two branches against three."""
    grid = np.append(record.grid_s, record.grid_s[-1] * np.array([GRID_EXTENSION**0.5, GRID_EXTENSION]))
    branches = record.rows(record.branches(grid))
    basis, _ = np.linalg.qr(fit.jacobian)
    beyond = branches - (branches @ basis) @ basis.T
    size = np.sqrt((beyond**2).sum(axis=1))
    independent = size > MIN_INDEPENDENT_SHARE * np.sqrt((branches**2).sum(axis=1))
    if not independent.any():
        return ThirdBranchTest(None, None, None, None, "The run cannot distinguish five elements from more.")
    grid, direction = grid[independent], beyond[independent] / size[independent, None]
    # The residual is prediction minus measurement: a missing branch projects on it negatively.
    gains = np.maximum(-(direction @ fit.residual), 0.0) ** 2
    best = int(gains.argmax())
    gain = float(gains[best])
    misfit = max(1.0, (fit.chi2 - gain) / max(fit.degrees - 2, 1))
    p_value = _null_probability(direction, gain / misfit)
    if p_value < SIGNIFICANCE:
        modulus = gain**0.5 / float(size[independent][best])
        return _significant_third(record, fit, float(grid[best]), modulus, p_value)
    if fit.reduced_chi2 > POOR_FIT_CHI2:
        sentence = f"Neither five elements nor a third branch describe the run (χ² per degree {fit.reduced_chi2:.3g})."
        return ThirdBranchTest(None, p_value, None, None, sentence)
    sentence = f"Five elements suffice: a third branch explains no more than noise (p = {p_value:.2g})."
    return ThirdBranchTest(True, p_value, None, None, sentence)


def _null_probability(direction: FloatArray, gain: float) -> float:
    """Probability that white noise gives at least this largest gain over all branches."""
    _, triangle = np.linalg.qr(direction.T)
    draws = np.random.default_rng(NULL_SEED).standard_normal((NULL_DRAWS, len(triangle))) @ triangle
    largest = np.maximum(draws, 0.0).max(axis=1) ** 2
    return float((1 + np.count_nonzero(largest >= gain)) / (1 + NULL_DRAWS))


def _significant_third(
    record: ShearRecord, fit: BranchFit, time_s: float, modulus: float, p_value: float
) -> ThirdBranchTest:
    """Fit three branches from a first guess of the third, and judge by its largest force."""
    values, count = fit.values, fit.count
    start = np.concatenate((values[: 2 + count], [np.log(max(modulus, 1e-6))], values[2 + count :], [np.log(time_s)]))
    three = _refine_branches(record, start)
    if three.converged and three.chi2 <= fit.chi2:
        # The weakest of the three is called the third.
        weakest = int(three.moduli.argmin())
        time_s, modulus = float(three.times_s[weakest]), float(three.moduli[weakest])
    time = np.append(record.ramp_s[1], record.blocks.middle_s)
    shown = record.forces_at(np.array([time_s]), np.array([modulus]), 0.0, time)
    force_mN, largest_mN = float(shown[0]), float(np.abs(shown).max())
    p_text = f"p < {1 / NULL_DRAWS:.2g}" if p_value < 2 / NULL_DRAWS else f"p = {p_value:.2g}"
    third = f"a third branch of {time_s:.3g} s and {abs(force_mN):.3g} mN explains more than noise ({p_text})"
    if largest_mN < MIN_RELEVANT_FORCE_MN:
        sentence = f"Five elements suffice: {third}, but stays below the sensor's {MIN_RELEVANT_FORCE_MN:g} mN."
        return ThirdBranchTest(True, p_value, time_s, force_mN, sentence)
    poor = f", yet not all of it (χ² per degree {three.reduced_chi2:.3g})"
    sentence = f"Five elements do not suffice: {third}{poor if three.reduced_chi2 > POOR_FIT_CHI2 else ''}."
    return ThirdBranchTest(False, p_value, time_s, force_mN, sentence)


@dataclass(frozen=True, slots=True, eq=False)
class RelaxationResiduals:
    """A run beside its fit."""

    ramp_s: tuple[float, float]
    """Start and end of the ramp."""
    middle_s: FloatArray
    whitened: FloatArray
    """`middle_s`, `whitened`: middle of each block of the fit, and its residual, measured less predicted, shape `(n,)`.
    """
    time_s: FloatArray
    predicted_mN: FloatArray
    """`time_s`, `predicted_mN`: times from the ramp's start on, evenly spread over their logarithm, and the predicted
    force, zero included.
    """


def relaxation_residuals(fit: RelaxationFit, experiment: Experiment, noise: NoiseModel) -> RelaxationResiduals:
    """Evaluate a fit beside its run; raises `AnalysisError` where it has no elements."""
    if not fit.elements or (zero := fit.zero.value) is None:
        raise AnalysisError(f"{fit.file}: has no identified elements to predict from ({fit.remark})")
    E1, E2, spring, eta1, eta2 = (element.value for element in fit.elements)
    moduli, times = np.array([E1, E2]), np.array([eta1 / E1, eta2 / E2])
    record = ShearRecord.of(experiment, noise)
    blocks = record.blocks
    predicted = zero + spring * record.spring() + moduli @ record.branches(times)
    whitened = record.rows((blocks.mean - predicted)[None])[0, :-1]
    start = record.ramp_s[0]
    time = start + np.geomspace(record.step_s, blocks.end_s[-1] - start, 400)
    force = zero + record.forces_at(times, moduli, spring, time)
    return RelaxationResiduals(record.ramp_s, blocks.middle_s, whitened, time, force)


ELEMENT_NAMES = tuple(WALL_UNITS)
TIME_CONSTANTS = ("tau1", "tau2")
MAX_RELATIVE_ERROR = 0.25
"""Largest relative standard error with which a run supports an element."""
MIN_SAMPLES_PER_TIME_CONSTANT = 1.5
"""A branch that relaxes within fewer samples absorbs whatever the stage does between two of them."""
SAME_STRAIN_TOLERANCE = 0.01
"""Relative difference up to which strains count as repeats of one strain."""
MAX_DEGREE = 2

_TO_ELEMENTS = np.array(
    [[0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 1, 0, 1, 0], [0, 0, 0, 1, 0, 1]], dtype=float
)
"""Logarithms of E1, E2, E3, η1, η2 from zero and logarithms of E3, E1, E2, τ1, τ2."""


@single_blas_thread()
def identify_relaxation(selection: RunSelection) -> RelaxationResult:
    """Identify E1, E2, E3, η1, η2 from each relaxation run, ramp and hold, and their laws over strain.

    Noise levels are estimated from the rests and the ends of the holds of these runs, which share them. A run that
    supports no elements has none, with the reason in its `remark`.
    """
    experiments = selection.of_kind("relaxation")
    if not experiments:
        return RelaxationResult((), (), ("There is no relaxation run, so that the five elements are not known.",))
    noise = estimate_noise(experiments, "force")
    fits = tuple(_fit_relaxation(experiment, noise) for experiment in experiments)
    return RelaxationResult(fits, *strain_laws(fits))


def _fit_relaxation(experiment: Experiment, noise: NoiseModel) -> RelaxationFit:
    """Identify the five elements of one run; nothing is raised."""
    try:
        record = ShearRecord.of(experiment, noise)
        fits = [_refine_branches(record, start) for start in _start_values(record)]
    except AnalysisError as error:
        remark = str(error).removeprefix(f"{experiment.file}: ")
        return RelaxationFit(experiment.file, experiment.shear_strain, remark=remark)
    fit = min(fits, key=lambda tried: tried.chi2)
    covariance = fit.covariance()
    logs = _TO_ELEMENTS @ fit.values
    element_covariance = _TO_ELEMENTS @ covariance @ _TO_ELEMENTS.T
    errors = np.sqrt(np.diag(element_covariance))
    if (reason := _unsupported_reason(record, fit, errors)) is not None:
        return RelaxationFit(
            record.file, record.shear_strain, chi2=fit.chi2, degrees=fit.degrees, converged=fit.converged, remark=reason
        )
    remarks = []
    if not record.rested:
        remarks.append("no rest shows the sensor's zero, which was assumed as 0 ± 5 mN")
    if fit.reduced_chi2 > POOR_FIT_CHI2:
        remarks.append(
            f"the five elements describe it poorly (χ² per degree {fit.reduced_chi2:.3g}), which widened the intervals"
        )
    return RelaxationFit(
        file=record.file,
        shear_strain=record.shear_strain,
        elements=_lognormal(WALL_UNITS.items(), logs, errors),
        times=_lognormal([(name, "s") for name in TIME_CONSTANTS], fit.values[4:], np.sqrt(np.diag(covariance)[4:])),
        correlation=element_covariance / np.outer(errors, errors),
        zero=Estimate(float(fit.values[0]), float(np.sqrt(covariance[0, 0]))),
        chi2=fit.chi2,
        degrees=fit.degrees,
        test=third_branch_test(record, fit),
        converged=True,
        remark="; ".join(remarks),
    )


def _lognormal(named: Iterable[tuple[str, str]], logs: FloatArray, errors: FloatArray) -> tuple[EstimatedQuantity, ...]:
    return tuple(
        EstimatedQuantity.lognormal(name, unit, float(log), float(error))
        for (name, unit), log, error in zip(named, logs, errors, strict=True)
    )


def _unsupported_reason(record: ShearRecord, fit: BranchFit, errors: FloatArray) -> str | None:
    if not fit.converged:
        return f"the fit did not converge: {_missing_information(record, fit)}"
    fast = float(fit.times_s[0])
    if fast < MIN_SAMPLES_PER_TIME_CONSTANT * record.step_s:
        return f"a sample every {1e3 * record.step_s:.2g} ms is too slow for a fast branch of {1e3 * fast:.2g} ms"
    worst = int(np.argmax(np.where(np.isfinite(errors), errors, np.inf)))
    if errors[worst] <= MAX_RELATIVE_ERROR:
        return None
    if fit.reduced_chi2 > POOR_FIT_CHI2:
        return f"a spring and two Maxwell branches do not describe its force (χ² per degree {fit.reduced_chi2:.0f})"
    name, factor = ELEMENT_NAMES[worst], np.exp(min(NORMAL_95 * errors[worst], 9.0))
    return f"{name} stays uncertain by a factor of {factor:.2g}: {_missing_information(record, fit)}"


def _missing_information(record: ShearRecord, fit: BranchFit) -> str:
    """Say which condition a run lacks that does not determine both branches."""
    fast, slow = fit.times_s.tolist()
    ramp = record.ramp_s[1] - record.ramp_s[0]
    if slow > 0.5 * record.hold_s:
        return f"its hold of {record.hold_s:.3g} s is too short to separate the slow branch from the spring"
    if fast < 2 * record.step_s:
        return f"a sample every {1e3 * record.step_s:.2g} ms is too slow for the fast branch"
    if fast < 0.05 * ramp:
        return f"its ramp of {ramp:.3g} s is too slow to show the fast branch"
    return "its force shows no two separate branches"


def strain_laws(fits: Iterable[RelaxationFit]) -> tuple[tuple[StrainLaw, ...], tuple[str, ...]]:
    """Fit each element against strain, by weighted least squares.

    Runs at one strain are averaged first. A point's error includes its interval, the run-to-run scatter of 2 %, and
    the scatter of its repeats if that is more; the covariance includes the lack of fit where points lie further from
    the polynomial than that.

    Returns
    -------
    laws, remarks
        A quadratic over three or more strains, a straight line over two, none over one; remarks say which.
    """
    groups: list[list[RelaxationFit]] = []
    for fit in sorted((fit for fit in fits if fit.elements), key=lambda fit: fit.shear_strain):
        if groups and fit.shear_strain - groups[-1][0].shear_strain <= SAME_STRAIN_TOLERANCE * fit.shear_strain:
            groups[-1].append(fit)
        else:
            groups.append([fit])
    strains = tuple(float(np.mean([fit.shear_strain for fit in group])) for group in groups)
    if len(strains) < 2:
        known = "no run" if not strains else f"only the strain of {100 * strains[0]:.4g} %"
        return (), (f"The elements' dependence on strain is unknown: {known} gave elements.",)
    laws = tuple(_fit_law(index, strains, groups) for index in range(len(ELEMENT_NAMES)))
    remarks = {
        2: "Two strains give straight lines through both; a curvature as in Eq. 14 needs a third.",
        3: "The quadratics run exactly through the three strains, so that nothing checks them.",
    }
    return laws, (remarks[len(strains)],) if len(strains) in remarks else ()


def _fit_law(index: int, strains: tuple[float, ...], groups: Sequence[Sequence[RelaxationFit]]) -> StrainLaw:
    values, errors = np.array([_strain_mean([fit.elements[index] for fit in group]) for group in groups]).T
    degree = min(MAX_DEGREE, len(strains) - 1)
    coefficients, covariance = np.polyfit(strains, values, degree, w=1 / errors, cov="unscaled")
    degrees = len(strains) - degree - 1
    residual = values - np.polyval(coefficients, strains)
    widening = max(1.0, float(((residual / errors) ** 2).sum()) / degrees) if degrees else 1.0
    about_mean = float(((values - values.mean()) ** 2).sum())
    element = groups[0][0].elements[index]
    return StrainLaw(
        element=element.name,
        unit=element.unit,
        strains=strains,
        coefficients=tuple(map(float, coefficients)),
        covariance=widening * covariance,
        r2=1 - float(residual @ residual) / about_mean if degrees and about_mean else None,
    )


def _strain_mean(repeats: Sequence[EstimatedQuantity]) -> tuple[float, float]:
    """Mean of an element over the runs at one strain, and its standard error."""
    values = np.array([quantity.value for quantity in repeats])
    errors = np.array([quantity.standard_error for quantity in repeats])
    mean = float(values.mean())
    variance = float((errors**2).mean()) + (STIFFNESS_SCATTER * mean) ** 2
    if len(values) > 1:
        variance = max(variance, float(values.var(ddof=1)))
    return mean, float(np.sqrt(variance / len(values)))


def evaluate_strain_law(law: StrainLaw, strain: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return value and standard error of a law at strains, each of their shape."""
    powers = np.vander(np.asarray(strain, dtype=float), len(law.coefficients))
    variance = np.einsum("ij,jk,ik->i", powers, law.covariance, powers)
    return np.asarray(powers @ np.array(law.coefficients)), np.sqrt(np.maximum(variance, 0.0))


def wall_polynomials(laws: Sequence[StrainLaw]) -> WallPolynomials:
    """Turn the laws of all five elements into the polynomials that the simulator loads as `wall = "polynomial"`.

    Raises
    ------
    AnalysisError
        Where an element is missing, or a law is not positive throughout its strains.
    """
    by_element = {law.element: law for law in laws}
    missing = [name for name in ELEMENT_NAMES if name not in by_element]
    if missing:
        raise AnalysisError(
            f"No law over strain for {', '.join(missing)}: relaxations at two strains or more are needed for a wall"
        )
    for name in ELEMENT_NAMES:
        law = by_element[name]
        between = np.linspace(min(law.strains), max(law.strains), 101)
        values, _ = evaluate_strain_law(law, between)
        if values.min() <= 0:
            raise AnalysisError(
                f"The law of {name} is not positive at a strain of {between[values.argmin()]:.0%}, as a wall must be; "
                "measure at more strains"
            )
    return WallPolynomials.model_validate({name: by_element[name].coefficients for name in ELEMENT_NAMES})
