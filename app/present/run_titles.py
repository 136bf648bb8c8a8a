"""Title, subtitle and problem of a run, for its figure and its document."""

from collections.abc import Mapping

from dragrig.rig import Attribute, RunInfo, RunStatus

_KIND_TITLES = {
    "drag": "Drag",
    "coulomb": "Coulomb friction",
    "blank": "Blank run",
    "return": "Return",
    "motion": "Motion",
    "relaxation": "Relaxation",
}


def run_title(info: RunInfo) -> str:
    """Say in a few words what a run is: its kind, its speed or strain, its specimen."""
    kind = _KIND_TITLES.get(info.kind, info.kind.replace("_", " ").capitalize())
    parameters = info.header.protocol
    speed, strain = _numeric_attribute(parameters, "speed_mm_s"), _numeric_attribute(parameters, "shear_strain")
    if info.kind == "relaxation" and strain is not None:
        kind += f" at {100 * strain:g} % shear strain"
    elif speed is not None:
        kind += f" at {speed:g} mm/s"
    name = str(info.header.specimen.get("name", "")).strip()
    return f"{kind} · {name}" if name else kind


def run_subtitle(info: RunInfo) -> str:
    """Say when a run began and which file it is."""
    began = info.header.start_time.strftime("%Y-%m-%d %H:%M:%S")
    offset = info.header.start_time.isoformat()[-6:]
    return f"{began} {offset}  ·  run {info.header.run_id[:8]}  ·  {info.path.name}"


def run_problem(info: RunInfo, bad_reason: str | None = None) -> str:
    """Say what is wrong with a run: that it was marked bad, or how it ended early; empty for a good one."""
    if bad_reason is not None:
        return f"marked bad: {bad_reason}"
    if info.status is RunStatus.COMPLETE:
        return ""
    return f"{info.status}: {info.reason}" if info.reason else str(info.status)


def _numeric_attribute(parameters: Mapping[str, Attribute], name: str) -> float | None:
    value = parameters.get(name)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
