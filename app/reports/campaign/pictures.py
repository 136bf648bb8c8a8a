"""The figures of a campaign's report."""

from collections.abc import Iterator

from dragrig.analysis.progress import Progress, silent
from dragrig.figures.campaign import campaign_figure
from dragrig.reports.campaign.results import CampaignResults, anchor_of
from dragrig.reports.embedding import Picture, embedded
from dragrig.reports.run.page import run_picture
from dragrig.rig.protocols.way_back import Return
from dragrig.rig.runfile import read_run
from dragrig.rig.runfile.model import Run, RunInfo

OVERVIEW = "overview"
MOST_RUNS = 100
"""So many runs are drawn one by one; a page that is mailed must stay small."""


def pictures(results: CampaignResults, progress: Progress = silent) -> dict[str, Picture]:
    """Draw the overview, and each run that is drawn by itself, by its id in the page."""
    singles = drawn_runs(results)
    steps = len(results.readable) + len(singles)
    bad = list(results.found.marks)
    overview = campaign_figure(_read(results.readable, progress, steps), results.name, bad)
    drawn = {
        OVERVIEW: embedded(
            overview,
            "Steady force against speed, relaxation of the force against time since the ramp, and force along the way "
            "at a few speeds.",
            "Runs that are complete and not marked bad. Bars are 95 % intervals; forces are as recorded, the sensor's "
            "zero included.",
        )
    }
    for done, info in enumerate(singles, len(results.readable)):
        progress(done, steps)
        drawn[anchor_of(info)] = run_picture(read_run(info.path), results.bad.get(info.path.name))
    progress(steps, steps)
    return drawn


def drawn_runs(results: CampaignResults) -> tuple[RunInfo, ...]:
    """Return the runs that are drawn one by one: the first ones, ways back left out."""
    return tuple(one for one in results.readable if one.kind != Return.kind)[:MOST_RUNS]


def _read(infos: tuple[RunInfo, ...], progress: Progress, steps: int) -> Iterator[Run]:
    for done, info in enumerate(infos):
        progress(done, steps)
        yield read_run(info.path)
