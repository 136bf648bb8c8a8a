"""Runs of a single stroke at constant speed, which differ in what holds the gut and in the capsule."""

from dragrig.config import Fixture
from dragrig.rig import Contact
from dragrig.rig.protocols import StrokeProtocol


class DragProtocol(StrokeProtocol):
    """Constant-speed drag through the gut closed around the capsule."""

    kind = "drag"
    fixture = Fixture.FOAM
    contact = Contact.SLIDING
    capsule = "drag"


class CoulombProtocol(StrokeProtocol):
    """Constant-speed drag through the gut held open: friction without wall contact pressure."""

    kind = "coulomb"
    fixture = Fixture.VACUUM
    contact = Contact.SLIDING
    capsule = "smooth"


class BlankProtocol(StrokeProtocol):
    """The stage moves with nothing attached: the record shows the rig alone."""

    kind = "blank"
    fixture = Fixture.NONE
    contact = Contact.NONE
    capsule = "none"
