"""Constant-speed drag through the gut held open: friction without wall contact pressure."""

from typing import ClassVar

from dragrig.config import Fixture
from dragrig.rig import Contact
from dragrig.rig.protocols import StrokeProtocol


class CoulombProtocol(StrokeProtocol):
    """Constant-speed drag through the gut held open: friction without wall contact pressure."""

    kind: ClassVar[str] = "coulomb"
    fixture: ClassVar[Fixture] = Fixture.VACUUM
    contact: ClassVar[Contact] = Contact.SLIDING
    capsule: ClassVar[str] = "smooth"
