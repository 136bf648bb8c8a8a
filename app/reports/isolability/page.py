"""What runs can tell apart, as one HTML page."""

from dragrig.analysis.gap.isolability.results import CLOSE, Isolability
from dragrig.analysis.gap.isolability.sentences import isolability_sentences
from dragrig.analysis.gap.seen import SEEN
from dragrig.analysis.gap.sentences import capital, name_of, sentence
from dragrig.figures.gap_isolability import isolability_figure
from dragrig.reports.embedding import embedded
from dragrig.reports.rendering import render
from dragrig.reports.tabular import Column, Table, digits, plainly
from dragrig.reports.tabular import places as decimals

MOST_PAIRS = 40


def page(found: Isolability) -> str:
    """Return the page."""
    first, *more = isolability_sentences(found)
    shown = embedded(
        isolability_figure(found),
        "A matrix of effects: below the diagonal sin² of the angle between each two, above it d′ between them.",
        "Below the diagonal: sin² of the angle between what two effects can do to the force, in hundredths; dark where "
        "they are near each other. Above: d′ between them at their usual sizes. Near ones are neighbours.",
    )
    return render(
        "isolability.html",
        {
            "title": f"What {found.source} can tell apart",
            "first": first,
            "more": more,
            "close": CLOSE,
            "seen": SEEN,
            "tables": {"effects": _effects(found), "pairs": _pairs(found)},
            "pictures": {"matrix": shown},
            "remarks_": [sentence(one) for one in found.remarks],
        },
    )


def _effects(found: Isolability) -> Table:
    columns = (
        Column("effect", "effect"),
        Column("channel", "seen in"),
        Column("d_prime", "d′ at the usual size", decimals(0)),
        Column("usual", "usual size", plainly),
        Column("least", "smallest seen", digits(2)),
        Column("unit", "unit"),
        Column("least_mN", "as mN", digits(2)),
    )
    rows = tuple(
        (
            capital(name_of(one.effect)),
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


def _pairs(found: Isolability) -> Table:
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
            capital(name_of(one.effects[0])),
            capital(name_of(one.effects[1])),
            one.sin2,
            *one.typical_sin2,
            one.separation,
            "hardly told apart" if one.confused else "",
        )
        for one in found.pairs[:MOST_PAIRS]
    )
    return Table("pairs", f"The closest {len(rows)} of {len(found.pairs)} pairs", columns, rows)
