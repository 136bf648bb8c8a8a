"""Commands that tabulate, draw, compare, report and watch runs."""

import os
import sys
from dataclasses import dataclass
from math import isfinite
from mimetypes import guess_type
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click

from dragrig.cli import options
from dragrig.cli.console import (
    FileBatch,
    ProgressMeter,
    display_path,
    echo,
    join_path,
    print_document,
    print_json,
    print_remark,
    write_report,
)
from dragrig.present import duration_text, shortest

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from matplotlib.figure import Figure
    from rich.table import Table

    from dragrig.rig import Campaign
    from dragrig.run_listing import RunListing, RunQuery
    from dragrig.watch import CampaignState, CampaignWatch

AnswerT = TypeVar("AnswerT")


@click.command("table")
@options.campaigns
@options.as_json
@options.quiet
def table_command(campaigns: tuple[Path, ...], listing: "Campaign | None", as_json: bool) -> None:
    """Tabulate CAMPAIGNs: folders, pooled where they are several, or run files of one (default: the newest campaign).

    One line per run: kind, speed, steady force with its standard error, checks, and whether it is marked bad; then the
    mean steady force of each specimen's repeats, and over specimens where there are several, with 95 % intervals by
    Student's t, without bad and unfinished runs and sentinels. Specimens are told apart by their id.
    """
    from dragrig.analysis import pooled_rows, table_rows
    from dragrig.present import campaign_table_document
    from dragrig.run_inputs import require_run_files

    with ProgressMeter("measuring") as meter:
        rows = pooled_rows(campaigns, meter.at) if listing is None else table_rows(listing, meter.at)
    if not rows:
        require_run_files(campaigns[0])
    print_document(campaign_table_document(rows), as_json=as_json)


def _ask_runs(folder: Path | None, question: "Callable[[RunListing], AnswerT]", *, rebuild: bool = False) -> "AnswerT":
    """Answer a question about the runs of a folder, by default the lab's data root, that holds some."""
    from dragrig.api import ask_lab

    with ProgressMeter("reading run files") as meter:
        return ask_lab(folder, question, remark=print_remark, progress=meter.at, rebuild=rebuild)


@click.command("list")
@click.argument("folder", required=False, type=click.Path(path_type=Path))
@click.option("--rebuild", is_flag=True, help="Make the lab's catalogue of runs again from the run files first.")
@options.as_json
@options.quiet
def list_command(folder: Path | None, rebuild: bool, as_json: bool) -> None:
    """List the campaigns in FOLDER and below it (default: the lab's data root).

    One line each: when it began, specimen, runs by kind, operator, and how many are marked bad.
    """
    from dragrig.present import campaigns_list_document

    campaigns = _ask_runs(folder, lambda listing: listing.summaries(), rebuild=rebuild)
    print_document(campaigns_list_document(campaigns), as_json=as_json)


@click.command("find")
@click.argument("folder", required=False, type=click.Path(path_type=Path))
@click.option("--specimen", metavar="NAME", default="", help="Name or id of the specimen.")
@click.option("--kind", metavar="NAME", default="", help="Kind of run: drag, relaxation, …, or sentinel.")
@click.option("--operator", metavar="NAME", default="", help="Part of the operator's name.")
@click.option("--date", metavar="DATE", default="", help="Begun on this day.")
@click.option("--since", metavar="DATE", default="", help="Begun at this time or later.")
@click.option("--until", metavar="DATE", default="", help="Begun at this time or earlier, or on this day.")
@click.option("--bad/--good", "marked", default=None, help="Marked bad, or not (default: either).")
@click.option("--campaigns", is_flag=True, help="Print the folders of the campaigns that hold such runs instead.")
@options.as_json
@options.quiet
def find_command(
    folder: Path | None,
    specimen: str,
    kind: str,
    operator: str,
    date: str,
    since: str,
    until: str,
    marked: bool | None,
    campaigns: bool,
    as_json: bool,
) -> None:
    """Find runs in all campaigns in FOLDER and below it (default: the lab's data root).

    Prints the path of each run file: dragrig show $(dragrig find --specimen P7 --kind drag); or of each campaign:
    dragrig identify --together $(dragrig find --kind relaxation --campaigns).
    """
    from dragrig.api import run_query

    if date and (since or until):
        raise click.UsageError("--date is a single day; leave out --since and --until", click.get_current_context())
    query = run_query(specimen, kind, operator, since or date, until or date, marked)
    found, hint = _ask_runs(folder, lambda listing: _found_or_hint(listing, query))
    if as_json:
        paths = [join_path(str(parent), name) for parent, names in found.items() for name in names]
        print_json(list(map(str, found)) if campaigns else paths)
        return
    count = sum(map(len, found.values()))
    if campaigns and found:
        echo("\n".join(map(display_path, found)))
    elif count:
        shown = ((display_path(parent), names) for parent, names in found.items())
        echo("\n".join(join_path(parent, name) for parent, names in shown for name in names))
    print_remark(f"{count} run{'' if count == 1 else 's'}{hint}")


