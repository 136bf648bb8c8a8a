"""Commands on run files: info, mark, filter, import, export."""

from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict, Unpack

import click

from dragrig.cli import options
from dragrig.cli.console import (
    BAD_INPUT,
    FileBatch,
    FileProgress,
    display_path,
    print_error,
    print_json,
    print_remark,
    print_result,
    with_progress,
)
from dragrig.present.numbers import duration_text, size_text

if TYPE_CHECKING:
    from dragrig.analysis.importing import ImportedRun
    from dragrig.analysis.savgol import FilteredRun
    from dragrig.rig.runfile import Verification
    from dragrig.rig.runfile.model import RunInfo


@click.command("info")
@options.inputs
@click.option("--verify", is_flag=True, help="Read every sample and compare it with the checksum in the file.")
@options.as_json
@options.quiet
@click.pass_context
def info_command(ctx: click.Context, inputs: tuple[str, ...], verify: bool, as_json: bool) -> None:
    """Say what run files hold. RUN is a run file, a pattern or a campaign's folder.

    With --verify the exit code is 2 when a file is not what was recorded.
    """
    from dragrig.config.errors import RunFileError
    from dragrig.rig import runfile
    from dragrig.run_inputs import run_files

    found, wrong = [], []
    for path in with_progress(run_files(inputs), "reading"):
        try:
            mark = runfile.read_mark(path)
            verdict = runfile.verify(path) if verify else None
            info = runfile.read_info(path)
        except RunFileError as error:
            wrong.append(str(error))
            continue
        found.append((info, mark.reason if mark is not None else None, None if verdict is None else verdict.holds))
        if verdict is not None and not verdict.holds:
            wrong.append(f"{path}: {_checksum_error(verdict)}")
    if as_json:
        print_json([_info_json(*one) for one in found])
    elif found:
        print_result("\n\n".join(_info_text(*one) for one in found))
    for sentence in wrong:
        print_error(sentence)
    if wrong:
        ctx.exit(BAD_INPUT)


def _checksum_error(verdict: "Verification") -> str:
    if not verdict.stored:
        return "has no checksum, so that nobody can tell whether its samples are those that were recorded."
    return "its samples are NOT those that were recorded; take it from a copy."


def _info_json(info: "RunInfo", bad: str | None, intact: bool | None) -> dict[str, object]:
    header = info.header
    return {
        "file": info.path,
        "run_id": header.run_id,
        "kind": info.kind,
        "status": info.status,
        "reason": info.reason,
        "bad": bad,
        "start_time": header.start_time,
        "end_time": info.end_time,
        "order": header.order,
        "backend": header.backend,
        "sample_rate_hz": header.sample_rate_hz,
        "samples": info.samples,
        "duration_s": info.samples / header.sample_rate_hz,
        "channels": {channel.name: channel.units for channel in header.channels},
        "entry": header.entry,
        "protocol": header.protocol,
        "capsule": header.capsule,
        "specimen": header.specimen,
        "checks": info.checks,
        "intact": intact,
        "format_version": info.format_version,
    }


def _info_text(info: "RunInfo", bad: str | None, intact: bool | None) -> str:
    header = info.header
    lines = [
        str(info.path),
        _info_line("run", f"{info.kind}, {info.status.value}" + (f" ({info.reason})" if info.reason else "")),
        *([_info_line("marked bad", bad)] if bad is not None else []),
        *([_info_line("checksum", "holds" if intact else "none, or the samples differ")] if intact is not None else []),
        _info_line("started", f"{header.start_time:%Y-%m-%d %H:%M:%S %z}, order {header.order}, {header.backend}"),
        _info_line(
            "samples",
            f"{info.samples} at {header.sample_rate_hz:g} Hz, {duration_text(info.samples / header.sample_rate_hz)}"
            f", {size_text(Path(info.path).stat().st_size)}",
        ),
        _info_line("channels", ", ".join(f"{channel.name} [{channel.units}]" for channel in header.channels)),
    ]
    groups = {
        "protocol": header.protocol,
        "capsule": header.capsule,
        "specimen": header.specimen,
        "checks": info.checks,
        "more": header.entry,
    }
    for name, values in groups.items():
        lines += [
            _info_line(name if place == 0 else "", f"{key} = {value}")
            for place, (key, value) in enumerate(values.items())
        ]
    return "\n".join(lines)


def _info_line(name: str, text: str) -> str:
    return f"  {name:11} {text}"


@click.command("mark")
@options.inputs
@click.option("--bad", metavar="REASON", help="Why the runs are not to be used.")
@click.option("--good", is_flag=True, help="Take the mark back.")
@options.as_json
def mark_command(inputs: tuple[str, ...], bad: str | None, good: bool, as_json: bool) -> None:
    """Mark runs as bad, or take the mark back.

    RUN is a run file, a pattern or a campaign's folder. The mark is kept beside the run file, which stays as it is;
    filter, export, table and everything later leave marked runs out or say so.
    """
    if good == (bad is not None):
        raise click.UsageError("Give either --bad REASON or --good", click.get_current_context())
    from dragrig.rig.runfile import mark_bad, read_info, unmark
    from dragrig.run_inputs import run_files

    paths = run_files(inputs)
    for path in paths:
        read_info(path)  # nothing is marked unless everything named is a run
    for path in paths:
        if bad is not None:
            mark_bad(path, bad)
        else:
            unmark(path)
    if as_json:
        print_json([{"file": path, "bad": bad} for path in paths])
    else:
        for path in paths:
            print_result(f"{path}  {f'bad: {bad}' if bad is not None else 'good'}")


