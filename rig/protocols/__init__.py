"""One file per kind of run: a validated description that yields its motion."""

from dragrig.rig.protocols.run_protocol import RunProtocol, expand_sweep, protocol_kinds

__all__ = ["RunProtocol", "expand_sweep", "protocol_kinds"]
