"""Reports on a run or a campaign, and the shipped programmes (demonstration, paper) carried out and evaluated."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dragrig import campaign_session as campaigns
from dragrig.analysis.computation import Progress, no_progress
from dragrig.analysis.export import ExportFormat, export_run
from dragrig.analysis.savgol import filter_file
from dragrig.campaign_session import Made, SessionOperator, SessionOptions
from dragrig.config.errors import AnalysisError, OutputError, SettingsError
from dragrig.present.files import (
    PAPER_MODEL_FILE,
    PAPER_REPORT_FILE,
    PAPER_TABLES,
    existing_files,
    require_writable,
    write_text,
    write_texts,
)
from dragrig.rig.engine import AcquisitionOutcome as RunOutcome
from dragrig.rig.operator import NullOperator
from dragrig.rig.programme import PlannedRun, Programme
from dragrig.rig.runfile import read_campaign, read_run, schema
from dragrig.rig.runfile.filesystem import remove_file
from dragrig.rig.session import session_record_of_run
from dragrig.session_state import STATE_FILE
from dragrig.setup import Setup, resolve

if TYPE_CHECKING:
    from dragrig.analysis.identification.identification import Identification
    from dragrig.analysis.paper.published import PaperFinding
    from dragrig.api.identify import IdentifiedCampaign
    from dragrig.present.campaign import CampaignReportData
    from dragrig.present.paper import PaperReportData


MEASURING_SHARE, DRAWING_SHARE = 1, 9
"""How the work on a campaign is shared between the two."""


def report(
    source: str | Path, out: str | Path | None = None, *, overwrite: bool = False, progress: Progress = no_progress
) -> Path:
    """Write a report on a run or a campaign: one HTML file with its figures inside, which needs no network.

    Parameters
    ----------
    source
        A run file, or the folder of a campaign.
    out
        The file; unless given, it is named after the run and stands beside it, or after the campaign and stands in it.
    overwrite
        Whether a file that is there already may be replaced.
    progress
        Called with how much is done, and of how much.

    Returns
    -------
    The file.

    Raises
    ------
    RunFileError
        When there is no run to report on, or it cannot be read.
    OutputError
        When the file is there already, or its folder refuses.

    Examples
    --------
    >>> import dragrig
    >>> dragrig.report("runs/first")  # doctest: +SKIP
    PosixPath('runs/first/first.html')
    """
    path = Path(source)
    target = default_report_file(path) if out is None else Path(out)
    require_writable(target, overwrite=overwrite)
    text = _campaign_report(path, progress) if path.is_dir() else _run_report(path)
    return write_text(text, target, overwrite=overwrite)


def default_report_file(source: Path) -> Path:
    """Return where the report on a run or a campaign stands unless told otherwise."""
    from dragrig.rig.runfile.schema import run_name

    return source / f"{source.resolve().name}.html" if source.is_dir() else source.with_name(f"{run_name(source)}.html")


def _run_report(path: Path) -> str:
    from dragrig.present.run import run_page
    from dragrig.rig.runfile import read_mark, read_run

    run, mark = read_run(path), read_mark(path)
    return run_page(run, None if mark is None else mark.reason)


def _campaign_report(folder: Path, progress: Progress) -> str:
    from dragrig.present.campaign import campaign_page, inline_campaign_figures

    whole = MEASURING_SHARE + DRAWING_SHARE
    results = campaign_results(folder, lambda done, of: progress(MEASURING_SHARE * done, whole * max(of, 1)))
    drawn = inline_campaign_figures(
        results, lambda done, of: progress(MEASURING_SHARE * of + DRAWING_SHARE * done, whole * of)
    )
    return campaign_page(results, drawn)


def campaign_results(folder: Path, progress: Progress = no_progress) -> "CampaignReportData":
    """Look at a campaign whole: its runs in numbers, its sessions.

    Raises
    ------
    RunFileError
        When the folder holds no run file.
    """
    from dragrig.analysis.campaign_table import table_rows
    from dragrig.present.campaign import CampaignReportData
    from dragrig.rig.runfile import read_campaign
    from dragrig.rig.session import read_session_records
    from dragrig.run_inputs import run_files

    run_files([folder])
    sessions, damaged = read_session_records(folder)
    return CampaignReportData(
        folder.resolve().name, read_campaign(folder), table_rows(folder, progress), sessions, damaged
    )


PAPER_PLAN = "paper"
PAPER_SEED = 20120509
"""Seed of noise, zeros and variation unless another is given."""
MAX_SEED = 2**63 - 1
"""As far as whole numbers go in settings."""
PAPER_RATE_HZ = 500.0
IDENTIFYING_STEPS, WRITING_STEPS = 20, 20
"""What comes after the runs, counted as so many of them."""
PAPER_NOTE = "made by dragrig paper"
"""Every run carries it, so that nobody else's run is ever replaced."""

