"""`dragrig export`."""

from pathlib import Path

import click

from dragrig.cli import options
from dragrig.cli.batch import Batch, Within
from dragrig.cli.console import result, result_json, shown_path


@click.command("export")
@options.inputs
@click.option(
    "--format",
    "-f",
    "form",
    type=click.Choice(["csv", "parquet", "mat", "npz"]),
    default="csv",
    show_default=True,
    help="Of the files.",
)
@click.option("--decimal", metavar="MARK", help="Decimal mark of CSV, . or ,")
@click.option("--delimiter", metavar="MARK", help="Between the columns of CSV: , ; | or tab.")
@options.out("Folder for the files; beside each run file unless given.")
@options.overwrite
@options.as_json
@options.quiet
def command(
    inputs: tuple[str, ...],
    form: str,
    decimal: str | None,
    delimiter: str | None,
    out: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write runs, raw and filtered, for other programs.

    RUN is a run file, a pattern or a campaign's folder. Nothing is written over unless --overwrite is given. Runs
    marked bad are left out unless they are named themselves.
    """
    from dragrig.analysis.export import ExportFormat, export_run
    from dragrig.analysis.exporting.text import CsvStyle

    if form != "csv" and (decimal or delimiter):
        raise click.UsageError("--decimal and --delimiter are for --format csv alone", click.get_current_context())
    style = CsvStyle(decimal or ".", "\t" if delimiter in {"tab", "\\t"} else delimiter or "")
    batch = Batch.of_good_runs(inputs, "exporting")
    folder = options.made_folder(out) if out is not None else None

    def write(path: Path, within: Within) -> Path:
        target = (folder or path.parent) / f"{path.stem}.{form}"
        return export_run(path, target, ExportFormat(form), style, overwrite=overwrite, progress=within)

    done = []
    for path, written in batch.each(write):
        done.append({"run": path, "file": written})
        if not as_json:
            result(shown_path(written))
    if as_json:
        result_json(done)
    batch.close()
