"""Runs as the blind plant takes them in a list."""


def table(kind: str, start_s: float, **settings: float) -> dict[str, str | float]:
    stroke = {"speed_mm_s": 5.0, "travel_mm": 40.0, "accel_mm_s2": 400.0}
    ramp = {"ramp_speed_mm_s": 20.0, "ramp_accel_mm_s2": 2000.0, "shear_strain": 1.0}
    usual = {"rest_s": 1.0, "hold_s": 3.0, "dwell_s": 60.0}
    return {"kind": kind, "start_s": start_s, **usual, **(ramp if kind == "relaxation" else stroke), **settings}
