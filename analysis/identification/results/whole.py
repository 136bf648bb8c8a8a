"""All of it."""

from dataclasses import dataclass

from dragrig.analysis.identification.results.joint import JointFit
from dragrig.analysis.identification.results.quantity import LeftOut
from dragrig.analysis.identification.results.relaxation import Relaxation
from dragrig.analysis.identification.results.sliding import Coulomb, Drag


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """All that a campaign says of one specimen; parts that it does not support are None, with the reason."""

    specimen: str
    used: tuple[str, ...]
    left_out: tuple[LeftOut, ...]
    joint: JointFit | None
    relaxation: Relaxation | None
    coulomb: Coulomb | None
    drag: Drag | None
    remarks: tuple[str, ...] = ()
