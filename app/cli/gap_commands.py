"""Commands on the gap between runs and model: gap diagnose, evaluate, next, isolability, effects, blind, calibrate."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import click

from dragrig.cli import options
from dragrig.cli.console import (
    ProgressMeter,
    display_path,
    echo,
    print_document,
    print_json,
    print_remark,
    print_warning,
    print_written,
    write_report,
)
from dragrig.cli.options import NUMBER

if TYPE_CHECKING:
    from dragrig.api import DiagnosedFolder
    from dragrig.rig import Campaign
    from dragrig.setup import SetupChoices


FILE = click.Path(path_type=Path)
HANDS = click.option(
    "--hands",
    metavar="MIN",
    type=NUMBER,
    help="Minutes of a person at a change of fixture or capsule: a run that needs one must tell more (default: 2).",
)
DIAGNOSE_COST, ISOLATE_COST, PAGE_COST, FIGURES_COST = 11, 19, 4, 4
"""User CPU time [s] of the diagnosis of a campaign of 40 runs, of the isolability of a plan with 58, of a page, and of
figures beside it."""


@click.command("diagnose")
@options.campaigns
@click.option(
    "--nominal",
    metavar="NAME|FILE",
    default="capsule",
    help="Expected behaviour: capsule (default), drive, a friction model (.toml), or a model of your own (.py).",
)
@options.without
@click.option("--tolerance", "tolerance_mN", metavar="MN", type=NUMBER, help="Smaller gaps [mN] are ignored.")
@options.measured_specimen
@click.option("--calibration", metavar="FILE", help="File from gap calibrate --save (default: the shipped one).")
@options.written_file("--save-model", "FILE", "Write the model with the effect added to this file.")
@options.report
@options.figures
@click.option(
    "--together", is_flag=True, help="Diagnose campaigns of one rig together: which effects are in all, some, or one."
)
@options.workers("campaigns")
@options.overwrite
@options.as_json
@options.quiet
def diagnose_command(
    campaigns: tuple[Path, ...],
    listing: "Campaign | None",
    nominal: str,
    without: tuple[str, ...],
    tolerance_mN: float | None,
    specimen: str | None,
    calibration: str | None,
    save_model: Path | None,
    report: Path | None,
    figures: Path | None,
    together: bool,
    workers: int | None,
    scheduler: str | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Diagnose where a campaign differs from the model, which effect causes it, and how far it closes the gap.

    CAMPAIGN is a folder of run files (default: the newest), or run files of one; it need not be complete. For one this
    prints the verdict (one effect, several, no gap, or a gap that no effect of the catalogue explains), where the gap
    is, the ranking with probabilities, how far the gap closes on held-out runs, and which questions these runs leave
    open. Several campaigns
    are diagnosed in parallel and printed as a table, or with --json as one line each; with --together campaigns of one
    rig are one question: which effects are in all of them, in some, or in one. Runs marked bad, return strokes
    and runs that did not end as planned are left out. The exit code is 0 whatever the verdict; no model is written
    where no effect is named.
    """
    from dragrig.analysis import parts_of
    from dragrig.api import DiagnosisRequest, save_amended_model
    from dragrig.parallel import worker_count
    from dragrig.present import diagnosis_document, pooled_document, save_figures

    worker_count(workers, scheduler)
    request, count = DiagnosisRequest(nominal, without, tolerance_mN, specimen, calibration), len(campaigns)
    if together:
        options.require_single_campaign(count, save_model=save_model)
    elif count > 1:
        options.require_single_campaign(count, save_model=save_model, report=report, figures=figures)
        with ProgressMeter(f"diagnosing {count} campaigns") as meter:
            several = request.diagnose_many(campaigns, workers, scheduler, meter.at)
        _print_diagnoses(several, as_json=as_json)
        return
    model: Path | None = None
    with ProgressMeter(f"diagnosing {count} campaigns together" if together else "diagnosing") as meter:
        costs = DIAGNOSE_COST * count, PAGE_COST * (report is not None), FIGURES_COST * (figures is not None)
        finding, reporting, drawing = parts_of(meter.at, *costs)
        if together:
            document = pooled_document(request.diagnose_together(campaigns, workers, scheduler, finding))
        else:
            if scheduler is None or listing is not None:
                diagnosed = request.diagnose(listing or campaigns[0], finding)
            else:
                diagnosed = request.diagnose_on_cluster(campaigns[0], scheduler)
            if save_model is not None:
                model = save_amended_model(diagnosed.result, save_model, overwrite=overwrite)
            named = None if model is None else str(model)
            document = diagnosis_document(
                diagnosed.result, source=diagnosed.source, model=named, run_ids=diagnosed.run_ids
            )
        # Written before anything is printed: a reader such as head ends the command.
        write_report(document, report, *campaigns, overwrite=overwrite, progress=reporting)
        drawn: list[Path] = []
        for path in () if figures is None else save_figures(document, figures, overwrite=overwrite):
            drawn.append(path)
            drawing(len(drawn), len(tuple(document.figures())))
    if save_model is not None and model is None:
        print_remark(f"{display_path(save_model)} is not written: the verdict gives no model")
    print_document(document, as_json=as_json)
    print_written(as_json=as_json, model=model, report=report)
    for path in drawn if not as_json else ():
        echo(f"figure  {display_path(path)}")


