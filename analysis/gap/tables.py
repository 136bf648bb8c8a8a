"""Parameters and traces in the form that people see."""

from collections.abc import Iterator, Sequence

import numpy as np

from dragrig.analysis.estimates import NORMAL_95
from dragrig.analysis.gap.candidate import Candidate
from dragrig.analysis.gap.design import Part
from dragrig.analysis.gap.explanation import Explanation
from dragrig.analysis.gap.gaps import RunGap
from dragrig.analysis.gap.lines import Lines
from dragrig.analysis.gap.position.finding import PositionFinding
from dragrig.analysis.gap.results import RunView
from dragrig.analysis.gap.solving import fit
from dragrig.analysis.identification.results import Quantity


def parameters_of(name: str, one: Explanation | None, position: PositionFinding, lines: Lines) -> tuple[Quantity, ...]:
    """Return the parameters of a hypothesis with their errors; none for what has none."""
    found: list[Quantity] = []
    if one is not None:
        solution = fit(one.design, one.design.total(), Part.NOMINAL, Part.DETAIL, Part.EFFECT)
        errors = np.sqrt(np.maximum(np.diag(solution.covariance), 0.0))
        own = errors[np.searchsorted(solution.columns, one.design.of(Part.EFFECT))].tolist()
        several = len(one.point.candidates) > 1
        for candidate in one.point.candidates:
            mine, own = own[: len(candidate.fitted)], own[len(candidate.fitted) :]
            found += _quantities(candidate, mine, several)
    moved = position.candidate
    if moved is not None and moved.effect.id in name.split("+"):
        found += _quantities(moved, position.standard_errors, "+" in name)
    if name == "mains_hum":
        found.append(_quantity("amplitude_mN", "mN", lines.mains.amplitude, 0.5 * lines.mains.amplitude**0.5))
        found.append(_quantity("frequency_hz", "Hz", lines.mains.frequency_hz, 0.5))
    return tuple(found)


def _quantities(candidate: Candidate, errors: Sequence[float], several: bool) -> Iterator[Quantity]:
    for one, error in zip(candidate.fitted, errors, strict=True):
        name = f"{candidate.effect.id}.{one.name}" if several else one.name
        yield _quantity(name, one.unit, candidate.values[one.name], error)


def _quantity(name: str, unit: str, value: float, error: float) -> Quantity:
    half = NORMAL_95 * error
    return Quantity(name, unit, value, error, (value - half, value + half))


def views_of(gaps: Sequence[RunGap]) -> tuple[RunView, ...]:
    """Return each run as it was measured and as both models have it."""
    return tuple(_view(one) for one in gaps)


def _view(one: RunGap) -> RunView:
    sight, at = one.sight, one.sight.coordinates
    kind, value = sight.condition
    measured = sight.evidence.blocks.mean
    label = f"{value:g} × strain" if kind == "relaxation" else f"{value:g} mm/s"
    return RunView(
        file=sight.file,
        kind=kind,
        label=label,
        channel=sight.evidence.channel,
        unit="mN",
        time_s=at.time_s,
        position_mm=at.position_mm,
        measured=measured,
        before=measured - one.before,
        after=measured - one.after,
    )
