"""The demonstration: a short programme on the simulated rig, and everything that is made of its runs."""

from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from dragrig import campaigns
from dragrig.analysis.export import ExportFormat, export_run
from dragrig.analysis.filtering import filter_file
from dragrig.campaigns import Made
from dragrig.rig.runfile import read_run
from dragrig.sessions import Person, Terms
from dragrig.setup import resolve

PLAN = "demo"
TABLES, PICTURES = "csv", "pictures"
OVERVIEW = "overview.png"


def measure(out: Path, person: Person) -> Made:
    """Carry out the demonstration's plan on the shipped simulated rig, into a new campaign below `out`.

    Raises
    ------
    DragrigError
        As `dragrig.run`.
    """
    setup = resolve(PLAN, rig="bench", backend="simulated")
    folder = out / f"{datetime.now().astimezone():%Y%m%d-%H%M%S}"
    made = campaigns.begin(setup, folder, Terms(folder, note="demonstration"), person)
    made.session.require()
    return made


def evaluate(made: Made, progress: Callable[[int, int], None]) -> Path:
    """Filter and export every run of the campaign, draw all but the ways back; return the picture of the whole.

    Raises
    ------
    DragrigError
        When a file cannot be read or written.
    """
    from dragrig.figures import campaign_figure, run_figure, save_in

    paths = [one.path for one in made.session.runs if one.path is not None]
    own = {one.path for one in made.session.runs if one.run.follows < 0}
    tables = made.folder / TABLES
    tables.mkdir(exist_ok=True)
    for done, path in enumerate(paths):
        progress(done, len(paths) + 1)
        filter_file(path)
        export_run(path, tables, ExportFormat.CSV)
        if path in own:
            save_in(made.folder / PICTURES, f"{path.stem}.png", run_figure(read_run(path)))
    progress(len(paths), len(paths) + 1)
    return save_in(made.folder, OVERVIEW, campaign_figure(map(read_run, paths), PLAN))
