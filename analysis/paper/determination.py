"""Findings on R² as Eq. 15 defines it."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import sqrt

import numpy as np

from dragrig.analysis.paper import printed
from dragrig.analysis.paper.finding import Finding, Number, spelled
from dragrig.analysis.paper.printed import BOUNDARY_MM_S, CAPSULE, MODEL, R2_ABOVE, R2_BELOW, WALL_THICKNESS_MM
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction import steady_forces


@dataclass(frozen=True, slots=True)
class Example:
    """Made-up measurements beside the model's forces [mN] at the same speeds, and what both forms of R² say of them."""

    name: str
    measured_mN: tuple[float, ...]
    eq15: float
    correlation: float


def findings() -> Iterator[Finding]:
    """Yield the findings."""
    yield _no_correlation()
    yield _offset()


def by_eq15(model: FloatArray, measured: FloatArray) -> float:
    """R² as the paper computes it: sums of squares about the model's mean, model over measurement."""
    mean = model.mean()
    return float(((model - mean) ** 2).sum() / ((measured - mean) ** 2).sum())


def by_correlation(model: FloatArray, measured: FloatArray) -> float:
    """Square of the correlation, as the paper describes it."""
    return float(np.corrcoef(model, measured)[0, 1] ** 2)


def band(above: bool) -> FloatArray:
    """Return the programme's speeds above the paper's boundary, or up to it [mm/s]."""
    speeds = np.array(printed.SPEEDS_MM_S)
    return np.asarray(speeds[(speeds > BOUNDARY_MM_S) == above])


def model_over(speeds_mm_s: FloatArray) -> FloatArray:
    """Return the model's steady force [mN]."""
    return steady_forces(speeds_mm_s, MODEL, CAPSULE, WALL_THICKNESS_MM).total


def examples() -> tuple[Example, ...]:
    """Return measurements made up around the model's forces above the boundary."""
    model = model_over(band(above=True))
    mean = model.mean()
    made_up = {
        "half as steep": mean + (model - mean) / 2,
        "mirrored: falls where the model rises": 2 * mean - model,
        "shifted by 5 mN": model + printed.SENSOR_ACCURACY_MN,
        f"shifted so far that Eq. 15 gives {R2_ABOVE:g}": model + offset_for(R2_ABOVE, model),
    }
    return tuple(
        Example(name, tuple(map(float, one)), by_eq15(model, one), by_correlation(model, one))
        for name, one in made_up.items()
    )


def offset_for(r2: float, model: FloatArray) -> float:
    """Return the constant difference [mN] between model and measurement that alone makes Eq. 15 this R²."""
    return float(model.std()) * sqrt(1 / r2 - 1)


def _no_correlation() -> Finding:
    made_up = examples()
    flat, mirrored = made_up[0], made_up[1]
    numbers = [
        number
        for one in made_up
        for number in (
            Number(f"Eq. 15, {one.name}", one.eq15, "", 4),
            Number(f"squared correlation, {one.name}", one.correlation, "", 4),
        )
    ]
    return Finding(
        "eq15",
        "Eq. 15 is not the square of the correlation",
        "Section 4, Eq. 15",
        "R² is called the square of the correlation; its formula divides the model's sum of squares about the model's "
        "mean by the measurement's about the same mean.",
        tuple(numbers),
        f"The ratio can exceed 1 and does not see the sign: a measurement half as steep as the model gets "
        f"{spelled(flat.eq15)}, one that falls where the model rises {spelled(mirrored.eq15)}; both have a squared "
        f"correlation of {spelled(flat.correlation)}.",
        "Both forms are reported, under names of their own.",
    )


def _offset() -> Finding:
    below, above = model_over(band(above=False)), model_over(band(above=True))
    low, high = offset_for(R2_BELOW, below), offset_for(R2_ABOVE, above)
    same = 1 / (1 + (low / float(above.std())) ** 2)
    return Finding(
        "offset",
        "A constant offset and a narrow band lower Eq. 15 by themselves",
        "Section 4, Eq. 15, Fig. 11",
        f"R² is {R2_BELOW:g} below {BOUNDARY_MM_S:g} mm/s and {R2_ABOVE:g} above, from which the model is said to fail "
        "above.",
        (
            Number(f"spread of the model's forces up to {BOUNDARY_MM_S:g} mm/s", float(below.std()), "mN"),
            Number(f"spread of the model's forces above {BOUNDARY_MM_S:g} mm/s", float(above.std()), "mN"),
            Number(f"offset that alone gives {R2_BELOW:g} below", low, "mN", 2),
            Number(f"offset that alone gives {R2_ABOVE:g} above", high, "mN", 2),
            Number("Eq. 15 above with the offset that gives 0.8769 below", same, "", 2),
            Number("the larger offset over the model's mean above", 100 * high / float(above.mean()), "%", 2),
        ),
        f"On the speeds of our programme an offset of {spelled(low, 2)} mN, with everything else perfect, makes "
        f"{R2_BELOW:g} below; the same offset makes {spelled(same, 2)} above, where the model's forces spread less "
        f"({spelled(above.std())} against {spelled(below.std())} mN). {R2_ABOVE:g} needs {spelled(high, 2)} mN, "
        f"{spelled(100 * high / float(above.mean()), 2)} % of the model's mean there. How much of the paper's "
        "difference is of this kind cannot be told "
        "without its data.",
        "R² stands beside the differences themselves, with their errors, and the boundary is estimated from these.",
    )
