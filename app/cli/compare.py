"""`dragrig compare`."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dragrig.cli import options
from dragrig.cli.console import is_quiet, result, result_json, shown_path
from dragrig.cli.progress import Meter
from dragrig.cli.wording import columns, number

if TYPE_CHECKING:
    from dragrig.analysis.comparison.measured import Difference
    from dragrig.analysis.comparison.results import Comparison, GroupDifference, Pair
    from dragrig.analysis.identification.results import LeftOut

MOST_ALONE = 12
"""So many runs without a partner are named; of more the rest are counted."""


@click.command("compare")
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path), required=False)
@click.option("--model", metavar="F|NAME", help="Compare A with this friction model in place of B.")
@options.effects("What that model has beside its own, as dragrig gap effects lists it; repeatable.")
@click.option(
    "--specimen", metavar="NAME", help="Specimen that is meant, where a folder holds several; all unless given."
)
@options.out("Folder for pictures and table; a new one beside A's runs unless given. With --json only if given.")
@options.overwrite
@options.as_json
@options.quiet
def command(
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

    A and B are campaign folders or run files. Runs in which the same was done are paired and aligned on the start of
    their motion. Prints the measures side by side (differences are B − A, ± holds 95 % of equal runs: noise,
    run-to-run scatter and unknown zeros), the largest differences first, and a few sentences; writes a table as CSV,
    an overview, and a picture of each pair. That two campaigns differ is no error: the exit code is 0.
    """
    if (b is None) == (model is None):
        raise click.UsageError(
            "name a second campaign or run, or a --model, one of the two", click.get_current_context()
        )
    from dragrig import comparing

    with Meter("comparing", 1.0, quiet=is_quiet()) as meter:
        found = comparing.compare(a, b, model=model, effects=effects, specimen=specimen, progress=meter.at)
    if as_json and out is None:
        result_json(comparison_table(found))
        return
    if not as_json:
        result(comparison_text(found))
    folder = out or _beside(comparing.folder_for(found, a))
    with Meter("drawing", 1.0, quiet=is_quiet()) as meter:
        written = list(comparing.write(found, folder, overwrite=overwrite, progress=meter.at))
    if as_json:
        result_json({**comparison_table(found), "files": written})
        return
    result(f"\noverview  {shown_path(written[0])}\ntable     {shown_path(written[1])}")
    result(f"pictures  {len(written) - 2} in {shown_path(folder)}")


def comparison_text(found: "Comparison") -> str:
    """Return a comparison as text: pairs, conditions, what is left out, and the sentences last."""
    parts = [
        f"A  {found.a.name}\nB  {found.b.name}",
        _pairs(found.pairs),
        f"Largest differences first, in standard errors:\n{_groups(found.groups)}",
        _left("Without a partner", [*_of("A", found.alone_a), *_of("B", found.alone_b)]),
        _left("Left out", [*_of("A", found.a.left_out), *_of("B", found.b.left_out)]),
        "\n".join(f"! {remark}" for remark in found.remarks),
        "\n".join(found.sentences),
    ]
    return "\n\n".join(part for part in parts if part)


def comparison_table(found: "Comparison") -> dict[str, object]:
    """Return a comparison as what JSON knows; forces in mN."""
    from dragrig.analysis.comparison.frame import rows_of

    return {
        "a": found.a.name,
        "b": found.b.name,
        "sentences": found.sentences,
        "remarks": found.remarks,
        "zero_allowed_mN": found.zero_mN,
        "measures": list(rows_of(found)),
        "pairs": [_pair_table(pair) for pair in found.pairs],
        "conditions": [_group_table(one) for one in found.groups],
        "without_partner": {"a": found.alone_a, "b": found.alone_b},
        "left_out": {"a": found.a.left_out, "b": found.b.left_out},
    }


def _pair_table(pair: "Pair") -> dict[str, object]:
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


def _group_table(one: "GroupDifference") -> dict[str, object]:
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


def _pairs(pairs: "tuple[Pair, ...]") -> str:
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
    return columns(header, [row for pair in pairs for row in _pair_rows(pair)])


def _pair_rows(pair: "Pair") -> list[tuple[str, ...]]:
    whole = next((one for one in pair.phases if one.phase == "all"), None)
    trace = ("", "", "", "")
    if whole is not None:
        phase = next((one.phase for one in pair.phases if one.at_s == whole.at_s and one.phase != "all"), "")
        trace = (f"{whole.rms_mN:.1f}", f"{whole.largest_mN:.1f}", f"{whole.at_s:.2f}", phase)
    return [
        (str(pair.condition), pair.a.file, pair.b.file, one.measure, *_difference(one), *trace)
        if place == 0
        else ("", "", "", one.measure, *_difference(one), "", "", "", "")
        for place, one in enumerate(pair.main)
    ]


def _difference(one: "Difference") -> tuple[str, ...]:
    from dragrig.analysis.estimates import NORMAL_95

    a, b = one.compared
    half = None if one.error is None else NORMAL_95 * one.error
    return _mN(a), _mN(b), _mN(one.value, "+"), _mN(half), one.reason if one.value is None else one.verdict.value


def _groups(groups: "tuple[GroupDifference, ...]") -> str:
    from dragrig.analysis.estimates import NORMAL_95

    header = ("condition", "measure", "pairs", "A mN", "B mN", "B − A", "± 95 %", "%", "errors", "", "rms mN")
    return columns(
        header,
        [
            (
                str(one.condition),
                one.measure,
                str(one.pairs),
                _mN(one.a),
                _mN(one.b),
                _mN(one.value, "+"),
                _mN(NORMAL_95 * one.error),
                "" if one.relative is None else f"{100 * one.relative:+.1f}",
                number(one.times_error, 2),
                one.verdict.value,
                _mN(one.rms_mN),
            )
            for one in groups
        ],
    )


def _mN(value: float | None, sign: str = "") -> str:
    return "" if value is None else f"{value:{sign}.1f}"


def _of(side: str, found: "tuple[LeftOut, ...]") -> list[str]:
    return [f"  {side}  {one.what}: {one.reason}" for one in found]


def _left(heading: str, lines: list[str]) -> str:
    if not lines:
        return ""
    shown = (
        lines if len(lines) <= MOST_ALONE else [*lines[: MOST_ALONE - 1], f"  and {len(lines) - MOST_ALONE + 1} more"]
    )
    return "\n".join((f"{heading}:", *shown))


def _beside(folder: Path) -> Path:
    """Return the folder with a number where its name is taken; in the working folder where the runs' own refuses."""
    # Measured data often lie where nothing may be added.
    wanted = folder if os.access(folder.parent, os.W_OK) else Path(folder.name)
    found, count = wanted, 1
    while found.exists():
        count += 1
        found = wanted.with_name(f"{wanted.name}-{count}")
    return found
