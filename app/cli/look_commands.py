"""Commands that tabulate, draw and report runs: table, show, report, compare."""

import os
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dragrig.cli import options
from dragrig.cli.console import FileBatch, ProgressMeter, display_path, print_json, print_result
from dragrig.present.numbers import number_text, text_columns

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dragrig.analysis.campaign_table import TableRow
    from dragrig.analysis.comparison.comparison import Comparison, GroupDifference, MeasureDifference, RunPair
    from dragrig.analysis.estimates import Exclusion


@click.command("table")
@click.argument("campaign", type=click.Path(path_type=Path))
@options.as_json
@options.quiet
def table_command(campaign: Path, as_json: bool) -> None:
    """Tabulate CAMPAIGN, a folder of run files.

    One line per run: kind, speed, steady force with its standard error, checks, and whether it is marked bad; then the
    mean steady force of repeated runs, without bad and unfinished ones.
    """
    from dragrig.analysis.campaign_table import mean_per_speed, table_rows

    with ProgressMeter("measuring") as meter:
        rows = table_rows(campaign, meter.at)
    if as_json:
        print_json({"runs": rows, "means": mean_per_speed(rows)})
    else:
        print_result(table_text(rows))


def table_text(rows: "tuple[TableRow, ...]") -> str:
    """Return the table of runs and that of their means, as text."""
    from dragrig.analysis.campaign_table import mean_per_speed

    header = ("file", "kind", "mm/s", "strain", "steady mN", "±", "rest mN", "peak mN", "status", "checks", "remark")
    runs = [
        (
            row.file,
            row.kind,
            number_text(row.measured_speed_mm_s if row.speed_mm_s is None else row.speed_mm_s),
            number_text(row.shear_strain),
            *map(_force_text, (row.steady_force_mN, row.steady_force_error_mN, row.rest_offset_mN, row.peak_force_mN)),
            row.status,
            row.checks,
            "; ".join(part for part in (f"BAD: {row.mark}" if row.bad else "", row.remark) if part),
        )
        for row in rows
    ]
    means = [
        (
            mean.specimen,
            mean.kind,
            mean.capsule,
            number_text(mean.speed_mm_s),
            "forward" if mean.direction > 0 else "backward",
            str(mean.runs),
            _force_text(mean.steady_force_mN),
            _force_text(mean.standard_error_mN),
        )
        for mean in mean_per_speed(rows)
    ]
    if not means:
        return text_columns(header, runs)
    mean_header = ("specimen", "kind", "capsule", "mm/s", "direction", "runs", "steady mN", "±")
    return f"{text_columns(header, runs)}\n\n{text_columns(mean_header, means)}"


def _force_text(value: float | None, sign: str = "") -> str:
    return "" if value is None else f"{value:{sign}.1f}"


PICTURE_SUFFIXES = (".png", ".svg")


@click.command("show")
@options.inputs
@click.option(
    "--out",
    "-o",
    metavar="FILE|DIR",
    type=click.Path(path_type=Path),
    help="A .png or .svg file for one picture, or a folder for all (default: beside the runs).",
)
@click.option("--no-filtered", "raw_only", is_flag=True, help="Leave out the filtered force.")
@click.option("--motor-force", is_flag=True, help="Add the motor force, where it was recorded.")
@options.overwrite
@options.as_json
@options.quiet
def show_command(
    inputs: tuple[str, ...], out: Path | None, raw_only: bool, motor_force: bool, overwrite: bool, as_json: bool
) -> None:
    """Draw runs: force, raw and filtered, position and speed, with the phases. Prints the paths of the pictures.

    RUN is a run file, a pattern or a campaign's folder; a folder gets an overview of the campaign too. An existing
    name gets a number, unless it was given with --out: then it is refused.
    """
    from dragrig.run_inputs import run_files

    paths = run_files(inputs)
    campaigns = [Path(name) for name in inputs if Path(name).is_dir()]
    target = _picture_target(out, len(paths) + len(campaigns), overwrite)
    runs, overviews = FileBatch(paths, "drawing runs"), FileBatch(campaigns, "drawing the campaign")
    pictures = chain(
        runs.each(lambda path, _: _draw_run(path, target, filtered=not raw_only, motor_force=motor_force)),
        overviews.each(lambda folder, _: _draw_campaign(folder, target)),
    )
    drawn = []
    for source, picture in pictures:
        drawn.append({"source": source, "picture": picture})
        if not as_json:
            print_result(display_path(picture))
    if as_json:
        print_json(drawn)
    runs.close()
    overviews.close()


@dataclass(frozen=True, slots=True)
class _PictureTarget:
    """Where pictures go: a file, a folder, or beside the runs."""

    file: Path | None
    folder: Path | None
    overwrite: bool

    def save(self, figure: "Figure", name: str, beside: Path) -> Path:
        from dragrig.present.figure_files import save_figure, save_figure_in

        if self.file is not None:
            return save_figure(figure, self.file, overwrite=self.overwrite)
        # Measured data are often read-only.
        here = beside if os.access(beside, os.W_OK) else Path()
        return save_figure_in(self.folder or here, name, figure, overwrite=self.overwrite)


