"""The simulated rig behind the device protocols of `dragrig.rig.devices`."""

from dragrig.sim_backend.devices.simulated_backend import SimulatedBackend, open_backend

__all__ = ["SimulatedBackend", "open_backend"]
