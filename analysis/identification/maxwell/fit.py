"""Zero, spring and Maxwell branches of one run by least squares on whitened block means.

The force is linear in zero and moduli: all pairs of time constants on a logarithmic grid are solved at once from one
matrix of products, and the best pair with positive moduli starts the refinement, in logarithms.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from dragrig.analysis.identification.maxwell.record import ShearRecord
from dragrig.analysis.identification.noise import Noise
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import FloatArray

GRID = 60
FASTEST_S = 5e-4
SLOWEST_HOLDS = 3.0
"""Slowest branch that is looked for, in lengths of the hold; a slower one is a spring to such a run."""
ZERO_SD_MN = 5.0
"""What is known of the sensor's zero where no rest shows it."""
STEP = 1e-4
MOST_STEPS = 100


@dataclass(frozen=True, slots=True, eq=False)
class Whitened:
    """A run whose block means are turned into numbers of unit variance."""

    record: ShearRecord
    factor: FloatArray
    """Lower triangle of Cholesky of the block means' covariance."""

    @classmethod
    def of(cls, record: ShearRecord, noise: Noise) -> "Whitened":
        """Whiten with the sensor's noise."""
        blocks = record.blocks
        covariance = noise.covariance(blocks.start_s, blocks.end_s, blocks.samples)
        return cls(record, np.asarray(np.linalg.cholesky(covariance), dtype=np.float64))

    def rows(self, signals: FloatArray) -> FloatArray:
        """Whiten signals of shape `(B, n)`; one more column says what is known of the zero."""
        from scipy.linalg import solve_triangular

        white = solve_triangular(self.factor, signals.T, lower=True, check_finite=False).T
        return np.hstack((white, np.zeros((len(signals), 1))))

    def zero(self) -> FloatArray:
        """Row of a zero of 1 mN."""
        row = self.rows(np.ones((1, self.record.blocks.samples.size)))
        row[:, -1] = 0.0 if self.record.rested else 1 / ZERO_SD_MN
        return row

    @property
    def grid_s(self) -> FloatArray:
        """Time constants that the run could show."""
        slowest = SLOWEST_HOLDS * self.record.hold_s
        return np.geomspace(min(FASTEST_S, 0.1 * slowest), slowest, GRID)


@dataclass(frozen=True, slots=True, eq=False)
class BranchFit:
    """Spring and `B` branches, the fastest first.

    Attributes
    ----------
    values
        Zero [mN], then logarithms of E3, of the branches' moduli and of their time constants, shape `(2 + 2 B,)`.
    residual, jacobian
        Whitened residuals and their derivatives by the values, shapes `(N,)` and `(N, 2 + 2 B)`.
    """

    values: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    converged: bool

    @property
    def count(self) -> int:
        """Number of branches."""
        return self.values.size // 2 - 1

    @property
    def spring(self) -> float:
        """E3 [kPa]."""
        return float(np.exp(self.values[1]))

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
    def scale(self) -> float:
        """Variance of the whitened residuals where it is larger than the noise's, else 1."""
        return max(1.0, self.chi2 / max(self.degrees, 1))

    def covariance(self) -> FloatArray:
        """Covariance of the values, residuals that are larger than the noise accounted for."""
        _, triangle = np.linalg.qr(self.jacobian)
        inverse = np.linalg.pinv(triangle)
        return np.asarray(self.scale * inverse @ inverse.T)


def scan(whitened: Whitened) -> list[FloatArray]:
    """Return start values for two branches: the best pair of time constants, and the best ones further apart.

    A time constant between two of the grid is described best by both of them, at the expense of the other branch;
    hence the pairs further apart. Raises as `fit_two`.
    """
    record, grid = whitened.record, whitened.grid_s
    rows = np.vstack((whitened.zero(), whitened.rows(np.vstack((record.spring(), record.branches(grid))))))
    target = whitened.rows(record.blocks.mean[None])[0]
    size = np.sqrt((rows**2).sum(axis=1))
    products, right = (rows / size[:, None]) @ (rows / size[:, None]).T, (rows / size[:, None]) @ target
    pairs = np.array([(0, 1, 2 + i, 2 + j) for i, j in combinations(range(grid.size), 2) if j > i + 1])
    matrices = products[pairs[:, :, None], pairs[:, None, :]] + 1e-12 * np.eye(4)
    solved = np.linalg.solve(matrices, right[pairs][..., None])[..., 0]
    gained = (solved * right[pairs]).sum(axis=1)
    gained[(solved[:, 1:] <= 0).any(axis=1)] = -np.inf
    apart = pairs[:, 3] - pairs[:, 2]
    starts = {int(np.where(apart >= least, gained, -np.inf).argmax()) for least in (2, GRID // 8, GRID // 3)}
    starts = {best for best in starts if np.isfinite(gained[best])}
    if not starts:
        raise AnalysisError(
            f"{record.file}: its force does not relax as a spring and two Maxwell branches would, for no time constants"
        )
    return [_start(solved[best] / size[pairs[best]], grid[pairs[best, 2:] - 2]) for best in sorted(starts)]


def _start(amplitudes: FloatArray, times_s: FloatArray) -> FloatArray:
    zero, *moduli = amplitudes.tolist()
    return np.array([zero, *np.log([*moduli, *times_s])])


def fit_two(whitened: Whitened) -> BranchFit:
    """Fit two branches from every start that the grid suggests, and return the best fit.

    Raises
    ------
    AnalysisError
        Where no two branches beside a spring, all of them positive, describe the run.
    """
    return min((refine(whitened, start) for start in scan(whitened)), key=lambda fit: fit.chi2)


def refine(whitened: Whitened, start: FloatArray) -> BranchFit:
    """Fit from start values, the branches in the order of their time constants."""
    from scipy.optimize import least_squares

    count = start.size // 2 - 1
    zero, spring = whitened.zero(), whitened.rows(whitened.record.spring()[None])
    target = whitened.rows(whitened.record.blocks.mean[None])[0]
    grid = np.log(whitened.grid_s)

    def residual(values: FloatArray) -> FloatArray:
        moduli, times = np.exp(values[2 : 2 + count]), np.exp(values[2 + count :])
        branches = whitened.rows(whitened.record.branches(times))
        return np.asarray(values[0] * zero[0] + np.exp(values[1]) * spring[0] + moduli @ branches - target)

    def jacobian(values: FloatArray) -> FloatArray:
        moduli, logs = np.exp(values[2 : 2 + count]), values[2 + count :]
        times = np.exp(np.concatenate((logs, logs + STEP, logs - STEP)))
        here, ahead, behind = np.split(whitened.rows(whitened.record.branches(times)), 3)
        by_time = moduli[:, None] * (ahead - behind) / (2 * STEP)
        return np.vstack((zero, np.exp(values[1]) * spring, moduli[:, None] * here, by_time)).T

    low, high = np.full(start.size, -np.inf), np.full(start.size, np.inf)
    low[2 + count :], high[2 + count :] = grid[0] - 1.0, grid[-1] + 2.0
    low[1 : 2 + count], high[1 : 2 + count] = -20.0, 20.0
    found = least_squares(
        residual, np.clip(start, low + 1e-6, high - 1e-6), jacobian, (low, high), x_scale="jac", max_nfev=MOST_STEPS
    )
    order = np.argsort(found.x[2 + count :])
    shuffled = np.concatenate(([0, 1], 2 + order, 2 + count + order))
    converged = bool(found.success) and not found.active_mask.any()
    return BranchFit(found.x[shuffled], found.fun, jacobian(found.x)[:, shuffled], converged)
