"""What `dragrig gap diagnose` prints of several campaigns: a table, or a line of JSON each."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dragrig.cli.console import is_quiet, result
from dragrig.cli.gap.printing import show, table
from dragrig.cli.progress import Meter
from dragrig.config.errors import AnalysisError
from dragrig.plain import to_plain

if TYPE_CHECKING:
    from dragrig.diagnosing_many import Asked, DiagnosedFolder


def diagnose_several(
    campaigns: Sequence[Path],
    asked: "Asked",
    *,
    workers: int | None,
    scheduler: str | None,
    as_json: bool,
) -> None:
    """Diagnose campaigns side by side and print what was found, in their order."""
    from dragrig.diagnosing_many import diagnose_many

    with Meter(f"diagnosing {len(campaigns)} campaigns", 1.0, quiet=is_quiet()) as meter:
        found = diagnose_many(
            campaigns,
            nominal=asked.nominal,
            without=asked.without,
            tolerance_mN=asked.tolerance_mN,
            specimen=asked.specimen,
            calibration=asked.calibration,
            workers=workers,
            scheduler=scheduler,
            progress=meter.at,
        )
    if as_json:
        for line in json_lines(found):
            result(line)
    else:
        header = ("campaign", "verdict", "probability", "not told from", "gap [mN]", "closed", "95 % interval")
        show([table(f"{len(found)} campaigns", header, map(_row, found), (2, 4, 5))])
    failed = [one for one in found if one.result is None]
    if failed:
        told = failed[0].why_not.rstrip(".") + (f"; and {len(failed) - 1} more" if failed[1:] else "")
        raise AnalysisError(f"{len(failed)} of {len(found)} campaigns were not diagnosed: {told}.")


def json_lines(found: "Sequence[DiagnosedFolder]") -> Iterator[str]:
    """Yield a line for each campaign: its gap report with its folder as `source`, or `source` and `error`."""
    from dragrig.gap_json import gap_document

    for one in found:
        told = {"error": one.why_not} if one.result is None else gap_document(one.result, run_ids=one.run_ids)
        yield json.dumps(to_plain({"source": one.source, **told}), allow_nan=False)


def _row(one: "DiagnosedFolder") -> tuple[str, ...]:
    from dragrig.analysis.gap.sentences import chance_in_words, is_verdict, percent

    if one.result is None:
        return one.source, f"not diagnosed: {one.why_not}", "", "", "", "", ""
    said = one.result
    first = next((each for each in said.ranking if is_verdict(each, said)), None)
    shrink = said.shrink
    closed = shrink if shrink is not None and said.effects else None
    interval = closed.closed_95ci if closed is not None else None
    return (
        one.source,
        " + ".join(said.effects) or said.verdict.value.replace("_", " "),
        "" if first is None else chance_in_words(first.probability),
        ", ".join(said.confusable_with),
        "" if shrink is None else f"{shrink.gap_before_mN:.3g}",
        "" if closed is None or closed.closed is None else percent(closed.closed),
        "" if interval is None else f"{percent(interval[0])} to {percent(interval[1])}",
    )
