"""Constant-speed drag through the gut closed around the capsule."""

from dragrig.config import Fixture
from dragrig.rig import Contact
from dragrig.rig.protocols import StrokeProtocol


class DragProtocol(StrokeProtocol):
    """Constant-speed drag through the gut closed around the capsule."""

    kind = "drag"
    fixture = Fixture.FOAM
    contact = Contact.SLIDING
    capsule = "drag"
