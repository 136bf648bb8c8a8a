"""Commands that measure: init, check, run, recover, demo, gui."""

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, Unpack, cast

import click

from dragrig.cli import options
from dragrig.cli.console import (
    BAD_INPUT,
    ProgressMeter,
    display_path,
    echo,
    print_document,
    print_error,
    print_json,
    print_remark,
    print_warning,
)

if TYPE_CHECKING:
    from dragrig.campaign_session import Made
    from dragrig.rig import RecoveredRecording
    from dragrig.setup import RigChoices, SetupChoices


@click.command("init")
@click.argument("folder", metavar="[DIR]", default=".", type=click.Path(path_type=Path))
@options.quiet
def init_command(folder: Path) -> None:
    """Make a lab folder: settings of rig and notification, data root, calibration history.

    Every command called in or below it takes its rig from there.
    """
    from dragrig.setup import create_lab

    for path in create_lab(folder):
        echo(str(path))
    print_remark("Edit the rig settings, then try: dragrig check drag")


@click.command("check")
@click.argument("plan", required=False)
@click.option("--live", is_flag=True, help="Look at the rig's wiring with a person who pushes and presses.")
@click.option("--operator", metavar="NAME", default="", help="Operator's name, stored with the result of --live.")
@options.settings
@options.out("Folder whose free space is checked (default: the rig's data root).")
@options.as_json
@click.pass_context
def check_command(
    ctx: click.Context,
    plan: str | None,
    live: bool,
    operator: str,
    out: Path | None,
    as_json: bool,
    **settings: "Unpack[SetupChoices]",
) -> None:
    """Check PLAN, a file or a shipped name; without PLAN, check the rig. Nothing moves without --live.

    Shipped plans: blank, coulomb, demo, diagnose, drag, drag-sweep, first, paper, relaxation. The lab's own come
    first: files of the lab folder and of its folder plans.

    With PLAN: every run with its range, speed and duration, and each limit that it violates.

    Without: limits, calibrations, every device in turn, and a message in each way that notification.toml names, each ok
    or FAILED; exit code 5 when one failed.

    With --live, signal by signal: push the carriage, press the sensor, press each switch; volts, counts and switches
    are shown as they change. Then its stops are taken away from the drive: at a standstill, and, unless skipped, at
    1 mm/s. The result is stored as commissioning.toml in the lab folder.
    """
    from dragrig.api import check

    if live or (plan is None and operator):
        _look_at_rig(ctx, plan, settings, out, operator, live=live, as_json=as_json)
        return
    if plan is None:
        _check_rig(ctx, settings, out, as_json=as_json)
        return
    preflight = check(plan, out=out, **settings)
    from dragrig.present import preflight_document

    print_document(preflight_document(preflight), as_json=as_json)
    for remark in preflight.remarks:
        print_remark(f"NOTE {remark}.")
    for finding in preflight.findings:
        print_error(f"{finding}.")
    if preflight.findings:
        ctx.exit(BAD_INPUT)


def _check_rig(ctx: click.Context, settings: "SetupChoices", out: Path | None, *, as_json: bool) -> None:
    choices = _rig_choices(ctx, settings, out)
    from dragrig.api import examine
    from dragrig.config import DeviceError
    from dragrig.present import rig_check_document

    checks = tuple(examine(**choices))
    print_document(rig_check_document(checks), as_json=as_json)
    if not all(check.passed for check in checks):
        ctx.exit(DeviceError.exit_code)


def _look_at_rig(
    ctx: click.Context,
    plan: str | None,
    settings: "SetupChoices",
    out: Path | None,
    operator: str,
    *,
    live: bool,
    as_json: bool,
) -> None:
    if not live:
        raise click.UsageError("--operator is stored with the result of --live; add it, or leave --operator out", ctx)
    if plan is not None:
        raise click.UsageError("--live looks at the rig itself, so leave the plan out", ctx)
    choices = _rig_choices(ctx, settings, out)
    from dragrig.api import commission
    from dragrig.cli.operator import TerminalOperator
    from dragrig.config import COMMISSIONING_FILE, DeviceError
    from dragrig.present import commissioning_document

    with TerminalOperator(yes=False) as person:
        record = commission(operator=operator, person=person, found=person.show_finding, **choices)
    print_document(commissioning_document(record), as_json=as_json)
    print_remark(f"Stored as {COMMISSIONING_FILE} in the lab folder.")
    if not record.passed:
        ctx.exit(DeviceError.exit_code)


