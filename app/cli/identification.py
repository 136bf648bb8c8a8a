"""What an identification says, as text for a terminal."""

from collections.abc import Iterator, Mapping, Sequence
from math import isnan, sqrt

from dragrig.analysis.estimates import Estimate
from dragrig.analysis.identification.results import Identification, Identified, JointFit, LeftOut, RunResidual
from dragrig.cli.identification_parts import coulomb_text, drag_text, relaxation_text
from dragrig.cli.precision import between, chance, interval_of, to_error, unit_of, with_error
from dragrig.cli.wording import columns, number

STANDS_OUT = 4.0
"""Standard deviations of χ² above which a run is pointed out."""
UNKNOWN = "-"
LARGE = 1000.0
MISSING = {
    "joint": "Joint fit: none.",
    "relaxation": "Relaxation: not identified.",
    "coulomb": "Coulomb friction: not identified.",
    "drag": "Drag: not identified.",
}


def identification_text(identification: Identification) -> str:
    """Return all that an identification says: the joint fit, each kind of run by itself, and what was left out."""
    parts = [
        _heading(identification),
        joint_text(identification.joint) if identification.joint is not None else MISSING["joint"],
        *_part_by_part(identification),
        left_out_text(identification.left_out),
        "\n".join(f"! {remark}" for remark in identification.remarks),
    ]
    return "\n\n".join(part for part in parts if part)


def _part_by_part(identification: Identification) -> Iterator[str]:
    one = identification
    if one.joint is not None and all(part is None for part in (one.relaxation, one.coulomb, one.drag)):
        return  # a model that has no such parts
    yield relaxation_text(one.relaxation) if one.relaxation is not None else MISSING["relaxation"]
    yield coulomb_text(one.coulomb) if one.coulomb is not None else MISSING["coulomb"]
    yield drag_text(one.drag) if one.drag is not None else MISSING["drag"]


def joint_text(fit: JointFit) -> str:
    """Return the joint fit: parameters, their products, what cannot be told apart, and how each run is left."""
    lines = [_verdict(fit), "", _parameters(fit)]
    if fit.combinations:
        rows = [(*_value(one, fit), _percent(one, fit), unit_of(one.unit)) for one in fit.combinations]
        lines += ["", "What these combine to", columns(("", "value", "95 % interval", "±", ""), rows)]
    told = [*_words(fit), *fit.remarks]
    lines += ["", *(f"! {one}" for one in told)] if told else []
    if fit.runs:
        lines += ["", _runs(fit.runs)]
    return "\n".join(lines)


def left_out_text(left_out: Sequence[LeftOut]) -> str:
    """Return what is not used, and why; empty where nothing was left out."""
    if not left_out:
        return ""
    return "Left out\n" + columns(("what", "why"), [(one.what, one.reason) for one in left_out])


def _heading(identification: Identification) -> str:
    used, all_runs = len(identification.used), len(identification.used) + len(identification.left_out)
    runs = f"{used} run{'' if used == 1 else 's'}" if used == all_runs else f"{used} of {all_runs} runs"
    return f"Specimen {identification.specimen}: {runs} used. Intervals hold 95 %; ± in columns is a standard error."


def _verdict(fit: JointFit) -> str:
    if not fit.converged:
        return f"Joint fit of the {fit.nominal} model: did NOT converge in {fit.steps} steps, no interval below holds."
    per_degree = (
        f"χ² is {fit.chi2 / fit.degrees:.3g} per degree of freedom ({fit.degrees})"
        if fit.degrees
        else "no degree of freedom"
    )
    beginning = f"Joint fit of the {fit.nominal} model, {fit.steps} steps: {per_degree}, {_chance(fit.p_value)}"
    if not fit.holds:
        return f"{beginning}: the model leaves something unexplained, so that no interval below need hold."
    if not any(one.determined for one in fit.parameters):
        return f"{beginning}. These runs determine NONE of its parameters."
    return f"{beginning}."


def _chance(p_value: float) -> str:
    return "its chance not known" if isnan(p_value) else chance(p_value)


def _value(one: Identified, fit: JointFit) -> tuple[str, str, str]:
    """Return name, value and interval: no value that the runs do not determine, no interval that does not hold."""
    if not one.determined:
        return one.name, UNKNOWN, ""
    return one.name, to_error(one.value, one.standard_error), interval_of(one) if fit.converged else ""


def _parameters(fit: JointFit) -> str:
    rows = [
        (
            *_value(one, fit),
            unit_of(one.unit),
            between(one.prior, one.standard_error),
            f"{100 * one.learnt:.0f} %" if fit.converged else "",
            one.meaning,
        )
        for one in fit.parameters
    ]
    return columns(("parameter", "value", "95 % interval", "", "before the runs", "learnt", "what it is"), rows)


def _words(fit: JointFit) -> Iterator[str]:
    unknown = [one.name for one in fit.parameters if not one.determined]
    if unknown:
        yield f"the runs say next to nothing of {_listed(unknown)}: no more is known than before"
    strange = [one.name for one in fit.parameters if one.determined and not one.prior[0] <= one.value <= one.prior[1]]
    if strange:
        yield (
            f"{_listed(strange)} lies outside of what was expected before the runs"
            if len(strange) == 1
            else (f"{_listed(strange)} lie outside of what was expected before the runs")
        )
    odd = [one.file for one in fit.runs if _stands_out(one)]
    if odd:
        yield f"the model leaves more than noise in {_listed(odd)}"


def _runs(runs: Sequence[RunResidual]) -> str:
    factors = list(dict.fromkeys(name for run in runs for name in run.factors))
    offsets = list(dict.fromkeys(name for run in runs for name in run.offsets))
    own = (*(f"{name} ×" for name in factors), *offsets)
    header = ("run", "kind", "channel", "χ²", "", "rms mN", "zero mN", "±", *own)
    return columns(header, [_run(run, factors, offsets) for run in runs])


def _run(run: RunResidual, factors: Sequence[str], offsets: Sequence[str]) -> tuple[str, ...]:
    zero = with_error(run.zero) if run.zero.value is not None else (UNKNOWN, "")
    return (
        run.file,
        run.kind,
        run.channel,
        f"{run.chi2:.2f}" if run.chi2 < LARGE else f"{run.chi2:.3g}",
        "!" if _stands_out(run) else "",
        f"{run.rms_mN:.2f}",
        *zero,
        *_own(run.factors, factors, ".3f"),
        *_own(run.offsets, offsets, ".1f"),
    )


def _own(known: Mapping[str, Estimate], names: Sequence[str], spelling: str) -> tuple[str, ...]:
    found = (known.get(name) for name in names)
    return tuple("" if one is None or one.value is None else format(one.value, spelling) for one in found)


def _stands_out(run: RunResidual) -> bool:
    return run.blocks > 0 and run.chi2 > 1 + STANDS_OUT * sqrt(2 / run.blocks)


def _percent(one: Identified, fit: JointFit) -> str:
    share = one.half_width
    return f"{number(100 * share, 2)} %" if fit.converged and one.determined and share < 10 else ""


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
