"""`dragrig check`."""

from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import click

from dragrig.cli import options
from dragrig.cli.console import BAD_INPUT, complain, result, result_json
from dragrig.cli.wording import columns, duration, size

if TYPE_CHECKING:
    from dragrig.rig.preflight import Preflight, Preview


@click.command("check")
@click.argument("plan", required=False)
@options.settings
@options.out("Folder whose free space counts; the rig's data root unless given.")
@options.as_json
@click.pass_context
def command(
    ctx: click.Context, plan: str | None, out: Path | None, as_json: bool, **settings: Unpack[options.SettingsOptions]
) -> None:
    """Say what PLAN, a file or a shipped name, would do; without PLAN, look at the rig. Nothing moves.

    Shipped plans: blank, coulomb, demo, diagnose, drag, drag-sweep, paper, relaxation.

    With PLAN: every run with the range, speed and time that it takes, and what forbids it, if anything does.

    Without: limits, calibrations and every device in turn, each ok or NOT; exit code 5 when one is not.
    """
    from dragrig import api

    if plan is None:
        _look_at_the_rig(ctx, settings, out, as_json=as_json)
        return
    found = api.check(plan, out=out, **settings)
    if as_json:
        result_json(_plain(found))
    else:
        result(_table(found))
        result(
            f"{len(found.previews)} runs, {duration(found.duration_s)}, {size(found.size_bytes)} "
            f"of {size(found.free_bytes)} free"
        )
    for finding in found.findings:
        complain(f"{finding}.")
    if found.findings:
        ctx.exit(BAD_INPUT)


def _look_at_the_rig(ctx: click.Context, settings: options.SettingsOptions, out: Path | None, *, as_json: bool) -> None:
    given = {
        "specimen": settings["specimen"],
        "effect": settings["effects"],
        "capsule": settings["capsule"],
        "out": out,
    }
    if spare := [name for name, value in given.items() if value]:
        raise click.UsageError(f"Without a plan the rig itself is looked at, so leave out --{' --'.join(spare)}", ctx)
    from dragrig import api
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
            result(f"{'ok ' if finding.fine else 'NOT'}  {finding.what}: {finding.detail}")
    if as_json:
        result_json(findings)
    if not all(finding.fine for finding in findings):
        ctx.exit(DeviceError.exit_code)


def _table(found: "Preflight") -> str:
    header = ("", "run", "capsule", "lowest mm", "highest mm", "mm/s", "mm/s²", "rest", "takes", "size", "before it")
    return columns(header, (_row(one) for one in found.previews))


def _row(preview: "Preview") -> tuple[str, ...]:
    run = preview.run
    return (
        str(run.index),
        run.protocol.summary(),
        run.capsule.name,
        f"{preview.lowest_mm:g}",
        f"{preview.highest_mm:g}",
        f"{preview.speed_mm_s:g}",
        f"{preview.accel_mm_s2:g}",
        duration(run.wait_s),
        duration(run.duration_s),
        size(preview.size_bytes),
        run.prompt,
    )


def _plain(found: "Preflight") -> dict[str, object]:
    return {
        "runs": [_plain_run(one) for one in found.previews],
        "duration_s": found.duration_s,
        "size_bytes": found.size_bytes,
        "free_bytes": found.free_bytes,
        "findings": found.findings,
    }


def _plain_run(preview: "Preview") -> dict[str, object]:
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
