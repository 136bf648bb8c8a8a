"""The command watch."""

import sys
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dragrig.cli import options
from dragrig.cli.console import print_json_line, print_remark, print_result
from dragrig.present.numbers import duration_text, shortest

if TYPE_CHECKING:
    from rich.table import Table

    from dragrig.watch import CampaignState, CampaignWatch

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
    help=f"Serve a page to this machine alone (default port: {DEFAULT_PORT}; 0: any free one).",
)
@click.option(
    "--every",
    "every_s",
    metavar="S",
    default=0.5,
    show_default=True,
    type=click.FloatRange(0.05, 60.0),
    help="Refresh interval in seconds.",
)
@options.as_json
@options.quiet
def watch_command(folder: Path, once: bool, page: int | None, every_s: float, as_json: bool) -> None:
    """Follow a running campaign from another process; only reads files.

    DIR is the campaign's folder, or a folder of campaigns, of which the latest is followed. Shows the run, its phase,
    the time left, the present force and what the session waits for; ends when the campaign does. With --json each state
    is one line of JSON; with --once there is one state.
    """
    from dragrig.watch import CampaignWatch, serve_state_page

    watch = CampaignWatch(folder)
    if page is not None and not once:
        with serve_state_page(page) as server:
            print_remark(f"http://127.0.0.1:{server.port}/ shows {watch.folder}")
            for state in watch.follow(every_s):
                server.show(state)
            server.wait_for_last()
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
            print_json_line(state.to_json())
        else:
            print_result(state_line(state))


def _print_state(state: "CampaignState", as_json: bool) -> None:
    if as_json:
        print_json_line(state.to_json())
    elif sys.stdout.isatty():
        from rich.console import Console

        Console().print(state_table(state))
    else:
        print_result("\n".join(f"{name:10}{text}" for name, text in state_texts(state).items()))


def state_line(state: "CampaignState") -> str:
    """Return a state as one line, which changes with each activity and not with every sample."""
    run = "" if state.runs is None else f"run {state.run} of {state.runs}, "
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
    from rich.markup import escape
    from rich.table import Table

    table = Table.grid(padding=(0, 2))
    loud = {"asking": "bold yellow", "died": "bold red", "ended": "bold"}.get(state.doing, "bold green")
    for name, text in state_texts(state).items():
        styled = f"[{loud}]{escape(text)}[/]" if name in {"state", "message"} else escape(text)
        table.add_row(f"[dim]{name}[/]", f"[bold]{styled}[/]" if name == "force" else styled)
    return table
