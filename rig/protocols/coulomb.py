"""Constant-speed drag through the gut held open: friction without wall contact pressure."""

from dragrig.config import Fixture
from dragrig.rig import Contact
from dragrig.rig.protocols import StrokeProtocol


class CoulombProtocol(StrokeProtocol):
    """Constant-speed drag through the gut held open: friction without wall contact pressure."""

    kind = "coulomb"
    fixture = Fixture.VACUUM
    contact = Contact.SLIDING
    capsule = "smooth"
