"""One file per kind of run: a validated description that yields its motion."""

from dragrig.rig.protocols.base import Protocol
from dragrig.rig.protocols.catalogue import kinds, swept

__all__ = ["Protocol", "kinds", "swept"]
