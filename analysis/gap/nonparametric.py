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
"""Prior of a law's value at a knot."""
MIN_KNOT_SPEED_MM_S = 0.3
LOG_SPEED_KNOTS = np.log(np.geomspace(MIN_KNOT_SPEED_MM_S, 62.0, 14))
LOG_TIME_KNOTS = np.log(np.geomspace(0.03, 8.0, 8))
LOAD_KNOTS, SESSION_KNOTS = 12, 8
POSITION_KNOT_STEP_MM, POSITION_KNOTS = 1.5, 30
SWING_HARMONICS = 4


def nonparametric_columns(
    runs: Sequence[RunData], predicted: Sequence[FloatArray], period_s: float
) -> Mapping[str, list[FloatArray]]:
    """Return the columns of every law that runs share, by its name, for each in units of their priors, shape `(B, k)`.

    Parameters
    ----------
    predicted
        Block means of each run's force [mN].
    period_s
        Period of a swing in all runs; 0 for none.
    """
    knots = _Knots.of([run.coordinates for run in runs], predicted)
    laws = [_columns_of_run(run_data, force, knots) for run_data, force in zip(runs, predicted, strict=True)]
    found = {name: [one[name] for one in laws] for name in laws[0]}
    if period_s > 0:
        found["swing in all runs"] = [_harmonic_columns(run.coordinates.session_s / period_s) for run in runs]
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Knots:
    """Where the values of laws are given, that runs of a campaign share."""

    place_mm: FloatArray
    load_mN: FloatArray
    session_s: FloatArray

    @classmethod
    def of(cls, runs: Sequence[BlockCoordinates], predicted: Sequence[FloatArray]) -> "_Knots":
        place = np.concatenate([at.position_mm for at in runs])
        session, load = np.concatenate([at.session_s for at in runs]), np.concatenate(predicted)
        places = int(np.clip(np.ptp(place) / POSITION_KNOT_STEP_MM, 2, POSITION_KNOTS))
        return cls(
            *(
                np.linspace(float(values.min()), float(values.max()) + 1e-9, count)
                for values, count in ((place, places), (load, LOAD_KNOTS), (session, SESSION_KNOTS))
            )
        )


def _columns_of_run(run: RunData, predicted: FloatArray, knots: _Knots) -> Mapping[str, FloatArray]:
    """Return the columns of every law at the blocks of a run, in units of their priors, shape `(B, k)`."""
    at, contact = run.coordinates, run.experiment.contact
    stance = SlipHistory.of(run.experiment.motion, at.time_s)
    slides = contact is Contact.SLIDING
    closed = slides and run.experiment.kind != "coulomb"
    moves = at.speed_mm_s > 0.5 * MIN_KNOT_SPEED_MM_S
    speed = _hat_functions(np.log(at.speed_mm_s + 1e-9), LOG_SPEED_KNOTS) * moves[:, None]
    against = speed * stance.heading[:, None]
    place = _hat_functions(at.position_mm, knots.place_mm)
    rest, start, stop = _time_hats(at.time_s), _time_hats(stance.since_start_s), _time_hats(stance.since_stop_s)
    before, after = (stance.heading == 0)[:, None], (stance.since_stop_s > 0)[:, None]
    stands = np.column_stack((rest * before, stop * after))
    creeps = np.column_stack((start * moves[:, None], stop * after))
    found = {
        "speed": speed,
        "speed of sliding": slides * against,
        "speed in the gut": closed * against,
        "place": (contact is not Contact.STICKING) * place,
        "place in the gut": closed * place,
        "time at rest": stands,
        "time at rest in the gut": closed * stands,
        "time since start and stop": creeps,
        "time since start and stop in the gut": closed * creeps,
        "load": _hat_functions(predicted, knots.load_mN),
        "session": _hat_functions(at.session_s, knots.session_s),
    }
    return {name: KNOT_PRIOR_SD_MN * values for name, values in found.items()}


