"""`dragrig run`."""

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import click

from dragrig.cli import options
from dragrig.cli.console import complain, result, result_json, say, shown_path

if TYPE_CHECKING:
    from dragrig.campaigns import Made
    from dragrig.rig.people import RunResult


@click.command("run")
@click.argument("plan", required=False)
@options.settings
@options.out("Folder of the campaign, new or empty; one below the rig's data root unless given.")
@click.option("--resume", metavar="CAMPAIGN", type=click.Path(path_type=Path), help="Go on where this campaign ended.")
@click.option("--operator", metavar="NAME", default="", help="Who is at the rig; kept in the run files.")
@click.option("--note", metavar="TEXT", default="", help="Kept in the run files.")
@click.option(
    "--mirror",
    metavar="DIR",
    type=click.Path(path_type=Path),
    help="Keep a second copy of each finished file here, compared after reading it back.",
)
@options.pace
@click.option("--yes", "-y", is_flag=True, help="Answer every prompt with done that asks for nobody's hands.")
@options.as_json
@options.quiet
def command(
    plan: str | None,
    out: Path | None,
    resume: Path | None,
    operator: str,
    note: str,
    mirror: Path | None,
    pace: options.Pace | None,
    yes: bool,
    as_json: bool,
    **settings: Unpack[options.SettingsOptions],
) -> None:
    """Carry out PLAN, a file or a shipped name, and write one run file per run.

    A run file in place of a plan makes its whole session again, with the settings it carries.

    Shipped plans: blank, coulomb, demo, diagnose, drag, drag-sweep, paper, relaxation.

    Everything is checked before anything moves. Ctrl-C stops the stage first and keeps what was recorded. The
    campaign's folder is printed at the end.

    Exit codes: 0 done, 2 bad input, 3 aborted, 4 the guard tripped, 5 device fault.
    """
    fixed = {**settings, "assignments": (), "effects": (), "effect": settings["effects"], "out": out}
    _require_plan_or_campaign(plan, resume, [name for name, value in fixed.items() if value])
    from dragrig import api
    from dragrig.cli.operator import Terminal

    with Terminal(yes=yes) as person:
        made = (
            api.resume(
                resume,
                operator=operator,
                note=note,
                pace=pace,
                person=person,
                assignments=settings["assignments"],
                mirror=mirror,
                tell=_tell_aloud,
            )
            if resume is not None
            else api.run(
                plan or "",
                out=out,
                operator=operator,
                note=note,
                pace=pace,
                person=person,
                mirror=mirror,
                tell=_tell_aloud,
                **settings,
            )
        )
    if as_json:
        result_json(_plain(made))
    else:
        say(made.summary())
        _say_mirrored(made)
        result(shown_path(made.folder))
    made.session.require()


def _require_plan_or_campaign(plan: str | None, campaign: Path | None, given: list[str]) -> None:
    context = click.get_current_context()
    if plan is not None and campaign is not None:
        raise click.UsageError("--resume takes its plan from the campaign, so leave the plan out", context)
    if plan is None and campaign is None:
        raise click.UsageError("Name a plan, or a campaign to go on with after --resume", context)
    if campaign is not None and given:
        raise click.UsageError(f"A campaign goes on with its own settings, so leave out --{' --'.join(given)}", context)


def _plain(made: "Made") -> dict[str, object]:
    return {
        "folder": made.folder,
        "status": made.session.status,
        "reason": made.session.reason,
        "runs": [_plain_run(one) for one in made.session.runs],
        **({} if made.mirrored is None else {"mirror": made.mirrored}),
    }


def _say_mirrored(made: "Made") -> None:
    found = made.mirrored
    if found is None:
        return
    if found.copied:
        say(f"mirror: {len(found.copied)} files in {found.folder}, each read back and compared")
    if found.missing:
        complain(
            f"NOT MIRRORED, {len(found.missing)} of {len(found.missing) + len(found.copied)} files: "
            + "; ".join(f"{name}: {why}" for name, why in found.missing.items())
        )


def _plain_run(one: "RunResult") -> dict[str, object]:
    return {
        "file": one.path,
        "order": one.order,
        "kind": one.run.protocol.kind,
        "parameters": one.run.protocol.attributes(),
        "status": one.outcome.status,
        "reason": one.outcome.reason,
        "samples": one.outcome.samples,
        "checks": one.outcome.checks.values,
        "warnings": one.outcome.checks.warnings,
    }


def _tell_aloud(sentence: str) -> None:
    # From the mirror's thread, and whatever --quiet says: a copy that is not there must be known of.
    with suppress(OSError):  # a terminal that was closed hears nothing, and the copying goes on
        click.echo(f"\n{sentence}", err=True)
