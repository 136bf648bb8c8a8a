"""Everything in the paper that does not fit together, in the paper's order."""

from functools import cache

from dragrig.analysis.paper import (
    contact,
    coulomb_test,
    determination,
    friction,
    high_speed,
    pressure,
    relaxation_test,
    wall,
)
from dragrig.analysis.paper.finding import Finding

_SUBJECTS = (wall, relaxation_test, contact, pressure, friction, coulomb_test, determination, high_speed)


@cache
def findings() -> tuple[Finding, ...]:
    """Compute all findings, by the model as printed."""
    return tuple(one for subject in _SUBJECTS for one in subject.findings())
