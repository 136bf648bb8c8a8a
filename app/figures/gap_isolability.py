"""What runs can tell apart, as a matrix of effects."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from dragrig.analysis.gap.isolability.results import CLOSE, Isolability, Pair
from dragrig.analysis.gap.isolability.sentences import isolability_sentences
from dragrig.analysis.gap.seen import SEEN
from dragrig.analysis.gap.sentences import name_of
from dragrig.figures.header import fitting, headline
from dragrig.figures.panels import Place, add_panel
from dragrig.figures.style import BLACK, BLUE, GREY, SMALL_PT, TEXT_PT, drawing, new_figure, text_width_in

CELL_IN, HEAD_IN, EDGE_IN, FOOT_IN = 0.56, 1.25, 0.45, 0.9
CELL_PT = 10.5
FAR_D_PRIME = 1000.0
"""From here on d′ is as faint as it can be."""
DARK = 0.55
"""Shades beyond this bear white words."""
LINE = "#D3D9DF"

_NEAR = LinearSegmentedColormap.from_list("near", ["#FFFFFF", "#BFD9EA", BLUE, "#002B45"])


def isolability_figure(found: Isolability) -> Figure:
    """Draw every two effects of the force against each other: sin² below the diagonal, d′ above it.

    Dark cells are near; a thick frame marks what the runs hardly tell apart.
    """
    names = [one.effect for one in found.of_channel("force")]
    words = [name_of(one) for one in names]
    with drawing():
        label_in = max((text_width_in(one, TEXT_PT) for one in words), default=1.0) + 0.2
        side = CELL_IN * max(len(names), 1)
        width = max(EDGE_IN + label_in + side + EDGE_IN, 9.0)
        figure = new_figure(width, HEAD_IN + label_in + side + FOOT_IN)
        said = fitting(isolability_sentences(found)[0], SMALL_PT, width - 2 * EDGE_IN)
        headline(figure, EDGE_IN, f"What {found.source} can tell apart", said)
        axes = add_panel(figure, Place(EDGE_IN + label_in, FOOT_IN, side, side))
        for row, one in enumerate(names):
            axes.add_patch(Rectangle((row - 0.5, row - 0.5), 1, 1, facecolor="#F1F3F5", edgecolor=LINE))
            for column, other in enumerate(names[:row]):
                pair = found.pair(one, other)
                if pair is not None:
                    _cells(axes, row, column, pair)
        _ticks(axes, words)
        _legend(figure)
        return figure


def _cells(axes: Axes, row: int, column: int, pair: Pair) -> None:
    near = 1.0 - float(np.sqrt(max(pair.sin2, 0.0)))
    _cell(axes, column, row, near, f"{100 * pair.sin2:.0f}", framed=pair.confused)
    shade = Normalize(np.log(SEEN), np.log(FAR_D_PRIME), clip=True)
    weak = 1.0 - float(shade(np.log(max(pair.separation, 1e-3))))
    _cell(axes, row, column, weak, f"{pair.separation:.0f}", framed=pair.confused)


def _cell(axes: Axes, x: int, y: int, shade: float, text: str, *, framed: bool) -> None:
    axes.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=_NEAR(shade), edgecolor=LINE))
    if framed:
        frame = Rectangle((x - 0.46, y - 0.46), 0.92, 0.92, fill=False, edgecolor=BLACK, linewidth=2.4, zorder=3)
        axes.add_patch(frame)
    colour = "white" if shade > DARK else BLACK if shade > 0.05 else GREY
    axes.text(x, y, text, ha="center", va="center", fontsize=CELL_PT, color=colour, zorder=4)


def _ticks(axes: Axes, words: list[str]) -> None:
    axes.set_xlim(-0.5, max(len(words), 1) - 0.5)
    axes.set_ylim(max(len(words), 1) - 0.5, -0.5)
    axes.set_yticks(range(len(words)), words, fontsize=TEXT_PT)
    axes.xaxis.tick_top()
    axes.set_xticks(range(len(words)), words, fontsize=TEXT_PT, rotation=90)
    axes.tick_params(length=0)
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _legend(figure: Figure) -> None:
    width, height = figure.get_size_inches()
    lines = (
        f"Below the diagonal: 100 sin² of the angle, 0 for what cannot be told apart. Framed: below {100 * CLOSE:.0f}, "
        f"or d′ below {SEEN:g}.",
        "Above: d′ between the two at their usual sizes. Dark: near. The catalogue's effects of the force only.",
    )
    for place, text in enumerate(lines):
        figure.text(EDGE_IN / width, (0.55 - 0.28 * place) / height, text, fontsize=SMALL_PT, color=GREY)
