"""A short first plan, and the effect that it leaves open."""

from dragrig.config.plan import Plan

FIRST = Plan.model_validate(
    {
        "name": "few",
        "steps": [
            {"kind": "relaxation", "shear_strain": 1.0, "hold_s": 10.0, "wait_s": 5.0},
            {"kind": "drag", "speed_mm_s": [20.0, 5.0, 60.0], "travel_mm": 20.0, "wait_s": 10.0},
        ],
    }
)
EFFECT = "stribeck:ratio=0.3"
