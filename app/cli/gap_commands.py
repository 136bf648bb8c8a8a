"""Commands on the gap between runs and model: gap diagnose, evaluate, next, isolability, effects."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import click

from dragrig.cli import options
from dragrig.cli.console import ProgressMeter, display_path, print_json, print_json_line, print_remark, print_result
from dragrig.present.numbers import text_columns
from dragrig.present.terminal import print_parts, terminal_table

if TYPE_CHECKING:
    from rich.console import RenderableType

    from dragrig.analysis.gap.diagnosis import NextExperiment
    from dragrig.analysis.gap.isolability import Isolability
    from dragrig.api.diagnose import DiagnosedFolder
    from dragrig.sim_backend.effects.base import Effect


FILE = click.Path(path_type=Path)


@click.command("diagnose")
@click.argument("campaigns", metavar="CAMPAIGN…", type=FILE, nargs=-1, required=True)
@click.option(
    "--nominal",
    metavar="NAME|FILE",
    default="capsule",
    help="Expected behaviour: capsule (default), drive, a friction model (.toml), or a model of your own (.py).",
)
@click.option("--without", metavar="EFFECT", multiple=True, help="Leave an effect out of the catalogue; repeatable.")
@click.option("--tolerance", "tolerance_mN", metavar="MN", type=float, help="Gap [mN] below which nothing matters.")
@click.option("--specimen", metavar="NAME", help="Name or id, where there are several (default: the most measured).")
@click.option("--calibration", metavar="FILE", help="File from gap calibrate --save (default: the shipped one).")
@click.option("--save-model", metavar="FILE", type=FILE, help="Write the model with the effect added to this file.")
@click.option("--report", metavar="FILE.html", type=FILE, help="Write the report to this file.")
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
    """Diagnose where a campaign differs from the model, which effect causes it, and how far it closes the gap.

    CAMPAIGN is a folder of run files; it need not be complete. For one campaign this prints the verdict (one effect,
    several, no gap, or a gap that no effect of the catalogue explains), where the gap is, the ranking with
    probabilities, how far the gap closes on held-out runs, and which questions these runs leave open. Several campaigns
    are diagnosed in parallel and printed as a table, or with --json as one line each. Runs marked bad, return strokes
    and runs that did not end as planned are left out. The exit code is 0 whatever the verdict; no model is written
    where no effect is named.
    """
    from dragrig.api.diagnose import DiagnosisRequest, save_amended_model, save_gap_report
    from dragrig.parallel import worker_count
    from dragrig.present.diagnosis import diagnosis_json, diagnosis_parts
    from dragrig.present.files import require_writable

    worker_count(workers, scheduler)
    if len(campaigns) > 1:
        options.require_single_campaign(len(campaigns), save_model=save_model, report=report)
        from dragrig.api.diagnose import diagnose_many

        with ProgressMeter(f"diagnosing {len(campaigns)} campaigns") as meter:
            folders = diagnose_many(
                campaigns,
                nominal=nominal,
                without=without,
                tolerance_mN=tolerance_mN,
                specimen=specimen,
                calibration=calibration,
                workers=workers,
                scheduler=scheduler,
                progress=meter.at,
            )
        _print_diagnoses(folders, as_json=as_json)
        return
    [campaign] = campaigns
    request = DiagnosisRequest(nominal, without, tolerance_mN, specimen, calibration)
    for path in filter(None, (save_model, report)):
        require_writable(path, overwrite=overwrite)
    with ProgressMeter("diagnosing") as meter:
        if scheduler is None:
            diagnosed = request.diagnose(campaign, meter.at)
        else:
            diagnosed = request.diagnose_on_cluster(campaign, scheduler)
    diagnosis = diagnosed.result
    if not as_json:
        print_parts(diagnosis_parts(diagnosis))
    model = None if save_model is None else save_amended_model(diagnosis, save_model, overwrite=overwrite)
    if save_model is not None and model is None:
        print_remark(f"{display_path(save_model)} is not written: the verdict gives no model")
    if report is not None:
        save_gap_report(diagnosis, report, source=diagnosed.source, model=model, overwrite=overwrite)
    if as_json:
        print_json(diagnosis_json(diagnosis, model=None if model is None else str(model), run_ids=diagnosed.run_ids))
        return
    for name, file in (("model", model), ("report", report)):
        if file is not None:
            print_result(f"{name:8}{display_path(file)}")


def _print_diagnoses(folders: "Sequence[DiagnosedFolder]", *, as_json: bool) -> None:
    """Print the diagnoses of several campaigns as a table or lines of JSON; raises where one was not diagnosed."""
    from dragrig.present.diagnosis import diagnosis_json

    if as_json:
        for folder in folders:
            content = (
                {"error": folder.why_not}
                if folder.result is None
                else diagnosis_json(folder.result, run_ids=folder.run_ids)
            )
            print_json_line({"source": folder.source, **content})
    else:
        header = ("campaign", "verdict", "probability", "confusable with", "gap [mN]", "closed", "95 % interval")
        print_parts([terminal_table(f"{len(folders)} campaigns", header, map(_campaign_row, folders), (2, 4, 5))])
    options.require_all_succeeded(
        "diagnosed", len(folders), [folder.why_not for folder in folders if folder.result is None]
    )


def _campaign_row(folder: "DiagnosedFolder") -> tuple[str, ...]:
    from dragrig.analysis.gap.diagnosis_text import is_stated_verdict, percent_text, probability_text

    diagnosis = folder.result
    if diagnosis is None:
        return folder.source, f"not diagnosed: {folder.why_not}", "", "", "", "", ""
    stated = next((ranked for ranked in diagnosis.ranking if is_stated_verdict(ranked, diagnosis)), None)
    reduction = diagnosis.shrink
    closed = reduction.closed if reduction is not None and diagnosis.effects else None
    interval = reduction.closed_95ci if reduction is not None and diagnosis.effects else None
    return (
        folder.source,
        " + ".join(diagnosis.effects) or diagnosis.verdict.value.replace("_", " "),
        "" if stated is None else probability_text(stated.probability),
        ", ".join(diagnosis.confusable_with),
        "" if reduction is None else f"{reduction.gap_before_mN:.3g}",
        "" if closed is None else percent_text(closed),
        "" if interval is None else f"{percent_text(interval[0])} to {percent_text(interval[1])}",
    )


@click.command("evaluate")
@click.argument("model", type=FILE)
@click.argument("campaign", type=FILE)
@click.option("--specimen", metavar="NAME", help="Name or id, where there are several (default: the most measured).")
@options.as_json
@options.quiet
def evaluate_command(model: Path, campaign: Path, specimen: str | None, as_json: bool) -> None:
    """Evaluate how far an amended model closes the gap on fresh runs of the same specimen.

    MODEL is written by dragrig gap diagnose --save-model; CAMPAIGN is a folder of runs that took no part in the
    diagnosis, best at other speeds.
    """
    from dragrig.api.diagnose import gap_evaluate
    from dragrig.present.diagnosis import shrink_parts, shrink_report_json

    reduction = gap_evaluate(model, campaign, specimen=specimen)
    if as_json:
        print_json(shrink_report_json(reduction))
    else:
        print_parts(shrink_parts(reduction))


@click.command("next")
@click.argument("source", metavar="CAMPAIGN|PLAN")
@click.option("--between", nargs=2, metavar="EFFECT EFFECT", help="Two effects to separate, at their default sizes.")
@click.option("--minutes", metavar="MIN", type=float, default=20.0, show_default=True, help="Rig time available.")
@click.option("--save-plan", metavar="FILE.toml", type=FILE, help="Write the runs as a plan to this file.")
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
    """Recommend the next runs: those that separate the leading hypotheses best per minute of rig time.

    CAMPAIGN, a folder of run files, is diagnosed first, and the recommended runs decide between its leading hypotheses.
    The runs of a PLAN are taken as made, and the recommended ones separate its most similar effects. Runs come from a
    fixed grid of kinds, speeds, strokes, strains, rests and reversals, added one by one, the best each time, until none
    helps or the rig time is used up. dragrig run carries out the plan of --save-plan.
    """
    from dragrig.api.plan_next import next_experiment, save_next_plan
    from dragrig.present.diagnosis import next_experiment_json
    from dragrig.present.files import require_writable

    if save_plan is not None:
        require_writable(save_plan, overwrite=overwrite)
    with ProgressMeter("searching") as meter:
        experiment = next_experiment(source, between=between, minutes=minutes, progress=meter.at, **settings)
    if as_json:
        print_json(next_experiment_json(experiment))
    elif experiment is None:
        print_result("No run of the grid would separate the leading hypotheses any better.")
    else:
        print_parts(_next_run_parts(experiment))
    if save_plan is not None and experiment is None:
        print_remark(f"{display_path(save_plan)} is not written: there is no run to recommend")
    elif save_plan is not None and experiment is not None:
        save_next_plan(experiment, save_plan, overwrite=overwrite)
        if not as_json:
            print_result(f"plan    {display_path(save_plan)}")


def _next_run_parts(experiment: "NextExperiment") -> "Iterator[RenderableType]":
    from dragrig.analysis.gap.diagnosis_text import run_text, separation_text

    yield experiment.reason
    rows = [
        (run_text(run.step), f"{run.minutes:.1f}", separation_text(run.before, run.after)) for run in experiment.runs
    ]
    title = f"Recommended runs, {experiment.minutes:.1f} min of rig time in all"
    yield terminal_table(title, ("", "min", "separation with those above"), rows, (1,))


MAX_PAIRS = 20
"""Pairs printed; the JSON has all of them."""


@click.command("isolability")
@click.argument("source", metavar="PLAN|CAMPAIGN")
@click.option("--without", metavar="EFFECT", multiple=True, help="Leave an effect out of the catalogue; repeatable.")
@click.option("--report", metavar="FILE.html", type=FILE, help="Write the page to this file.")
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
    """Determine which effects runs can tell apart, and the smallest size of each that they would show.

    PLAN, a file or a shipped name, is examined before any run, by simulating its runs without any effect. CAMPAIGN is a
    folder of run files. Each pair of effects has an angle between the force changes that they can cause, nuisance
    parameters projected out: sin² = 0 means that they cannot be told apart, 1 that they have nothing in common. d′ is
    their distance in standard deviations of the noise, at their default sizes.
    """
    from dragrig.api.plan_next import isolability
    from dragrig.present.files import require_writable, write_text
    from dragrig.present.isolability import isolability_json, isolability_page

    if report is not None:
        require_writable(report, overwrite=overwrite)
    with ProgressMeter("computing") as meter:
        result = isolability(source, without=without, progress=meter.at, **settings)
    if as_json:
        print_json(isolability_json(result))
    else:
        print_parts(_isolability_parts(result))
    if report is not None:
        write_text(isolability_page(result), report, overwrite=overwrite)
        if not as_json:
            print_result(f"report  {display_path(report)}")


def _isolability_parts(result: "Isolability") -> "Iterator[RenderableType]":
    from dragrig.analysis.gap.diagnosis_text import as_sentence, display_name
    from dragrig.analysis.gap.isolability import isolability_sentences, smallest_visible_text

    yield "\n".join(isolability_sentences(result))
    header = ("effect", "seen in", "d′, default size", "default", "smallest visible", "as mN")
    rows = [
        (
            effect.effect,
            effect.channel,
            f"{effect.d_prime:.0f}",
            f"{effect.usual:g}",
            smallest_visible_text(effect),
            "" if effect.smallest_mN is None else f"{effect.smallest_mN:.2g}",
        )
        for effect in result.effects
    ]
    yield terminal_table("Detectability, similar effects together", header, rows, (2, 3, 4, 5))
    pairs = result.pairs[:MAX_PAIRS]
    title = f"The closest pairs, {len(pairs)} of {len(result.pairs)}"
    names = ("", "", "sin²", "first by second", "second by first", "d′", "")
    pair_rows = [
        (
            display_name(pair.effects[0]),
            display_name(pair.effects[1]),
            f"{pair.sin2:.2f}",
            *(f"{sin2:.2f}" for sin2 in pair.typical_sin2),
            f"{pair.separation:.0f}",
            "hardly distinguishable" if pair.confused else "",
        )
        for pair in pairs
    ]
    yield terminal_table(title, names, pair_rows, (2, 3, 4, 5))
    yield "\n".join(f"! {as_sentence(remark)}" for remark in result.remarks)


@click.command("effects")
@options.as_json
def effects_command(as_json: bool) -> None:
    """List the catalogue of effects that the friction model leaves out and a rig or a gut can have.

    For each effect: its id, a summary and what exposes it, its parameters with unit, default and prior range, the
    effects it is easily confused with, and the source of its equation. A simulated rig has an effect with, for
    instance, --effect stribeck:ratio=0.4,speed_mm_s=2.
    """
    from dragrig.sim_backend.effects.base import catalogue

    effects = tuple(catalogue().values())
    if as_json:
        print_json({"effects": [_effect_json(effect) for effect in effects]})
    else:
        print_result(_catalogue_text(effects))


def _catalogue_text(effects: "Sequence[Effect]") -> str:
    from dragrig.sim_backend.effects.base import Location

    paragraphs = []
    for location in Location:
        texts = [_effect_text(effect) for effect in effects if effect.location is location]
        paragraphs += [location.upper(), *texts] if texts else []
    return "\n\n".join(paragraphs)


def _effect_text(effect: "Effect") -> str:
    header = ("parameter", "unit", "default", "from", "to", "")
    rows = [
        (
            parameter.name,
            "" if parameter.unit == "1" else parameter.unit,
            f"{parameter.default:g}",
            f"{parameter.low:g}",
            f"{parameter.high:g}",
            f"{parameter.role}: {parameter.meaning}",
        )
        for parameter in effect.parameters
    ]
    lines = [effect.id, f"  {effect.summary}", f"  shows in: {effect.visible_in} ({effect.channel})"]
    lines += [f"    {line}" for line in text_columns(header, rows).splitlines()]
    if effect.confused_with:
        lines.append(f"  easily confused with: {', '.join(effect.confused_with)}")
    if effect.nominal:
        lines.append(f"  for the model: {effect.nominal}")
    return "\n".join((*lines, f"  source: {effect.source}"))


def _effect_json(effect: "Effect") -> dict[str, object]:
    parameters = [
        {
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
        for parameter in effect.parameters
    ]
    return {
        "id": effect.id,
        "name": effect.name,
        "place": effect.location,
        "domain": effect.coordinate,
        "summary": effect.summary,
        "exposes": effect.visible_in,
        "channel": effect.channel,
        "parameters": parameters,
        "aliases": effect.confused_with,
        "nominal": effect.nominal or None,
        "source": effect.source,
    }
