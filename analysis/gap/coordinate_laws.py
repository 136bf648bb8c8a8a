"""Laws that bear no name: a force that is any function of one coordinate, given by its values at knots."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.gap.sights import Coordinates, Sight
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Contact
from dragrig.sim_backend.effects.scene import Stance

FORCE_SD_MN = 30.0
"""Prior of a law's value at a knot."""
SLOWEST_MM_S = 0.3
SPEEDS = np.log(np.geomspace(SLOWEST_MM_S, 62.0, 14))
TIMES = np.log(np.geomspace(0.03, 8.0, 8))
LOAD_KNOTS, SESSION_KNOTS = 12, 8
PLACE_STEP_MM, PLACE_KNOTS = 1.5, 30
HARMONICS = 4


def law_columns(
    sights: Sequence[Sight], predicted: Sequence[FloatArray], period_s: float
) -> Mapping[str, list[FloatArray]]:
    """Return the columns of every law that runs share, by its name, for each in units of their priors, shape `(B, k)`.

    Parameters
    ----------
    predicted
        Block means of each run's force [mN].
    period_s
        Period of a swing in all runs; 0 for none.
    """
    knots = _Knots.of([one.coordinates for one in sights], predicted)
    laws = [_laws(sight, force, knots) for sight, force in zip(sights, predicted, strict=True)]
    found = {name: [one[name] for one in laws] for name in laws[0]}
    if period_s > 0:
        found["swing in all runs"] = [_swing(one.coordinates.session_s / period_s) for one in sights]
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Knots:
    """Where the values of laws are given, that runs of a campaign share."""

    place_mm: FloatArray
    load_mN: FloatArray
    session_s: FloatArray

    @classmethod
    def of(cls, runs: Sequence[Coordinates], predicted: Sequence[FloatArray]) -> "_Knots":
        place = np.concatenate([at.position_mm for at in runs])
        session, load = np.concatenate([at.session_s for at in runs]), np.concatenate(predicted)
        places = int(np.clip(np.ptp(place) / PLACE_STEP_MM, 2, PLACE_KNOTS))
        return cls(
            *(
                np.linspace(float(one.min()), float(one.max()) + 1e-9, count)
                for one, count in ((place, places), (load, LOAD_KNOTS), (session, SESSION_KNOTS))
            )
        )


def _laws(sight: Sight, predicted: FloatArray, knots: _Knots) -> Mapping[str, FloatArray]:
    """Return the columns of every law at the blocks of a run, in units of their priors, shape `(B, k)`."""
    at, contact = sight.coordinates, sight.experiment.contact
    stance = Stance.of(sight.experiment.motion, at.time_s)
    slides = contact is Contact.SLIDING
    closed = slides and sight.experiment.kind != "coulomb"
    moves = at.speed_mm_s > 0.5 * SLOWEST_MM_S
    speed = _hats(np.log(at.speed_mm_s + 1e-9), SPEEDS) * moves[:, None]
    against = speed * stance.heading[:, None]
    place = _hats(at.position_mm, knots.place_mm)
    rest, start, stop = _since(at.time_s), _since(stance.since_start_s), _since(stance.since_stop_s)
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
        "load": _hats(predicted, knots.load_mN),
        "session": _hats(at.session_s, knots.session_s),
    }
    return {name: FORCE_SD_MN * one for name, one in found.items()}


def _since(time_s: FloatArray) -> FloatArray:
    return _hats(np.log(np.maximum(time_s, 1e-9)), TIMES)


def _hats(at: FloatArray, knots: FloatArray) -> FloatArray:
    """Return functions that are 1 at one knot, fall to 0 at its neighbours, and stay beyond the ends, `(B, k)`."""
    return np.stack([np.interp(at, knots, one) for one in np.eye(knots.size)], axis=1)


def _swing(turns: FloatArray) -> FloatArray:
    angle = 2 * np.pi * np.arange(1, HARMONICS + 1) * turns[:, None]
    return FORCE_SD_MN * np.hstack((np.cos(angle), np.sin(angle)))