PaperWall = Literal["eq14", "table1"]
PaperViscous = Literal["published", "newtonian"]


@dataclass(frozen=True, slots=True, eq=False)
class PaperReport:
    """What `paper` left: the folder with its runs, the report and the tables, and what they hold.

    `model` is the identified friction model, a file that the simulator loads; None where the fit did not converge.
    """

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
        Which of the paper's wall parameters, and which reading of Eq. 10, is simulated.
    overwrite
        Whether runs and report of an earlier call may be replaced; other people's runs never are.
    progress
        Called with how many runs are made and steps are done, and of how many.

    Raises
    ------
    OutputError
        When the folder holds runs, a report, tables or a model already, or refuses.
    SettingsError
        For a choice that does not exist.

    Examples
    --------
    >>> import dragrig
    >>> made = dragrig.paper("paper-again", seed=1)  # doctest: +SKIP
    >>> made.report, made.identification.coulomb.mu  # doctest: +SKIP
    """
    folder, setup = Path(out), paper_setup(seed, wall, viscous)
    clear_paper_folder(folder, overwrite=overwrite)
    counted = _RunCounter(progress)
    made = campaigns.start_campaign(setup, folder, SessionOptions(folder, note=PAPER_NOTE), counted)
    made.session.require()
    found = identify_paper_runs(folder, setup, counted.share(IDENTIFYING_STEPS))
    return _write_paper_files(made, found, _paper_results(made, setup, found), counted.share(WRITING_STEPS))


class _RunCounter(NullOperator):
    """Follows a session, and what is made of it afterwards, to tell how far both are."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._done, self._of = 0, IDENTIFYING_STEPS + WRITING_STEPS

    def begins(self, programme: Programme, pending: Sequence[PlannedRun], *, real_time: bool) -> None:
        del programme, real_time
        self._of += len(pending)

    def run_ends(self, run: PlannedRun, outcome: RunOutcome) -> None:
        del run, outcome
        self._done += 1
        self._progress(self._done, self._of)

    def share(self, steps: int) -> Progress:
        """Return what follows a piece of work that counts as so many runs."""
        before = self._done
        self._done += steps

        def follow(done: int, of: int) -> None:
            self._progress(before + steps * done // max(of, 1), self._of)

        return follow


def identify_paper_runs(folder: Path, setup: Setup, progress: Progress = no_progress) -> "IdentifiedCampaign":
    """Identify the campaign, the scales counted from the model that was simulated."""
    from dragrig.api.identify import identify

    return identify(folder, model=setup.model, progress=progress)


def _write_paper_files(
    made: "Made", found: "IdentifiedCampaign", results: "PaperReportData", progress: Progress
) -> PaperReport:
    """Write model, tables and report beside the runs."""
    from dragrig.present.paper import inline_paper_figures, paper_page, paper_tables

    runs = tuple(one.path for one in made.session.runs if one.path is not None)
    model = _write_paper_model(found, made.folder)
    tabulated = paper_tables(results)
    written = write_texts(made.folder, {f"{name}.csv": table.csv() for name, table in tabulated.items()})
    progress(1, 3)
    drawn = inline_paper_figures(results)
    progress(2, 3)
    text = paper_page(results, tabulated, drawn, None if model is None else model.name)
    (report,) = write_texts(made.folder, {PAPER_REPORT_FILE: text})
    progress(3, 3)
    return PaperReport(made.folder, report, model, written, runs, results.identification, results.findings)


def _write_paper_model(found: "IdentifiedCampaign", folder: Path) -> Path | None:
    """Write the model that the simulator loads; None, and no older one left, where the fit did not converge."""
    try:
        text = found.toml()
    except AnalysisError:
        remove_file(folder / PAPER_MODEL_FILE)
        return None
    return write_texts(folder, {PAPER_MODEL_FILE: text})[0]


def _paper_results(made: "Made", setup: Setup, found: "IdentifiedCampaign") -> "PaperReportData":
    from dragrig.analysis.paper.reproduction import all_findings, element_rows
    from dragrig.config.settings import find_settings
    from dragrig.config.specimen import Capsule
    from dragrig.present.paper import PaperReportData
    from dragrig.sim_backend.devices.variability import draw_run_model

    simulated, result = setup.rig.simulated, found.result
    of_run = {
        one.path.name: draw_run_model(setup.model, simulated.variation, simulated.seed, one.order)
        for one in made.session.runs
        if one.path is not None
    }
    traces = {one.file: one.run for one in found.selection.experiments}
    first = result.coulomb.runs[0].file if result.coulomb is not None and result.coulomb.runs else ""
    return PaperReportData(
        model=setup.model,
        capsule=find_settings(Capsule, "capsule", "drag"),
        wall_thickness_mm=setup.specimen.wall_thickness_mm,
        rig=setup.rig,
        runs=len(of_run),
        of_run=of_run,
        identification=result,
        elements=element_rows(result.relaxation, setup.model, of_run),
        findings=all_findings(),
        coulomb_trace=traces.get(first),
    )


def paper_setup(seed: int, wall: str, viscous: str) -> Setup:
    """Return the settings of the programme; raises `SettingsError` for a choice that does not exist."""
    if not 0 <= seed <= MAX_SEED:
        raise SettingsError(f"--seed {seed}: a seed is a whole number from 0 to {MAX_SEED}.")
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
    """Take away what an earlier call left; raises `OutputError` for what may not be replaced."""
    if not folder.is_dir():
        return
    here = read_campaign(folder)
    held = [one.path for one in here.runs] + [path for path, _ in here.unreadable] + list(here.recordings)
    written = existing_files(folder, (PAPER_REPORT_FILE, PAPER_MODEL_FILE, *(f"{name}.csv" for name in PAPER_TABLES)))
    own = {one.path for one in here.runs if one.header.entry.get("note") == PAPER_NOTE}
    foreign = next((path for path in held if path not in own), None)
    if foreign is not None:
        raise OutputError(f"{foreign}: is no run of dragrig paper and is not replaced; name another folder.")
    if not overwrite and (held or written):
        raise OutputError(f"{(*held, *written)[0]}: is there already; name another folder, or say --overwrite.")
    one_each = {one.header.settings_toml: one.path for one in here.runs if one.path in own}
    beside = {folder / session_record_of_run(path).file_name() for path in one_each.values()}
    beside |= {schema.mark_path(path) for path in own}
    beside |= {folder / STATE_FILE} if own else set()
    try:
        for path in (*sorted(own), *sorted(beside)):
            remove_file(path)
    except OSError as error:
        raise OutputError(f"{error.filename}: cannot be replaced ({error.strerror}); choose another folder.") from error


DEMO_PLAN = "demo"
DEMO_TABLES, DEMO_PICTURES = "csv", "pictures"
DEMO_OVERVIEW = "overview.png"


def run_demo(out: Path, person: SessionOperator) -> Made:
    """Carry out the demonstration's plan on the shipped simulated rig, into a new campaign below `out`.

    Raises
    ------
    DragrigError
        As `dragrig.run`.
    """
    setup = resolve(DEMO_PLAN, rig="bench", backend="simulated")
    folder = out / f"{datetime.now().astimezone():%Y%m%d-%H%M%S}"
    made = campaigns.start_campaign(setup, folder, SessionOptions(folder, note="demonstration"), person)
    made.session.require()
    return made


def evaluate_demo(made: Made, progress: Callable[[int, int], None]) -> Path:
    """Filter and export every run of the campaign, draw all but the ways back; return the picture of the whole.

    Raises
    ------
    DragrigError
        When a file cannot be read or written.
    """
    from dragrig.present.campaign_figures import campaign_figure
    from dragrig.present.figure_files import save_figure_in
    from dragrig.present.run_figures import run_figure

    paths = [one.path for one in made.session.runs if one.path is not None]
    own = {one.path for one in made.session.runs if one.run.follows < 0}
    tables = made.folder / DEMO_TABLES
    tables.mkdir(exist_ok=True)
    for done, path in enumerate(paths):
        progress(done, len(paths) + 1)
        filter_file(path)
        export_run(path, tables, ExportFormat.CSV)
        if path in own:
            save_figure_in(made.folder / DEMO_PICTURES, f"{path.stem}.png", run_figure(read_run(path)))
    progress(len(paths), len(paths) + 1)
    return save_figure_in(made.folder, DEMO_OVERVIEW, campaign_figure(map(read_run, paths), DEMO_PLAN))
