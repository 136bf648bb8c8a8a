"""Commands that measure: init, check, run, recover, demo, gui."""

import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import click

from dragrig.cli import options
from dragrig.cli.console import (
    BAD_INPUT,
    ProgressMeter,
    display_path,
    is_quiet,
    print_error,
    print_json,
    print_remark,
    print_result,
)
from dragrig.present.numbers import duration_text, size_text, text_columns

if TYPE_CHECKING:
    from dragrig.campaign_session import Made
    from dragrig.engine_host.messages import RigSelection
    from dragrig.rig.operator import RunResult
    from dragrig.rig.preflight import Preflight, RunPreview
    from dragrig.rig.runfile import RecoveredRecording


@click.command("init")
@click.argument("folder", metavar="[DIR]", default=".", type=click.Path(path_type=Path))
@options.quiet
def init_command(folder: Path) -> None:
    """Make a lab folder: rig settings, data root, calibration history.

    Every command called in or below it takes its rig from there.
    """
    from dragrig.lab import create_lab

    for made in create_lab(folder):
        print_result(str(made))
    print_remark("Edit the rig settings, then try: dragrig check drag")


@click.command("check")
@click.argument("plan", required=False)
@options.settings
@options.out("Folder whose free space counts; the rig's data root unless given.")
@options.as_json
@click.pass_context
def check_command(
    ctx: click.Context, plan: str | None, out: Path | None, as_json: bool, **settings: Unpack[options.SettingsOptions]
) -> None:
    """Say what PLAN, a file or a shipped name, would do; without PLAN, look at the rig. Nothing moves.

    Shipped plans: blank, coulomb, demo, diagnose, drag, drag-sweep, paper, relaxation.

    With PLAN: every run with the range, speed and time that it takes, and what forbids it, if anything does.

    Without: limits, calibrations and every device in turn, each ok or NOT; exit code 5 when one is not.
    """
    import dragrig as api

    if plan is None:
        _check_rig(ctx, settings, out, as_json=as_json)
        return
    found = api.check(plan, out=out, **settings)
    if as_json:
        print_json(_check_json(found))
    else:
        print_result(_check_table(found))
        print_result(
            f"{len(found.previews)} runs, {duration_text(found.duration_s)}, {size_text(found.size_bytes)} "
            f"of {size_text(found.free_bytes)} free"
        )
    for finding in found.findings:
        print_error(f"{finding}.")
    if found.findings:
        ctx.exit(BAD_INPUT)


def _check_rig(ctx: click.Context, settings: options.SettingsOptions, out: Path | None, *, as_json: bool) -> None:
    given = {
        "specimen": settings["specimen"],
        "effect": settings["effects"],
        "capsule": settings["capsule"],
        "out": out,
    }
    if spare := [name for name, value in given.items() if value]:
        raise click.UsageError(f"Without a plan the rig itself is looked at, so leave out --{' --'.join(spare)}", ctx)
    import dragrig as api
    from dragrig.config.errors import DeviceError

    findings = []
    for finding in api.examine(
        rig=settings["rig"],
        model=settings["model"],
        backend=settings["backend"],
        double=settings["double"],
        assignments=settings["assignments"],
    ):
        findings.append(finding)
        if not as_json:
            print_result(f"{'ok ' if finding.fine else 'NOT'}  {finding.what}: {finding.detail}")
    if as_json:
        print_json(findings)
    if not all(finding.fine for finding in findings):
        ctx.exit(DeviceError.exit_code)


def _check_table(found: "Preflight") -> str:
    header = ("", "run", "capsule", "lowest mm", "highest mm", "mm/s", "mm/s²", "rest", "takes", "size", "before it")
    return text_columns(header, (_check_row(one) for one in found.previews))


def _check_row(preview: "RunPreview") -> tuple[str, ...]:
    run = preview.run
    return (
        str(run.index),
        run.protocol.summary(),
        run.capsule.name,
        f"{preview.lowest_mm:g}",
        f"{preview.highest_mm:g}",
        f"{preview.speed_mm_s:g}",
        f"{preview.accel_mm_s2:g}",
        duration_text(run.wait_s),
        duration_text(run.duration_s),
        size_text(preview.size_bytes),
        run.prompt,
    )


