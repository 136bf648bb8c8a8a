"""`dragrig info`."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from dragrig.cli import options
from dragrig.cli.console import BAD_INPUT, complain, result, result_json
from dragrig.cli.progress import tracked
from dragrig.cli.wording import duration, size

if TYPE_CHECKING:
    from dragrig.rig.runfile import VerifyResult
    from dragrig.rig.runfile.model import RunInfo


@click.command("info")
@options.inputs
@click.option("--verify", is_flag=True, help="Read every sample and compare it with the checksum in the file.")
@options.as_json
@options.quiet
@click.pass_context
def command(ctx: click.Context, inputs: tuple[str, ...], verify: bool, as_json: bool) -> None:
    """Say what run files hold. RUN is a run file, a pattern or a campaign's folder.

    With --verify the exit code is 2 when a file is not what was recorded.
    """
    from dragrig.config.errors import RunFileError
    from dragrig.inputs import run_files
    from dragrig.rig import runfile

    found, wrong = [], []
    for path in tracked(run_files(inputs), "reading"):
        try:
            mark = runfile.read_mark(path)
            verdict = runfile.verify(path) if verify else None
            info = runfile.read_info(path)
        except RunFileError as error:
            wrong.append(str(error))
            continue
        found.append((info, mark.reason if mark is not None else None, None if verdict is None else verdict.holds))
        if verdict is not None and not verdict.holds:
            wrong.append(f"{path}: {_what_is_wrong(verdict)}")
    if as_json:
        result_json([_plain(*one) for one in found])
    elif found:
        result("\n\n".join(_text(*one) for one in found))
    for sentence in wrong:
        complain(sentence)
    if wrong:
        ctx.exit(BAD_INPUT)


def _what_is_wrong(verdict: "VerifyResult") -> str:
    if not verdict.stored:
        return "has no checksum, so that nobody can tell whether its samples are those that were recorded."
    return "its samples are NOT those that were recorded; take it from a copy."


def _plain(info: "RunInfo", bad: str | None, intact: bool | None) -> dict[str, object]:
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


def _text(info: "RunInfo", bad: str | None, intact: bool | None) -> str:
    header = info.header
    lines = [
        str(info.path),
        _line("run", f"{info.kind}, {info.status.value}" + (f" ({info.reason})" if info.reason else "")),
        *([_line("marked bad", bad)] if bad is not None else []),
        *([_line("checksum", "holds" if intact else "none, or the samples differ")] if intact is not None else []),
        _line("started", f"{header.start_time:%Y-%m-%d %H:%M:%S %z}, order {header.order}, {header.backend}"),
        _line(
            "samples",
            f"{info.samples} at {header.sample_rate_hz:g} Hz, {duration(info.samples / header.sample_rate_hz)}"
            f", {size(Path(info.path).stat().st_size)}",
        ),
        _line("channels", ", ".join(f"{channel.name} [{channel.units}]" for channel in header.channels)),
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
            _line(name if place == 0 else "", f"{key} = {value}") for place, (key, value) in enumerate(values.items())
        ]
    return "\n".join(lines)


def _line(name: str, text: str) -> str:
    return f"  {name:11} {text}"
