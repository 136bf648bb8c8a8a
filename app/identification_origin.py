"""Where the values of an identified model come from, as its file keeps it."""

from dragrig.analysis.identification.results import Identification, Identified, JointFit
from dragrig.config.identified import IdentifiedSettings, IdentifiedValue
from dragrig.rig.header import software


def origin(result: Identification, joint: JointFit, campaign: str) -> IdentifiedSettings:
    """Return what the file of an identified model says of where its values come from."""
    return IdentifiedSettings(
        campaign=campaign,
        specimen=result.specimen,
        runs=len(result.used),
        software=software(),
        converged=joint.converged,
        chi2_per_degree=joint.chi2 / joint.degrees,
        parameters=tuple(_value(one) for one in joint.parameters),
        combinations=tuple(_value(one) for one in joint.combinations),
        correlation=tuple(tuple(row) for row in joint.correlation.round(4).tolist()),
    )


def _value(one: Identified) -> IdentifiedValue:
    return IdentifiedValue(
        name=one.name,
        unit=one.unit,
        value=one.value,
        standard_error=one.standard_error,
        low=one.interval[0],
        high=one.interval[1],
        learnt=one.learnt,
        determined=one.determined,
    )
