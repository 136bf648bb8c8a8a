"""What an identification says, as values; every number stands with its uncertainty or is missing with the reason."""

from dragrig.analysis.identification.results.joint import DOUBTFUL, Identified, JointFit, RunResidual
from dragrig.analysis.identification.results.quantity import LeftOut, Quantity, counted
from dragrig.analysis.identification.results.relaxation import ElementsTest, Relaxation, RelaxationFit, StrainLaw
from dragrig.analysis.identification.results.sliding import (
    Boundary,
    Coulomb,
    CoulombRun,
    Determination,
    Drag,
    LogLaw,
    SpeedPoint,
)
from dragrig.analysis.identification.results.whole import Identification

__all__ = [
    "DOUBTFUL",
    "Boundary",
    "Coulomb",
    "CoulombRun",
    "Determination",
    "Drag",
    "ElementsTest",
    "Identification",
    "Identified",
    "JointFit",
    "LeftOut",
    "LogLaw",
    "Quantity",
    "Relaxation",
    "RelaxationFit",
    "RunResidual",
    "SpeedPoint",
    "StrainLaw",
    "counted",
]
