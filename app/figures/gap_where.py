"""Where a gap is, at one glance: channels, protocols and phases as a map, and the excess along each axis."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MultipleLocator

from dragrig.analysis.gap.where.axes import CHANNELS, PROTOCOLS
from dragrig.analysis.gap.where.locate import ALPHA
from dragrig.analysis.gap.where.results import Cell, Location, Where
from dragrig.figures.header import HEADER_IN, fitting, headline
from dragrig.figures.panels import Place, add_panel, width_in
from dragrig.figures.style import BLACK, GREY, PALE, SMALL_PT, TEXT_PT, VERMILLION, drawing, new_figure, text_width_in

WIDTH_IN, LEFT_IN, RIGHT_IN, FOOT_IN = 14.0, 0.45, 0.45, 0.75
CELL_IN, DOMAINS_IN, GAP_IN, NAME_IN = 0.46, 3.3, 1.5, 4.5
BARS_IN, BARS_GAP_IN, BETWEEN_IN, TITLES_IN = 1.9, 0.62, 1.25, 0.55
DEEPEST_SD = 30.0
"""From here on a cell of the map is as dark as it can be."""
LEAST_SD = 0.5
"""Less than this is written faintly."""
LARGE_SD = 6.0
"""From here on what is written in a cell is white."""

AXES = {
    "speed_mm_s": ("Speed (mm/s)", 1.0),
    "position": ("Position (mm)", 1.0),
    "session": ("Session time (min)", 1 / 60),
    "strain": ("Shear strain (%)", 100.0),
    "band_hz": ("Frequency (Hz)", 1.0),
}
"""Titles, and what ends of bins are multiplied by."""

_MAP = LinearSegmentedColormap.from_list("excess", ["#FFFFFF", "#F6C9A8", VERMILLION, "#7A2E00"])


def where_figure(where: Where, name: str = "") -> Figure:
    """Draw where a gap is.

    Above, how far each channel exceeds what is expected of it, in standard deviations, by protocol and phase; beside
    it, how much of the residual each domain accounts for. Below, shares of the excess along speed, position, session,
    strain and frequency; below each panel the narrowest neighbouring bins that have most of it, which are dark where
    they stand out beyond chance.

    Parameters
    ----------
    where
        What `locate` found.
    name
        What the campaign is called.
    """
    rows = _rows(where.cells)
    map_in = CELL_IN * len(rows)
    tall = HEADER_IN + TITLES_IN + max(map_in, 7 * 0.3) + BETWEEN_IN + BARS_IN + FOOT_IN
    labels_in = LEFT_IN + max((text_width_in(_row(row), TEXT_PT) for row in rows), default=0.0) + 0.15
    with drawing():
        figure = new_figure(WIDTH_IN, tall)
        subtitle = fitting(_subtitle(where, name), SMALL_PT, WIDTH_IN - LEFT_IN - RIGHT_IN)
        headline(figure, LEFT_IN, _title(where), subtitle)
        top = tall - HEADER_IN - TITLES_IN
        domains_at = WIDTH_IN - RIGHT_IN - DOMAINS_IN
        wide = domains_at - GAP_IN - labels_in
        _map(add_panel(figure, Place(labels_in, top - map_in, wide, map_in)), where.cells, rows)
        _domains(
            add_panel(figure, Place(domains_at, top - max(map_in, 7 * 0.3), DOMAINS_IN, max(map_in, 7 * 0.3))), where
        )
        room = WIDTH_IN - LEFT_IN - 0.45 - RIGHT_IN
        each = (room - (len(AXES) - 1) * BARS_GAP_IN) / len(AXES)
        for number, (axis, (title, unit)) in enumerate(AXES.items()):
            place = Place(LEFT_IN + 0.45 + number * (each + BARS_GAP_IN), FOOT_IN, each, BARS_IN)
            axes = add_panel(figure, place)
            _bars(axes, where.location(axis), title, unit)
            if number == 0:
                axes.set_ylabel("Share (%)")
        return figure


def _title(where: Where) -> str:
    if not where.present:
        return "No gap beyond noise and repeatability"
    channel, protocol = (where.location(axis).shares for axis in ("channel", "protocol"))
    in_channel, in_runs = (max(shares, key=lambda one: shares[one]) for shares in (channel, protocol))
    share = f"{100 * protocol[in_runs]:.0f} %"
    matter = f", above all a matter of {where.domain}" if where.domain else ""
    return f"Gap in {in_channel}, {share} of it in {in_runs} runs{matter}"


def _subtitle(where: Where, name: str) -> str:
    p = f"p = {where.p:.2g}" if where.p >= 0.001 else "p < 0.001"
    excess = f"excess over what noise, repeatability and tolerance explain: {_sd(where.rms)} standard deviations, {p}"
    return "  ·  ".join(part for part in (fitting(name, SMALL_PT, NAME_IN), excess) if part)


def _rows(cells: Sequence[Cell]) -> list[tuple[str, str]]:
    """Return protocols and channels as a report lists them, those of one's own last."""
    known = [*PROTOCOLS, *(one.protocol for one in cells)], [*CHANNELS, *(one.channel for one in cells)]
    found = {(one.protocol, one.channel) for one in cells}
    return sorted(found, key=lambda row: (known[0].index(row[0]), known[1].index(row[1])))


