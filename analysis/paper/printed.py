"""Numbers that the paper prints and that are no settings of the model; units mm, s, mN, kPa, g."""

from typing import Final

from dragrig.config.capsule import Capsule
from dragrig.config.model import FrictionModelSettings

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

MODEL: Final = FrictionModelSettings()
"""The model as printed: Eq. 14, mucus as published, μ = 0.082."""
CAPSULE: Final = Capsule(name="drag", surface="smooth", diameter_mm=12.9, length_mm=15.2, mass_g=COULOMB_MASS_G)
"""The dummy of the drag and relaxation tests."""