def _rig_choices(ctx: click.Context, settings: "SetupChoices", out: Path | None) -> "RigChoices":
    plan_settings = {name: settings[name] for name in ("specimen", "effects", "capsule")}
    given = {name.removesuffix("s"): value for name, value in plan_settings.items()} | {"out": out}
    if unused := [name for name, value in given.items() if value]:
        raise click.UsageError(f"Without a plan the rig itself is checked, so leave out --{' --'.join(unused)}", ctx)
    return cast("RigChoices", {name: value for name, value in settings.items() if name not in plan_settings})


@click.command("run")
@click.argument("plan", required=False)
@options.settings
@options.out("Folder of the campaign, new or empty (default: a new one in the rig's data root).")
@click.option(
    "--append",
    metavar="CAMPAIGN",
    type=click.Path(path_type=Path),
    help="Add the runs to this campaign, with its rig and, where none is stated, its specimen.",
)
@click.option("--resume", metavar="CAMPAIGN", type=click.Path(path_type=Path), help="Resume an interrupted campaign.")
@options.session_notes("in the run files")
@click.option(
    "--mirror",
    metavar="DIR",
    type=click.Path(path_type=Path),
    help="Write a second copy of each finished file here, verified by reading it back.",
)
@options.pace
@click.option("--plot", is_flag=True, help="Show the force of the run in progress in the terminal.")
@options.yes
@options.as_json
@options.quiet
def run_command(
    plan: str | None,
    out: Path | None,
    append: Path | None,
    resume: Path | None,
    operator: str,
    note: str,
    mirror: Path | None,
    pace: options.Pace | None,
    plot: bool,
    yes: bool,
    as_json: bool,
    **settings: "Unpack[SetupChoices]",
) -> None:
    """Carry out PLAN, a file or a shipped name, and write one run file per run.

    A run file in place of a plan repeats its whole session, with the settings stored in it.

    Shipped plans: blank, coulomb, demo, diagnose, drag, drag-sweep, first, paper, relaxation. The lab's own come
    first: files of the lab folder and of its folder plans.

    Everything is checked before anything moves. Ctrl-C stops the stage first and keeps the recorded samples; p, typed
    at the terminal, pauses the session after the run in progress. The campaign's folder is printed at the end.

    Exit codes: 0 done, 2 bad input, 3 aborted, 4 guard tripped, 5 device fault.
    """
    _require_plan_or_campaign(plan, resume, settings, out, append)
    from dragrig.api import resume as resume_campaign
    from dragrig.api import run as run_plan
    from dragrig.cli.operator import TerminalOperator

    if resume is not None:
        start = partial(resume_campaign, resume, assignments=settings["assignments"])
    else:
        start = partial(run_plan, plan or "", out=out, append=append, **settings)
    with TerminalOperator(yes=yes, plot=plot) as person:
        made = start(
            operator=operator,
            note=note,
            pace=pace,
            person=person,
            mirror=mirror,
            tell=print_warning,
            pause=person.pause,
        )
    if as_json:
        print_json(_session_json(made))
    else:
        print_remark(made.summary())
        _print_mirror_state(made)
        echo(display_path(made.folder))
    made.session.require()


