"""From a planned run to what devices are armed with."""

from dataclasses import replace
from uuid import uuid4

from dragrig.config.specimen import Fixture
from dragrig.rig.devices import Acquisition, Contact
from dragrig.rig.profile import MotionProfile
from dragrig.rig.programme import PlannedRun


def recorded(order: int, run: PlannedRun, dwell_s: float) -> Acquisition:
    """Return the acquisition of a run whose contact is `dwell_s` old at its first sample."""
    return Acquisition(
        run_id=str(uuid4()),
        order=order,
        kind=run.protocol.kind,
        profile=run.profile,
        capsule=run.capsule,
        specimen=run.specimen,
        fixture=run.fixture,
        contact=run.contact,
        insertion_dwell_s=dwell_s,
        shear_strain=run.shear_strain,
        sheared_from=run.sheared_from,
    )


def unrecorded(order: int, kind: str, run: PlannedRun, profile: MotionProfile) -> Acquisition:
    """Return what is made for a run beside it, with the capsule clear of the gut: a tare, the way to its start."""
    free = replace(run, profile=profile, contact=Contact.NONE, fixture=Fixture.NONE)
    return replace(recorded(order, free, 0.0), kind=kind, recorded=False)
