"""The five elements against shear strain: polynomials as in Eq. 14, by weighted least squares."""

from collections.abc import Iterable, Sequence

import numpy as np

from dragrig.analysis.identification.results import RelaxationFit, StrainLaw
from dragrig.config.errors import AnalysisError
from dragrig.config.model import WallPolynomials
from dragrig.rig.arrays import FloatArray

RUN_SCATTER = 0.02
"""Relative standard deviation of all stiffness from run to run on one specimen."""
SAME_STRAIN = 0.01
"""Strains that differ by less than this share are one strain, repeated."""
HIGHEST_DEGREE = 2
NAMES = ("E1", "E2", "E3", "eta1", "eta2")


def strain_laws(fits: Iterable[RelaxationFit]) -> tuple[tuple[StrainLaw, ...], tuple[str, ...]]:
    """Fit each element against strain.

    Runs at one strain are averaged first. A point's error holds its interval, the run-to-run scatter of 2 %, and what
    its repeats scatter by if that is more; the covariance holds the lack of fit where points lie further from the
    polynomial than that.

    Returns
    -------
    laws, remarks
        A quadratic over three or more strains, a straight line over two, none over one; remarks say which.
    """
    usable = [fit for fit in fits if fit.elements]
    groups = _by_strain(usable)
    strains = tuple(float(np.mean([fit.shear_strain for fit in group])) for group in groups)
    if len(strains) < 2:
        told = "no run" if not strains else f"only the strain of {100 * strains[0]:.4g} %"
        return (), (f"The elements' dependence on strain is unknown: {told} gave elements.",)
    laws = tuple(_law(index, strains, groups) for index in range(len(NAMES)))
    remarks = {
        2: "Two strains give straight lines through both; a curvature as in Eq. 14 needs a third.",
        3: "The quadratics run exactly through the three strains, so that nothing checks them.",
    }
    return laws, (remarks[len(strains)],) if len(strains) in remarks else ()


def evaluate(law: StrainLaw, strain: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return value and standard error of a law at strains, each of their shape."""
    powers = np.vander(np.asarray(strain, dtype=float), len(law.coefficients))
    variance = np.einsum("ij,jk,ik->i", powers, law.covariance, powers)
    return np.asarray(powers @ np.array(law.coefficients)), np.sqrt(np.maximum(variance, 0.0))


def wall_polynomials(laws: Sequence[StrainLaw]) -> WallPolynomials:
    """Turn the laws of all five elements into what the simulator loads as `wall = "polynomial"`.

    Raises
    ------
    AnalysisError
        Where an element is lacking, or a law is not positive throughout the strains that it comes from.
    """
    found = {law.element: law for law in laws}
    lacking = [name for name in NAMES if name not in found]
    if lacking:
        raise AnalysisError(
            f"No law over strain for {', '.join(lacking)}: relaxations at two strains or more are needed for a wall"
        )
    for name in NAMES:
        law = found[name]
        between = np.linspace(min(law.strains), max(law.strains), 101)
        values, _ = evaluate(law, between)
        if values.min() <= 0:
            raise AnalysisError(
                f"The law of {name} is not positive at a strain of {between[values.argmin()]:.0%}, as a wall must be; "
                "measure at more strains"
            )
    return WallPolynomials.model_validate({name: found[name].coefficients for name in NAMES})


def _by_strain(fits: Iterable[RelaxationFit]) -> list[list[RelaxationFit]]:
    groups: list[list[RelaxationFit]] = []
    for fit in sorted(fits, key=lambda one: one.shear_strain):
        if groups and fit.shear_strain - groups[-1][0].shear_strain <= SAME_STRAIN * fit.shear_strain:
            groups[-1].append(fit)
        else:
            groups.append([fit])
    return groups


def _law(index: int, strains: tuple[float, ...], groups: Sequence[Sequence[RelaxationFit]]) -> StrainLaw:
    points = np.array([_point(index, group) for group in groups])
    values, errors = points[:, 0], points[:, 1]
    degree = min(HIGHEST_DEGREE, len(strains) - 1)
    powers = np.vander(np.array(strains), degree + 1)
    weighted = powers / errors[:, None]
    coefficients, *_ = np.linalg.lstsq(weighted, values / errors)
    inverse = np.linalg.inv(weighted.T @ weighted)
    free = len(strains) - degree - 1
    stray = values - powers @ coefficients
    scale = max(1.0, float(((stray / errors) ** 2).sum()) / free) if free else 1.0
    around = float(((values - values.mean()) ** 2).sum())
    return StrainLaw(
        element=NAMES[index],
        unit=groups[0][0].elements[index].unit,
        strains=strains,
        coefficients=tuple(float(one) for one in coefficients),
        covariance=scale * inverse,
        r2=1 - float(stray @ stray) / around if free and around else None,
    )


def _point(index: int, group: Sequence[RelaxationFit]) -> tuple[float, float]:
    """Mean of an element over the runs at one strain, and its standard error."""
    values = np.array([fit.elements[index].value for fit in group])
    errors = np.array([fit.elements[index].standard_error for fit in group])
    mean = float(values.mean())
    variance = float((errors**2).mean()) + (RUN_SCATTER * mean) ** 2
    if len(values) > 1:
        variance = max(variance, float(values.var(ddof=1)))
    return mean, float(np.sqrt(variance / len(values)))