def _print_diagnoses(folders: "Sequence[DiagnosedFolder]", *, as_json: bool) -> None:
    """Print the diagnoses of several campaigns as a table or lines of JSON; raises where one was not diagnosed."""
    from dragrig.present import campaigns_document, diagnosis_json

    if as_json:
        for folder in folders:
            content = (
                {"error": folder.why_not}
                if folder.result is None
                else diagnosis_json(folder.result, run_ids=folder.run_ids)
            )
            print_json({"source": folder.source, **content}, indent=None)
    else:
        rows = [(folder.source, folder.result, folder.why_not) for folder in folders]
        print_document(campaigns_document(rows), as_json=False)
    options.require_all_succeeded(
        "diagnosed", len(folders), [folder.why_not for folder in folders if folder.result is None]
    )


@click.command("evaluate")
@click.argument("model", type=FILE)
@click.argument("campaign", type=FILE)
@options.measured_specimen
@options.report
@options.overwrite
@options.as_json
@options.quiet
def evaluate_command(
    model: Path, campaign: Path, specimen: str | None, report: Path | None, overwrite: bool, as_json: bool
) -> None:
    """Evaluate on fresh runs of the same specimen whether an amended model keeps its promise.

    MODEL is written by dragrig gap diagnose --save-model; CAMPAIGN is a folder of runs that took no part in the
    diagnosis, preferably at other speeds. The answer is KEPT, NOT KEPT (exit code 1) or NO POWER: the runs cannot tell.
    """
    from dragrig.analysis.gap import PromiseVerdict
    from dragrig.api import gap_evaluate
    from dragrig.present import evaluation_document

    evaluation = gap_evaluate(model, campaign, specimen=specimen)
    document = evaluation_document(evaluation)
    write_report(document, report, campaign, overwrite=overwrite)
    print_document(document, as_json=as_json)
    print_written(as_json=as_json, report=report)
    if evaluation.verdict is PromiseVerdict.NOT_KEPT:
        click.get_current_context().exit(1)


@click.command("next")
@click.argument("source", metavar="CAMPAIGN|PLAN")
@click.option("--between", nargs=2, metavar="EFFECT EFFECT", help="Two effects to separate, at their default sizes.")
@click.option("--minutes", metavar="MIN", type=NUMBER, default=20.0, show_default=True, help="Rig time available.")
@HANDS
@options.written_file("--save-plan", "FILE.toml", "Write the runs as a plan to this file.")
@options.settings
@options.overwrite
@options.as_json
@options.quiet
def next_command(
    source: str,
    between: tuple[str, str] | None,
    minutes: float,
    hands: float | None,
    save_plan: Path | None,
    overwrite: bool,
    as_json: bool,
    **settings: "Unpack[SetupChoices]",
) -> None:
    """Recommend the next runs: those that separate the leading hypotheses best per minute of rig time.

    CAMPAIGN, a folder of run files, is diagnosed first, and the recommended runs decide between its leading hypotheses.
    The runs of a PLAN are taken as made, and the recommended ones separate its most similar effects. Runs come from a
    fixed grid of kinds, speeds, strokes, strains, rests and reversals, added one by one, the best each time, until none
    helps or the rig time is used up. dragrig run carries out the plan of --save-plan.
    """
    from dragrig.analysis.gap import DEFAULT_HANDS_MIN
    from dragrig.api import gap_next, save_next_plan
    from dragrig.present import next_experiment_document

    with ProgressMeter("searching") as meter:
        experiment = gap_next(
            source,
            between=between,
            minutes=minutes,
            hands_min=DEFAULT_HANDS_MIN if hands is None else hands,
            progress=meter.at,
            **settings,
        )
    if save_plan is not None and experiment is not None:
        save_next_plan(experiment, save_plan, overwrite=overwrite)
    print_document(next_experiment_document(experiment), as_json=as_json)
    if save_plan is not None and experiment is None:
        print_remark(f"{display_path(save_plan)} is not written: there is no run to recommend")
    else:
        print_written(as_json=as_json, plan=save_plan)


