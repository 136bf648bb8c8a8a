"""The stage moves with nothing attached: the record shows the rig alone."""

from dragrig.config import Fixture
from dragrig.rig import Contact
from dragrig.rig.protocols import StrokeProtocol


class BlankProtocol(StrokeProtocol):
    """The stage moves with nothing attached: the record shows the rig alone."""

    kind = "blank"
    fixture = Fixture.NONE
    contact = Contact.NONE
    capsule = "none"
