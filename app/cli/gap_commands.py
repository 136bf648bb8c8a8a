"""Commands on the gap between runs and model: gap diagnose, evaluate, next, isolability, effects."""

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import click

from dragrig.cli import options
from dragrig.cli.console import ProgressMeter, display_path, is_quiet, print_json, print_remark, print_result
from dragrig.config.errors import AnalysisError
from dragrig.present.json_values import to_json_value
from dragrig.present.numbers import text_columns
from dragrig.present.terminal import print_parts, terminal_table

if TYPE_CHECKING:
    from rich.console import RenderableType

    from dragrig.analysis.gap.diagnosis import NextExperiment
    from dragrig.analysis.gap.isolability import Isolability
    from dragrig.api.diagnose import DiagnosedFolder, DiagnosisRequest
    from dragrig.sim_backend.effects.base import Effect, EffectParameter


def diagnose_several(
    campaigns: Sequence[Path],
    asked: "DiagnosisRequest",
    *,
    workers: int | None,
    scheduler: str | None,
    as_json: bool,
) -> None:
    """Diagnose campaigns side by side and print what was found, in their order."""
    from dragrig.api.diagnose import diagnose_many

    with ProgressMeter(f"diagnosing {len(campaigns)} campaigns", 1.0, quiet=is_quiet()) as meter:
        found = diagnose_many(
            campaigns,
            nominal=asked.nominal,
            without=asked.without,
            tolerance_mN=asked.tolerance_mN,
            specimen=asked.specimen,
            calibration=asked.calibration,
            workers=workers,
            scheduler=scheduler,
            progress=meter.at,
        )
    if as_json:
        for line in diagnosis_json_lines(found):
            print_result(line)
    else:
        header = ("campaign", "verdict", "probability", "not told from", "gap [mN]", "closed", "95 % interval")
        print_parts([terminal_table(f"{len(found)} campaigns", header, map(_campaign_row, found), (2, 4, 5))])
    failed = [one for one in found if one.result is None]
    if failed:
        told = failed[0].why_not.rstrip(".") + (f"; and {len(failed) - 1} more" if failed[1:] else "")
        raise AnalysisError(f"{len(failed)} of {len(found)} campaigns were not diagnosed: {told}.")


def diagnosis_json_lines(found: "Sequence[DiagnosedFolder]") -> Iterator[str]:
    """Yield a line for each campaign: its gap report with its folder as `source`, or `source` and `error`."""
    from dragrig.present.diagnosis import diagnosis_json

    for one in found:
        told = {"error": one.why_not} if one.result is None else diagnosis_json(one.result, run_ids=one.run_ids)
        yield json.dumps(to_json_value({"source": one.source, **told}), allow_nan=False)


def _campaign_row(one: "DiagnosedFolder") -> tuple[str, ...]:
    from dragrig.analysis.gap.diagnosis_text import is_stated_verdict, percent_text, probability_text

    if one.result is None:
        return one.source, f"not diagnosed: {one.why_not}", "", "", "", "", ""
    said = one.result
    first = next((each for each in said.ranking if is_stated_verdict(each, said)), None)
    shrink = said.shrink
    closed = shrink if shrink is not None and said.effects else None
    interval = closed.closed_95ci if closed is not None else None
    return (
        one.source,
        " + ".join(said.effects) or said.verdict.value.replace("_", " "),
        "" if first is None else probability_text(first.probability),
        ", ".join(said.confusable_with),
        "" if shrink is None else f"{shrink.gap_before_mN:.3g}",
        "" if closed is None or closed.closed is None else percent_text(closed.closed),
        "" if interval is None else f"{percent_text(interval[0])} to {percent_text(interval[1])}",
    )


FILE = click.Path(path_type=Path)


