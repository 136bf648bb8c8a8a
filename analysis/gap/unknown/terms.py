"""The library that a law of a gap is put together from: powers and logarithms, and products of two."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from dragrig.analysis.gap.unknown.part import Part
from dragrig.analysis.gap.where.axes import IndexArray
from dragrig.analysis.gap.where.blocks import ResidualBlocks
from dragrig.rig.arrays import FloatArray
from dragrig.rig.profile import Phase

SLOWEST_MM_S = 0.05
"""Where the logarithm of the speed ends."""
LEAST_CHANGE = 1e-3
"""Terms that vary by less than this part of themselves are constant."""

UNITS: Mapping[str, str] = {
    "v": "speed v in mm/s",
    "x": "position x in mm",
    "t": "time since the start t in s",
    "T": "session time T in min",
    "n": "run count n",
    "ε": "strain ε",
    "F": "measured force F in mN",
}
"""What the symbols are."""


@dataclass(frozen=True, slots=True, eq=False)
class Library:
    """Terms at `N` blocks.

    Attributes
    ----------
    names
        Of the `M` terms.
    factors
        Number of factors of each term, shape `(M,)`.
    values
        Shape `(N, M)`.
    residual, weight
        What is to be explained [the part's unit], and what its square counts: all blocks of a run together at most 1
        over the expected mean square. Shape `(N,)`.
    run
        Number of the run, shape `(N,)`.
    """

    names: tuple[str, ...]
    factors: FloatArray
    values: FloatArray
    residual: FloatArray
    weight: FloatArray
    run: IndexArray


def library(part: Part) -> Library:
    """Return all terms that vary, and 1, at the blocks of a part."""
    starts = sorted({(one.session_s, one.run_id) for one in part.blocks})
    order = {name: number for number, (_, name) in enumerate(starts)}
    leave = _left_out(part)
    columns: dict[str, FloatArray] = {}
    for name, of in _variables(order).items():
        if not name.startswith(leave):
            columns[name] = np.concatenate([of(one)[at] for one, at in zip(part.blocks, part.inside, strict=True)])
    simple = {name: one for name, one in columns.items() if name == "1" or _varies(one)}
    bare = [name for name in simple if name != "1" and not name.endswith("²")]
    products = {f"{one}·{other}": simple[one] * simple[other] for one, other in combinations(bare, 2)}
    pairs = {name: one for name, one in products.items() if _varies(one) and name != "v·ln(v)"}
    terms = {**simple, **pairs}
    inside = list(zip(part.blocks, part.inside, strict=True))
    return Library(
        names=tuple(terms),
        factors=np.array([2.0 if name in pairs or name.endswith("²") else 1.0 for name in terms]),
        values=np.stack(list(terms.values()), axis=1),
        residual=part.scale * np.concatenate([one.residual[at] for one, at in inside]),
        weight=np.concatenate([(one.weight / (part.scale * one.noise_sd) ** 2)[at] for one, at in inside]),
        run=np.concatenate([np.full(np.count_nonzero(at), number) for number, (_, at) in enumerate(inside)]),
    )


def _varies(values: FloatArray) -> bool:
    return bool(np.ptp(values) > LEAST_CHANGE * abs(values).max())


def _left_out(part: Part) -> tuple[str, ...]:
    """Return variables that say nothing here: speed and way where walls are sheared, force where it is not known."""
    sheared = all(one.strain > 0 for one in part.blocks)
    unknown = any(one.level_mN is None for one in part.blocks)
    return (*(("v", "ln(v)", "x") if sheared else ()), *(("F",) if unknown else ()))


def _variables(order: Mapping[str, int]) -> Mapping[str, Callable[[ResidualBlocks], FloatArray]]:
    return {
        "1": lambda one: np.ones_like(one.residual),
        "v": speed,
        "ln(v)": lambda one: np.log(np.maximum(speed(one), SLOWEST_MM_S)),
        "v²": lambda one: speed(one) ** 2,
        "ε": lambda one: np.full_like(one.residual, one.strain),
        "ε²": lambda one: np.full_like(one.residual, one.strain**2),
        "x": lambda one: np.abs(one.position_mm),
        "x²": lambda one: one.position_mm**2,
        "t": since_start,
        "T": lambda one: (one.session_s + one.time_s) / 60.0,
        "n": lambda one: np.full_like(one.residual, order[one.run_id]),
        "F": lambda one: np.zeros_like(one.residual) if one.level_mN is None else one.level_mN,
    }


def speed(one: ResidualBlocks) -> FloatArray:
    """Return the speed [mm/s], as commanded where it is steady, shape `(B,)`."""
    if one.residual.size < 2:
        return np.full_like(one.residual, one.speed_mm_s)
    local = np.abs(np.gradient(one.position_mm, one.time_s))
    changing = (one.phase == Phase.ACCELERATE) | (one.phase == Phase.DECELERATE)
    steady = np.where(one.phase == Phase.STEADY, one.speed_mm_s, 0.0)
    return np.where(changing, np.clip(local, 0.0, one.speed_mm_s), steady)


def since_start(one: ResidualBlocks) -> FloatArray:
    """Return the time since the motion began [s], 0 before, shape `(B,)`."""
    begun = one.phase != Phase.REST
    return np.maximum(one.time_s - one.time_s[begun][0], 0.0) if begun.any() else np.zeros_like(one.time_s)