def _found_or_hint(listing: "RunListing", query: "RunQuery") -> "tuple[Mapping[Path, tuple[str, ...]], str]":
    """Return the runs found; where there are none, also the requests that no run meets."""
    from dragrig.config import suggestion

    found = listing.found(query)
    specimens = sorted({name for campaign in listing.summaries() for name in campaign.specimens}) if not found else []
    for name, value, known in (("kind", query.kind, listing.kinds), ("specimen", query.specimen, lambda: specimens)):
        if not found and value and value.casefold() not in map(str.casefold, known()):
            return found, f": no run is of the {name} {value}; {suggestion(value, known())}"
    return found, ""


PICTURE_SUFFIXES = (".png", ".svg", ".pdf")


@click.command("show")
@options.inputs_or_newest
@click.option(
    "--out",
    "-o",
    metavar="FILE|DIR",
    type=click.Path(path_type=Path),
    help="A .png, .svg or .pdf file for one picture, or a folder for all (default: beside the runs).",
)
@click.option("--no-filtered", "raw_only", is_flag=True, help="Leave out the filtered force.")
@click.option("--motor-force", is_flag=True, help="Add the motor force, where it was recorded.")
@options.picture_form
@options.overwrite
@options.as_json
@options.quiet
def show_command(
    inputs: tuple[str, ...], out: Path | None, raw_only: bool, motor_force: bool, overwrite: bool, as_json: bool
) -> None:
    """Draw runs: force, raw and filtered, position and speed, with the phases. Prints the paths of the pictures.

    RUN is a run file, a pattern, as runs/first/*.h5, or a campaign's folder, of which an overview is drawn, or with
    --column its steady forces against speed (default: the newest campaign). An existing name gets a number, unless it
    was given with --out: then it is refused. With --column, pictures are as journals take them: 85 mm (single), 180 mm
    (double) or so many mm wide, without title and badge, letters of 6 to 7 pt, PNG with 600 dpi. Panels side by side
    take 180 mm where less than 120 mm are asked for.
    """
    from dragrig.api import show
    from dragrig.rig import run_name
    from dragrig.run_inputs import run_files

    folders = [Path(name) for name in inputs if Path(name).is_dir()]
    files = [name for name in inputs if not Path(name).is_dir()]
    target = _picture_target(out, len(folders) + len(paths := run_files(files)), overwrite)

    def draw(path: Path, _: object) -> Path:
        figure = show(path, filtered=not raw_only, motor_force=motor_force)
        return target.save(figure, path.resolve().name if path.is_dir() else run_name(path), path)

    batch = FileBatch((*paths, *folders), "drawing")
    # All are drawn before any is printed: a reader such as head ends the command.
    drawn = [{"source": source, "picture": picture} for source, picture in batch.process(draw)]
    if as_json:
        print_json(drawn)
    else:
        for line in drawn:
            echo(display_path(line["picture"]))
    batch.close()


@dataclass(frozen=True, slots=True)
class _PictureTarget:
    """Where pictures go: a file, a folder, or beside the runs."""

    file: Path | None
    folder: Path | None
    overwrite: bool

    def save(self, figure: "Figure", name: str, source: Path) -> Path:
        from dragrig.present import save_figure, save_figure_in

        if self.file is not None:
            return save_figure(figure, self.file, overwrite=self.overwrite)
        beside = source if source.is_dir() else source.parent
        # Measured data are often read-only.
        here = beside if os.access(beside, os.W_OK) else Path()
        return save_figure_in(self.folder or here, name, figure, overwrite=self.overwrite)


def _picture_target(out: Path | None, pictures: int, overwrite: bool) -> _PictureTarget:
    if out is None or out.is_dir() or out.suffix.lower() not in PICTURE_SUFFIXES:
        if out is not None and not out.is_dir() and guess_type(out.name)[0] is not None:
            raise click.UsageError(
                f"{out}: pictures are written as {', '.join(PICTURE_SUFFIXES)}; name such a file, or a folder",
                click.get_current_context(),
            )
        return _PictureTarget(None, out, overwrite)
    if pictures > 1:
        raise click.UsageError(f"{pictures} pictures do not fit into {out}; name a folder", click.get_current_context())
    return _PictureTarget(out, None, overwrite)


