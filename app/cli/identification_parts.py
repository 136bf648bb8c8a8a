"""What the relaxations, Coulomb runs and drags of a campaign say, each by itself, as text for a terminal."""

from collections.abc import Iterator, Sequence
from math import isfinite

from dragrig.analysis.estimates import Estimate
from dragrig.analysis.identification.results import (
    Coulomb,
    CoulombRun,
    Drag,
    LogLaw,
    Quantity,
    Relaxation,
    RelaxationFit,
    SpeedPoint,
    StrainLaw,
)
from dragrig.cli.precision import between, chance, interval_of, to_error, unit_of, with_error
from dragrig.cli.wording import columns, number

TOGETHER = 0.9
"""Correlation from which two elements are said to be hard to tell apart."""
DOUBTED = 0.01


def relaxation_text(relaxation: Relaxation) -> str:
    """Return the five elements of each relaxation run, whether five suffice, and how they depend on strain."""
    known = [fit for fit in relaxation.fits if fit.elements]
    lines = [f"Relaxation: five elements from {len(known)} of {len(relaxation.fits)} runs"]
    if known:
        header = ("run", "strain", "", "value", "95 % interval", "±", "")
        lines.append(columns(header, [row for fit in known for row in _elements(fit)]))
    lines += ["", *(f"{fit.file}: {sentence}" for fit in relaxation.fits for sentence in _on_fit(fit))]
    if relaxation.laws:
        against = ("element", "", "against strain ε", "R²", "strains")
        lines += ["", columns(against, [_law(law) for law in relaxation.laws])]
    lines += [f"! {remark}" for remark in relaxation.remarks]
    return "\n".join(lines)


def coulomb_text(coulomb: Coulomb) -> str:
    """Return the friction coefficient of each run in the vacuum fixture, and of all."""
    header = ("run", "mm/s", "weight mN", "force mN", "±", "μ", "±", "μ less viscous", "±", "viscous mN", "share")
    lines = [
        "Coulomb friction",
        f"μ                         {_estimate(coulomb.mu)}",
        f"μ without viscous part    {_estimate(coulomb.mu_without_viscous)}",
    ]
    if coulomb.runs:
        lines.append(columns(header, [_coulomb(run) for run in coulomb.runs]))
    lines += [f"! {remark}" for remark in coulomb.remarks]
    return "\n".join(lines)


def drag_text(drag: Drag) -> str:
    """Return the steady drag at each speed beside the model, its law, the boundary, and R² in both forms."""
    lines = ["Drag: steady force, zero taken off, beside the model"]
    if drag.points:
        header = ("mm/s", "runs", "measured mN", "±", "f_e mN", "f_v mN", "f_c mN", "model mN", "over model", "errors")
        lines.append(columns(header, [_point(point) for point in drag.points]))
    if drag.log_law is not None:
        lines += ["", *_log_law(drag.log_law)]
    if drag.boundary is not None:
        lines += ["", drag.boundary.sentence]
    if drag.determination:
        forms = ("R² of the model", "speeds", "Eq. 15", "correlation²")
        rows = [(one.band, str(one.speeds), _r2(one.eq15), _r2(one.correlation)) for one in drag.determination]
        lines += ["", columns(forms, rows)]
    lines += [f"! {remark}" for remark in drag.remarks]
    return "\n".join(lines)


def _elements(fit: RelaxationFit) -> Iterator[tuple[str, ...]]:
    for place, one in enumerate((*fit.elements, *fit.times)):
        first = (fit.file, f"{100 * fit.shear_strain:.3g} %") if place == 0 else ("", "")
        yield *first, symbol(one.name), to_error(one.value, one.standard_error), interval_of(one), _half(one), one.unit


def _half(quantity: Quantity) -> str:
    return f"{number(100 * quantity.half_width, 2)} %" if quantity.half_width < 10 else ""


