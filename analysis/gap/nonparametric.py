"""Nonparametric laws: the force as any smooth function of one coordinate, given by its values at knots.

An effect that is missing in the catalogue is mistaken for the one most similar to it. If a smooth function of one
coordinate explains more than that effect does, the effect is not the cause.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dragrig.analysis.gap.design import ColumnKind, Design
from dragrig.analysis.gap.features import NonparametricLaw
from dragrig.analysis.gap.linear_fit import schur_complement
from dragrig.analysis.gap.run_data import BlockCoordinates, RunData, rms_where_active
from dragrig.rig.arrays import FloatArray, IndexArray
from dragrig.rig.devices import Contact
from dragrig.sim_backend.effects.run_state import SlipHistory

KNOT_PRIOR_SD_MN = 30.0
"""Prior standard deviation of a law's value at a knot."""
MIN_KNOT_SPEED_MM_S = 0.3
LOG_SPEED_KNOTS = np.log(np.geomspace(MIN_KNOT_SPEED_MM_S, 62.0, 14))
LOG_TIME_KNOTS = np.log(np.geomspace(0.03, 8.0, 8))
LOAD_KNOTS, SESSION_KNOTS = 12, 8
POSITION_KNOT_STEP_MM, POSITION_KNOTS = 1.5, 30
SWING_HARMONICS = 4


def nonparametric_columns(
    runs: Sequence[RunData], predicted: Sequence[FloatArray], period_s: float
) -> Mapping[str, list[FloatArray]]:
    """Return the columns of every shared law by its name, per run, in units of their priors, shape `(B, k)`.

    Parameters
    ----------
    predicted
        Predicted block means of each run's force [mN].
    period_s
        Period of a swing that all runs share; 0 for none.
    """
    knots = _Knots.of([run.coordinates for run in runs], predicted)
    laws = [_columns_of_run(run_data, force, knots) for run_data, force in zip(runs, predicted, strict=True)]
    columns = {name: [columns_of_run[name] for columns_of_run in laws] for name in laws[0]}
    if period_s > 0:
        columns["swing in all runs"] = [_harmonic_columns(run.coordinates.session_s / period_s) for run in runs]
    return columns


@dataclass(frozen=True, slots=True, eq=False)
class _Knots:
    """Knots of position, load and session time, shared by all runs of a campaign."""

    place_mm: FloatArray
    load_mN: FloatArray
    session_s: FloatArray

    @classmethod
    def of(cls, runs: Sequence[BlockCoordinates], predicted: Sequence[FloatArray]) -> "_Knots":
        position = np.concatenate([blocks.position_mm for blocks in runs])
        session, load = np.concatenate([blocks.session_s for blocks in runs]), np.concatenate(predicted)
        position_knots = int(np.clip(np.ptp(position) / POSITION_KNOT_STEP_MM, 2, POSITION_KNOTS))
        return cls(
            *(
                np.linspace(float(coordinate.min()), float(coordinate.max()) + 1e-9, count)
                for coordinate, count in ((position, position_knots), (load, LOAD_KNOTS), (session, SESSION_KNOTS))
            )
        )


def _columns_of_run(run: RunData, predicted: FloatArray, knots: _Knots) -> Mapping[str, FloatArray]:
    """Return the columns of every law at the blocks of a run, in units of their priors, shape `(B, k)`."""
    blocks, contact = run.coordinates, run.experiment.contact
    slip = SlipHistory.of(run.experiment.motion, blocks.time_s)
    slides = contact is Contact.SLIDING
    closed = slides and run.experiment.kind != "coulomb"
    moves = blocks.speed_mm_s > 0.5 * MIN_KNOT_SPEED_MM_S
    speed = _hat_functions(np.log(blocks.speed_mm_s + 1e-9), LOG_SPEED_KNOTS) * moves[:, None]
    signed_speed = speed * slip.heading[:, None]
    position = _hat_functions(blocks.position_mm, knots.place_mm)
    since_begin, since_start, since_stop = (
        _time_hats(blocks.time_s),
        _time_hats(slip.since_start_s),
        _time_hats(slip.since_stop_s),
    )
    before, after = (slip.heading == 0)[:, None], (slip.since_stop_s > 0)[:, None]
    time_at_rest = np.column_stack((since_begin * before, since_stop * after))
    since_change = np.column_stack((since_start * moves[:, None], since_stop * after))
    laws = {
        "speed": speed,
        "speed of sliding": slides * signed_speed,
        "speed in the gut": closed * signed_speed,
        "place": (contact is not Contact.STICKING) * position,
        "place in the gut": closed * position,
        "time at rest": time_at_rest,
        "time at rest in the gut": closed * time_at_rest,
        "time since start and stop": since_change,
        "time since start and stop in the gut": closed * since_change,
        "load": _hat_functions(predicted, knots.load_mN),
        "session": _hat_functions(blocks.session_s, knots.session_s),
    }
    return {name: KNOT_PRIOR_SD_MN * values for name, values in laws.items()}


