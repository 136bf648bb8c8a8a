"""Constant-speed drag through the gut closed around the capsule."""

from typing import ClassVar

from dragrig.config import Fixture
from dragrig.rig import Contact
from dragrig.rig.protocols import StrokeProtocol


class DragProtocol(StrokeProtocol):
    """Constant-speed drag through the gut closed around the capsule."""

    kind: ClassVar[str] = "drag"
    fixture: ClassVar[Fixture] = Fixture.FOAM
    contact: ClassVar[Contact] = Contact.SLIDING
    capsule: ClassVar[str] = "drag"
