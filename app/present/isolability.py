"""Isolability laid out for a reader: which effects a set of runs can distinguish."""

from collections.abc import Mapping

from dragrig.analysis.gap.diagnosis_text import as_sentence, capitalise, display_name
from dragrig.analysis.gap.isolability import (
    CONFUSED_SIN2,
    DETECTABLE_D_PRIME,
    Isolability,
    isolability_sentences,
)
from dragrig.present.diagnosis_figures import isolability_figure
from dragrig.present.document import Column, Table, decimals, general_format, significant
from dragrig.present.figure_files import inline_figure
from dragrig.present.html_page import render_template
from dragrig.present.identification import finite_or_none

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
                "least_seen": finite_or_none(one.smallest),
                "least_seen_mN": finite_or_none(one.smallest_mN),
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
            one.smallest,
            "" if one.unit == "1" else one.unit,
            one.smallest_mN,
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
