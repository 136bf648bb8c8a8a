"""Campaigns with hidden effects: a separate plant that examines the diagnosis.

The nominal equations are written a second time here, and no formula of an effect is shared with the catalogue.
"""

from dragrig.sim_backend.blind.blind_campaign import (
    BlindCampaign,
    draw_campaign,
    parallel_session,
    true_answer,
    without_effects,
)
from dragrig.sim_backend.blind.effects import CATALOGUE, OUTSIDE, effect_group
from dragrig.sim_backend.blind.plant import EffectSignature, effect_signatures, write_campaign
from dragrig.sim_backend.blind.run_plans import RunList

__all__ = [
    "CATALOGUE",
    "OUTSIDE",
    "BlindCampaign",
    "EffectSignature",
    "RunList",
    "draw_campaign",
    "effect_group",
    "effect_signatures",
    "parallel_session",
    "true_answer",
    "without_effects",
    "write_campaign",
]
