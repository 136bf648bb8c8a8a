"""Many campaigns diagnosed side by side."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from dragrig.analysis.gap.results import Diagnosis
from dragrig.analysis.progress import Progress, silent
from dragrig.config.errors import DragrigError
from dragrig.config.library import from_anywhere
from dragrig.diagnosing import DiagnosedCampaign, diagnosed, options_of
from dragrig.spreading import executor, spread, spread_counted


@dataclass(frozen=True, slots=True, eq=False)
class DiagnosedFolder:
    """What was found about one of many campaigns.

    Attributes
    ----------
    source
        Its folder.
    result
        The diagnosis; None where there could be none.
    run_ids
        Ids of its runs by the names of their files.
    why_not
        Why there is no diagnosis, a sentence; empty where there is one.
    """

    source: str
    result: Diagnosis | None
    run_ids: Mapping[str, str]
    why_not: str = ""


@dataclass(frozen=True, slots=True)
class Asked:
    """What is asked of every campaign, as `dragrig.diagnose` takes it."""

    nominal: str = "capsule"
    without: tuple[str, ...] = ()
    tolerance_mN: float | None = None
    specimen: str | None = None
    calibration: str | None = None

    def diagnosed(self, campaign: Path, progress: Progress = silent) -> DiagnosedCampaign:
        """Diagnose one campaign; raises as `dragrig.diagnose`."""
        return diagnosed(
            campaign,
            nominal=self.nominal,
            without=self.without,
            tolerance_mN=self.tolerance_mN,
            specimen=self.specimen,
            calibration=self.calibration,
            progress=progress,
        )

    def diagnosed_there(self, campaign: Path, scheduler: str) -> DiagnosedCampaign:
        """Do the same on a Dask cluster; raises `SettingsError` and `WorkerError` beside."""
        with executor(scheduler=scheduler) as some:
            return spread(some, self.from_anywhere().diagnosed, [campaign.absolute()])[0]

    def from_anywhere(self) -> Self:
        """Return the same for processes with other working folders."""
        learnt = self.calibration
        return replace(
            self,
            nominal=from_anywhere(self.nominal),
            calibration=None if learnt is None else str(Path(learnt).absolute()),
        )

    def diagnosed_or_told(self, campaign: Path) -> DiagnosedFolder:
        """Diagnose one of many campaigns; what is wrong with it becomes a part of the answer."""
        try:
            found = self.diagnosed(campaign)
        except DragrigError as error:
            return DiagnosedFolder(str(campaign), None, {}, str(error))
        return DiagnosedFolder(str(campaign), found.result, dict(found.run_ids))


def diagnose_many(
    campaigns: Sequence[str | Path],
    *,
    nominal: str | Path = "capsule",
    without: Sequence[str] = (),
    tolerance_mN: float | None = None,
    specimen: str | None = None,
    calibration: str | Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress = silent,
) -> tuple[DiagnosedFolder, ...]:
    """Diagnose many campaigns, each as `dragrig.diagnose` does it; one that cannot be is told, the others go on.

    Parameters
    ----------
    campaigns
        Their folders. On a cluster its workers must see the same ones.
    nominal, without, tolerance_mN, specimen, calibration
        As in `dragrig.diagnose`, for all.
    workers
        Processes that share the campaigns; as many as there are cores unless given.
    scheduler
        Address of a Dask cluster that does the work in their place.

    Returns
    -------
    tuple of DiagnosedFolder
        In the order of the campaigns, the same for any number of workers.

    Raises
    ------
    SettingsError
        When an option is none, or the cluster cannot be used.
    WorkerError
        When processes end before the work is done.

    Examples
    --------
    >>> import dragrig
    >>> found = dragrig.diagnose_many(["runs/first", "runs/second"])  # doctest: +SKIP
    >>> [one.result.verdict for one in found if one.result]  # doctest: +SKIP
    """
    options_of(without, tolerance_mN, calibration)
    learnt = None if calibration is None else str(calibration)
    asked = Asked(str(nominal), tuple(without), tolerance_mN, specimen, learnt).from_anywhere()
    folders = [Path(one).absolute() for one in campaigns]
    with executor(workers, scheduler, most=len(folders)) as some:
        found = spread_counted(some, asked.diagnosed_or_told, folders, progress)
    return tuple(
        DiagnosedFolder(str(given), one.result, one.run_ids, one.why_not.replace(one.source, str(given)))
        for given, one in zip(campaigns, found, strict=True)
    )
