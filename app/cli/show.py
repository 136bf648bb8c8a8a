"""`dragrig show`."""

import os
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dragrig.cli import options
from dragrig.cli.batch import Batch
from dragrig.cli.console import result, result_json, shown_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PICTURES = (".png", ".svg")


@click.command("show")
@options.inputs
@click.option(
    "--out",
    "-o",
    metavar="FILE|DIR",
    type=click.Path(path_type=Path),
    help="A .png or .svg file for one picture, or a folder for all; beside the runs unless given.",
)
@click.option("--no-filtered", "raw_only", is_flag=True, help="Leave out the filtered force.")
@click.option("--motor-force", is_flag=True, help="Add the motor's force, where it was recorded.")
@options.overwrite
@options.as_json
@options.quiet
def command(
    inputs: tuple[str, ...], out: Path | None, raw_only: bool, motor_force: bool, overwrite: bool, as_json: bool
) -> None:
    """Draw runs: force, raw and filtered, position and speed, with the phases. Prints where the pictures are.

    RUN is a run file, a pattern or a campaign's folder; a folder gets an overview of the campaign too. A name that is
    taken gets a number, unless it was given with --out: then it is refused.
    """
    from dragrig.inputs import run_files

    paths = run_files(inputs)
    campaigns = [Path(one) for one in inputs if Path(one).is_dir()]
    target = _target(out, len(paths) + len(campaigns), overwrite)
    runs, overviews = Batch(paths, "drawing runs"), Batch(campaigns, "drawing the campaign")
    pictures = chain(
        runs.each(lambda path, _: _run(path, target, filtered=not raw_only, motor_force=motor_force)),
        overviews.each(lambda folder, _: _campaign(folder, target)),
    )
    drawn = []
    for source, picture in pictures:
        drawn.append({"source": source, "picture": picture})
        if not as_json:
            result(shown_path(picture))
    if as_json:
        result_json(drawn)
    runs.close()
    overviews.close()


@dataclass(frozen=True, slots=True)
class _Target:
    """Where pictures go: one file, or a folder, or beside what they show."""

    file: Path | None
    folder: Path | None
    overwrite: bool

    def save(self, figure: "Figure", name: str, beside: Path) -> Path:
        from dragrig.figures import save, save_in

        if self.file is not None:
            return save(figure, self.file, overwrite=self.overwrite)
        # Measured data often lie where nothing may be added.
        here = beside if os.access(beside, os.W_OK) else Path()
        return save_in(self.folder or here, name, figure, overwrite=self.overwrite)


def _target(out: Path | None, pictures: int, overwrite: bool) -> _Target:
    if out is None or out.is_dir() or out.suffix.lower() not in PICTURES:
        return _Target(None, out, overwrite)
    if pictures > 1:
        raise click.UsageError(f"{pictures} pictures do not fit into {out}; name a folder", click.get_current_context())
    return _Target(out, None, overwrite)


def _run(path: Path, target: _Target, *, filtered: bool, motor_force: bool) -> Path:
    from dragrig.figures import run_figure
    from dragrig.rig.runfile import read_mark, read_run
    from dragrig.rig.runfile.naming import run_name

    mark = read_mark(path)
    reason = None if mark is None else mark.reason
    figure = run_figure(read_run(path), filtered=filtered, motor_force=motor_force, bad_reason=reason)
    return target.save(figure, f"{run_name(path)}.png", path.parent)


def _campaign(folder: Path, target: _Target) -> Path:
    from dragrig.figures import campaign_figure
    from dragrig.inputs import run_files
    from dragrig.rig.runfile import read_mark, read_run

    paths = run_files([folder])
    bad = [path for path in paths if read_mark(path) is not None]
    name = folder.resolve().name
    figure = campaign_figure((read_run(path) for path in paths), name, bad)
    return target.save(figure, f"{name}.png", folder)
