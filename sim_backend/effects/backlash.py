"""Play between the drive and its load."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import (
    Coordinate,
    Location,
    MotorEffect,
    PositionForm,
    Values,
    behind_by_play,
    shape,
    size,
)


class Backlash(MotorEffect):
    """The payload is left behind by a play's width after each reversal of the drive, at any speed."""

    id = "backlash"
    location = Location.MOTOR
    coordinate = Coordinate.POSITION
    summary = "Play in screw, gear or coupling: after a reversal the payload stays until the play is taken up."
    visible_in = "position against command in strokes there and back: one way it is behind by the play"
    source = "Nordin and Gutman, Controlling mechanical systems with backlash: a survey, Automatica 38 (2002) 1633"
    position_form = PositionForm.PLAY
    parameters = (
        size("play_mm", "mm", 0.1, 0.0, 5.0, "width of the play"),
        shape(
            "taken_up",
            "1",
            0.0,
            0.0,
            1.0,
            "share of it that is taken up as a run begins, towards its first motion",
            grid=(0.02, 0.25, 0.5, 0.75, 0.98),
            bounds=(0.0, 1.0),
        ),
    )

    def stage_position(self, time_s: FloatArray, command_mm: FloatArray, values: Values) -> FloatArray:
        return np.asarray(command_mm + behind_by_play(command_mm, values["play_mm"], values["taken_up"]))
