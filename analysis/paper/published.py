"""Numbers that the paper prints and that are no settings of the model, and the form of a finding; mm, s, mN, kPa, g."""

from dataclasses import dataclass
from typing import Final

from dragrig.analysis import significant_text
from dragrig.config import Capsule, FrictionModelSettings

COULOMB_FORCE_MN: Final = 40.07
"""Mean force of the Coulomb test (Fig. 8)."""
COULOMB_SPEED_MM_S: Final = 0.5
COULOMB_MASS_G: Final = 50.1
COULOMB_DIAMETER_MM: Final = 13.0
"""Diameter of the Coulomb test's capsule, and the diameter to which the fixture opens the gut."""
FRICTION_COEFFICIENT: Final = 0.082
SENSOR_ACCURACY_MN: Final = 5.0
WALL_THICKNESS_MM: Final = 2.5
BOUNDARY_MM_S: Final = 20.0
"""Speed that parts the bands of R²."""
R2_BELOW: Final = 0.8769
R2_ABOVE: Final = 0.1666
SPEEDS_MM_S: Final = (0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 60.0)
"""Speeds of the drag programme; the paper's text names only its range by the axes of its figures."""
LOWEST_MM_S, HIGHEST_MM_S = SPEEDS_MM_S[0], SPEEDS_MM_S[-1]

SKEW_SPEEDS_MM_S: Final = (0.5, 2.0, 5.0, 10.0, 20.0, 60.0)
"""Speeds of the curves of skew resistance, Fig. 7."""
WALL_UNITS: Final = {"E1": "kPa", "E2": "kPa", "E3": "kPa", "eta1": "kPa·s", "eta2": "kPa·s"}
"""Units of the wall's five elements, Table 1."""
ELEMENT_SYMBOLS: Final = {"E1": "E1", "E2": "E2", "E3": "E3", "eta1": "η1", "eta2": "η2"}
"""Elements by their name in the model's settings."""
PAPER_MODEL: Final = FrictionModelSettings()
"""The model as printed: Eq. 14, mucus as published, μ = 0.082."""
PAPER_CAPSULE: Final = Capsule(name="drag", surface="smooth", diameter_mm=12.9, length_mm=15.2, mass_g=COULOMB_MASS_G)
"""The dummy of the drag and relaxation tests."""


@dataclass(frozen=True, slots=True)
class FindingNumber:
    """A computed number with its significant digits; `signed` shows a plus sign too."""

    quantity: str
    value: float
    unit: str = ""
    digits: int = 3
    signed: bool = False

    def __str__(self) -> str:
        sign = "+" if self.signed and self.value > 0 else ""
        return f"{sign}{significant_text(self.value, self.digits)} {self.unit}".strip()


@dataclass(frozen=True, slots=True)
class PaperFinding:
    """One finding."""

    key: str
    """Short name for tables."""
    title: str
    where: str
    """The paper's equations, tables or sections concerned."""
    paper: str
    """The paper's statement, paraphrased."""
    numbers: tuple[FindingNumber, ...]
    shown: str
    """The evidence of the numbers."""
    practice: str
    """dragrig's choice."""

    def value(self, quantity: str) -> float:
        """Return one of the numbers; raises `KeyError` for an unknown quantity."""
        return {number.quantity: number.value for number in self.numbers}[quantity]
