"""The lines above a picture of a run: what it is, where it came from, how it ended."""

from collections.abc import Mapping

from matplotlib.figure import Figure
from matplotlib.text import Text

from dragrig.figures.style import BLACK, BLUE, GREY, PURPLE, SMALL_PT, TITLE_PT, VERMILLION
from dragrig.rig.runfile.model import Attribute, RunInfo, Status

HEADER_IN = 1.0
"""Height of the header."""

_BADGES = {"simulated": PURPLE, "hardware": BLUE, "external": GREY}
_KINDS = {
    "drag": "Drag",
    "coulomb": "Coulomb friction",
    "blank": "Blank run",
    "return": "Return",
    "motion": "Motion",
    "relaxation": "Relaxation",
}
_LONGEST_REASON = 70


def title_of(info: RunInfo) -> str:
    """Say in a few words what a run is: its kind, its speed or strain, its specimen."""
    kind = _KINDS.get(info.kind, info.kind.replace("_", " ").capitalize())
    parameters = info.header.protocol
    speed, strain = _number(parameters, "speed_mm_s"), _number(parameters, "shear_strain")
    if info.kind == "relaxation" and strain is not None:
        kind += f" at {100 * strain:g} % shear strain"
    elif speed is not None:
        kind += f" at {speed:g} mm/s"
    name = str(info.header.specimen.get("name", "")).strip()
    return f"{kind} · {name}" if name else kind


def subtitle_of(info: RunInfo) -> str:
    """Say when a run began and which file it is."""
    began = info.header.start_time.strftime("%Y-%m-%d %H:%M:%S")
    offset = info.header.start_time.isoformat()[-6:]
    return f"{began} {offset}  ·  run {info.header.run_id[:8]}  ·  {info.path.name}"


def status_of(info: RunInfo, bad_reason: str = "") -> tuple[str, str]:
    """Return how a run ended in words, and the colour to write it in."""
    if bad_reason:
        return _shortened(f"marked bad: {bad_reason}"), VERMILLION
    if info.status is Status.COMPLETE:
        return "complete", GREY
    text = f"{info.status}: {info.reason}" if info.reason else str(info.status)
    return _shortened(text), VERMILLION


def headline(figure: Figure, left_in: float, title: str, subtitle: str) -> Text:
    """Write title and subtitle at the figure's upper edge, and return the subtitle."""
    width, height = figure.get_size_inches()
    left = left_in / width
    figure.text(left, 1 - 0.5 / height, title, fontsize=TITLE_PT, fontweight="bold", color=BLACK, va="baseline")
    return figure.text(left, 1 - 0.84 / height, subtitle, fontsize=SMALL_PT, color=GREY, va="baseline")


def write_header(
    figure: Figure, left_in: float, title: str, subtitle: str, status: tuple[str, str], badge: str
) -> None:
    """Write title, subtitle and status at the figure's upper edge, and the badge of the backend in its corner."""
    width, height = figure.get_size_inches()
    right = 1 - 0.45 / width
    second = headline(figure, left_in, title, subtitle)
    words, colour = status
    weight = "normal" if colour == GREY else "bold"
    after = second.get_window_extent().x1 / figure.dpi
    figure.text(
        after / width, 1 - 0.84 / height, f"  ·  {words}", fontsize=SMALL_PT, color=colour, weight=weight, va="baseline"
    )
    if badge:
        figure.text(
            right,
            1 - 0.43 / height,
            badge.upper(),
            fontsize=SMALL_PT,
            fontweight="bold",
            color="white",
            ha="right",
            va="center",
            bbox={"boxstyle": "round,pad=0.45", "facecolor": _BADGES.get(badge, BLACK), "edgecolor": "none"},
        )


def _number(parameters: Mapping[str, Attribute], name: str) -> float | None:
    value = parameters.get(name)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _shortened(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= _LONGEST_REASON else text[: _LONGEST_REASON - 1].rstrip() + "…"
