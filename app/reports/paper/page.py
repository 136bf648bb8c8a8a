"""The page of the report."""

from collections.abc import Mapping

from dragrig.analysis.paper import printed
from dragrig.analysis.paper.elements import ElementRow
from dragrig.analysis.paper.finding import percent, spelled
from dragrig.figures.derived import with_error
from dragrig.reports.embedding import Picture
from dragrig.reports.paper.joint_tables import held
from dragrig.reports.paper.results import PaperResults
from dragrig.reports.rendering import render
from dragrig.reports.tabular import Table
from dragrig.rig.header import software

TITLE = "The paper's programme, simulated and identified"
_WALLS = {"eq14": "Eq. 14, as printed", "table1": "the least-squares quadratic through Table 1"}
_VISCOUS = {"published": "δ v, as published", "newtonian": "δ (v/d) S, dimensionally consistent"}


def page(
    results: PaperResults, tables: Mapping[str, Table], pictures: Mapping[str, Picture], model: str | None = None
) -> str:
    """Return the whole report as one HTML page; `model` names the file of the identified model beside it."""
    return render(
        "paper.html",
        {
            "title": TITLE,
            "settings": _settings(results),
            "wall": _WALLS.get(results.model.wall, results.model.wall),
            "papers_own": results.model == printed.MODEL,
            "elements": _agreement(results.elements),
            "joint": _joint(results),
            "model": model,
            "identification": results.identification,
            "findings": results.findings,
            "tables": tables,
            "printed": printed,
            "spelled": spelled,
            "percent": percent,
            "with_error": with_error,
            "pictures": pictures,
        },
    )


def _settings(results: PaperResults) -> dict[str, str]:
    simulated, model = results.rig.simulated, results.model
    noise, variation = simulated.noise, simulated.variation
    return {
        "Software": f"{software()}, simulated rig",
        "Seed": str(simulated.seed),
        "Programme": f"plan paper: {results.runs} runs, ways back included, at {results.rig.sampling.rate_hz:g} Hz",
        "Wall": _WALLS.get(model.wall, model.wall),
        "Viscous friction": _VISCOUS[model.viscous],
        "Coulomb friction": f"μ = {model.friction_coefficient:g}",
        "Sensor": f"noise {noise.white_mN:g} mN white and {noise.slow_mN:g} mN slow ({noise.slow_correlation_s:g} s), "
        f"zero off by {noise.zero_mN:g} mN (standard deviation) in each run",
        "Between runs": f"stiffness varies by {100 * variation.run_stiffness:g} %, "
        f"μ by {100 * variation.run_friction:g} % (standard deviations)",
    }


def _joint(results: PaperResults) -> dict[str, object] | None:
    """Say what the joint fit gave back; None without one that converged."""
    fit = results.identification.joint
    if fit is None or not fit.converged:
        return None
    return {
        "fit": fit,
        "parameters": held(fit.parameters, results.model),
        "combinations": held(fit.combinations, results.model),
        "unknown": [one.name for one in fit.parameters if not one.determined],
    }


def _agreement(rows: tuple[ElementRow, ...]) -> dict[str, object]:
    """Say how the identified elements agree with what was simulated."""
    found = [row for row in rows if row.identified is not None]
    worst = max((abs(row.difference or 0.0) for row in found), default=0.0)
    return {
        "all": len(rows),
        "found": len(found),
        "inside": sum(bool(row.inside) for row in found),
        "worst": percent(worst).removeprefix("+"),
    }