def _require_plan_or_campaign(
    plan: str | None, campaign: Path | None, settings: "SetupChoices", out: Path | None, append: Path | None
) -> None:
    context = click.get_current_context()
    if append is not None and out is not None:
        raise click.UsageError("--append names the folder of the runs, so leave out --out", context)
    if plan is not None and campaign is not None:
        raise click.UsageError("--resume takes its plan from the campaign, so leave the plan out", context)
    if plan is None and campaign is None:
        raise click.UsageError("Name a plan, or a campaign to go on with after --resume", context)
    fixed = {**settings, "assignments": (), "effects": (), "effect": settings["effects"], "out": out, "append": append}
    if campaign is not None and (unused := [name for name, value in fixed.items() if value]):
        raise click.UsageError(
            f"A campaign goes on with its own settings, so leave out --{' --'.join(unused)}", context
        )


def _session_json(made: "Made") -> dict[str, object]:
    runs = [
        {
            "file": result.path,
            "order": result.order,
            "kind": result.run.protocol.kind,
            "parameters": result.run.protocol.attributes(),
            "status": result.outcome.status,
            "reason": result.outcome.reason,
            "samples": result.outcome.samples,
            "checks": result.outcome.checks.values,
            "warnings": result.outcome.checks.warnings,
        }
        for result in made.session.runs
    ]
    return {
        "folder": made.folder,
        "status": made.session.status,
        "reason": made.session.reason,
        "runs": runs,
        **({} if made.mirrored is None else {"mirror": made.mirrored}),
    }


def _print_mirror_state(made: "Made") -> None:
    mirrored = made.mirrored
    if mirrored is None:
        return
    copied, missing = len(mirrored.copied), mirrored.missing
    if copied:
        print_remark(f"mirror: {copied} files in {mirrored.folder}, each read back and compared")
    if missing:
        reasons = "; ".join(f"{name}: {why}" for name, why in missing.items())
        print_error(f"NOT MIRRORED, {len(missing)} of {len(missing) + copied} files: {reasons}")


@click.command("recover")
@click.argument("places", metavar="[PLACE…]", nargs=-1, type=click.Path(path_type=Path))
@options.as_json
@options.quiet
@click.pass_context
def recover_command(ctx: click.Context, places: tuple[Path, ...], as_json: bool) -> None:
    """Finish the run files of a crashed session.

    PLACE is a folder, searched with its subfolders, or one recording (NAME.recording.h5) (default: the working folder).
    A recording that is still being written is left alone, and so is one that cannot be read.
    """
    from dragrig.rig import RecoveryOutcome, left_recordings, recover

    folders = places or (Path(),)
    recordings: list[RecoveredRecording] = []
    with ProgressMeter("recovering", sum(len(left_recordings(place)) for place in folders)) as meter:
        for place in folders:
            recordings += recover(place, lambda recording: meter.advance(0.0, f"recovering {recording.name}"))
            meter.advance(float(len(left_recordings(place))))
    if as_json:
        print_json(recordings)
    else:
        for recording in recordings:
            if recording.path is not None:
                echo(f"{recording.path}  {recording.samples} samples")
    if not recordings:
        print_remark("There is nothing to recover.")
    for recording in recordings:
        if recording.outcome is RecoveryOutcome.EMPTY:
            print_remark(f"{recording.message}.")
        elif recording.outcome is not RecoveryOutcome.FINISHED:
            print_error(recording.message)
    if any(recording.outcome is RecoveryOutcome.LEFT for recording in recordings):
        ctx.exit(BAD_INPUT)


