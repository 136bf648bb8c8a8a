"""The command watch."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dragrig.cli import options
from dragrig.cli.console import print_remark, print_result
from dragrig.present.numbers import duration_text, number_text

if TYPE_CHECKING:
    from rich.table import Table

    from dragrig.watch import CampaignState, CampaignWatch

DEFAULT_PORT = 8765
ACTIVITY_TEXTS = {
    "preparing": "makes the rig ready",
    "asking": "waits for a person",
    "waiting": "rests",
    "recording": "records",
    "between": "between two runs",
    "ended": "over",
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
    help=f"Serve a small page on this machine alone, at port {DEFAULT_PORT} unless given; 0 takes a free one.",
)
@click.option(
    "--every",
    "every_s",
    metavar="S",
    default=0.5,
    show_default=True,
    type=click.FloatRange(0.05, 60.0),
    help="Seconds between two looks.",
)
@options.as_json
@options.quiet
def watch_command(folder: Path, once: bool, page: int | None, every_s: float, as_json: bool) -> None:
    """Follow a running campaign from another process, which it never notices: files are only read.

    DIR is the campaign's folder, or the folder of campaigns, whose latest is meant. Shows the run, its phase, the time
    left, the force now and what the session waits for; ends by itself when the campaign does. With --json each look is
    a line of JSON; with --once there is one look.
    """
    from dragrig.watch import CampaignWatch

    watch = CampaignWatch(folder)
    if page is not None and not once:
        from dragrig.watch import serve_state_page

        with serve_state_page(page) as server:
            print_remark(f"http://127.0.0.1:{server.port}/ shows {watch.folder}")
            for state in watch.follow(every_s):
                server.show(state)
            server.linger()
        _print_state(state, as_json)
    elif once:
        _print_state(watch.look(), as_json)
    else:
        _follow(watch, every_s, as_json=as_json)


def _follow(watch: "CampaignWatch", every_s: float, *, as_json: bool) -> None:
    if as_json or not sys.stdout.isatty():
        before = ""
        for state in watch.follow(every_s):
            line = _state_json(state) if as_json else state_line(state)
            if line != before:
                print_result(line)
            before = line
        return
    from rich.live import Live

    with Live(auto_refresh=False) as live:
        for state in watch.follow(every_s):
            live.update(state_table(state), refresh=True)


def _print_state(state: "CampaignState", as_json: bool) -> None:
    if as_json or not sys.stdout.isatty():
        print_result(
            _state_json(state)
            if as_json
            else "\n".join(f"{name:10}{text}" for name, text in state_texts(state).items())
        )
        return
    from rich.console import Console

    Console().print(state_table(state))


def _state_json(state: "CampaignState") -> str:
    import json

    from dragrig.present.json_values import to_json_value

    return json.dumps(to_json_value(state), allow_nan=False)


def state_line(state: "CampaignState") -> str:
    """Return a state as a line that changes when something begins or ends, and not with every sample."""
    run = "" if state.of is None else f"run {state.run} of {state.of}, "
    what = state.recording.kind if state.recording is not None else ""
    phase = f", {state.recording.phase}" if state.recording is not None and state.recording.phase else ""
    ended = f", {state.status}" if state.status else ""
    said = f": {state.said}" if state.said else ""
    return f"{state.campaign}: {run}{ACTIVITY_TEXTS[state.doing]}{ended}{f' {what}{phase}' if what else ''}{said}"


def state_texts(state: "CampaignState") -> dict[str, str]:
    """Return a state in words, by what each is about."""
    recording = state.recording
    words = {
        "campaign": f"{state.campaign} ({state.plan}, {state.backend})" if state.plan else state.campaign,
        "state": f"{ACTIVITY_TEXTS[state.doing]}{f', {state.status}' if state.status else ''}",
        "what": state.said,
        "run": "" if state.of is None else f"{state.run} of {state.of}",
        "left": "" if state.left_s is None else duration_text(state.left_s),
        "finished": f"{len(state.finished)} runs" if state.finished else "",
    }
    if recording is not None:
        of = "" if recording.run_s is None else f" of {duration_text(recording.run_s)}"
        words |= {
            "kind": recording.kind,
            "phase": f"{recording.phase}, {duration_text(recording.time_s)}{of}",
            "force": f"{number_text(recording.force_mN, 4)} mN",
            "position": f"{number_text(recording.position_mm, 5)} mm",
            "samples": f"{recording.samples}",
        }
    return {name: text for name, text in words.items() if text}


def state_table(state: "CampaignState") -> "Table":
    """Return a state as a table for the terminal."""
    from rich.markup import escape
    from rich.table import Table

    table = Table.grid(padding=(0, 2))
    loud = {"asking": "bold yellow", "died": "bold red", "ended": "bold"}.get(state.doing, "bold green")
    for name, text in state_texts(state).items():
        styled = f"[{loud}]{escape(text)}[/]" if name in {"state", "what"} else escape(text)
        table.add_row(f"[dim]{name}[/]", f"[bold]{styled}[/]" if name == "force" else styled)
    return table
