"""The tables of an exam."""

from collections.abc import Sequence
from math import isfinite

from dragrig.gap_scoring import Score
from dragrig.gap_scoring.rates import Rate
from dragrig.gap_scoring.scoring import missed_cells
from dragrig.reports.tabular import Cell, Column, Table, places, plainly

TWO = places(2)


def tables(score: Score) -> dict[str, Table]:
    """Return all tables by name; one that has nothing to say has no rows."""
    made = (
        _rates("rates", "Each with its 95 % interval (Wilson)", score.rates),
        _rates("withheld", "Single effects, diagnosed with the true one taken out", score.withheld),
        _detection(score),
        _reliability(score),
        _missed(score),
    )
    return {table.name: table for table in made}


def _rates(name: str, caption: str, rates: Sequence[Rate]) -> Table:
    columns = (
        Column("rate", "what"),
        Column("held", "held", plainly),
        Column("count", "of", plainly),
        Column("share", "share", TWO),
        Column("low", "95 % from", TWO),
        Column("high", "to", TWO),
    )
    rows = tuple((one.name, one.held, one.count, one.share, one.low, one.high) for one in rates if one.count)
    return Table(name, caption, columns, rows)


def _detection(score: Score) -> Table:
    columns = (
        Column("d_prime", "d′"),
        Column("effects", "effects", plainly),
        Column("seen", "a gap is seen", TWO),
        Column("named", "the right name", TWO),
        Column("misled", "a wrong name", TWO),
    )
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (
            f"{one.low:g} to {one.high:g}" if isfinite(one.high) else f"above {one.low:g}",
            one.seen.count,
            one.seen.share,
            one.named.share,
            one.misled.share,
        )
        for one in score.detection
    )
    return Table("detection", "Single effects by size", columns, rows)


def _reliability(score: Score) -> Table:
    columns = (
        Column("from", "probability from", TWO),
        Column("to", "to", TWO),
        Column("count", "verdicts", plainly),
        Column("share", "right", TWO),
        Column("band_low", "would be, 95 % from", TWO),
        Column("band_high", "to", TWO),
    )
    rows = tuple((one.low, one.high, one.count, one.share, *one.band) for one in score.calibration.bins)
    return Table("reliability", "Verdicts by their probability", columns, rows)


def _missed(score: Score) -> Table:
    names = ("case", "truth", "form", "size", "said", "probability")
    rows = tuple(missed_cells(one) for one in score.missed)
    return Table("not-right", "Every verdict that is not right", tuple(Column(one, one) for one in names), rows)
