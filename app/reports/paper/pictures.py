"""The report's figures."""

from dragrig.analysis.identification.results import Drag, Quantity
from dragrig.analysis.paper import printed
from dragrig.figures import coulomb_figure, drag_figure, forces_figure, joint_figure, skew_figure, wall_figure
from dragrig.reports.embedding import Picture, embedded
from dragrig.reports.paper.results import PaperResults


def pictures(results: PaperResults) -> dict[str, Picture]:
    """Draw all figures; what was not identified is missing."""
    model, capsule, thickness = results.model, results.capsule, results.wall_thickness_mm
    drawn = {
        "wall": embedded(
            wall_figure(_identified(results)),
            "Five panels, one for each element against strain: Table 1's points, Eq. 14's curve, which misses them, "
            "the quadratic through them, and the identified values with their intervals.",
            "The wall's elements against strain.",
        ),
        "skew": embedded(
            skew_figure(model, capsule, thickness),
            "Skew resistance along the contact at six speeds; each curve rises to a maximum inside the hemisphere and "
            "falls towards the equator, beside the capsule it stays constant for 20 mm.",
            "After the paper's Fig. 7. A dot marks each curve's largest value.",
        ),
        "forces": embedded(
            forces_figure(model, capsule, thickness, printed.SPEEDS_MM_S),
            "Environmental resistance, viscous friction, Coulomb friction and their sum against speed.",
            "After the paper's Fig. 9, by the model that was simulated.",
        ),
    }
    if results.coulomb_trace is not None:
        drawn["coulomb"] = embedded(
            coulomb_figure(results.coulomb_trace, results.coulomb, printed.COULOMB_FORCE_MN),
            "Force of the simulated Coulomb test against time, raw and filtered, with its mean and the printed one.",
            "After the paper's Fig. 8: the simulated run, zero taken off. The orange line is the paper's mean.",
        )
    joint = results.identification.joint
    if joint is not None:
        drawn["joint"] = embedded(
            joint_figure(joint),
            "Left, the 95 % interval of each parameter before and after the runs, and of what they combine to; right, "
            "χ² per degree of freedom of each run.",
            "The joint fit. Left, on a scale on which all parameters were known equally well before; right, 1 where "
            "nothing but noise and the variation between runs is left.",
        )
    drag = results.identification.drag
    if drag is not None:
        drawn["drag"] = _drag(drag, results)
    return drawn


def _drag(drag: Drag, results: PaperResults) -> Picture:
    found = results.identified_model
    figure = drag_figure(
        drag,
        found or results.model,
        results.capsule,
        results.wall_thickness_mm,
        printed.BOUNDARY_MM_S,
        printed.SENSOR_ACCURACY_MN,
        "simulated",
        results.model if found is not None else None,
    )
    return embedded(
        figure,
        "Measured drag of the simulated runs with intervals against speed, the curves of the identified and of the "
        "simulated model, and the fitted logarithm; below, the differences from the identified model.",
        "After the paper's Fig. 11: simulated runs in place of the paper's measurements, which its text does not hold, "
        "the model as it was identified from all runs, and the model that was simulated. Bars are 95 % intervals.",
    )


def _identified(results: PaperResults) -> dict[str, list[tuple[float, Quantity]]]:
    found: dict[str, list[tuple[float, Quantity]]] = {}
    for row in results.elements:
        if row.identified is not None:
            found.setdefault(row.published.parameter, []).append((row.published.strain, row.identified))
    return found