def _time_hats(time_s: FloatArray) -> FloatArray:
    return _hat_functions(np.log(np.maximum(time_s, 1e-9)), LOG_TIME_KNOTS)


def _hat_functions(at: FloatArray, knots: FloatArray) -> FloatArray:
    """Return functions that are 1 at one knot, fall to 0 at its neighbours, and stay beyond the ends, `(B, k)`."""
    return np.stack([np.interp(at, knots, values) for values in np.eye(knots.size)], axis=1)


def _harmonic_columns(turns: FloatArray) -> FloatArray:
    angle = 2 * np.pi * np.arange(1, SWING_HARMONICS + 1) * turns[:, None]
    return KNOT_PRIOR_SD_MN * np.hstack((np.cos(angle), np.sin(angle)))


RUN_GAIN_LAW, RUN_GAIN_PRIOR_SD = "gain of a run", 0.2
"""The law by which every run has a gain of its own, and the prior of that."""


def fit_nonparametric_laws(
    design: Design, runs: Sequence[RunData], period_s: float = 0.0, nuisance_columns: IndexArray | None = None
) -> tuple[NonparametricLaw, ...]:
    """Try every law beside what a design explains.

    Parameters
    ----------
    design
        A campaign, linearised.
    runs
        Its runs.
    period_s
        The period at which a swing on the session's clock is looked for that is in all runs; 0 for none.
    nuisance_columns
        The design's columns that take what they can; those of the nominal model unless given.

    Returns
    -------
    laws
        All of them, the best first.
    """
    predicted = [run.predicted for run in design.runs]
    columns = nonparametric_columns(runs, predicted, period_s)
    nuisances = (
        design.columns_of(ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR) if nuisance_columns is None else nuisance_columns
    )
    own = 1 + np.arange(nuisances.size)
    edges = 1 + own.size + np.cumsum([0, *(one[0].shape[1] for one in columns.values())])
    total = np.zeros((edges[-1] + len(predicted), edges[-1] + len(predicted)))
    for number, run in enumerate(design.runs):
        shared = (run.residual, run.columns[:, nuisances], *(one[number] for one in columns.values()))
        white = run.whitening.whiten(np.column_stack((*shared, RUN_GAIN_PRIOR_SD * predicted[number])))
        rows = np.append(np.arange(edges[-1]), edges[-1] + number)
        total[np.ix_(rows, rows)] += white.T @ white
    left = schur_complement(design, total, nuisances, np.arange(edges[0], len(total)), own)
    widths = np.concatenate([run_data.coordinates.width_s for run_data in runs])

    def law(name: str, low: int, high: int) -> NonparametricLaw:
        taken, values = _twice_log_evidence(left, slice(low - own.size, high - own.size))
        if name == RUN_GAIN_LAW:
            more = [RUN_GAIN_PRIOR_SD * value * force for value, force in zip(values.tolist(), predicted, strict=True)]
        else:
            more = [array @ values for array in columns[name]]
        return NonparametricLaw(name, float(left[0, 0]) - taken, rms_where_active(np.concatenate(more), widths))

    ends = [*edges.tolist(), len(total)]
    laws = [law(name, *item) for name, item in zip((*columns, RUN_GAIN_LAW), pairwise(ends), strict=True)]
    return tuple(sorted(laws, key=lambda one: one.chi2))


def _twice_log_evidence(left: FloatArray, rows: slice) -> tuple[float, FloatArray]:
    """Return squares that columns in units of their priors take away, less what their number costs, and their values.

    Both together are twice the logarithm of the evidence for them.
    """
    gram, along = left[rows, rows], left[rows, 0]
    whole = gram + np.eye(gram.shape[0])
    values = np.asarray(np.linalg.solve(whole, along), dtype=np.float64)
    return float(along @ values) - float(np.linalg.slogdet(whole)[1]), values
