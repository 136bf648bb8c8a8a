"""The simulated rig behind the device protocols of `dragrig.rig.devices`."""

from dragrig.sim_backend.devices.faults import (
    DriveFault,
    Faults,
    FollowError,
    ForceSpike,
    LimitSwitch,
    LostSamples,
    Runaway,
    StaleData,
    StuckEncoder,
)
from dragrig.sim_backend.devices.simulated_backend import SimulatedBackend, open_backend

__all__ = [
    "DriveFault",
    "Faults",
    "FollowError",
    "ForceSpike",
    "LimitSwitch",
    "LostSamples",
    "Runaway",
    "SimulatedBackend",
    "StaleData",
    "StuckEncoder",
    "open_backend",
]