def _picture_target(out: Path | None, pictures: int, overwrite: bool) -> _PictureTarget:
    if out is None or out.is_dir() or out.suffix.lower() not in PICTURE_SUFFIXES:
        return _PictureTarget(None, out, overwrite)
    if pictures > 1:
        raise click.UsageError(f"{pictures} pictures do not fit into {out}; name a folder", click.get_current_context())
    return _PictureTarget(out, None, overwrite)


def _draw_run(path: Path, target: _PictureTarget, *, filtered: bool, motor_force: bool) -> Path:
    from dragrig.present.run_figures import run_figure
    from dragrig.rig.runfile import read_mark, read_run
    from dragrig.rig.runfile.schema import run_name

    mark = read_mark(path)
    reason = None if mark is None else mark.reason
    figure = run_figure(read_run(path), filtered=filtered, motor_force=motor_force, bad_reason=reason)
    return target.save(figure, f"{run_name(path)}.png", path.parent)


def _draw_campaign(folder: Path, target: _PictureTarget) -> Path:
    from dragrig.present.campaign_figures import campaign_figure
    from dragrig.rig.runfile import read_mark, read_run
    from dragrig.run_inputs import run_files

    paths = run_files([folder])
    bad = [path for path in paths if read_mark(path) is not None]
    name = folder.resolve().name
    figure = campaign_figure((read_run(path) for path in paths), name, bad)
    return target.save(figure, f"{name}.png", folder)


@click.command("report")
@click.argument("source", metavar="RUN|CAMPAIGN", type=click.Path(path_type=Path))
@click.option(
    "--out",
    "-o",
    metavar="FILE.html",
    type=click.Path(path_type=Path),
    help="Report file (default: beside the run, or in the campaign's folder).",
)
@options.overwrite
@options.as_json
@options.quiet
def report_command(source: Path, out: Path | None, overwrite: bool, as_json: bool) -> None:
    """Write a report on a run file or a campaign's folder, one HTML file that can be mailed.

    For a run: force, position and speed, measures with their errors, checks, events and all settings. For a campaign:
    steady force against speed, relaxations, a table and a figure of every run, sessions, and the runs left out with the
    reasons. Figures are embedded, tables sort by any column, and the page prints and fits a phone.
    """
    from dragrig.api.report import report

    with ProgressMeter("measuring and drawing") as meter:
        written = report(source, out, overwrite=overwrite, progress=meter.at)
    if as_json:
        print_json({"source": source, "report": written})
        return
    print_result(display_path(written))


MAX_UNPAIRED = 12
"""Runs without a partner that are listed; the others are counted."""


@click.command("compare")
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path), required=False)
@click.option("--model", metavar="F|NAME", help="Compare A with this friction model in place of B.")
@options.effects("Add an effect to that model, as listed by dragrig gap effects; repeatable.")
@click.option("--specimen", metavar="NAME", help="Specimen, where a folder holds several (default: all).")
@options.out("Folder for pictures and table (default: a new one beside A's runs; with --json: none).")
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
    overwrite: bool,
    as_json: bool,
) -> None:
    """Compare two campaigns, two runs, or either with the friction model.

    A and B are campaign folders or run files. Runs under the same conditions are paired and aligned on the start of
    their motion. Prints the measures side by side (differences are B − A; ± is the 95 % interval for equal runs, from
    noise, run-to-run scatter and unknown zeros), the largest differences first, and a summary; writes a table as CSV,
    an overview, and a picture of each pair. The exit code is 0 even where they differ.
    """
    if (b is None) == (model is None):
        raise click.UsageError(
            "name a second campaign or run, or a --model, one of the two", click.get_current_context()
        )
    from dragrig.api.compare import compare, comparison_folder, write_comparison
    from dragrig.present.files import unused_path

    with ProgressMeter("comparing") as meter:
        comparison = compare(a, b, model=model, effects=effects, specimen=specimen, progress=meter.at)
    if as_json and out is None:
        print_json(comparison_json(comparison))
        return
    if not as_json:
        print_result(comparison_text(comparison))
    default = comparison_folder(comparison, a)
    # Measured data are often read-only.
    writable = default if os.access(default.parent, os.W_OK) else Path(default.name)
    folder = out or unused_path(writable)
    with ProgressMeter("drawing") as meter:
        written = list(write_comparison(comparison, folder, overwrite=overwrite, progress=meter.at))
    if as_json:
        print_json({**comparison_json(comparison), "files": written})
        return
    print_result(f"\noverview  {display_path(written[0])}\ntable     {display_path(written[1])}")
    print_result(f"pictures  {len(written) - 2} in {display_path(folder)}")


