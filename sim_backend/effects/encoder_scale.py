"""An encoder whose counts times pitch is not the distance."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, EncoderEffect, Location, PositionForm, Values, size


class EncoderScale(EncoderEffect):
    """The recorded position is the true one times `1 + scale_error`."""

    id = "encoder_scale"
    location = Location.ACQUISITION
    coordinate = Coordinate.POSITION
    summary = "The encoder's counts times its pitch are not the distance travelled."
    visible_in = "position against command, in proportion to the distance"
    source = "error of scale; Slocum, Precision Machine Design, chapter 4"
    confused_with = ("velocity_ripple",)
    position_form = PositionForm.SCALE
    parameters = (size("scale_error", "1", 0.002, -0.1, 0.1, "relative error of scale"),)

    def counted_position(self, time_s: FloatArray, position_mm: FloatArray, values: Values) -> FloatArray:
        return np.asarray(position_mm * (1 + values["scale_error"]))
