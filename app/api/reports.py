"""Reports on a run or a campaign, and the shipped programmes (demonstration, paper) carried out and evaluated."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dragrig import present
from dragrig.analysis import ExportFormat, Progress, export_run, filter_file, no_progress, parts_of
from dragrig.campaign_session import Made, start_campaign
from dragrig.config import AnalysisError, OutputError, SettingsError
from dragrig.hosted_session import RunCounter, SessionOperator, SessionOptions
from dragrig.present import (
    PAPER_MODEL_FILE,
    PAPER_REPORT_FILE,
    PAPER_TABLES,
    drawn,
    require_writable,
    write_text,
    write_texts,
)
from dragrig.rig import (
    mark_path,
    note_path,
    read_campaign,
    read_mark,
    read_run,
    remove_file,
    run_name,
    session_record_of_run,
)
from dragrig.session_state import STATE_FILE
from dragrig.setup import Setup, resolve

if TYPE_CHECKING:
    from dragrig.analysis import Identification
    from dragrig.analysis.paper import PaperFinding
    from dragrig.api.model_fit import IdentifiedCampaign
    from dragrig.present import PaperReportData


def report(
    source: str | Path,
    out: str | Path | None = None,
    *,
    overwrite: bool = False,
    workers: int | None = 1,
    progress: Progress = no_progress,
) -> Path:
    """Write a report on a run or a campaign: one HTML file with embedded figures, which needs no network.

    Parameters
    ----------
    source
        A run file, or the folder of a campaign.
    out
        The file (default: beside the run, or in the campaign, named after it).
    overwrite
        Whether an existing file may be replaced.
    workers
        Processes that draw the figures (None: as many as there are cores).

    Returns
    -------
    The file.

    Raises
    ------
    RunFileError
        When there is no run to report on, or it cannot be read.
    OutputError
        When the file exists, or its folder cannot be written.

    Examples
    --------
    >>> import dragrig
    >>> dragrig.report("runs/first")  # doctest: +SKIP
    PosixPath('runs/first/first.html')
    """
    path = Path(source)
    target = default_report_file(path) if out is None else Path(out)
    require_writable(target, overwrite=overwrite)
    text = _campaign_report(path, workers, progress) if path.is_dir() else _run_report(path)
    return write_text(text, target, overwrite=overwrite)


def default_report_file(source: Path) -> Path:
    """Return the default path of the report on a run or a campaign."""
    return source / f"{source.resolve().name}.html" if source.is_dir() else source.with_name(f"{run_name(source)}.html")


def _run_report(path: Path) -> str:
    from dragrig.present import render_page, run_document

    run, mark = read_run(path), read_mark(path)
    return render_page(run_document(run, None if mark is None else mark.reason), path)


EXAMINING_COST, WRITING_COST = 4, 1


def _campaign_report(folder: Path, workers: int | None, progress: Progress) -> str:
    from dragrig.present import campaign_document, examine_campaign, render_page
    from dragrig.run_inputs import run_files

    run_files([folder])
    examining, writing = parts_of(progress, EXAMINING_COST, WRITING_COST)
    text = render_page(campaign_document(examine_campaign(folder, workers, examining)), folder)
    writing(1, 1)
    return text


PAPER_PLAN = "paper"
PAPER_SEED = 20120509
"""Default seed of noise, zeros and variation."""
MAX_SEED = 2**63 - 1
"""Largest integer that TOML settings can hold."""
PAPER_RATE_HZ = 500.0
IDENTIFYING_STEPS, WRITING_STEPS = 20, 20
"""Progress steps after the runs, each counted as a run."""
PAPER_NOTE = "made by dragrig paper"
"""Note in every run, so that no other run is ever replaced."""

PaperWall = Literal["eq14", "table1"]
PaperViscous = Literal["published", "newtonian"]


@dataclass(frozen=True, slots=True, eq=False)
class PaperReport:
    """The result of `paper`; `model` is None where the fit did not converge."""

    folder: Path
    report: Path
    model: Path | None
    tables: tuple[Path, ...]
    runs: tuple[Path, ...]
    identification: "Identification"
    findings: "tuple[PaperFinding, ...]"


def paper(
    out: str | Path = "paper",
    *,
    seed: int = PAPER_SEED,
    wall: PaperWall = "eq14",
    viscous: PaperViscous = "published",
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> PaperReport:
    """Simulate the paper's programme, identify it, and write a report: HTML, tables as CSV, model, run files.

    The same seed gives the same runs and numbers.

    Parameters
    ----------
    out
        Folder of the campaign, the report, the tables and the identified model.
    wall, viscous
        The paper's wall parameters, and the reading of Eq. 10, to simulate.
    overwrite
        Whether runs and report of an earlier call may be replaced; other runs never are.

    Raises
    ------
    OutputError
        When the folder holds runs, a report, tables or a model, or cannot be written.
    SettingsError
        For a choice that does not exist.

    Examples
    --------
    >>> import dragrig
    >>> made = dragrig.paper("paper-again", seed=1)  # doctest: +SKIP
    >>> made.report, made.identification.coulomb.mu  # doctest: +SKIP
    """
    from dragrig.api.model_fit import identify

    folder, setup = Path(out), paper_setup(seed, wall, viscous)
    clear_paper_folder(folder, overwrite=overwrite)
    counter = RunCounter(progress, IDENTIFYING_STEPS + WRITING_STEPS)
    made = start_campaign(setup, folder, SessionOptions(folder, note=PAPER_NOTE), counter)
    made.session.require()
    identified = identify(folder, model=setup.model, progress=counter.step(IDENTIFYING_STEPS))
    data = _paper_data(made, setup, identified)
    return _write_paper_files(made, identified, data, counter.step(WRITING_STEPS))


def _write_paper_files(
    made: Made, identified: "IdentifiedCampaign", data: "PaperReportData", progress: Progress
) -> PaperReport:
    """Write model, tables and report beside the runs."""
    from dragrig.present import paper_document, paper_tables, render_page

    folder, tables = made.folder, paper_tables(data)
    model: Path | None
    try:
        (model,) = write_texts(folder, {PAPER_MODEL_FILE: identified.toml()})
    except AnalysisError:  # without a model; an earlier one must not stay
        remove_file(folder / PAPER_MODEL_FILE)
        model = None
    written = write_texts(folder, {f"{name}.csv": table.csv() for name, table in tables.items()})
    progress(1, 3)
    document = drawn(paper_document(data, tables, None if model is None else model.name))
    progress(2, 3)
    (report_file,) = write_texts(folder, {PAPER_REPORT_FILE: render_page(document, folder)})
    progress(3, 3)
    return PaperReport(folder, report_file, model, written, made.files, data.identification, data.findings)


def _paper_data(made: Made, setup: Setup, identified: "IdentifiedCampaign") -> "PaperReportData":
    from dragrig.analysis.paper import all_findings, element_rows
    from dragrig.config import Capsule, find_settings
    from dragrig.present import PaperReportData
    from dragrig.sim_backend.devices import draw_run_model

    simulated, result = setup.rig.simulated, identified.result
    models = {
        run.path.name: draw_run_model(setup.model, simulated.variation, simulated.seed, run.order)
        for run in made.session.runs
        if run.path is not None
    }
    traces = {experiment.file: experiment.run for experiment in identified.selection.experiments}
    first = result.coulomb.runs[0].file if result.coulomb is not None and result.coulomb.runs else ""
    return PaperReportData(
        model=setup.model,
        capsule=find_settings(Capsule, "capsule", "drag"),
        wall_thickness_mm=setup.specimen.wall_thickness_mm,
        rig=setup.rig,
        runs=len(models),
        run_models=models,
        identification=result,
        elements=element_rows(result.relaxation, setup.model, models),
        findings=all_findings(),
        coulomb_trace=traces.get(first),
    )


def paper_setup(seed: int, wall: str, viscous: str) -> Setup:
    """Return the settings of the programme; raises `SettingsError` for a choice that does not exist."""
    if not 0 <= seed <= MAX_SEED:
        raise SettingsError(f"seed {seed}: a seed is a whole number from 0 to {MAX_SEED}.")
    return resolve(
        PAPER_PLAN,
        rig="bench",
        model="paper",
        specimen="jejunum",
        backend="simulated",
        assignments=(
            f"rig.sampling.rate_hz={PAPER_RATE_HZ}",
            f"rig.simulated.seed={seed}",
            f"model.wall='{wall}'",
            f"model.viscous='{viscous}'",
        ),
    )


def clear_paper_folder(folder: Path, *, overwrite: bool) -> None:
    """Remove the files of an earlier call; raises `OutputError` for files that may not be replaced."""
    if not folder.is_dir():
        return
    campaign = read_campaign(folder)
    runs = [run.path for run in campaign.runs] + [path for path, _ in campaign.unreadable] + list(campaign.recordings)
    names = (PAPER_REPORT_FILE, PAPER_MODEL_FILE, *(f"{name}.csv" for name in PAPER_TABLES))
    own = [run for run in campaign.runs if run.header.entry.get("note") == PAPER_NOTE]
    own_paths = {run.path for run in own}
    foreign = next((path for path in runs if path not in own_paths), None)
    if foreign is not None:
        raise OutputError(f"{foreign}: is no run of dragrig paper and is not replaced; name another folder.")
    if not overwrite and (existing := (*runs, *filter(Path.exists, (folder / name for name in names)))):
        raise OutputError(f"{existing[0]}: is there already; name another folder, or say --overwrite.")
    # One session wrote all runs with the same settings.
    one_per_session = {run.header.settings_toml: run.path for run in own}
    beside = {folder / session_record_of_run(path).file_name() for path in one_per_session.values()}
    beside |= {beside_run(path) for path in own_paths for beside_run in (mark_path, note_path)}
    beside |= {folder / STATE_FILE} if own else set()
    try:
        for path in (*sorted(own_paths), *sorted(beside)):
            remove_file(path)
    except OSError as error:
        raise OutputError(f"{error.filename}: cannot be replaced ({error.strerror}); choose another folder.") from error


DEMO_PLAN = "demo"
DEMO_TABLES, DEMO_PICTURES = "csv", "pictures"
DEMO_OVERVIEW = "overview"


def run_demo(out: Path, person: SessionOperator) -> Made:
    """Carry out the demonstration's plan on the shipped simulated rig, into a new campaign below `out`.

    Raises
    ------
    DragrigError
        As `dragrig.run`.
    """
    setup = resolve(DEMO_PLAN, rig="bench", backend="simulated")
    folder = out / f"{datetime.now().astimezone():%Y%m%d-%H%M%S}"
    made = start_campaign(setup, folder, SessionOptions(folder, note="demonstration"), person)
    made.session.require()
    return made


def evaluate_demo(made: Made, progress: Callable[[int, int], None]) -> Path:
    """Filter and export every run of the campaign, draw all but the return strokes; return the overview picture.

    Raises
    ------
    DragrigError
        When a file cannot be read or written.
    """
    from dragrig.present import save_figure_in

    paths = made.files
    shown = {run.path for run in made.session.runs if run.run.follows < 0}
    tables = made.folder / DEMO_TABLES
    tables.mkdir(exist_ok=True)
    for done, path in enumerate(paths):
        progress(done, len(paths) + 1)
        filter_file(path)
        export_run(path, tables, ExportFormat.CSV)
        if path in shown:
            save_figure_in(made.folder / DEMO_PICTURES, f"{path.stem}", present.run_figure(read_run(path)))
    progress(len(paths), len(paths) + 1)
    return save_figure_in(made.folder, DEMO_OVERVIEW, present.campaign_figure(map(read_run, paths), DEMO_PLAN))