@click.command("settle")
@click.argument("plan", required=False)
@click.option("--minutes", metavar="MIN", type=NUMBER, help="Rig time of all runs (default: 30).")
@click.option("--until", metavar="P", type=NUMBER, help="Probability from which the gap is settled (default: 0.95).")
@HANDS
@click.option("--resume", metavar="CAMPAIGN", type=FILE, help="Go on with a campaign, whatever ended it.")
@options.settings
@options.out("Folder of the campaign, new or empty (default: a new one in the rig's data root).")
@options.session_notes("in the run files")
@click.option("--mirror", metavar="DIR", type=FILE, help="Write a second, verified copy of each finished file here.")
@options.pace
@options.yes
@options.report
@options.overwrite
@options.as_json
@options.quiet
def settle_command(
    plan: str | None,
    minutes: float | None,
    until: float | None,
    hands: float | None,
    resume: Path | None,
    out: Path | None,
    operator: str,
    note: str,
    mirror: Path | None,
    pace: options.Pace | None,
    yes: bool,
    report: Path | None,
    overwrite: bool,
    as_json: bool,
    **settings: "Unpack[SetupChoices]",
) -> None:
    """Make runs until the gap is settled: the runs of PLAN first, then batches of those that tell most per minute.

    After each batch the campaign is diagnosed. It ends when verdict and causes are as probable as --until, when the rig
    time is spent, or when no further run would tell more. PLAN is a file or a shipped name; first has eight runs to
    begin with. On a rig that needs hands it asks for them where fixture or capsule change, and bundles runs so that
    they change rarely. All runs and decisions are kept in the campaign's folder: after a kill, --resume goes on.

    Exit codes: 0 ended as it should, 2 bad input, 3 aborted, 4 guard tripped, 5 device fault.
    """
    from dragrig.analysis.gap import DEFAULT_HANDS_MIN, DEFAULT_UNTIL, SettleRecord
    from dragrig.api import DEFAULT_SETTLE_MIN, SettleHands, gap_settle, gap_settle_resume
    from dragrig.cli.operator import TerminalOperator
    from dragrig.present import settlement_document, step_sentence

    context = click.get_current_context()
    if (plan is None) == (resume is None):
        raise click.UsageError("Name a plan, or a campaign to go on with after --resume, and not both", context)
    if resume is not None and (any(value is not None for value in (until, hands, out)) or any(settings.values())):
        raise click.UsageError("--resume goes on as it began: only --minutes may be changed", context)

    def tell(record: SettleRecord) -> None:
        print_remark(step_sentence(record))

    with TerminalOperator(yes=yes) as person:
        at_the_rig = SettleHands(
            operator=operator, note=note, pace=pace, person=person, mirror=mirror, tell=print_warning
        )
        if resume is not None:
            settled = gap_settle_resume(resume, hands=at_the_rig, step=tell, minutes=minutes)
        else:
            settled = gap_settle(
                plan or "",
                minutes=DEFAULT_SETTLE_MIN if minutes is None else minutes,
                until=DEFAULT_UNTIL if until is None else until,
                hands_min=DEFAULT_HANDS_MIN if hands is None else hands,
                out=out,
                hands=at_the_rig,
                step=tell,
                **settings,
            )
    document = settlement_document(settled.record, settled.diagnosed.result, source=str(settled.folder))
    write_report(document, report, settled.folder, overwrite=overwrite)
    print_document(document, as_json=as_json)
    print_written(as_json=as_json, folder=settled.folder, report=report)


@click.command("isolability")
@click.argument("source", metavar="PLAN|CAMPAIGN")
@options.without
@options.report
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
    **settings: "Unpack[SetupChoices]",
) -> None:
    """Determine which effects runs can tell apart, and the smallest detectable size of each.

    PLAN, a file or a shipped name, is examined before any run, by simulating its runs without any effect. CAMPAIGN is a
    folder of run files. Each pair of effects has an angle between the force changes that they can cause, nuisance
    parameters projected out: sin² = 0 means that they cannot be told apart, 1 that they have nothing in common. d′ is
    their distance in standard deviations of the noise, at their default sizes.
    """
    from dragrig.analysis import parts_of
    from dragrig.api import gap_isolability
    from dragrig.present import isolability_document

    with ProgressMeter("computing") as meter:
        isolating, reporting = parts_of(meter.at, ISOLATE_COST, PAGE_COST * (report is not None))
        document = isolability_document(gap_isolability(source, without=without, progress=isolating, **settings))
        write_report(document, report, source, overwrite=overwrite, progress=reporting)
    print_document(document, as_json=as_json)
    print_written(as_json=as_json, report=report)