def _row(row: tuple[str, str]) -> str:
    return f"{row[0]}, {row[1]}"


def _map(axes: Axes, cells: Sequence[Cell], rows: Sequence[tuple[str, str]]) -> None:
    """Draw a cell for each phase of each protocol and channel, its excess in words; hatched where nothing was seen."""
    phases = list(dict.fromkeys(one.phase for one in cells))
    shade = Normalize(0.0, np.log1p(DEEPEST_SD), clip=True)
    for one in cells:
        row, column = rows.index((one.protocol, one.channel)), phases.index(one.phase)
        seen = one.rms is not None
        colour = _MAP(shade(np.log1p(one.rms))) if one.rms is not None else "#FFFFFF"
        axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor=colour, edgecolor="#D3D9DF",
                                 hatch=None if seen else "///"))  # fmt: skip
        if one.rms is not None:
            faint, dark = one.rms < LEAST_SD, one.rms >= LARGE_SD
            axes.text(column, row, _sd(one.rms), ha="center", va="center", fontsize=SMALL_PT,
                      color="white" if dark else GREY if faint else BLACK)  # fmt: skip
    axes.set_xlim(-0.5, len(phases) - 0.5)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xticks(range(len(phases)), phases)
    axes.set_yticks(range(len(rows)), [_row(row) for row in rows], fontsize=TEXT_PT)
    axes.tick_params(length=0)
    axes.grid(visible=False)
    axes.set_title("Excess in standard deviations of what is expected", loc="left", fontsize=TEXT_PT)


def _sd(value: float) -> str:
    if value < 0.05:
        return "0"
    return f"{value:.1f}" if value < 10 else f"{value:.0f}"


def _domains(axes: Axes, where: Where) -> None:
    """Draw how much of the residual follows from other runs by each coordinate."""
    axes.set_title("Follows from other runs by", loc="left", fontsize=TEXT_PT)
    if not where.domain_scores:
        _say_nothing(axes, "no gap")
        return
    names = sorted(where.domain_scores, key=lambda one: where.domain_scores[one])
    scores = [100 * where.domain_scores[one] for one in names]
    colours = [VERMILLION if one == where.domain else PALE for one in names]
    axes.barh(range(len(names)), scores, color=colours, height=0.7)
    axes.set_yticks(range(len(names)), names)
    axes.set_xlim(0, 100)
    axes.xaxis.set_major_locator(MultipleLocator(25))
    axes.set_xlabel("of the residual's squares (%)", fontsize=SMALL_PT)
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)


def _bars(axes: Axes, location: Location, title: str, unit: float) -> None:
    """Draw shares along an axis; the narrowest bins that have most of the excess stand out."""
    axes.set_title(title, loc="left", fontsize=TEXT_PT)
    if location.low is None or location.high is None:
        _say_nothing(axes, "no excess here")
        return
    low, high = location.low, location.high
    inside = [one.low is not None and one.high is not None and one.low >= low and one.high <= high
              for one in location.bins]  # fmt: skip
    colours = [VERMILLION if most and location.p < ALPHA else PALE for most in inside]
    axes.bar(range(len(location.bins)), [100 * one.share for one in location.bins], color=colours, width=0.86)
    _ticks(axes, location, unit)
    axes.set_ylim(0, 118 * max(one.share for one in location.bins))
    axes.grid(visible=False, axis="x")
    axes.set_xlabel(_words(location, unit), fontsize=SMALL_PT, color=VERMILLION if location.p < ALPHA else GREY)


def _ticks(axes: Axes, location: Location, unit: float) -> None:
    """Name levels below their bars, and ends of bins between them, as many as there is room for."""
    levels = all(one.low == one.high for one in location.bins)
    ends = [one.low for one in location.bins] + ([] if levels else [location.bins[-1].high])
    words = [_number(unit * end) for end in ends if end is not None]
    places = np.arange(len(words)) - (0.0 if levels else 0.5)
    room = width_in(axes) / max(len(location.bins), 1)
    step = max(1, int(np.ceil((max(text_width_in(word, SMALL_PT) for word in words) + 0.08) / room)))
    shown = sorted({*range(0, len(words) - step, step), len(words) - 1})
    axes.set_xticks(places[shown].tolist(), [words[one] for one in shown])
    axes.set_xlim(-0.6, len(location.bins) - 0.4)


def _words(location: Location, unit: float) -> str:
    ends = [_number(unit * end) for end in (location.low, location.high) if end is not None]
    where = ends[0] if ends[0] == ends[-1] else f"{ends[0]} to {ends[-1]}"
    chance = "p < 0.002" if location.p <= 0.001 else f"p = {location.p:.2g}"
    return f"{100 * location.share:.0f} % in {where}, {chance}"


def _number(value: float) -> str:
    return f"{value:.3g}"


def _say_nothing(axes: Axes, words: str) -> None:
    axes.text(0.5, 0.5, words, transform=axes.transAxes, ha="center", va="center", color=GREY)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(visible=False)
