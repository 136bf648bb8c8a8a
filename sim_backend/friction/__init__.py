"""The velocity-dependent friction model as pure functions of motion and parameters.

`prepare` gives the force of an acquisition at any sample times, `steady_forces` and `skew_resistance` the paper's
curves, `wall_parameters` and `parameter_set_differences` the two published parameter sets, `model_wall` the wall of a
model.
"""

from dragrig.sim_backend.friction.friction_force import (
    Components,
    PreparedForce,
    SteadyFriction,
    prepare,
    skew_resistance,
    steady_forces,
)
from dragrig.sim_backend.friction.motion import Motion, ProfileMotion, RecordedMotion
from dragrig.sim_backend.friction.wall import (
    ParameterSetDifference,
    WallKind,
    WallParameters,
    model_wall,
    parameter_set_differences,
    wall_parameters,
)

__all__ = [
    "Components",
    "Motion",
    "ParameterSetDifference",
    "PreparedForce",
    "ProfileMotion",
    "RecordedMotion",
    "SteadyFriction",
    "WallKind",
    "WallParameters",
    "model_wall",
    "parameter_set_differences",
    "prepare",
    "skew_resistance",
    "steady_forces",
    "wall_parameters",
]