def comparison_text(found: "Comparison") -> str:
    """Return a comparison as text: pairs, conditions, what is left out, and the sentences last."""
    parts = [
        f"A  {found.a.name}\nB  {found.b.name}",
        _pairs_text(found.pairs),
        f"Largest differences first, in standard errors:\n{_groups_text(found.groups)}",
        _left_out_text(
            "Without a partner", [*_left_out_lines("A", found.alone_a), *_left_out_lines("B", found.alone_b)]
        ),
        _left_out_text("Left out", [*_left_out_lines("A", found.a.left_out), *_left_out_lines("B", found.b.left_out)]),
        "\n".join(f"! {remark}" for remark in found.remarks),
        "\n".join(found.sentences),
    ]
    return "\n\n".join(part for part in parts if part)


def comparison_json(found: "Comparison") -> dict[str, object]:
    """Return a comparison as what JSON knows; forces in mN."""
    from dragrig.analysis.comparison.comparison import comparison_rows

    return {
        "a": found.a.name,
        "b": found.b.name,
        "sentences": found.sentences,
        "remarks": found.remarks,
        "zero_allowed_mN": found.zero_mN,
        "measures": list(comparison_rows(found)),
        "pairs": [_pair_json(pair) for pair in found.pairs],
        "conditions": [_group_json(one) for one in found.groups],
        "without_partner": {"a": found.alone_a, "b": found.alone_b},
        "left_out": {"a": found.a.left_out, "b": found.b.left_out},
    }


def _pair_json(pair: "RunPair") -> dict[str, object]:
    return {
        "condition": str(pair.condition),
        "a_file": pair.a.file,
        "b_file": pair.b.file,
        "shift_s": pair.shift_s,
        "verdict": pair.verdict,
        "phases": pair.phases,
        "motion": pair.motion,
        "remarks": pair.remarks,
    }


def _group_json(one: "GroupDifference") -> dict[str, object]:
    return {
        "condition": str(one.condition),
        "measure": one.measure,
        "pairs": one.pairs,
        "a_mN": one.a,
        "b_mN": one.b,
        "b_minus_a_mN": one.value,
        "noise_error_mN": one.noise,
        "error_with_scatter_mN": one.error,
        "relative": one.relative,
        "trace_rms_mN": one.rms_mN,
        "verdict": one.verdict,
    }


def _pairs_text(pairs: "tuple[RunPair, ...]") -> str:
    header = (
        "condition",
        "A",
        "B",
        "measure",
        "A mN",
        "B mN",
        "B − A",
        "± 95 %",
        "",
        "rms mN",
        "most mN",
        "at s",
        "in",
    )
    return text_columns(header, [row for pair in pairs for row in _pair_rows(pair)])


def _pair_rows(pair: "RunPair") -> list[tuple[str, ...]]:
    whole = next((one for one in pair.phases if one.phase == "all"), None)
    trace = ("", "", "", "")
    if whole is not None:
        phase = next((one.phase for one in pair.phases if one.at_s == whole.at_s and one.phase != "all"), "")
        trace = (f"{whole.rms_mN:.1f}", f"{whole.largest_mN:.1f}", f"{whole.at_s:.2f}", phase)
    return [
        (str(pair.condition), pair.a.file, pair.b.file, one.measure, *_difference_cells(one), *trace)
        if place == 0
        else ("", "", "", one.measure, *_difference_cells(one), "", "", "", "")
        for place, one in enumerate(pair.main)
    ]


def _difference_cells(one: "MeasureDifference") -> tuple[str, ...]:
    from dragrig.analysis.estimates import NORMAL_95

    a, b = one.compared
    half = None if one.error is None else NORMAL_95 * one.error
    return (
        _force_text(a),
        _force_text(b),
        _force_text(one.value, "+"),
        _force_text(half),
        one.reason if one.value is None else one.verdict.value,
    )


def _groups_text(groups: "tuple[GroupDifference, ...]") -> str:
    from dragrig.analysis.estimates import NORMAL_95

    header = ("condition", "measure", "pairs", "A mN", "B mN", "B − A", "± 95 %", "%", "errors", "", "rms mN")
    return text_columns(
        header,
        [
            (
                str(one.condition),
                one.measure,
                str(one.pairs),
                _force_text(one.a),
                _force_text(one.b),
                _force_text(one.value, "+"),
                _force_text(NORMAL_95 * one.error),
                "" if one.relative is None else f"{100 * one.relative:+.1f}",
                number_text(one.times_error, 2),
                one.verdict.value,
                _force_text(one.rms_mN),
            )
            for one in groups
        ],
    )


def _left_out_lines(side: str, found: "tuple[Exclusion, ...]") -> list[str]:
    return [f"  {side}  {one.what}: {one.reason}" for one in found]


def _left_out_text(heading: str, lines: list[str]) -> str:
    if not lines:
        return ""
    shown = (
        lines
        if len(lines) <= MAX_UNPAIRED
        else [*lines[: MAX_UNPAIRED - 1], f"  and {len(lines) - MAX_UNPAIRED + 1} more"]
    )
    return "\n".join((f"{heading}:", *shown))
