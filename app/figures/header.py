"""The lines above a picture of a run: what it is, where it came from, how it ended."""

from bisect import bisect_right
from collections.abc import Mapping

from matplotlib.figure import Figure
from matplotlib.text import Text

from dragrig.figures.style import BLACK, BLUE, GREY, PURPLE, SMALL_PT, TITLE_PT, VERMILLION, text_width_in
from dragrig.rig.runfile.model import Attribute, RunInfo, Status

HEADER_IN = 1.0
"""Height of a header without trouble."""

_BADGES = {"simulated": PURPLE, "hardware": BLUE, "external": GREY}
_KINDS = {
    "drag": "Drag",
    "coulomb": "Coulomb friction",
    "blank": "Blank run",
    "return": "Return",
    "motion": "Motion",
    "relaxation": "Relaxation",
}
_LINE_IN = 0.3


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


def trouble_of(info: RunInfo, bad_reason: str | None = None) -> str:
    """Say what is wrong with a run: that it was marked bad, or how it ended early; empty for a good one."""
    if bad_reason is not None:
        return f"marked bad: {bad_reason}"
    if info.status is Status.COMPLETE:
        return ""
    return f"{info.status}: {info.reason}" if info.reason else str(info.status)


def header_in(trouble: str) -> float:
    """Height of the header [inch]: trouble has a line of its own."""
    return HEADER_IN + (_LINE_IN if trouble else 0.0)


def headline(figure: Figure, left_in: float, title: str, subtitle: str) -> Text:
    """Write title and subtitle at the figure's upper edge, and return the subtitle."""
    width, height = figure.get_size_inches()
    left = left_in / width
    figure.text(left, 1 - 0.5 / height, title, fontsize=TITLE_PT, fontweight="bold", color=BLACK, va="baseline")
    return figure.text(left, 1 - 0.84 / height, subtitle, fontsize=SMALL_PT, color=GREY, va="baseline")


def write_header(figure: Figure, left_in: float, info: RunInfo, trouble: str) -> None:
    """Write title, subtitle and trouble at the figure's upper edge, and a badge for the backend in its corner."""
    complete = "  ·  complete" if info.status is Status.COMPLETE else ""
    headline(figure, left_in, title_of(info), subtitle_of(info) + complete)
    write_trouble(figure, left_in, trouble)
    write_badge(figure, info.header.backend)


def write_trouble(figure: Figure, left_in: float, trouble: str) -> None:
    """Write what is wrong below the subtitle, as much of it as fits."""
    width, height = figure.get_size_inches()
    figure.text(
        left_in / width,
        1 - (0.84 + _LINE_IN) / height,
        fitting(trouble, SMALL_PT, width - left_in - 0.45),
        fontsize=SMALL_PT,
        fontweight="bold",
        color=VERMILLION,
        va="baseline",
    )


def write_badge(figure: Figure, backend: str) -> None:
    """Say in the figure's corner whether it shows simulated, measured or foreign data."""
    width, height = figure.get_size_inches()
    figure.text(
        1 - 0.45 / width,
        1 - 0.43 / height,
        backend.upper(),
        fontsize=SMALL_PT,
        fontweight="bold",
        color="white",
        ha="right",
        va="center",
        bbox={"boxstyle": "round,pad=0.45", "facecolor": _BADGES.get(backend, BLACK), "edgecolor": "none"},
    )


def fitting(text: str, size_pt: float, room_in: float) -> str:
    """Return the text on one line, cut off with an ellipsis where it would be wider than the room for it."""
    text = " ".join(text.split())
    bold = 1.15
    if bold * text_width_in(text, size_pt) <= room_in:
        return text
    kept = bisect_right(range(len(text)), room_in, key=lambda count: bold * text_width_in(text[:count] + "…", size_pt))
    return text[: kept - 1].rstrip() + "…"


def _number(parameters: Mapping[str, Attribute], name: str) -> float | None:
    value = parameters.get(name)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
