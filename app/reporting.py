"""Reports on runs and campaigns, written as single HTML files."""

from pathlib import Path
from typing import TYPE_CHECKING

from dragrig.analysis.progress import Progress, silent
from dragrig.reports.files import require_room, write_text

if TYPE_CHECKING:
    from dragrig.reports.campaign.results import CampaignResults

MEASURING, DRAWING = 1, 9
"""How the work on a campaign is shared between the two."""


def report(
    source: str | Path, out: str | Path | None = None, *, overwrite: bool = False, progress: Progress = silent
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
    target = usual_file(path) if out is None else Path(out)
    require_room(target, overwrite=overwrite)
    text = _of_campaign(path, progress) if path.is_dir() else _of_run(path)
    return write_text(text, target, overwrite=overwrite)


def usual_file(source: Path) -> Path:
    """Return where the report on a run or a campaign stands unless told otherwise."""
    from dragrig.rig.runfile.naming import run_name

    return source / f"{source.resolve().name}.html" if source.is_dir() else source.with_name(f"{run_name(source)}.html")


def _of_run(path: Path) -> str:
    from dragrig.reports.run.page import page
    from dragrig.rig.runfile import read_mark, read_run

    run, mark = read_run(path), read_mark(path)
    return page(run, None if mark is None else mark.reason)


def _of_campaign(folder: Path, progress: Progress) -> str:
    from dragrig.reports.campaign.page import page
    from dragrig.reports.campaign.pictures import pictures

    whole = MEASURING + DRAWING
    results = campaign_results(folder, lambda done, of: progress(MEASURING * done, whole * max(of, 1)))
    drawn = pictures(results, lambda done, of: progress(MEASURING * of + DRAWING * done, whole * of))
    return page(results, drawn)


def campaign_results(folder: Path, progress: Progress = silent) -> "CampaignResults":
    """Look at a campaign whole: its runs in numbers, its sessions.

    Raises
    ------
    RunFileError
        When the folder holds no run file.
    """
    from dragrig.analysis.table import table
    from dragrig.inputs import run_files
    from dragrig.reports.campaign.results import CampaignResults
    from dragrig.rig.record import records_in
    from dragrig.rig.runfile import campaign

    run_files([folder])
    sessions, damaged = records_in(folder)
    return CampaignResults(folder.resolve().name, campaign(folder), table(folder, progress), sessions, damaged)