def _time_hats(time_s: FloatArray) -> FloatArray:
    return _hat_functions(np.log(np.maximum(time_s, 1e-9)), LOG_TIME_KNOTS)


def _hat_functions(coordinate: FloatArray, knots: FloatArray) -> FloatArray:
    """Return piecewise linear functions: 1 at one knot, 0 at all others, constant beyond the ends, `(B, k)`."""
    return np.stack([np.interp(coordinate, knots, unit) for unit in np.eye(knots.size)], axis=1)


def _harmonic_columns(turns: FloatArray) -> FloatArray:
    angle = 2 * np.pi * np.arange(1, SWING_HARMONICS + 1) * turns[:, None]
    return KNOT_PRIOR_SD_MN * np.hstack((np.cos(angle), np.sin(angle)))


RUN_GAIN_LAW, RUN_GAIN_PRIOR_SD = "gain of a run", 0.2
"""The law that every run has a gain of its own, and the gain's prior standard deviation."""


def fit_nonparametric_laws(
    design: Design, runs: Sequence[RunData], period_s: float = 0.0, nuisance_columns: IndexArray | None = None
) -> tuple[NonparametricLaw, ...]:
    """Fit every law beside the nuisances of a design.

    Parameters
    ----------
    design
        Linearised campaign.
    runs
        Data of its runs.
    period_s
        Period of a swing on the session clock that all runs share; 0 for none.
    nuisance_columns
        Columns of the design to project out; default: those of the nominal model.

    Returns
    -------
    laws
        All laws, by increasing chi-square.
    """
    predicted = [run.predicted for run in design.runs]
    columns = nonparametric_columns(runs, predicted, period_s)
    nuisances = (
        design.columns_of(ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR) if nuisance_columns is None else nuisance_columns
    )
    nuisance_rows = 1 + np.arange(nuisances.size)
    edges = 1 + nuisance_rows.size + np.cumsum([0, *(fitted_law[0].shape[1] for fitted_law in columns.values())])
    total = np.zeros((edges[-1] + len(predicted), edges[-1] + len(predicted)))
    for number, run in enumerate(design.runs):
        shared_columns = (
            run.residual,
            run.columns[:, nuisances],
            *(fitted_law[number] for fitted_law in columns.values()),
        )
        white = run.whitening.whiten(np.column_stack((*shared_columns, RUN_GAIN_PRIOR_SD * predicted[number])))
        rows = np.append(np.arange(edges[-1]), edges[-1] + number)
        total[np.ix_(rows, rows)] += white.T @ white
    complement = schur_complement(design, total, nuisances, np.arange(edges[0], len(total)), nuisance_rows)
    widths_s = np.concatenate([run_data.coordinates.width_s for run_data in runs])

    def law(name: str, low: int, high: int) -> NonparametricLaw:
        twice_log_evidence, values = _twice_log_evidence(
            complement, slice(low - nuisance_rows.size, high - nuisance_rows.size)
        )
        if name == RUN_GAIN_LAW:
            more = [RUN_GAIN_PRIOR_SD * value * force for value, force in zip(values.tolist(), predicted, strict=True)]
        else:
            more = [array @ values for array in columns[name]]
        return NonparametricLaw(
            name, float(complement[0, 0]) - twice_log_evidence, rms_where_active(np.concatenate(more), widths_s)
        )

    limits = [*edges.tolist(), len(total)]
    laws = [
        law(name, *rows_of_law) for name, rows_of_law in zip((*columns, RUN_GAIN_LAW), pairwise(limits), strict=True)
    ]
    return tuple(sorted(laws, key=lambda fitted_law: fitted_law.chi2))


def _twice_log_evidence(complement: FloatArray, rows: slice) -> tuple[float, FloatArray]:
    """Return twice the log evidence for columns in units of their priors, and their coefficients.

    The log evidence is the chi-square difference minus the Occam factor of the free values.
    """
    gram, moment = complement[rows, rows], complement[rows, 0]
    precision = gram + np.eye(gram.shape[0])
    coefficients = np.asarray(np.linalg.solve(precision, moment), dtype=np.float64)
    return float(moment @ coefficients) - float(np.linalg.slogdet(precision)[1]), coefficients
