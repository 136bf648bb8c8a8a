"""What `dragrig identify` prints of several campaigns: a table, or a line of JSON each."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dragrig.cli.console import is_quiet, result, shown_path
from dragrig.cli.precision import to_error
from dragrig.cli.progress import Meter
from dragrig.config.errors import AnalysisError, SettingsError
from dragrig.plain import to_plain

if TYPE_CHECKING:
    from dragrig.identifying_many import IdentifiedFolder


def identify_several(
    campaigns: Sequence[Path],
    *,
    nominal: str,
    model: str,
    wall: Literal["scaled", "fitted"],
    specimen: str | None,
    workers: int | None,
    scheduler: str | None,
    out: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Identify campaigns side by side and print what was found, in their order."""
    from dragrig.identifying_many import identify_many

    with Meter(f"identifying {len(campaigns)} campaigns", 1.0, quiet=is_quiet()) as meter:
        found = identify_many(
            campaigns,
            nominal=nominal,
            model=model,
            wall=wall,
            specimen=specimen,
            write=out is not None or not as_json,
            out=out,
            overwrite=overwrite,
            workers=workers,
            scheduler=scheduler,
            progress=meter.at,
        )
    if as_json:
        for line in json_lines(found):
            result(line)
    else:
        _show(found)
    failed = [one for one in found if one.failed]
    if failed:
        told = failed[0].why_not.rstrip(".") + (f"; and {len(failed) - 1} more" if failed[1:] else "")
        raise AnalysisError(f"{len(failed)} of {len(found)} campaigns were not identified: {told}.")


def require_several(scheduler: str | None) -> None:
    """Raise `SettingsError` where a cluster is to share out a single campaign."""
    if scheduler is not None:
        raise SettingsError(f"--scheduler {scheduler}: shares out campaigns, and one was given; leave it out.")


def json_lines(found: "Sequence[IdentifiedFolder]") -> Iterator[str]:
    """Yield a line for each campaign: what `--json` says of one, with its folder as `source`, or an `error`."""
    from dragrig.identification_json import identification_table

    for one in found:
        told = {"error": one.why_not} if one.result is None else identification_table(one.result)
        yield json.dumps(to_plain({"source": one.source, **told, "files": one.files}), allow_nan=False)


def _show(found: "Sequence[IdentifiedFolder]") -> None:
    from dragrig.cli.gap.printing import show, table

    fits = [one.result.joint for one in found if one.result is not None and one.result.joint is not None]
    names = list(dict.fromkeys(parameter.name for fit in fits for parameter in fit.parameters))
    rows = [(one.source, *_cells(one, names)) for one in found]
    title = "Value ± standard error of each campaign's joint fit; - is not determined by its runs"
    show([table(title, ("campaign", *names), rows, range(1, len(names) + 1))])
    for one in found:
        if one.why_not:
            result(f"! {one.why_not}")
        for path in one.files:
            result(shown_path(path))


def _cells(one: "IdentifiedFolder", names: Sequence[str]) -> Iterator[str]:
    joint = None if one.result is None else one.result.joint
    known = {} if joint is None else {each.name: each for each in joint.parameters if each.determined}
    for name in names:
        if name not in known or joint is None or not joint.converged:
            yield "-"
            continue
        value, error = known[name].value, known[name].standard_error
        yield f"{to_error(value, error)} ± {to_error(error, error)}"
