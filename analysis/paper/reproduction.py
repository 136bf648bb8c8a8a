"""All findings in the paper's order, and the wall's elements as published beside those identified."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

from dragrig.analysis.estimates import EstimatedQuantity
from dragrig.analysis.identification.identification import RelaxationFit, RelaxationResult
from dragrig.analysis.paper.friction_findings import coulomb_test_findings, friction_sum_findings, r2_findings
from dragrig.analysis.paper.published import PaperFinding
from dragrig.analysis.paper.wall_findings import (
    contact_findings,
    high_speed_findings,
    pressure_findings,
    relaxation_findings,
    wall_parameter_findings,
)
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.sim_backend.friction import ParameterSetDifference, parameter_set_differences
from dragrig.sim_backend.friction.wall import model_wall

ELEMENT_UNITS = {"E1": "kPa", "E2": "kPa", "E3": "kPa", "eta1": "kPa·s", "eta2": "kPa·s"}
"""Unit of each element, in the order of Table 1."""
SAME_STRAIN_TOLERANCE = 0.02
"""Strains that differ by no more count as one."""


@dataclass(frozen=True, slots=True)
class ElementRow:
    """One element at one of Table 1's strains.

    Attributes
    ----------
    published
        Table 1's entry, Eq. 14's and the quadratic's value, and how these differ from the entry.
    identified
        What a relaxation gives; None where there is none at that strain, or it supports none.
    simulated
        What the run was simulated with, its own variation included.
    """

    published: ParameterSetDifference
    identified: EstimatedQuantity | None
    simulated: float

    @property
    def unit(self) -> str:
        """Unit of the element."""
        return ELEMENT_UNITS[self.published.parameter]

    @property
    def difference(self) -> float | None:
        """Relative difference of the identified from the simulated value."""
        return None if self.identified is None else self.identified.value / self.simulated - 1

    @property
    def difference_from_table1(self) -> float | None:
        """Relative difference of the identified value from Table 1's entry."""
        return None if self.identified is None else self.identified.value / self.published.table1 - 1

    @property
    def inside(self) -> bool | None:
        """Whether the interval holds the simulated value."""
        if self.identified is None:
            return None
        low, high = self.identified.interval
        return low <= self.simulated <= high


def element_rows(
    relaxation: RelaxationResult | None, model: FrictionModelSettings, of_run: Mapping[str, FrictionModelSettings]
) -> tuple[ElementRow, ...]:
    """Put an identification of simulated relaxations beside what is published, element by element.

    Parameters
    ----------
    model
        What was simulated, before a run's own variation.
    of_run
        What each run was simulated with, by its file's name.
    """
    fits = {} if relaxation is None else {fit.shear_strain: fit for fit in relaxation.fits if fit.elements}
    rows = []
    for one in parameter_set_differences():
        fit = next((fit for strain, fit in fits.items() if abs(strain - one.strain) <= SAME_STRAIN_TOLERANCE), None)
        simulated = model if fit is None else of_run.get(fit.file, model)
        wall = model_wall(simulated, one.strain)
        rows.append(ElementRow(one, _identified_element(fit, one.parameter), float(getattr(wall, one.parameter))))
    order = list(ELEMENT_UNITS)
    return tuple(sorted(rows, key=lambda row: (order.index(row.published.parameter), row.published.strain)))


def _identified_element(fit: RelaxationFit | None, element: str) -> EstimatedQuantity | None:
    elements = () if fit is None else fit.elements
    return next((quantity for quantity in elements if quantity.name == element), None)


_SUBJECT_FINDINGS = (
    wall_parameter_findings,
    relaxation_findings,
    contact_findings,
    pressure_findings,
    friction_sum_findings,
    coulomb_test_findings,
    r2_findings,
    high_speed_findings,
)


@cache
def all_findings() -> tuple[PaperFinding, ...]:
    """Compute all findings, by the model as printed."""
    return tuple(finding for findings in _SUBJECT_FINDINGS for finding in findings())
