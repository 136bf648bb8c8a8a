"""`dragrig import`."""

from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict, Unpack

import click

from dragrig.cli import options
from dragrig.cli.batch import Batch, Within
from dragrig.cli.console import result, result_json, say, shown_path

if TYPE_CHECKING:
    from dragrig.analysis.importing import Imported


class _Given(TypedDict):
    """Options that are settings of the import, by their names."""

    encoding: str | None
    delimiter: str | None
    decimal: str | None
    header_lines: int | None
    table: str | None
    sample_rate_hz: float | None
    resample_hz: float | None
    steady: bool | None
    from_s: float | None
    to_s: float | None
    kind: str | None
    specimen: str | None
    operator: str | None
    note: str | None
    start_time: str | None


@click.command("import")
@click.argument("inputs", metavar="FILE…", nargs=-1, required=True)
@click.option(
    "--map", "assignments", metavar="QUANTITY=COLUMN:UNIT", multiple=True, help="What a column is; repeatable."
)
@click.option("--settings", metavar="F", help="TOML file with these settings, for files that come again and again.")
@click.option("--encoding", metavar="NAME", help="Of text; found out unless given.")
@click.option("--delimiter", metavar="MARK", help="Between the columns of text; found out unless given.")
@click.option("--decimal", metavar="MARK", help="Decimal mark of text; found out unless given.")
@click.option("--header-lines", type=int, metavar="N", help="Lines before the first row of numbers.")
@click.option("--table", metavar="NAME", help="Variable of a MAT file, or group of a TDMS file.")
@click.option("--sample-rate-hz", type=float, metavar="HZ", help="Rows are evenly spaced at this rate.")
@click.option("--resample-hz", type=float, metavar="HZ", help="Interpolate rows at uneven times to this rate.")
@click.option("--steady", is_flag=True, default=None, help="Told to go at one speed: the command is a straight line.")
@click.option("--from-s", type=float, metavar="S", help="Leave out rows before this time.")
@click.option("--to-s", type=float, metavar="S", help="Leave out rows after this time.")
@click.option("--kind", metavar="NAME", help="Kind of run: drag, relaxation, …; motion unless given.")
@click.option("--set", "protocol", metavar="KEY=VALUE", multiple=True, help="Known of the motion: speed_mm_s=5, ….")
@click.option("--specimen", metavar="NAME", help="What was measured; the file's name unless given.")
@click.option("--operator", metavar="NAME", help="Who measured.")
@click.option("--note", metavar="TEXT", help="Kept in the run file.")
@click.option("--start-time", metavar="TIME", help="When it began, as 2026-05-04T09:15:00+02:00.")
@options.out("Folder of the run files; the working folder unless given.")
@options.as_json
@options.quiet
def command(
    inputs: tuple[str, ...],
    assignments: tuple[str, ...],
    settings: str | None,
    protocol: tuple[str, ...],
    out: Path | None,
    as_json: bool,
    **given: Unpack[_Given],
) -> None:
    """Turn measurements from elsewhere into run files.

    FILE is text (CSV, decimal commas, any encoding that instruments write), MAT, Parquet, TDMS or NPZ. Say with --map
    which column is time, force, position, command, motor_force or temperature, and its unit: --map force=Load:N, or
    by number, --map time=1:s. A unit of another kind needs a factor: --map force=Friction:1*1000. An export of this
    software needs no map. Nothing is written over.
    """
    from dragrig.analysis.importing import import_file
    from dragrig.importing import import_settings, next_order
    from dragrig.inputs import files

    batch = Batch(files(inputs), "importing")
    wanted = {key: value for key, value in given.items() if value is not None}
    how = import_settings(assignments, {**wanted, **_protocol(protocol)}, settings)
    folder = options.made_folder(out) if out is not None else Path()

    orders = count(next_order(folder))

    def read(path: Path, _within: Within) -> "Imported":
        return import_file(path, folder, how.model_copy(update={"order": next(orders)}))

    done = []
    for path, imported in batch.each(read):
        done.append({"source": path, **_plain(imported)})
        if not as_json:
            result(shown_path(imported.path))
            for event in imported.events:
                say(f"  {event.time_s:.3f} s: {event.message}")
    if as_json:
        result_json(done)
    batch.close()


def _plain(imported: "Imported") -> dict[str, object]:
    return {
        "file": imported.path,
        "samples": imported.samples,
        "sample_rate_hz": imported.sample_rate_hz,
        "events": imported.events,
    }


def _protocol(assignments: tuple[str, ...]) -> dict[str, object]:
    from dragrig.config.errors import SettingsError
    from dragrig.config.loading import parse_assignment

    found: dict[str, object] = {}
    for text in assignments:
        path, value = parse_assignment(text)
        if len(path) > 1:
            raise SettingsError(f"--set {text}: is not a plain key of the motion, as in speed_mm_s=5.")
        found[path[0]] = value
    return {"protocol": found} if found else {}