def _on_fit(fit: RelaxationFit) -> Iterator[str]:
    if not fit.elements:
        yield f"nothing can be said of its elements: {fit.remark or 'the fit gave none'}."
        return
    if not fit.converged:
        yield "the fit did NOT converge, so that no interval of it holds."
    if fit.test is not None:
        yield fit.test.sentence
    together = _together(fit)
    if together:
        yield f"hard to tell apart: {together}."
    if fit.remark:
        yield f"{fit.remark}."


def _together(fit: RelaxationFit) -> str:
    if fit.correlation is None:
        return ""
    names = [symbol(one.name) for one in fit.elements]
    found = [
        f"{names[row]} and {names[column]} (correlation {fit.correlation[row, column]:.2f})"
        for row in range(len(names))
        for column in range(row)
        if abs(fit.correlation[row, column]) >= TOGETHER
    ]
    return ", ".join(found)


def _law(law: StrainLaw) -> tuple[str, ...]:
    highest = len(law.coefficients) - 1
    text = ""
    for place, value in enumerate(law.coefficients):
        error = float(law.covariance[place, place]) ** 0.5
        sign = ("−" if value < 0 else "") if place == 0 else (" − " if value < 0 else " + ")
        power = highest - place
        text += (
            f"{sign}({to_error(abs(value), error)} ± {to_error(error, error)})"
            + ("", " ε", " ε²", " ε³")[min(power, 3)]
        )
    strains = ", ".join(f"{100 * one:.3g}" for one in law.strains)
    return symbol(law.element), unit_of(law.unit), text, "" if law.r2 is None else f"{law.r2:.3f}", f"{strains} %"


def _estimate(estimate: Estimate) -> str:
    value, error = with_error(estimate)
    if not error:
        return value
    return f"{value} ± {error} (95 %: {between(estimate.interval, estimate.standard_error)})"


def _known(estimate: Estimate) -> tuple[str, str]:
    """Spell an estimate for two columns; why one is missing stands with the coefficient of all runs."""
    return with_error(estimate) if estimate.value is not None else ("-", "")


def _coulomb(run: CoulombRun) -> tuple[str, ...]:
    return (
        run.file,
        number(run.speed_mm_s),
        f"{run.weight_mN:.1f}",
        *_known(run.force),
        *_known(run.mu),
        *_known(run.mu_without_viscous),
        f"{run.viscous_mN:.2f}" if isfinite(run.viscous_mN) else "-",
        "" if run.viscous_share is None else f"{100 * run.viscous_share:.1f} %",
    )


def _point(point: SpeedPoint) -> tuple[str, ...]:
    value, error = point.force.value, point.force.standard_error
    over = None if value is None else value - point.model_mN
    return (
        number(point.speed_mm_s),
        str(point.runs),
        *with_error(point.force),
        f"{point.f_e_mN:.1f}",
        f"{point.f_v_mN:.1f}",
        f"{point.f_c_mN:.1f}",
        f"{point.model_mN:.1f}",
        "" if over is None else f"{over:+.1f}",
        "" if over is None or not error else f"{over / error:+.1f}",
    )


def _log_law(law: LogLaw) -> Sequence[str]:
    fits = "too few speeds to tell whether it holds"
    if law.lack_of_fit_p is not None:
        doubted = (
            "stray from it by more than their errors" if law.lack_of_fit_p < DOUBTED else "lie on it within errors"
        )
        fits = f"the forces {doubted} ({chance(law.lack_of_fit_p)})"
    rows = [
        (letter, to_error(one.value, one.standard_error), interval_of(one))
        for letter, one in (("a", law.intercept), ("b", law.slope))
    ]
    heading = f"Force = a + b ln(v / 1 mm/s), R² {law.r2:.3f}: {fits}"
    return heading, columns(("", "mN", "95 % interval"), rows)


def _r2(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def symbol(name: str) -> str:
    """Spell an element or a time constant as on paper: η1, τ2."""
    return name.replace("eta", "η").replace("tau", "τ")