@click.command("demo")
@options.out("Folder for the campaign.", default="dragrig-demo")
@options.quiet
def demo_command(out: Path) -> None:
    """Run a short programme on the simulated rig, and filter, export and draw its runs.

    A blank run, a relaxation, a Coulomb test and drags at three speeds, one run file each; every trace filtered,
    exported as CSV and drawn; and an overview picture. Takes some seconds.
    """
    from dragrig.analysis import table_rows
    from dragrig.api import DEMO_PICTURES, DEMO_TABLES, evaluate_demo, run_demo
    from dragrig.cli.operator import TerminalOperator
    from dragrig.present import campaign_table_document

    print_remark("The simulated rig makes a blank run, a relaxation, a Coulomb test and drags at three speeds:")
    with TerminalOperator(yes=True) as person:
        made = run_demo(out, person)
    print_remark("Filtering, exporting and drawing every run …")
    with ProgressMeter("filtering, exporting, drawing") as meter:
        overview = evaluate_demo(made, meter.at)
    print_document(campaign_table_document(table_rows(made.folder)), as_json=False)
    folder = display_path(made.folder)
    echo(
        f"\nrun files  {folder}\ncsv        {display_path(made.folder / DEMO_TABLES)}"
        f"\npictures   {display_path(made.folder / DEMO_PICTURES)}, {display_path(overview)}"
    )
    print_remark(f"\nInspect it: dragrig info {folder}\nYour own:   dragrig init lab, then in it: dragrig run drag")


def _missing_libraries() -> list[str]:
    """Return the system libraries that Qt's part for X11 needs and does not find: it would end this process for one."""
    chosen = os.environ.get("QT_QPA_PLATFORM", "" if os.environ.get("WAYLAND_DISPLAY") else "xcb")
    package = find_spec("PySide6")
    if sys.platform != "linux" or not chosen.startswith("xcb") or package is None or package.origin is None:
        return []
    plugin = Path(package.origin).parent / "Qt" / "plugins" / "platforms" / "libqxcb.so"
    try:
        told = subprocess.run(["ldd", str(plugin)], capture_output=True, text=True, check=False).stdout
    except OSError:
        return []
    return sorted(set(re.findall(r"(\S+) => not found", told)))


def _refuse_without(libraries: Sequence[str]) -> NoReturn:
    """Name system libraries that are missing, and their packages, which Debian names after them."""
    from dragrig.config import SettingsError

    names = (library.lower().split(".so.") for library in libraries)
    packages = " ".join(f"{name}{'-' * name[-1].isdigit()}{''.join(version)}" for name, *version in names)
    raise SettingsError(
        f"gui: Qt needs system libraries that are not here ({', '.join(libraries)}): apt-get install {packages} "
        "(on Debian and Ubuntu)."
    )


@click.command("gui")
@click.argument("lab", required=False, type=click.Path(path_type=Path))
@options.rig
@options.pace
@click.pass_context
def gui_command(
    ctx: click.Context,
    lab: Path | None,
    pace: options.Pace | None,
    rig: str | None,
    model: str | None,
    backend: str | None,
    double: bool,
    assignments: tuple[str, ...],
) -> None:
    """Open the window: run plans, view runs, diagnose campaigns.

    LAB is a lab folder (default: that of the working folder). The rig, simulated or hardware, is chosen here for as
    long as the window is open. The engine runs in its own process: when the window is closed or dies, the stage is
    stopped and the run finished.
    """
    from dragrig.config import RIG_FILE, SettingsError, rig_file_of
    from dragrig.engine_host import RigSelection

    if lab is not None and not (lab / RIG_FILE).is_file():
        raise SettingsError(f"{lab}: is no lab folder, it holds no {RIG_FILE}; make one with dragrig init {lab}.")
    rig_file = rig_file_of(lab or Path.cwd())
    selection = RigSelection(Path(rig) if rig is not None else rig_file, model, backend, double, assignments, pace)
    if sys.platform == "linux" and not any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM"))):
        raise SettingsError(
            "gui: there is no screen here, neither DISPLAY nor WAYLAND_DISPLAY is set; sit at the machine itself, or "
            "connect with ssh -X."
        )
    try:
        from dragrig.window.main_window import show_window
    except ImportError as error:
        if library := re.match(r"\S+\.so\.\S+(?=:)", str(error)):
            _refuse_without([library[0], *_missing_libraries()])
        missing = "the window needs PySide6 and pyqtgraph; install them with pip install 'dragrig[gui]'"
        raise SettingsError(f"gui: {missing}.") from error
    if libraries := _missing_libraries():
        _refuse_without(libraries)
    ctx.exit(show_window(selection, rig_file.parent if rig_file is not None else None))