@click.command("diagnose")
@click.argument("campaigns", metavar="CAMPAIGN…", type=FILE, nargs=-1, required=True)
@click.option(
    "--nominal",
    metavar="NAME|FILE",
    default="capsule",
    help="What is expected: capsule (unless given), drive, a friction model (.toml), or one's own (.py).",
)
@click.option("--without", metavar="EFFECT", multiple=True, help="Leave an effect out of the catalogue; repeatable.")
@click.option("--tolerance", "tolerance_mN", metavar="MN", type=float, help="Gap [mN] below which nothing matters.")
@click.option("--specimen", metavar="NAME", help="Name or id, where there are several; else the most measured.")
@click.option("--calibration", metavar="FILE", help="What gap calibrate wrote; what ships unless given.")
@click.option("--save-model", metavar="FILE", type=FILE, help="Where to write the model with the effect in it.")
@click.option("--report", metavar="FILE.html", type=FILE, help="Where to write the report, one HTML file.")
@options.workers("campaigns")
@options.overwrite
@options.as_json
@options.quiet
def diagnose_command(
    campaigns: tuple[Path, ...],
    nominal: str,
    without: tuple[str, ...],
    tolerance_mN: float | None,
    specimen: str | None,
    calibration: str | None,
    save_model: Path | None,
    report: Path | None,
    workers: int | None,
    scheduler: str | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Say where a campaign differs from the model, which effect that is, and how far it closes the gap.

    CAMPAIGN is a folder of run files; it need not be complete. Several are diagnosed side by side and told in a table,
    or with --json in a line each. Of one, this prints the verdict (an effect, several, no gap, or one that no effect of
    the catalogue explains), where the gap is, the ranking with probabilities, how far the gap closes on runs that took
    no part, and what these runs cannot answer. Runs marked bad, ways back and runs that did not end
    as planned are left out. The exit code is 0 whatever the verdict; no model is written where no effect is named.
    """
    from dragrig.api import diagnose as diagnosing
    from dragrig.api.diagnose import DiagnosisRequest
    from dragrig.parallel import worker_count
    from dragrig.present.diagnosis import diagnosis_json, diagnosis_parts
    from dragrig.present.files import require_writable
    from dragrig.present.terminal import print_parts

    worker_count(workers, scheduler)
    asked = DiagnosisRequest(nominal, without, tolerance_mN, specimen, calibration)
    if len(campaigns) > 1:
        options.require_single_campaign(len(campaigns), save_model=save_model, report=report)
        diagnose_several(campaigns, asked, workers=workers, scheduler=scheduler, as_json=as_json)
        return
    [campaign] = campaigns
    for path in filter(None, (save_model, report)):
        require_writable(path, overwrite=overwrite)
    with ProgressMeter("diagnosing", 1.0, quiet=is_quiet()) as meter:
        found = asked.diagnosed(campaign, meter.at) if scheduler is None else asked.diagnosed_there(campaign, scheduler)
    if not as_json:
        print_parts(diagnosis_parts(found.result))
    model = None if save_model is None else diagnosing.save_amended_model(found.result, save_model, overwrite=overwrite)
    if save_model is not None and model is None:
        print_remark(f"{display_path(save_model)} is not written: the verdict gives no model")
    written = None
    if report is not None:
        written = diagnosing.save_gap_report(
            found.result, report, source=found.source, model=model, overwrite=overwrite
        )
    if as_json:
        print_json(diagnosis_json(found.result, model=None if model is None else str(model), run_ids=found.run_ids))
        return
    for name, made in (("model", model), ("report", written)):
        if made is not None:
            print_result(f"{name:8}{display_path(made)}")


@click.command("evaluate")
@click.argument("model", type=FILE)
@click.argument("campaign", type=FILE)
@click.option("--specimen", metavar="NAME", help="Name or id, where there are several; else the most measured.")
@options.as_json
@options.quiet
def evaluate_command(model: Path, campaign: Path, specimen: str | None, as_json: bool) -> None:
    """Say how far an amended model closes the gap on fresh runs of the same specimen.

    MODEL is what dragrig gap diagnose wrote with --save-model, CAMPAIGN a folder of runs that took no part in it, best
    at other speeds.
    """
    from dragrig.api import diagnose as diagnosing
    from dragrig.present.diagnosis import shrink_parts, shrink_report_json
    from dragrig.present.terminal import print_parts

    found = diagnosing.gap_evaluate(model, campaign, specimen=specimen)
    if as_json:
        print_json(shrink_report_json(found))
    else:
        print_parts(shrink_parts(found))


@click.command("next")
@click.argument("source", metavar="CAMPAIGN|PLAN")
@click.option("--between", nargs=2, metavar="EFFECT EFFECT", help="Two effects to be told apart, at their usual sizes.")
@click.option("--minutes", metavar="MIN", type=float, default=20.0, help="Rig time that the runs may take; 20.")
@click.option(
    "--save-plan", metavar="FILE.toml", type=click.Path(path_type=Path), help="Where to write the runs as a plan."
)
@options.settings
@options.overwrite
@options.as_json
@options.quiet
def next_command(
    source: str,
    between: tuple[str, str] | None,
    minutes: float,
    save_plan: Path | None,
    overwrite: bool,
    as_json: bool,
    **settings: Unpack[options.SettingsOptions],
) -> None:
    """Say which runs to make next: those that separate the leading hypotheses best per minute of rig time.

    CAMPAIGN, a folder of run files, is diagnosed first, and what it leaves open is to be decided. Of a PLAN the runs
    are taken as made, and the effects that they hardly tell apart are to be told apart. Runs come from a fixed grid of
    kinds, speeds, strokes, strains, rests and reversals, one after another, the best each time, as long as they help
    and the rig time lasts. What --save-plan writes, dragrig run carries out.
    """
    from dragrig.api import plan_next as planning
    from dragrig.present.diagnosis import next_experiment_json
    from dragrig.present.files import require_writable
    from dragrig.present.terminal import print_parts

    if save_plan is not None:
        require_writable(save_plan, overwrite=overwrite)
    with ProgressMeter("searching", 1.0, quiet=is_quiet()) as meter:
        found = planning.next_experiment(source, between=between, minutes=minutes, progress=meter.at, **settings)
    if as_json:
        print_json(next_experiment_json(found))
    elif found is None:
        print_result("No run of the grid would separate the leading hypotheses any better.")
    else:
        print_parts(_next_run_parts(found))
    if save_plan is None:
        return
    if found is None:
        print_remark(f"{display_path(save_plan)} is not written: there is no run to recommend")
        return
    planning.save_next_plan(found, save_plan, overwrite=overwrite)
    if not as_json:
        print_result(f"plan    {display_path(save_plan)}")


def _next_run_parts(found: "NextExperiment") -> "Iterator[RenderableType]":
    from dragrig.analysis.gap.diagnosis_text import run_text, separation_text
    from dragrig.present.terminal import terminal_table

    yield found.why
    rows = [(run_text(one.step), f"{one.minutes:.1f}", separation_text(one.before, one.after)) for one in found.runs]
    title = f"What to run next, {found.minutes:.1f} min of rig time in all"
    yield terminal_table(title, ("", "min", "each after those above"), rows, (1,))


MAX_PAIRS = 20
"""So many pairs are told; the others are in the JSON."""


@click.command("isolability")
@click.argument("source", metavar="PLAN|CAMPAIGN")
@click.option("--without", metavar="EFFECT", multiple=True, help="Leave an effect out of the catalogue; repeatable.")
@click.option(
    "--report", metavar="FILE.html", type=click.Path(path_type=Path), help="Where to write the page, one HTML file."
)
@options.settings
@options.overwrite
@options.as_json
@options.quiet
def isolability_command(
    source: str,
    without: tuple[str, ...],
    report: Path | None,
    overwrite: bool,
    as_json: bool,
    **settings: Unpack[options.SettingsOptions],
) -> None:
    """Say which effects runs can tell apart, and how small a one they would show.

    PLAN, a file or a shipped name, is looked at before any run, by runs that the simulated rig makes of it without any
    effect. CAMPAIGN is a folder of run files. Every two effects have an angle between what they can do to the force,
    nuisances taken out: sin² of 0 means that they cannot be told apart at all, 1 that neither resembles the other. d′
    is how many standard deviations of noise stand between them at their usual size.
    """
    from dragrig.api import plan_next as isolating
    from dragrig.present.files import require_writable, write_text
    from dragrig.present.isolability import isolability_json
    from dragrig.present.terminal import print_parts

    if report is not None:
        require_writable(report, overwrite=overwrite)
    with ProgressMeter("looking", 1.0, quiet=is_quiet()) as meter:
        found = isolating.isolability(source, without=without, progress=meter.at, **settings)
    if as_json:
        print_json(isolability_json(found))
    else:
        print_parts(_isolability_parts(found))
    if report is not None:
        from dragrig.present.isolability import isolability_page

        write_text(isolability_page(found), report, overwrite=overwrite)
        if not as_json:
            print_result(f"report  {display_path(report)}")


def _isolability_parts(found: "Isolability") -> "Iterator[RenderableType]":
    from dragrig.analysis.gap.diagnosis_text import as_sentence, display_name
    from dragrig.analysis.gap.isolability import isolability_sentences, smallest_visible_text
    from dragrig.present.terminal import terminal_table

    yield "\n".join(isolability_sentences(found))
    header = ("effect", "seen in", "d′, usual size", "usual", "smallest seen", "as mN")
    rows = [
        (
            one.effect,
            one.channel,
            f"{one.d_prime:.0f}",
            f"{one.usual:g}",
            smallest_visible_text(one),
            "" if one.least_mN is None else f"{one.least_mN:.2g}",
        )
        for one in found.effects
    ]
    yield terminal_table("How clearly each is seen, near ones together", header, rows, (2, 3, 4, 5))
    pairs = found.pairs[:MAX_PAIRS]
    title = f"The closest pairs, {len(pairs)} of {len(found.pairs)}"
    names = ("", "", "sin²", "first by second", "second by first", "d′", "")
    told = [
        (
            display_name(one.effects[0]),
            display_name(one.effects[1]),
            f"{one.sin2:.2f}",
            *(f"{each:.2f}" for each in one.typical_sin2),
            f"{one.separation:.0f}",
            "hardly told apart" if one.confused else "",
        )
        for one in pairs
    ]
    yield terminal_table(title, names, told, (2, 3, 4, 5))
    yield "\n".join(f"! {as_sentence(one)}" for one in found.remarks)


@click.command("effects")
@options.as_json
def effects_command(as_json: bool) -> None:
    """List what the friction model leaves out and a rig or a gut can have.

    By place: each effect's id, what it is and what exposes it, its parameters with unit, usual value and prior range,
    what is hardly told from it, and where its form comes from. A simulated rig has an effect with, for instance,
    --effect stribeck:ratio=0.4,speed_mm_s=2.
    """
    from dragrig.sim_backend.effects.base import catalogue

    known = catalogue().values()
    if as_json:
        print_json({"effects": [_effect_json(one) for one in known]})
    else:
        print_result(_catalogue_text(known))


def _catalogue_text(effects: "Iterable[Effect]") -> str:
    from dragrig.sim_backend.effects.base import Location

    known = tuple(effects)
    places = ((place, [one for one in known if one.location is place]) for place in Location)
    return "\n\n".join("\n\n".join((f"{place.upper()}", *map(_effect_text, there))) for place, there in places if there)


def _effect_text(effect: "Effect") -> str:
    header = ("parameter", "unit", "usual", "from", "to", "")
    table = text_columns(header, (_parameter_row(one) for one in effect.parameters))
    lines = [effect.id, f"  {effect.summary}", f"  shows in: {effect.visible_in} ({effect.channel})"]
    lines += [f"    {line}" for line in table.splitlines()]
    if effect.confused_with:
        lines.append(f"  hardly told from: {', '.join(effect.confused_with)}")
    if effect.nominal:
        lines.append(f"  for the model: {effect.nominal}")
    return "\n".join((*lines, f"  source: {effect.source}"))


def _parameter_row(parameter: "EffectParameter") -> tuple[str, ...]:
    unit = "" if parameter.unit == "1" else parameter.unit
    numbers = (parameter.default, parameter.low, parameter.high)
    return (parameter.name, unit, *(f"{one:g}" for one in numbers), f"{parameter.role}: {parameter.meaning}")


def _parameter_json(parameter: "EffectParameter") -> dict[str, object]:
    return {
        "name": parameter.name,
        "unit": parameter.unit,
        "role": parameter.role,
        "usual": parameter.default,
        "low": parameter.low,
        "high": parameter.high,
        "meaning": parameter.meaning,
        "tried": parameter.grid,
        "possible": parameter.bounds,
    }


def _effect_json(effect: "Effect") -> dict[str, object]:
    return {
        "id": effect.id,
        "name": effect.name,
        "place": effect.location,
        "domain": effect.coordinate,
        "summary": effect.summary,
        "exposes": effect.visible_in,
        "channel": effect.channel,
        "parameters": [_parameter_json(parameter) for parameter in effect.parameters],
        "aliases": effect.confused_with,
        "nominal": effect.nominal or None,
        "source": effect.source,
    }