@click.command("report")
@options.inputs_or_newest
@click.option(
    "--report",
    "--out",
    "-o",
    "out",
    metavar="FILE.html",
    type=click.Path(path_type=Path),
    help="Report file (default: beside the run, or in the campaign's folder).",
)
@options.overwrite
@options.as_json
@options.quiet
def report_command(inputs: tuple[str, ...], out: Path | None, overwrite: bool, as_json: bool) -> None:
    """Write a report on RUN, a run file or a campaign's folder (default: the newest), one HTML file to be mailed.

    For a run: force, position and speed, measures with their errors, checks, events and all settings. For a campaign:
    steady force against speed, relaxations, a table and a figure of every run, sessions, and the runs left out with the
    reasons. Figures are embedded, tables sort by any column, and the page prints and fits a phone.
    """
    from dragrig.api import report

    if len(inputs) > 1:
        raise click.UsageError("a report is on one run or one campaign; name one", click.get_current_context())
    source = Path(inputs[0])
    with ProgressMeter("measuring and drawing") as meter:
        written = report(source, out, overwrite=overwrite, workers=None, progress=meter.at)
    if as_json:
        print_json({"source": source, "report": written})
        return
    echo(display_path(written))


@click.command("compare")
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path), required=False)
@click.option("--model", metavar="F|NAME", help="Compare A with this friction model in place of B.")
@options.effects("Add an effect to that model, as listed by dragrig gap effects; repeatable.")
@click.option("--specimen", metavar="NAME", help="Specimen, where a folder holds several (default: all).")
@options.out("Folder for a table, an overview, and a picture of each pair.")
@options.report
@options.picture_form
@options.overwrite
@options.as_json
@options.quiet
def compare_command(
    a: Path,
    b: Path | None,
    model: str | None,
    effects: tuple[str, ...],
    specimen: str | None,
    out: Path | None,
    report: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Compare two campaigns, two runs, or either with the friction model.

    A and B are campaign folders or run files. Runs under the same conditions are paired and aligned on the start of
    their motion. Prints the measures side by side (differences are B − A; ± is the 95 % interval for equal runs, from
    noise, run-to-run scatter and unknown zeros), the largest differences first; the report has all pairs. The exit code
    is 0 even where they differ.
    """
    if (b is None) == (model is None):
        raise click.UsageError("name either a second campaign or run, or a --model", click.get_current_context())
    from dragrig.api import compare, write_comparison
    from dragrig.present import comparison_document, comparison_json

    with ProgressMeter("comparing") as meter:
        comparison = compare(a, b, model=model, effects=effects, specimen=specimen, progress=meter.at)
    document = comparison_document(comparison)
    write_report(document, report, a, *filter(None, (b,)), overwrite=overwrite)
    written: list[Path] = []
    if out is not None:
        with ProgressMeter("drawing") as meter:
            written = list(write_comparison(comparison, out, overwrite=overwrite, progress=meter.at))
    if as_json:
        print_json({**comparison_json(comparison), **({"files": written} if written else {})})
        return
    print_document(document, as_json=False)
    for path in (*written[:2], *filter(None, (report,))):
        echo(display_path(path))
    if written[2:]:
        echo(f"{len(written) - 2} pictures of pairs in {display_path(written[0].parent)}")


DEFAULT_PORT = 8765
ACTIVITY_TEXTS = {
    "preparing": "preparing the rig",
    "asking": "waiting for the operator",
    "waiting": "waiting",
    "recording": "recording",
    "between": "between two runs",
    "ended": "ended",
    "died": "died",
}


@click.command("watch")
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--once", is_flag=True, help="Print one state and end.")
@click.option(
    "--page",
    metavar="[PORT]",
    is_flag=False,
    flag_value=DEFAULT_PORT,
    default=None,
    type=click.IntRange(0, 65535),
    help=f"Serve a page, without --host to this machine alone (default port: {DEFAULT_PORT}; 0: any free one).",
)
@click.option(
    "--host",
    metavar="ADDRESS",
    help="Serve the page to other machines too, at this address of this machine (0.0.0.0: at all); the printed address "
    "has a token without which nothing is shown.",
)
@click.option(
    "--every",
    "every_s",
    metavar="S",
    default=0.5,
    show_default=True,
    type=options.Number(0.05, 60.0),
    help="Refresh interval in seconds.",
)
@options.as_json
@options.quiet
def watch_command(folder: Path, once: bool, page: int | None, host: str | None, every_s: float, as_json: bool) -> None:
    """Show the progress of a running campaign from another process; only reads files.

    DIR is the campaign's folder, or a folder of campaigns, of which the latest is followed. Shows the run, its phase,
    the time left, the current force and what the session waits for; ends when the campaign does. With --json each state
    is one line of JSON; with --once there is one state.
    """
    from dragrig.watch import LOCAL_HOST, CampaignWatch, serve_state_page

    watch = CampaignWatch(folder)
    if host is not None and page is None:
        page = DEFAULT_PORT
    if page is not None and not once:
        with serve_state_page(page, host or LOCAL_HOST) as server:
            print_remark(f"{server.address} shows {watch.folder}")
            for state in watch.follow(every_s):
                server.show(state)
            server.wait_for_tabs()
        _print_state(state, as_json)
    elif once:
        _print_state(watch.look(), as_json)
    else:
        _follow(watch, every_s, as_json=as_json)


def _follow(watch: "CampaignWatch", every_s: float, *, as_json: bool) -> None:
    if sys.stdout.isatty() and not as_json:
        from rich.live import Live

        with Live(auto_refresh=False) as live:
            for state in watch.follow(every_s):
                live.update(state_table(state), refresh=True)
        return
    before: object = None
    for state in watch.follow(every_s):
        shown = state if as_json else state_line(state)
        if shown == before:
            continue
        before = shown
        if as_json:
            print_json(state.to_json(), indent=None)
        else:
            echo(state_line(state))


def _print_state(state: "CampaignState", as_json: bool) -> None:
    if as_json:
        print_json(state.to_json(), indent=None)
    elif sys.stdout.isatty():
        from rich.console import Console

        Console().print(state_table(state))
    else:
        echo("\n".join(f"{name:10}{text}" for name, text in state_texts(state).items()))


def state_line(state: "CampaignState") -> str:
    """Return a state as one line, which changes with each activity and not with every sample."""
    run = "" if state.runs is None else f"{state.run} of {state.runs} runs, "
    kind = state.recording.kind if state.recording is not None else ""
    phase = f", {state.recording.phase}" if state.recording is not None and state.recording.phase else ""
    ended = f", {state.status}" if state.status else ""
    reason = f": {state.message}" if state.message else ""
    return f"{state.campaign}: {run}{ACTIVITY_TEXTS[state.doing]}{ended}{f' {kind}{phase}' if kind else ''}{reason}"


def _quantity(value: float | None, unit: str, digits: int) -> str:
    return "" if value is None or not isfinite(value) else f"{shortest(digits)(value)} {unit}"


def state_texts(state: "CampaignState") -> dict[str, str]:
    """Return the fields of a state as text, by name."""
    recording = state.recording
    texts = {
        "campaign": f"{state.campaign} ({state.plan}, {state.backend})" if state.plan else state.campaign,
        "state": f"{ACTIVITY_TEXTS[state.doing]}{f', {state.status}' if state.status else ''}",
        "message": state.message,
        "run": "" if state.runs is None else f"{state.run} of {state.runs}",
        "left": "" if state.left_s is None else duration_text(state.left_s),
        "finished": f"{len(state.finished)} runs" if state.finished else "",
    }
    if recording is not None:
        planned = "" if recording.run_s is None else f" of {duration_text(recording.run_s)}"
        texts |= {
            "kind": recording.kind,
            "phase": f"{recording.phase}, {duration_text(recording.time_s)}{planned}",
            "force": _quantity(recording.force_mN, "mN", 4),
            "position": _quantity(recording.position_mm, "mm", 5),
            "samples": f"{recording.samples}",
        }
    return {name: text for name, text in texts.items() if text}


def state_table(state: "CampaignState") -> "Table":
    """Return a state as a table for the terminal."""
    from rich.table import Table

    from dragrig.present.terminal import rich_text

    table = Table.grid(padding=(0, 2))
    loud = {"asking": "bold yellow", "died": "bold red", "ended": "bold"}.get(state.doing, "bold green")
    styles = {"state": loud, "message": loud, "force": "bold"}
    for name, text in state_texts(state).items():
        table.add_row(rich_text(name, "dim"), rich_text(text, styles.get(name, "")))
    return table
