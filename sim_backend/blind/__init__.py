"""Campaigns whose hidden effects are known to nobody else: a plant of its own for examining a diagnosis.

The nominal equations are written a second time here, and no formula of an effect is shared with a catalogue.
"""

from dragrig.sim_backend.blind.effects import CATALOGUE, OUTSIDE
from dragrig.sim_backend.blind.files import make
from dragrig.sim_backend.blind.programme import Listed
from dragrig.sim_backend.blind.record import Signature, signature
from dragrig.sim_backend.blind.secret import Secret, another_session, answer, draw, without_effects

__all__ = [
    "CATALOGUE",
    "OUTSIDE",
    "Listed",
    "Secret",
    "Signature",
    "another_session",
    "answer",
    "draw",
    "make",
    "signature",
    "without_effects",
]