def _check_json(found: "Preflight") -> dict[str, object]:
    return {
        "runs": [_check_run_json(one) for one in found.previews],
        "duration_s": found.duration_s,
        "size_bytes": found.size_bytes,
        "free_bytes": found.free_bytes,
        "findings": found.findings,
    }


def _check_run_json(preview: "RunPreview") -> dict[str, object]:
    run = preview.run
    return {
        "index": run.index,
        "kind": run.protocol.kind,
        "parameters": run.protocol.attributes(),
        "capsule": run.capsule.name,
        "fixture": run.fixture,
        "lowest_mm": preview.lowest_mm,
        "highest_mm": preview.highest_mm,
        "speed_mm_s": preview.speed_mm_s,
        "accel_mm_s2": preview.accel_mm_s2,
        "wait_s": run.wait_s,
        "duration_s": run.duration_s,
        "size_bytes": preview.size_bytes,
        "prompt": run.prompt,
    }


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
def run_command(
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
    import dragrig as api
    from dragrig.cli.operator import TerminalOperator

    with TerminalOperator(yes=yes) as person:
        made = (
            api.resume(
                resume,
                operator=operator,
                note=note,
                pace=pace,
                person=person,
                assignments=settings["assignments"],
                mirror=mirror,
                tell=_print_warning,
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
                tell=_print_warning,
                **settings,
            )
        )
    if as_json:
        print_json(_session_json(made))
    else:
        print_remark(made.summary())
        _print_mirror_state(made)
        print_result(display_path(made.folder))
    made.session.require()


def _require_plan_or_campaign(plan: str | None, campaign: Path | None, given: list[str]) -> None:
    context = click.get_current_context()
    if plan is not None and campaign is not None:
        raise click.UsageError("--resume takes its plan from the campaign, so leave the plan out", context)
    if plan is None and campaign is None:
        raise click.UsageError("Name a plan, or a campaign to go on with after --resume", context)
    if campaign is not None and given:
        raise click.UsageError(f"A campaign goes on with its own settings, so leave out --{' --'.join(given)}", context)


def _session_json(made: "Made") -> dict[str, object]:
    return {
        "folder": made.folder,
        "status": made.session.status,
        "reason": made.session.reason,
        "runs": [_session_run_json(one) for one in made.session.runs],
        **({} if made.mirrored is None else {"mirror": made.mirrored}),
    }


def _print_mirror_state(made: "Made") -> None:
    found = made.mirrored
    if found is None:
        return
    if found.copied:
        print_remark(f"mirror: {len(found.copied)} files in {found.folder}, each read back and compared")
    if found.missing:
        print_error(
            f"NOT MIRRORED, {len(found.missing)} of {len(found.missing) + len(found.copied)} files: "
            + "; ".join(f"{name}: {why}" for name, why in found.missing.items())
        )


def _session_run_json(one: "RunResult") -> dict[str, object]:
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


def _print_warning(sentence: str) -> None:
    # From the mirror's thread, and whatever --quiet says: a copy that is not there must be known of.
    with suppress(OSError):  # a terminal that was closed hears nothing, and the copying goes on
        click.echo(f"\n{sentence}", err=True)


@click.command("recover")
@click.argument("places", metavar="[PLACE…]", nargs=-1, type=click.Path(path_type=Path))
@options.as_json
@options.quiet
@click.pass_context
def recover_command(ctx: click.Context, places: tuple[Path, ...], as_json: bool) -> None:
    """Finish the runs that a crash left behind.

    PLACE is a folder, searched with everything below it, or one recording (NAME.recording.h5); the working folder
    unless given. A recording that is still being written is left alone, and so is one that cannot be read.
    """
    from dragrig.rig.runfile import RecoveryOutcome, left_recordings, recover

    somewhere = places or (Path(),)
    total = sum(len(left_recordings(place)) for place in somewhere)
    found: list[RecoveredRecording] = []
    with ProgressMeter("recovering", total, quiet=is_quiet()) as meter:
        for place in somewhere:
            found += recover(place, lambda recording: meter.advance(0.0, f"recovering {recording.name}"))
            meter.advance(float(len(left_recordings(place))))
    if as_json:
        print_json(found)
    else:
        for one in found:
            if one.path is not None:
                print_result(f"{one.path}  {one.samples} samples")
    if not found:
        print_remark("There is nothing to recover.")
    left = [one for one in found if one.outcome is RecoveryOutcome.LEFT]
    for one in found:
        if one.outcome is not RecoveryOutcome.FINISHED:
            print_error(one.message)
    if left:
        ctx.exit(BAD_INPUT)


@click.command("demo")
@click.option(
    "--out",
    "-o",
    metavar="DIR",
    default="dragrig-demo",
    show_default=True,
    type=click.Path(path_type=Path),
    help="Folder that gets a campaign.",
)
@options.quiet
def demo_command(out: Path) -> None:
    """Run a short programme on the simulated rig and show what becomes of it.

    A blank run, a relaxation, a Coulomb test and drags at three speeds, one run file each; every trace filtered,
    exported as CSV and drawn; and a picture of the whole. Takes some seconds.
    """
    from dragrig.analysis.campaign_table import table_rows
    from dragrig.api import report as demo
    from dragrig.cli.look_commands import table_text
    from dragrig.cli.operator import TerminalOperator

    print_remark("The simulated rig makes a blank run, a relaxation, a Coulomb test and drags at three speeds:")
    with TerminalOperator(yes=True) as person:
        made = demo.run_demo(out, person)
    print_remark("Filtering, exporting and drawing every run …")
    with ProgressMeter("filtering, exporting, drawing", 1.0, quiet=is_quiet()) as meter:
        overview = demo.evaluate_demo(made, meter.at)
    print_result(table_text(table_rows(made.folder)))
    folder = display_path(made.folder)
    print_result(
        f"\nrun files  {folder}\ncsv        {display_path(made.folder / demo.DEMO_TABLES)}"
        f"\npictures   {display_path(made.folder / demo.DEMO_PICTURES)}, {display_path(overview)}"
    )
    print_remark(f"\nLook at it: dragrig info {folder}\nYour own:   dragrig init lab, then in it: dragrig run drag")


@click.command("gui")
@click.argument("lab", required=False, type=click.Path(path_type=Path))
@options.rig
@options.pace
@click.pass_context
def gui_command(
    ctx: click.Context,
    lab: Path | None,
    rig: str | None,
    model: str | None,
    backend: str | None,
    double: bool,
    assignments: tuple[str, ...],
    pace: options.Pace | None,
) -> None:
    """Show the window: run plans, look at runs, diagnose campaigns.

    LAB is a lab folder; the one that the working folder is in unless given. Which rig the window is for, simulated or
    hardware, is chosen here and holds for as long as it is open. The engine runs in a process of its own: when the
    window is closed or dies, the stage is stopped and the run finished.
    """
    from dragrig.config.errors import SettingsError
    from dragrig.config.rig import RIG_FILE, rig_file_of
    from dragrig.engine_host.messages import RigSelection

    if lab is not None and not (lab / RIG_FILE).is_file():
        raise SettingsError(f"{lab}: is no lab folder, it holds no {RIG_FILE}; make one with dragrig init {lab}.")
    rig_file = rig_file_of(lab or Path.cwd())
    meant = Path(rig) if rig is not None else rig_file
    terms = RigSelection(meant, model, backend, double, assignments, pace)
    ctx.exit(_show_window(terms, rig_file.parent if rig_file is not None else None))


def _show_window(terms: "RigSelection", lab: Path | None) -> int:
    from dragrig.config.errors import SettingsError

    try:
        from dragrig.window.main_window import show_window
    except ImportError as error:
        raise SettingsError(_missing_library(error)) from error
    if sys.platform == "linux" and not any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM"))):
        raise SettingsError(
            "gui: there is no screen here, neither DISPLAY nor WAYLAND_DISPLAY is set; sit at the machine itself, or "
            "connect with ssh -X."
        )
    return show_window(terms, lab)


def _missing_library(error: ImportError) -> str:
    """Say which package a window needs that is not there."""
    if error.name is not None and error.name.split(".")[0] in {"PySide6", "shiboken6", "pyqtgraph"}:
        return "gui: the window needs PySide6 and pyqtgraph; install them with pip install 'dragrig[gui]'."
    return f"gui: a library of the system that Qt needs is not there ({error}); the README names the packages."
