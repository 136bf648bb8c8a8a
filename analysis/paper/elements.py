"""The wall's elements as Table 1, Eq. 14, the quadratic through Table 1, and an identification have them."""

from dataclasses import dataclass

from dragrig.analysis.identification.results import Quantity, Relaxation, RelaxationFit
from dragrig.config.model import FrictionModelSettings
from dragrig.sim_backend.friction import Disagreement, disagreement
from dragrig.sim_backend.friction.wall import model_wall

UNITS = {"E1": "kPa", "E2": "kPa", "E3": "kPa", "eta1": "kPa·s", "eta2": "kPa·s"}
"""Unit of each element, in the order of Table 1."""
SAME_STRAIN = 0.02
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
        What the simulator was given at that strain, before a run's own variation.
    """

    published: Disagreement
    identified: Quantity | None
    simulated: float

    @property
    def unit(self) -> str:
        """Unit of the element."""
        return UNITS[self.published.parameter]

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


def element_rows(relaxation: Relaxation | None, model: FrictionModelSettings) -> tuple[ElementRow, ...]:
    """Put an identification of relaxations that `model` simulated beside what is published, element by element."""
    fits = () if relaxation is None else relaxation.fits
    rows = [
        ElementRow(
            one,
            _found(fits, one.strain, one.parameter),
            float(getattr(model_wall(model, one.strain), one.parameter)),
        )
        for one in disagreement()
    ]
    order = list(UNITS)
    return tuple(sorted(rows, key=lambda row: (order.index(row.published.parameter), row.published.strain)))


def _found(fits: tuple[RelaxationFit, ...], strain: float, element: str) -> Quantity | None:
    at_strain = [one for one in fits if abs(one.shear_strain - strain) <= SAME_STRAIN]
    elements = [quantity for fit in at_strain for quantity in fit.elements if quantity.name == element]
    return elements[0] if elements else None
