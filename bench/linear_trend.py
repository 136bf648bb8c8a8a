"""Friction that is constant but for a linear trend with slip."""

from collections.abc import Mapping

from dragrig.analysis.models import ChannelModel, MotionState, Parameter
from dragrig.rig.profile import FloatArray


class LinearTrend(ChannelModel):
    """What is taken off a velocity step before anything else."""

    name = "linear trend"
    zero_sd_mN = 0.0
    parameters = (
        Parameter("friction_mN", "mN", 500.0, 1.0, meaning="friction where the run begins"),
        Parameter("trend_mN_mm", "mN/mm", 0.0, 100.0, positive=False, meaning="by how much it grows with slip"),
    )

    def predict(self, values: Mapping[str, float], at: MotionState) -> FloatArray:
        """Return level and trend."""
        return values["friction_mN"] + values["trend_mN_mm"] * at.position_mm


MODEL = LinearTrend()
