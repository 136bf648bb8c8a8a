"""The stage moves with nothing attached: the record shows the rig alone."""

from typing import ClassVar

from dragrig.config import Fixture
from dragrig.rig import Contact
from dragrig.rig.protocols import StrokeProtocol


class BlankProtocol(StrokeProtocol):
    """The stage moves with nothing attached: the record shows the rig alone."""

    kind: ClassVar[str] = "blank"
    fixture: ClassVar[Fixture] = Fixture.NONE
    contact: ClassVar[Contact] = Contact.NONE
    capsule: ClassVar[str] = "none"