@click.command("filter")
@options.inputs
@click.option("--window-s", type=float, metavar="S", help="Length of the window in seconds; 0.05 unless given.")
@click.option("--window-samples", type=int, metavar="N", help="The same in samples, an odd number.")
@click.option("--order", type=int, metavar="N", help="Order of the polynomial; 3 unless given.")
@click.option(
    "--derivative", type=int, metavar="N", default=0, show_default=True, help="Derivative of the forces by time."
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
    """Smooth every force of run files, and measure the speed from the position.

    RUN is a run file, a pattern or a campaign's folder. The result is stored in the file beside the raw trace,
    with its parameters, in place of an earlier one; the raw trace stays as it is. Runs marked bad are left out
    unless they are named themselves.
    """
    from dragrig.analysis.savgol import filter_file
    from dragrig.api.evaluate import filter_settings
    from dragrig.rig.runfile import read_info

    batch = FileBatch.of_good_runs(inputs, "filtering")
    done = []
    for path, filtered in batch.each(
        lambda path, _within: filter_file(
            path,
            filter_settings(read_info(path).header.sample_rate_hz, window_s, window_samples, order, derivative),
        )
    ):
        done.append({"file": path, "parameters": filtered.trace.parameters, "events": filtered.events})
        if not as_json:
            print_result(f"{path}  {_filter_text(filtered)}")
    if as_json:
        print_json(done)
    batch.close()


def _filter_text(filtered: "FilteredRun") -> str:
    how = filtered.trace.parameters
    words = f"window {how['window_s']:.4g} s ({how['window_samples']} samples), order {how['order']}"
    if how["derivative"]:
        words += f", derivative {how['derivative']}"
    return "; ".join((words, *(event.message for event in filtered.events)))


class _ImportOptions(TypedDict):
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
def import_command(
    inputs: tuple[str, ...],
    assignments: tuple[str, ...],
    settings: str | None,
    protocol: tuple[str, ...],
    out: Path | None,
    as_json: bool,
    **given: Unpack[_ImportOptions],
) -> None:
    """Turn measurements from elsewhere into run files.

    FILE is text (CSV, decimal commas, any encoding that instruments write), MAT, Parquet, TDMS or NPZ. Say with --map
    which column is time, force, position, command, motor_force or temperature, and its unit: --map force=Load:N, or
    by number, --map time=1:s. A unit of another kind needs a factor: --map force=Friction:1*1000. An export of this
    software needs no map. Nothing is written over.
    """
    from dragrig.analysis.importing import import_file
    from dragrig.api.evaluate import import_settings, next_run_order
    from dragrig.run_inputs import input_files

    batch = FileBatch(input_files(inputs), "importing")
    wanted = {key: value for key, value in given.items() if value is not None}
    how = import_settings(assignments, {**wanted, **_protocol_settings(protocol)}, settings)
    folder = options.make_folder(out) if out is not None else Path()

    orders = count(next_run_order(folder))

    def read(path: Path, _within: FileProgress) -> "ImportedRun":
        return import_file(path, folder, how.model_copy(update={"order": next(orders)}))

    done = []
    for path, imported in batch.each(read):
        done.append({"source": path, **_import_json(imported)})
        if not as_json:
            print_result(display_path(imported.path))
            for event in imported.events:
                print_remark(f"  {event.time_s:.3f} s: {event.message}")
    if as_json:
        print_json(done)
    batch.close()


def _import_json(imported: "ImportedRun") -> dict[str, object]:
    return {
        "file": imported.path,
        "samples": imported.samples,
        "sample_rate_hz": imported.sample_rate_hz,
        "events": imported.events,
    }


def _protocol_settings(assignments: tuple[str, ...]) -> dict[str, object]:
    from dragrig.config.errors import SettingsError
    from dragrig.config.settings import parse_assignment

    found: dict[str, object] = {}
    for text in assignments:
        path, value = parse_assignment(text)
        if len(path) > 1:
            raise SettingsError(f"--set {text}: is not a plain key of the motion, as in speed_mm_s=5.")
        found[path[0]] = value
    return {"protocol": found} if found else {}


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
def export_command(
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
    from dragrig.analysis.export import CsvStyle, ExportFormat, export_run

    if form != "csv" and (decimal or delimiter):
        raise click.UsageError("--decimal and --delimiter are for --format csv alone", click.get_current_context())
    style = CsvStyle(decimal or ".", "\t" if delimiter in {"tab", "\\t"} else delimiter or "")
    batch = FileBatch.of_good_runs(inputs, "exporting")
    folder = options.make_folder(out) if out is not None else None

    def write(path: Path, within: FileProgress) -> Path:
        target = (folder or path.parent) / f"{path.stem}.{form}"
        return export_run(path, target, ExportFormat(form), style, overwrite=overwrite, progress=within)

    done = []
    for path, written in batch.each(write):
        done.append({"run": path, "file": written})
        if not as_json:
            print_result(display_path(written))
    if as_json:
        print_json(done)
    batch.close()
