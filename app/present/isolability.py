"""Isolability of effects as figure, tables, page and JSON: which effects a set of runs can distinguish."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from dragrig.analysis.gap.diagnosis_text import as_sentence, capitalise, display_name
from dragrig.analysis.gap.isolability import (
    CONFUSED_SIN2,
    DETECTABLE_D_PRIME,
    EffectPair,
    Isolability,
    isolability_sentences,
)
from dragrig.present.document import Column, Table, decimals, general_format, significant
from dragrig.present.drawing import (
    SMALL_PT,
    TEXT_PT,
    PanelBox,
    add_panel,
    figure_style,
    new_figure,
    shortened_to_width,
    text_width_in,
    write_title,
)
from dragrig.present.figure_files import inline_figure
from dragrig.present.html_page import render_template
from dragrig.present.identification import finite_or_none
from dragrig.present.palette import BLACK, BLUE, GREY

ISOLABILITY_FORMAT, ISOLABILITY_VERSION = "dragrig-isolability", 1


def isolability_json(found: Isolability) -> Mapping[str, object]:
    """Return it as JSON without any NaN or infinity."""
    return {
        "format": ISOLABILITY_FORMAT,
        "version": ISOLABILITY_VERSION,
        "source": found.source,
        "planned": found.planned,
        "runs": dict(found.runs),
        "duration_s": finite_or_none(found.duration_s),
        "in_words": list(isolability_sentences(found)),
        "seen_from_d_prime": DETECTABLE_D_PRIME,
        "close_below_sin2": CONFUSED_SIN2,
        "summary": {name: finite_or_none(value) for name, value in found.summary().items()},
        "effects": [
            {
                "id": one.effect,
                "channel": one.channel,
                "usual": one.usual,
                "unit": one.unit,
                "d_prime": finite_or_none(one.d_prime),
                "least_seen": finite_or_none(one.least),
                "least_seen_mN": finite_or_none(one.least_mN),
            }
            for one in found.effects
        ],
        "pairs": [
            {
                "effects": list(one.effects),
                "channel": one.channel,
                "sin2": finite_or_none(one.sin2),
                "typical_sin2": [finite_or_none(each) for each in one.typical_sin2],
                "d_prime": [finite_or_none(each) for each in one.d_prime],
                "confused": one.confused,
            }
            for one in found.pairs
        ],
        "remarks": list(found.remarks),
    }


ISOLABILITY_CELL_IN, ISOLABILITY_HEAD_IN, ISOLABILITY_EDGE_IN, ISOLABILITY_FOOT_IN = 0.56, 1.25, 0.45, 0.9
CELL_PT = 10.5
FAINTEST_D_PRIME = 1000.0
"""From here on d′ is as faint as it can be."""
WHITE_TEXT_SHADE = 0.55
"""Shades beyond this bear white words."""
CELL_EDGE_COLOUR = "#D3D9DF"

_SIMILARITY_COLOURS = LinearSegmentedColormap.from_list("near", ["#FFFFFF", "#BFD9EA", BLUE, "#002B45"])


def isolability_figure(found: Isolability) -> Figure:
    """Draw every two effects of the force against each other: sin² below the diagonal, d′ above it.

    Dark cells are near; a thick frame marks what the runs hardly tell apart.
    """
    names = [one.effect for one in found.of_channel("force")]
    words = [display_name(one) for one in names]
    with figure_style():
        label_in = max((text_width_in(one, TEXT_PT) for one in words), default=1.0) + 0.2
        side = ISOLABILITY_CELL_IN * max(len(names), 1)
        width = max(ISOLABILITY_EDGE_IN + label_in + side + ISOLABILITY_EDGE_IN, 9.0)
        figure = new_figure(width, ISOLABILITY_HEAD_IN + label_in + side + ISOLABILITY_FOOT_IN)
        said = shortened_to_width(isolability_sentences(found)[0], SMALL_PT, width - 2 * ISOLABILITY_EDGE_IN)
        write_title(figure, ISOLABILITY_EDGE_IN, f"What {found.source} can tell apart", said)
        axes = add_panel(figure, PanelBox(ISOLABILITY_EDGE_IN + label_in, ISOLABILITY_FOOT_IN, side, side))
        for row, one in enumerate(names):
            axes.add_patch(Rectangle((row - 0.5, row - 0.5), 1, 1, facecolor="#F1F3F5", edgecolor=CELL_EDGE_COLOUR))
            for column, other in enumerate(names[:row]):
                pair = found.pair(one, other)
                if pair is not None:
                    _draw_pair_cells(axes, row, column, pair)
        _set_effect_ticks(axes, words)
        _draw_isolability_legend(figure)
        return figure


def _draw_pair_cells(axes: Axes, row: int, column: int, pair: EffectPair) -> None:
    near = 1.0 - float(np.sqrt(max(pair.sin2, 0.0)))
    _draw_cell(axes, column, row, near, f"{100 * pair.sin2:.0f}", framed=pair.confused)
    shade = Normalize(np.log(DETECTABLE_D_PRIME), np.log(FAINTEST_D_PRIME), clip=True)
    weak = 1.0 - float(shade(np.log(max(pair.separation, 1e-3))))
    _draw_cell(axes, row, column, weak, f"{pair.separation:.0f}", framed=pair.confused)


def _draw_cell(axes: Axes, x: int, y: int, shade: float, text: str, *, framed: bool) -> None:
    axes.add_patch(
        Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=_SIMILARITY_COLOURS(shade), edgecolor=CELL_EDGE_COLOUR)
    )
    if framed:
        frame = Rectangle((x - 0.46, y - 0.46), 0.92, 0.92, fill=False, edgecolor=BLACK, linewidth=2.4, zorder=3)
        axes.add_patch(frame)
    colour = "white" if shade > WHITE_TEXT_SHADE else BLACK if shade > 0.05 else GREY
    axes.text(x, y, text, ha="center", va="center", fontsize=CELL_PT, color=colour, zorder=4)


def _set_effect_ticks(axes: Axes, words: list[str]) -> None:
    axes.set_xlim(-0.5, max(len(words), 1) - 0.5)
    axes.set_ylim(max(len(words), 1) - 0.5, -0.5)
    axes.set_yticks(range(len(words)), words, fontsize=TEXT_PT)
    axes.xaxis.tick_top()
    axes.set_xticks(range(len(words)), words, fontsize=TEXT_PT, rotation=90)
    axes.tick_params(length=0)
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _draw_isolability_legend(figure: Figure) -> None:
    width, height = figure.get_size_inches()
    lines = (
        f"Below the diagonal: 100 sin² of the angle, 0 for what cannot be told apart. Framed: below "
        f"{100 * CONFUSED_SIN2:.0f}, or d′ below {DETECTABLE_D_PRIME:g}.",
        "Above: d′ between the two at their usual sizes. Dark: near. The catalogue's effects of the force only.",
    )
    for place, text in enumerate(lines):
        figure.text(ISOLABILITY_EDGE_IN / width, (0.55 - 0.28 * place) / height, text, fontsize=SMALL_PT, color=GREY)


MAX_PAIRS = 40


def isolability_page(found: Isolability) -> str:
    """Return the page."""
    first, *more = isolability_sentences(found)
    shown = inline_figure(
        isolability_figure(found),
        "A matrix of effects: below the diagonal sin² of the angle between each two, above it d′ between them.",
        "Below the diagonal: sin² of the angle between what two effects can do to the force, in hundredths; dark where "
        "they are near each other. Above: d′ between them at their usual sizes. Near ones are neighbours.",
    )
    return render_template(
        "isolability.html",
        {
            "title": f"What {found.source} can tell apart",
            "first": first,
            "more": more,
            "close": CONFUSED_SIN2,
            "seen": DETECTABLE_D_PRIME,
            "tables": {"effects": _effects_table(found), "pairs": _pairs_table(found)},
            "pictures": {"matrix": shown},
            "remarks_": [as_sentence(one) for one in found.remarks],
        },
    )


def _effects_table(found: Isolability) -> Table:
    columns = (
        Column("effect", "effect"),
        Column("channel", "seen in"),
        Column("d_prime", "d′ at the usual size", decimals(0)),
        Column("usual", "usual size", general_format),
        Column("least", "smallest seen", significant(2)),
        Column("unit", "unit"),
        Column("least_mN", "as mN", significant(2)),
    )
    rows = tuple(
        (
            capitalise(display_name(one.effect)),
            one.channel,
            one.d_prime,
            one.usual,
            one.least,
            "" if one.unit == "1" else one.unit,
            one.least_mN,
        )
        for one in found.effects
    )
    return Table("effects", "How clearly each effect is seen, near ones together", columns, rows)


def _pairs_table(found: Isolability) -> Table:
    columns = (
        Column("first", "first"),
        Column("second", "second"),
        Column("sin2", "sin²", decimals(2)),
        Column("first_by_second", "first by second", decimals(2)),
        Column("second_by_first", "second by first", decimals(2)),
        Column("d_prime", "d′", decimals(0)),
        Column("confused", ""),
    )
    rows = tuple(
        (
            capitalise(display_name(one.effects[0])),
            capitalise(display_name(one.effects[1])),
            one.sin2,
            *one.typical_sin2,
            one.separation,
            "hardly told apart" if one.confused else "",
        )
        for one in found.pairs[:MAX_PAIRS]
    )
    return Table("pairs", f"The closest {len(rows)} of {len(found.pairs)} pairs", columns, rows)
