"""`dragrig table`."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from dragrig.cli import options
from dragrig.cli.console import is_quiet, result, result_json
from dragrig.cli.progress import Meter
from dragrig.cli.wording import columns, number

if TYPE_CHECKING:
    from dragrig.analysis.table import SpeedMean, TableRow


@click.command("table")
@click.argument("campaign", type=click.Path(path_type=Path))
@options.as_json
@options.quiet
def command(campaign: Path, as_json: bool) -> None:
    """Tabulate CAMPAIGN, a folder of run files.

    A line per run: kind, speed, steady force with its standard error, what its checks saw, and whether somebody
    marked it bad; then the mean steady force of repeated runs, without bad and unfinished ones.
    """
    from dragrig.analysis.table import mean_per_speed, table

    with Meter("measuring", 1.0, quiet=is_quiet()) as meter:
        rows = table(campaign, meter.at)
    if as_json:
        result_json({"runs": rows, "means": mean_per_speed(rows)})
    else:
        result(table_text(rows))


def table_text(rows: "tuple[TableRow, ...]") -> str:
    """Return the table of runs and that of their means, as text."""
    from dragrig.analysis.table import mean_per_speed

    means = mean_per_speed(rows)
    return f"{_runs(rows)}\n\n{_means(means)}" if means else _runs(rows)


def _runs(rows: "tuple[TableRow, ...]") -> str:
    header = ("file", "kind", "mm/s", "strain", "steady mN", "±", "rest mN", "peak mN", "status", "checks", "remark")
    return columns(header, (_run(row) for row in rows))


def _run(row: "TableRow") -> tuple[str, ...]:
    return (
        row.file,
        row.kind,
        number(row.measured_speed_mm_s if row.speed_mm_s is None else row.speed_mm_s),
        number(row.shear_strain),
        _force(row.steady_force_mN),
        _force(row.steady_force_error_mN),
        _force(row.rest_offset_mN),
        _force(row.peak_force_mN),
        row.status,
        row.checks,
        "; ".join(part for part in (f"BAD: {row.mark}" if row.bad else "", row.remark) if part),
    )


def _means(means: "tuple[SpeedMean, ...]") -> str:
    header = ("specimen", "kind", "capsule", "mm/s", "way", "runs", "steady mN", "±")
    return columns(
        header,
        (
            (
                one.specimen,
                one.kind,
                one.capsule,
                number(one.speed_mm_s),
                "forward" if one.direction > 0 else "backward",
                str(one.runs),
                _force(one.steady_force_mN),
                _force(one.standard_error_mN),
            )
            for one in means
        ),
    )


def _force(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"
