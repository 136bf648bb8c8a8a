"""Commands on run files: info, mark, filter, import, export."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dragrig.cli import options
from dragrig.cli.console import (
    BAD_INPUT,
    FileBatch,
    FileProgress,
    ProgressMeter,
    display_path,
    echo,
    print_document,
    print_error,
    print_json,
    print_remark,
    with_progress,
)
from dragrig.cli.options import NUMBER

if TYPE_CHECKING:
    from dragrig.analysis import FilteredRun, ImportedRun


@click.command("info")
@options.inputs_or_newest
@click.option("--verify", is_flag=True, help="Read every sample and compare it with the checksum in the file.")
@options.as_json
@options.quiet
@click.pass_context
def info_command(ctx: click.Context, inputs: tuple[str, ...], verify: bool, as_json: bool) -> None:
    """Print the content of run files. RUN is a run file, a pattern or a campaign's folder (default: the newest).

    With --verify the exit code is 2 when the samples of a file are not those that were recorded.
    """
    from dragrig.config import RunFileError
    from dragrig.present import InspectedFile, files_document
    from dragrig.rig import runfile
    from dragrig.run_inputs import run_files

    files, errors = [], []
    for path in with_progress(run_files(inputs), "reading"):
        try:
            mark, note = runfile.read_mark(path), runfile.read_note(path)
            verification = runfile.verify(path) if verify else None
            info = runfile.read_info(path)
        except RunFileError as error:
            errors.append(str(error))
            continue
        intact = None if verification is None else verification.holds
        files.append(InspectedFile(info, mark.reason if mark is not None else None, note, intact))
        if verification is not None and not verification.stored:
            errors.append(f"{path}: has no checksum, so its samples cannot be verified.")
        elif verification is not None and not intact:
            errors.append(f"{path}: its samples are NOT those that were recorded; restore it from a copy.")
    if files or as_json:
        print_document(files_document(files), as_json=as_json)
    for sentence in errors:
        print_error(sentence)
    if errors:
        ctx.exit(BAD_INPUT)


@click.command("mark")
@options.inputs
@click.option("--bad", metavar="REASON", help="Why the runs must not be used.")
@click.option("--good", is_flag=True, help="Remove the mark.")
@click.option("--note", metavar="TEXT", help="Note on the runs, in place of an earlier one; an empty one removes it.")
@options.as_json
def mark_command(inputs: tuple[str, ...], bad: str | None, good: bool, note: str | None, as_json: bool) -> None:
    """Mark runs as bad, remove the mark, or write a note on them.

    RUN is a run file, a pattern or a campaign's folder. Mark and note are stored beside the run file, which is not
    changed; filter, export, table and all later steps leave marked runs out or report them.
    """
    from dragrig.api import mark as mark_runs

    paths = mark_runs(inputs, bad=bad, good=good, note=note)
    if as_json:
        print_json([{"file": path, "bad": bad, "noted": note} for path in paths])
        return
    mark = f"bad: {bad}" if bad is not None else "good" if good else ""
    noted = "" if note is None else f"noted: {note}" if note.strip() else "no note"
    for path in paths:
        echo(f"{path}  {'; '.join(filter(None, (mark, noted)))}")


@click.command("filter")
@options.inputs
@click.option("--window-s", type=NUMBER, metavar="S", help="Length of the window in seconds (default: 0.05).")
@click.option("--window-samples", type=int, metavar="N", help="Length of the window in samples, odd.")
@click.option("--order", type=int, metavar="N", help="Order of the polynomial (default: 3).")
@click.option(
    "--derivative", type=int, metavar="N", default=0, show_default=True, help="Time derivative of the forces."
)
@options.as_json
@options.quiet
def filter_command(
    inputs: tuple[str, ...],
    window_s: float | None,
    window_samples: int | None,
    order: int | None,
    derivative: int,
    as_json: bool,
) -> None:
    """Smooth every force of run files with a Savitzky–Golay filter, and compute the speed from the position.

    RUN is a run file, a pattern or a campaign's folder. The result is stored in the file beside the raw trace, with its
    parameters, and replaces an earlier one; the raw trace is not changed. Runs marked bad are left out unless they are
    named themselves.
    """
    from dragrig.analysis import filter_file
    from dragrig.api import filter_settings
    from dragrig.rig import read_info

    def filter_run(path: Path, _progress: FileProgress) -> "FilteredRun":
        rate_hz = read_info(path).header.sample_rate_hz
        return filter_file(path, filter_settings(rate_hz, window_s, window_samples, order, derivative))

    batch = FileBatch.from_good_runs(inputs, "filtering")
    # All files are written before any line is printed: a reader such as head ends the command.
    results, lines = [], []
    for path, filtered in batch.process(filter_run):
        parameters = filtered.trace.parameters
        results.append({"file": path, "parameters": parameters, "events": filtered.events})
        if not as_json:
            text = f"window {parameters['window_s']:.4g} s ({parameters['window_samples']} samples), "
            text += f"order {parameters['order']}"
            if parameters["derivative"]:
                text += f", derivative {parameters['derivative']}"
            lines.append("; ".join((f"{path}  {text}", *(event.message for event in filtered.events))))
    _print_results(results, lines, as_json=as_json)
    batch.close()


def _print_results(results: Sequence[object], lines: Sequence[str], *, as_json: bool) -> None:
    if as_json:
        print_json(results)
    else:
        for line in lines:
            echo(line)


@click.command("import")
@click.argument("inputs", metavar="FILE…", nargs=-1, required=True)
@click.option(
    "--map",
    "assignments",
    metavar="QUANTITY=COLUMN:UNIT",
    multiple=True,
    help="Quantity and unit of a column; repeatable.",
)
@click.option("--settings", metavar="F", help="TOML file with these settings, for recurring files.")
@click.option("--encoding", metavar="NAME", help="Of text (default: detected).")
@click.option("--delimiter", metavar="MARK", help="Between the columns of text: , ; | tab or space (default: found).")
@click.option("--decimal", metavar="MARK", help="Decimal mark of text, . or , (default: found).")
@click.option("--header-lines", type=int, metavar="N", help="Lines before the first row of numbers.")
@click.option(
    "--missing",
    type=click.Choice(["refuse", "gap"]),
    help="Rows without a number (empty, NaN, ---, OVLD): refuse the file, or leave a gap (default: refuse).",
)
@click.option("--table", metavar="NAME", help="Sheet, group, variable or block (default: all like the largest).")
@click.option("--radius-mm", type=NUMBER, metavar="MM", help="Of a turning rig: converts rad, deg, rev and Nm.")
@click.option(
    "--split-at",
    metavar="rests|reversals|cycles|N",
    help="Make a run of each motion of a long record, or of each stroke, each two, each N strokes.",
)
@click.option("--sample-rate-hz", type=NUMBER, metavar="HZ", help="Rows are evenly spaced at this rate.")
@click.option("--resample-hz", type=NUMBER, metavar="HZ", help="Interpolate rows at uneven times to this rate.")
@click.option(
    "--steady",
    is_flag=True,
    default=None,
    help="The stage was commanded at constant speed: the command is a straight line.",
)
@click.option("--from-s", type=NUMBER, metavar="S", help="Leave out rows before this time.")
@click.option("--to-s", type=NUMBER, metavar="S", help="Leave out rows after this time.")
@click.option("--kind", metavar="NAME", help="Kind of run: drag, relaxation, … (default: motion).")
@click.option(
    "--set", "protocol", metavar="KEY=VALUE", multiple=True, help="Parameters of the motion: speed_mm_s=5, …."
)
@click.option("--specimen", metavar="NAME|F", help="Specimen, or its TOML file (default: the name of the file).")
@click.option("--wall-thickness-mm", type=NUMBER, metavar="MM", help="Thickness of the specimen's wall.")
@click.option("--capsule", metavar="F|NAME", help="Capsule dummy: drag, rough, smooth, or its TOML file.")
@click.option("--fixture", type=click.Choice(["foam", "vacuum", "none"]), help="What held the gut (default: by kind).")
@click.option("--insertion-dwell-s", type=NUMBER, metavar="S", help="Age of the contact at the first sample.")
@click.option("--operator", metavar="NAME", help="Operator's name, stored in the run file.")
@click.option("--note", metavar="TEXT", help="Note, stored in the run file.")
@click.option("--start-time", metavar="TIME", help="Start of the measurement, as 2026-05-04T09:15:00+02:00.")
@options.out("Folder of the run files (default: the working folder).")
@options.as_json
@options.quiet
def import_command(
    inputs: tuple[str, ...],
    assignments: tuple[str, ...],
    settings: str | None,
    protocol: tuple[str, ...],
    out: Path | None,
    as_json: bool,
    **options_set: object,
) -> None:
    """Convert foreign measurements into run files.

    FILE is text (CSV, .lvm, decimal commas, any encoding that instruments write), a workbook, MAT, Parquet, Feather,
    TDMS, NumPy or JSON, packed or not and whatever its name. Map each column to time, force, position, command,
    motor_force or temperature with its unit: --map force=Load:N, or by number, --map time=1:s; dates and times need
    none. A unit of another dimension needs a factor: --map force=Friction:1*1000. An export of this software needs no
    map. Existing files are never overwritten.

    Tables with the same columns (sheets, groups, trials, blocks) become a run each, and so do the stretches of a clock
    that begins anew. Remarks name all else that the file holds.

    Capsule, wall and fixture make a measurement one that gap diagnose compares with the capsule model. Settings that a
    kind of run must state (speed, travel, …) and --set does not are taken from the position.
    """
    from dragrig.analysis import import_runs
    from dragrig.api import import_settings, next_run_order
    from dragrig.run_inputs import input_files

    batch = FileBatch(input_files(inputs), "importing")
    named = {key: value for key, value in options_set.items() if value is not None}
    base = import_settings(assignments, {**named, **_protocol_settings(protocol)}, settings)
    folder = options.make_folder(out) if out is not None else Path()

    def convert(path: Path, _progress: FileProgress) -> "tuple[ImportedRun, ...]":
        return import_runs(path, folder, base.model_copy(update={"order": next_run_order(folder)}))

    results, lines = [], []
    for path, imported in ((path, run) for path, runs in batch.process(convert) for run in runs):
        results.append(
            {
                "source": path,
                "file": imported.path,
                "samples": imported.samples,
                "sample_rate_hz": imported.sample_rate_hz,
                "events": imported.events,
            }
        )
        lines.append(display_path(imported.path))
        if not as_json:
            print_remark(f"{path}:")
            for event in imported.events:
                print_remark(f"  {event.time_s:.3f} s: {event.message}")
    _print_results(results, lines, as_json=as_json)
    batch.close()


def _protocol_settings(assignments: tuple[str, ...]) -> dict[str, object]:
    from dragrig.config import SettingsError, parse_assignment

    parameters: dict[str, object] = {}
    for text in assignments:
        path, value = parse_assignment(text)
        if len(path) > 1:
            raise SettingsError(f"--set {text}: is not a plain key of the motion, as in speed_mm_s=5.")
        parameters[path[0]] = value
    return {"protocol": parameters} if parameters else {}


@click.command("export")
@options.inputs
@click.option(
    "--format",
    "-f",
    "form",
    type=click.Choice(["csv", "parquet", "mat", "npz", "tdms", "eln"]),
    default="csv",
    show_default=True,
    help="tdms: for LabVIEW and DIAdem; eln: a campaign as one archive for electronic laboratory notebooks.",
)
@click.option("--decimal", metavar="MARK", help="Decimal mark of CSV, . or ,")
@click.option("--delimiter", metavar="MARK", help="Between the columns of CSV: , ; | or tab.")
@click.option("--columns", metavar="NAME,NAME,…", help="Columns besides the time, as force,position (default: all).")
@click.option("--filtered-only", is_flag=True, help="Leave out what was recorded where the filter's result is there.")
@click.option(
    "--every",
    metavar="N",
    type=click.IntRange(min=1),
    default=1,
    help="Make one row of N samples, their mean; of fewer before a gap and at the end.",
)
@click.option("--licence", metavar="NAME|URL", default="", help="Licence of the data in an archive for notebooks.")
@options.out("Folder for the files (default: beside each run file, an archive beside its campaign).")
@options.overwrite
@options.as_json
@options.quiet
def export_command(
    inputs: tuple[str, ...],
    form: str,
    decimal: str | None,
    delimiter: str | None,
    columns: str | None,
    filtered_only: bool,
    every: int,
    licence: str,
    out: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write runs, raw and filtered, for other programs.

    RUN is a run file, a pattern or a campaign's folder. Without --overwrite no existing file is replaced. Runs
    marked bad are left out unless they are named themselves; an archive has them with their marks.

    The names of columns are made legal in the format; the metadata state the original ones, so that import needs no
    map. A row of --every has the mean time, and the phase of its middle sample.
    """
    from dragrig.analysis import CsvStyle, ExportFormat, ExportSelection, export_run

    if form != "csv" and (decimal or delimiter):
        raise click.UsageError("--decimal and --delimiter are for --format csv alone", click.get_current_context())
    if licence and form != "eln":
        raise click.UsageError("--licence is for --format eln alone", click.get_current_context())
    if form == "eln" and (columns or filtered_only or every > 1):
        why = "an archive holds whole runs: leave out --columns, --filtered-only and --every"
        raise click.UsageError(why, click.get_current_context())
    folder = options.make_folder(out) if out is not None else None
    if form == "eln":
        from dragrig.api import write_eln

        archives = []
        for place in map(Path, inputs):
            with ProgressMeter("measuring and drawing") as meter:
                to = folder or place.absolute().parent
                archives.append(write_eln(place, to, licence, overwrite=overwrite, progress=meter.at))
        _print_results([{"file": file} for file in archives], list(map(display_path, archives)), as_json=as_json)
        return
    style = CsvStyle(decimal or ".", "\t" if delimiter in {"tab", "\\t"} else delimiter or "")
    names = tuple(name.strip() for name in (columns or "").split(",") if name.strip())
    selection = ExportSelection(names, filtered_only, every)
    batch = FileBatch.from_good_runs(inputs, "exporting")

    def write(path: Path, progress: FileProgress) -> Path:
        target = (folder or path.parent) / f"{path.stem}.{form}"
        return export_run(
            path, target, ExportFormat(form), style, selection=selection, overwrite=overwrite, progress=progress
        )

    results, lines = [], []
    for path, written in batch.process(write):
        results.append({"run": path, "file": written})
        lines.append(display_path(written))
    _print_results(results, lines, as_json=as_json)
    batch.close()
