"""The paper's programme on the simulated rig, identified, and the report on it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dragrig import campaigns
from dragrig.analysis.progress import Progress, silent
from dragrig.config.errors import AnalysisError, OutputError, SettingsError
from dragrig.reports.files import taken, write_texts
from dragrig.reports.paper.names import MODEL_FILE, REPORT, TABLES
from dragrig.rig.acquiring import Outcome as RunOutcome
from dragrig.rig.people import Nobody
from dragrig.rig.programme import PlannedRun, Programme
from dragrig.rig.record import record_in
from dragrig.rig.runfile import campaign, files, naming
from dragrig.session_state import STATE_FILE
from dragrig.sessions import Terms
from dragrig.setup import Setup, resolve

if TYPE_CHECKING:
    from dragrig.analysis.identification.results import Identification
    from dragrig.analysis.paper.finding import Finding
    from dragrig.campaigns import Made
    from dragrig.identifying import IdentifiedCampaign
    from dragrig.reports.paper.results import PaperResults

PLAN = "paper"
SEED = 20120509
"""Seed of noise, zeros and variation unless another is given."""
MOST_SEED = 2**63 - 1
"""As far as whole numbers go in settings."""
RATE_HZ = 500.0
IDENTIFYING, WRITING = 20, 20
"""What comes after the runs, counted as so many of them."""
NOTE = "made by dragrig paper"
"""Every run carries it, so that nobody else's run is ever replaced."""

Wall = Literal["eq14", "table1"]
Viscous = Literal["published", "newtonian"]


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
    findings: "tuple[Finding, ...]"


def paper(
    out: str | Path = "paper",
    *,
    seed: int = SEED,
    wall: Wall = "eq14",
    viscous: Viscous = "published",
    overwrite: bool = False,
    progress: Progress = silent,
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
    folder, setup = Path(out), setup_of(seed, wall, viscous)
    make_room(folder, overwrite=overwrite)
    counted = _Counted(progress)
    made = campaigns.begin(setup, folder, Terms(folder, note=NOTE), counted)
    made.session.require()
    found = identified(folder, setup, counted.share(IDENTIFYING))
    return _written(made, found, _results(made, setup, found), counted.share(WRITING))


class _Counted(Nobody):
    """Follows a session, and what is made of it afterwards, to tell how far both are."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._done, self._of = 0, IDENTIFYING + WRITING

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


def identified(folder: Path, setup: Setup, progress: Progress = silent) -> "IdentifiedCampaign":
    """Identify the campaign, the scales counted from the model that was simulated."""
    from dragrig.identifying import identify

    return identify(folder, model=setup.model, progress=progress)


def _written(made: "Made", found: "IdentifiedCampaign", results: "PaperResults", progress: Progress) -> PaperReport:
    """Write model, tables and report beside the runs."""
    from dragrig.reports.paper.page import page
    from dragrig.reports.paper.pictures import pictures
    from dragrig.reports.paper.tables import tables

    runs = tuple(one.path for one in made.session.runs if one.path is not None)
    model = _model_written(found, made.folder)
    tabulated = tables(results)
    written = write_texts(made.folder, {f"{name}.csv": table.csv() for name, table in tabulated.items()})
    progress(1, 3)
    drawn = pictures(results)
    progress(2, 3)
    text = page(results, tabulated, drawn, None if model is None else model.name)
    (report,) = write_texts(made.folder, {REPORT: text})
    progress(3, 3)
    return PaperReport(made.folder, report, model, written, runs, results.identification, results.findings)


def _model_written(found: "IdentifiedCampaign", folder: Path) -> Path | None:
    """Write the model that the simulator loads; None, and no older one left, where the fit did not converge."""
    try:
        text = found.toml()
    except AnalysisError:
        files.remove(folder / MODEL_FILE)
        return None
    return write_texts(folder, {MODEL_FILE: text})[0]


def _results(made: "Made", setup: Setup, found: "IdentifiedCampaign") -> "PaperResults":
    from dragrig.analysis.paper.elements import element_rows
    from dragrig.analysis.paper.findings import findings
    from dragrig.config.capsule import Capsule
    from dragrig.config.library import find
    from dragrig.reports.paper.results import PaperResults
    from dragrig.sim_backend.devices.variation import draw_run

    simulated, result = setup.rig.simulated, found.result
    of_run = {
        one.path.name: draw_run(setup.model, simulated.variation, simulated.seed, one.order)
        for one in made.session.runs
        if one.path is not None
    }
    traces = {one.file: one.run for one in found.selection.experiments}
    first = result.coulomb.runs[0].file if result.coulomb is not None and result.coulomb.runs else ""
    return PaperResults(
        model=setup.model,
        capsule=find(Capsule, "capsule", "drag"),
        wall_thickness_mm=setup.specimen.wall_thickness_mm,
        rig=setup.rig,
        runs=len(of_run),
        of_run=of_run,
        identification=result,
        elements=element_rows(result.relaxation, setup.model, of_run),
        findings=findings(),
        coulomb_trace=traces.get(first),
    )


def setup_of(seed: int, wall: str, viscous: str) -> Setup:
    """Return the settings of the programme; raises `SettingsError` for a choice that does not exist."""
    if not 0 <= seed <= MOST_SEED:
        raise SettingsError(f"--seed {seed}: a seed is a whole number from 0 to {MOST_SEED}.")
    return resolve(
        PLAN,
        rig="bench",
        model="paper",
        specimen="jejunum",
        backend="simulated",
        assignments=(
            f"rig.sampling.rate_hz={RATE_HZ}",
            f"rig.simulated.seed={seed}",
            f"model.wall='{wall}'",
            f"model.viscous='{viscous}'",
        ),
    )


def make_room(folder: Path, *, overwrite: bool) -> None:
    """Take away what an earlier call left; raises `OutputError` for what may not be replaced."""
    if not folder.is_dir():
        return
    here = campaign(folder)
    held = [one.path for one in here.runs] + [path for path, _ in here.unreadable] + list(here.recordings)
    written = taken(folder, (REPORT, MODEL_FILE, *(f"{name}.csv" for name in TABLES)))
    own = {one.path for one in here.runs if one.header.entry.get("note") == NOTE}
    foreign = next((path for path in held if path not in own), None)
    if foreign is not None:
        raise OutputError(f"{foreign}: is no run of dragrig paper and is not replaced; name another folder.")
    if not overwrite and (held or written):
        raise OutputError(f"{(*held, *written)[0]}: is there already; name another folder, or say --overwrite.")
    one_each = {one.header.settings_toml: one.path for one in here.runs if one.path in own}
    beside = {folder / record_in(path).file_name() for path in one_each.values()}
    beside |= {naming.mark_path(path) for path in own}
    beside |= {folder / STATE_FILE} if own else set()
    try:
        for path in (*sorted(own), *sorted(beside)):
            files.remove(path)
    except OSError as error:
        raise OutputError(f"{error.filename}: cannot be replaced ({error.strerror}); choose another folder.") from error
