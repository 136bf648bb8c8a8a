"""The paper's programme on the simulated rig, identified, and the report on it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dragrig import campaigns
from dragrig.analysis.progress import Progress, silent
from dragrig.config.errors import OutputError
from dragrig.report.files import taken, write_texts
from dragrig.report.paper.names import REPORT, TABLES
from dragrig.rig.acquiring import Outcome as RunOutcome
from dragrig.rig.people import Nobody
from dragrig.rig.programme import PlannedRun, Programme
from dragrig.rig.record import record_in
from dragrig.rig.runfile import campaign, files, naming, read_run
from dragrig.sessions import Terms
from dragrig.setup import Setup, resolve

if TYPE_CHECKING:
    from dragrig.analysis.identification.results import Identification
    from dragrig.analysis.paper.finding import Finding
    from dragrig.campaigns import Made
    from dragrig.report.paper.results import PaperResults

PLAN = "paper"
SEED = 20120509
"""Seed of noise, zeros and variation unless another is given."""
RATE_HZ = 500.0
STEPS = 40
"""What comes after the runs, counted as so many of them."""
NOTE = "made by dragrig paper"
"""Every run carries it, so that nobody else's run is ever replaced."""

Wall = Literal["eq14", "table1"]
Viscous = Literal["published", "newtonian"]


@dataclass(frozen=True, slots=True, eq=False)
class PaperReport:
    """What `paper` left: the folder with its runs, the report and the tables, and what they hold."""

    folder: Path
    report: Path
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
    """Simulate the paper's programme, identify it, and write a report: HTML, tables as CSV, run files.

    The same seed gives the same runs and numbers.

    Parameters
    ----------
    out
        Folder of the campaign, the report and the tables.
    wall, viscous
        Which of the paper's wall parameters, and which reading of Eq. 10, is simulated.
    overwrite
        Whether runs and report of an earlier call may be replaced; other people's runs never are.
    progress
        Called with how many runs are made and steps are done, and of how many.

    Raises
    ------
    OutputError
        When the folder holds runs, a report or tables already, or refuses.
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
    return _evaluated(made, setup, counted.step)


class _Counted(Nobody):
    """Follows a session, and what is made of it afterwards, to tell how far both are."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._done, self._of = 0, STEPS

    def begins(self, programme: Programme, pending: int, *, real_time: bool) -> None:
        del programme, real_time
        self._of += pending

    def run_ends(self, run: PlannedRun, outcome: RunOutcome) -> None:
        del run, outcome
        self.step()

    def step(self, steps: int = 1) -> None:
        self._done += steps
        self._progress(self._done, self._of)


def _evaluated(made: "Made", setup: Setup, step: Callable[[int], None]) -> PaperReport:
    """Identify the campaign and write report and tables beside its runs."""
    from dragrig.report.paper.page import page
    from dragrig.report.paper.pictures import pictures
    from dragrig.report.paper.tables import tables

    runs = tuple(one.path for one in made.session.runs if one.path is not None)
    results = _results(made, setup)
    step(STEPS // 2)
    tabulated = tables(results)
    texts = {f"{name}.csv": table.csv() for name, table in tabulated.items()}
    written = write_texts(made.folder, texts)
    (report,) = write_texts(made.folder, {REPORT: page(results, tabulated, pictures(results))})
    step(STEPS - STEPS // 2)
    return PaperReport(made.folder, report, written, runs, results.identification, results.findings)


def _results(made: "Made", setup: Setup) -> "PaperResults":
    from dragrig.analysis.paper.elements import element_rows
    from dragrig.analysis.paper.findings import findings
    from dragrig.config.capsule import Capsule
    from dragrig.config.library import find
    from dragrig.report.paper.results import PaperResults
    from dragrig.sim_backend.devices.variation import draw_run

    found = identified(made.folder, setup)
    simulated = setup.rig.simulated
    of_run = {
        one.path.name: draw_run(setup.model, simulated.variation, simulated.seed, one.order)
        for one in made.session.runs
        if one.path is not None
    }
    trace = found.coulomb.runs[0].file if found.coulomb is not None and found.coulomb.runs else None
    return PaperResults(
        model=setup.model,
        capsule=find(Capsule, "capsule", "drag"),
        wall_thickness_mm=setup.specimen.wall_thickness_mm,
        rig=setup.rig,
        runs=len(of_run),
        of_run=of_run,
        identification=found,
        elements=element_rows(found.relaxation, setup.model, of_run),
        findings=findings(),
        coulomb_trace=None if trace is None else read_run(made.folder / trace),
    )


def identified(folder: Path, setup: Setup) -> "Identification":
    """Identify relaxations, Coulomb test and drags, against the model that was simulated."""
    from dragrig.analysis.identification.coulomb import identify_coulomb
    from dragrig.analysis.identification.drag import identify_drag
    from dragrig.analysis.identification.relaxation import identify_relaxation
    from dragrig.analysis.identification.results import Identification
    from dragrig.analysis.identification.selection import select

    chosen = select(folder)
    return Identification(
        specimen=chosen.specimen,
        used=tuple(one.file for one in chosen.experiments),
        left_out=chosen.left_out,
        joint=None,
        relaxation=identify_relaxation(chosen),
        coulomb=identify_coulomb(chosen, setup.model),
        drag=identify_drag(chosen, setup.model),
        remarks=chosen.remarks,
    )


def setup_of(seed: int, wall: str, viscous: str) -> Setup:
    """Return the settings of the programme; raises `SettingsError` for a choice that does not exist."""
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
    written = taken(folder, (REPORT, *(f"{name}.csv" for name in TABLES)))
    if not overwrite and (held or written):
        raise OutputError(f"{(*held, *written)[0]}: is there already; name another folder, or say --overwrite.")
    own = {one.path for one in here.runs if one.header.entry.get("note") == NOTE}
    foreign = next((path for path in held if path not in own), None)
    if foreign is not None:
        raise OutputError(f"{foreign}: is no run of dragrig paper and is not replaced; name another folder.")
    one_each = {one.header.settings_toml: one.path for one in here.runs if one.path in own}
    beside = {folder / record_in(path).file_name() for path in one_each.values()}
    beside |= {naming.mark_path(path) for path in own}
    try:
        for path in (*sorted(own), *sorted(beside)):
            files.remove(path)
    except OSError as error:
        raise OutputError(f"{error.filename}: cannot be replaced ({error.strerror}); choose another folder.") from error