@click.command("effects")
@options.as_json
def effects_command(as_json: bool) -> None:
    """List the catalogue of effects that the friction model leaves out and a rig or a gut can have.

    For each effect: its id, a summary, the runs in which it is visible, its parameters with unit, default and prior
    range, the effects it is easily confused with, and the source of its equation. A simulated rig has an effect with,
    for instance, --effect stribeck:ratio=0.4,speed_mm_s=2.
    """
    from dragrig.present import effects_document
    from dragrig.sim_backend.effects import catalogue

    print_document(effects_document(tuple(catalogue().values())), as_json=as_json)


@click.command("blind")
@click.option("--cases", metavar="N", type=int, default=100, show_default=True, help="Number of campaigns.")
@click.option("--seed", metavar="S", type=int, default=1, show_default=True, help="Seed of the campaigns.")
@click.option(
    "--mix",
    "kind",
    type=click.Choice(["exam", "learning", "conditions", "motion"]),
    default="exam",
    show_default=True,
    help="Mix of campaigns: realistic (exam), with more hard cases for training (learning), a third of them "
    "incomplete, of another programme, noise or specimen, or with a nominal model that is off (conditions), or all "
    "with stages that move as drives do (motion).",
)
@click.option(
    "--plant",
    type=click.Choice(["written", "drawn"]),
    default="written",
    show_default=True,
    help="Effects in forms that are written down, to learn from, or with laws drawn at random, to judge by.",
)
@options.out("Folder of the exam, which a second call continues (default: a temporary one).")
@options.workers("campaigns")
@click.option(
    "--without-true", is_flag=True, help="Diagnose single effects again with the true effect left out of the catalogue."
)
@options.report
@options.overwrite
@options.as_json
@options.quiet
def blind_command(
    cases: int,
    seed: int,
    kind: str,
    plant: str,
    out: Path | None,
    workers: int | None,
    scheduler: str | None,
    without_true: bool,
    report: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Examine how often the diagnosis is right, on simulated campaigns whose hidden effect it cannot know.

    A separate plant, which shares no equation with the catalogue, simulates the campaigns. The hash of the answers is
    written first; each campaign is diagnosed by a process that gets its folder alone; then the answers are opened and
    the verdicts scored, with Wilson intervals. Two exams with the same seed are identical. The exit code is 0 whatever
    the score, and 2 where campaigns could not be diagnosed.
    """
    from dragrig.config import AnalysisError
    from dragrig.exam import gap_blind
    from dragrig.present import exam_document

    with ProgressMeter(f"examining {cases} campaigns") as meter:
        exam = gap_blind(
            cases,
            seed,
            out,
            workers=workers,
            scheduler=scheduler,
            kind=kind,
            plant=plant,
            without_true=without_true,
            progress=meter.at,
        )
    document = replace(exam_document(exam.score, exam.cases, exam.seed, exam.answers_sha256), data=exam.document())
    write_report(document, report, overwrite=overwrite)
    print_document(document, as_json=as_json)
    print_written(as_json=as_json, report=report)
    if exam.failed:
        name, reason = next(iter(exam.failed.items()))
        raise AnalysisError(f"{len(exam.failed)} of {cases} campaigns were not diagnosed; of {name}: {reason}.")


@click.command("calibrate")
@click.argument("exams", metavar="EXAM…", type=FILE, nargs=-1, required=True)
@click.option("--save", metavar="FILE", type=FILE, help="File for dragrig gap diagnose --calibration.")
@click.option(
    "--folds",
    metavar="K",
    type=click.IntRange(min=2),
    help="Cross-validate with this number of folds, and print the rates.",
)
@options.as_json
@options.overwrite
def calibrate_command(
    exams: tuple[Path, ...], save: Path | None, folds: int | None, as_json: bool, overwrite: bool
) -> None:
    """Learn the verdict's thresholds and weights from exams that dragrig gap blind --out wrote.

    Judge the result on an exam with another seed.
    """
    from dragrig.exam import gap_calibrate, gap_cross_validate
    from dragrig.present import calibration_document, write_text

    calibration = gap_calibrate(exams)
    rates = None if folds is None else gap_cross_validate(exams, folds)
    if save is not None:
        write_text(calibration.model_dump_json(indent=1) + "\n", save, overwrite=overwrite)
    print_document(calibration_document(calibration, rates), as_json=as_json)
    if save is not None and not as_json:
        echo(f"calibration  {display_path(save)}")
