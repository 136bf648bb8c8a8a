"""What a run file says of itself, in words: settings, and what was checked right after the run."""

from collections.abc import Mapping
from typing import Final

from dragrig.reports.tabular import plainly
from dragrig.rig.runfile.model import Attribute, RunInfo

UNITS: Final = {
    "_mm_s2": "mm/s²",
    "_mm_s": "mm/s",
    "_mm2": "mm²",
    "_deg": "°",
    "_kPa": "kPa",
    "_um": "µm",
    "_mN": "mN",
    "_mm": "mm",
    "_hz": "Hz",
    "_g": "g",
    "_s": "s",
}
"""Endings of names and the units that they stand for, longer ones first."""
_NAMES: Final = {"accel": "acceleration", "mass": "mass", "rest": "rest before", "hold": "hold after"}
_TIMES: Final = "%Y-%m-%d %H:%M:%S %z"


def values_in_words(values: Mapping[str, Attribute]) -> dict[str, str]:
    """Return attributes as a person reads them: `speed_mm_s = 5.0` as "speed": "5 mm/s"."""
    return {_label(name): _said(name, value) for name, value in values.items() if value != ""}


def checks_in_words(checks: Mapping[str, Attribute]) -> dict[str, str]:
    """Say what was looked at right after the run, each with what was seen."""
    told = {key: value for key, value in checks.items() if key not in {"slip_time_s", "following_error_mm"}}
    words = values_in_words({key: float(f"{one:.3g}") if isinstance(one, float) else one for key, one in told.items()})
    following, slip = checks.get("following_error_mm"), checks.get("slip_time_s")
    if isinstance(following, int | float):
        words["largest distance from the command"] = f"{1000 * following:.1f} µm"
    if isinstance(slip, int | float):
        words["slip during the hold"] = f"at {slip:.1f} s" if slip >= 0 else "none seen"
    return words


def recorded_in_words(info: RunInfo) -> dict[str, str]:
    """Say when, by whom and with what a run was recorded."""
    header, entry = info.header, info.header.entry
    told = {
        "Run": header.run_id,
        "Began": f"{header.start_time:{_TIMES}}",
        "Ended": "" if info.end_time is None else f"{info.end_time:{_TIMES}}",
        "Operator": str(entry.get("operator", "")),
        "Note": str(entry.get("note", "")),
        "Plan": str(entry.get("plan", "")),
        "Samples": f"{info.samples} at {plainly(header.sample_rate_hz)} Hz",
        "Channels": ", ".join(f"{one.name} ({one.units})" for one in header.channels),
        "Software": str(entry.get("software", "")),
        "SHA-256 of the samples": info.raw_sha256,
    }
    return {name: value for name, value in told.items() if value}


def further_in_words(info: RunInfo) -> dict[str, str]:
    """Say what else stands in the file's head."""
    said = {"operator", "note", "plan", "software"}
    return values_in_words({key: value for key, value in info.header.entry.items() if key not in said})


def _label(name: str) -> str:
    ending = _ending(name)
    bare = name.removesuffix(ending)
    return _NAMES.get(bare, bare.replace("_", " "))


def _said(name: str, value: Attribute) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value
    unit = UNITS.get(_ending(name), "")
    number = str(value) if isinstance(value, int) else plainly(value)
    if name == "shear_strain":
        return f"{plainly(100 * value)} %"
    return f"{number}{'' if unit == '°' else ' '}{unit}".rstrip()


def _ending(name: str) -> str:
    return next((one for one in UNITS if name.endswith(one) and name != one[1:]), "")
