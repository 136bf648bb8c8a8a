"""The velocity-dependent friction model as pure functions of motion and parameters.

`prepare` gives the force of an acquisition at any sample times, `steady_forces` and `skew_resistance` the
paper's curves, `wall_parameters` and `disagreement` the two published parameter sets, `model_wall` those of a model.
"""

from dragrig.sim_backend.friction.motion import Motion, ProfileMotion
from dragrig.sim_backend.friction.prepared import PreparedForce, prepare
from dragrig.sim_backend.friction.recorded import RecordedMotion
from dragrig.sim_backend.friction.sliding import Components
from dragrig.sim_backend.friction.steady import SteadyForces, skew_resistance, steady_forces
from dragrig.sim_backend.friction.wall import (
    Disagreement,
    WallKind,
    WallParameters,
    disagreement,
    model_wall,
    wall_parameters,
)

__all__ = [
    "Components",
    "Disagreement",
    "Motion",
    "PreparedForce",
    "ProfileMotion",
    "RecordedMotion",
    "SteadyForces",
    "WallKind",
    "WallParameters",
    "disagreement",
    "model_wall",
    "prepare",
    "skew_resistance",
    "steady_forces",
    "wall_parameters",
]
