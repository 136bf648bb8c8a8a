"""Diagnose the gap between runs and model, of one campaign or many, and write amended model and report."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Self

from dragrig.analysis.computation import Progress, no_progress
from dragrig.analysis.gap.diagnosis import Diagnosis, GapReduction
from dragrig.analysis.gap.run_selection import choose_runs
from dragrig.analysis.models.catalogue import find_model
from dragrig.analysis.models.nominal_model import NominalModel
from dragrig.analysis.selection import RunSelection
from dragrig.config.errors import DragrigError, SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.settings import absolute_if_file, find_settings, suggestion, to_toml
from dragrig.parallel import open_executor, parallel_map, parallel_map_with_progress
from dragrig.present.files import write_text
from dragrig.rig.runfile.model import Run

if TYPE_CHECKING:
    from dragrig.analysis.gap.diagnose import DiagnosisOptions
    from dragrig.analysis.gap.features import Calibration


@dataclass(frozen=True, slots=True, eq=False)
class DiagnosedCampaign:
    """A diagnosis, and the runs that it was made of."""

    result: Diagnosis
    selection: RunSelection
    source: str

    @property
    def run_ids(self) -> Mapping[str, str]:
        """Ids of the runs by the names of their files."""
        return {one.file: one.run.info.header.run_id for one in self.selection.experiments}


def diagnose(
    campaign: str | Path | Iterable[Run],
    *,
    nominal: str | Path | NominalModel = "capsule",
    without: Sequence[str] = (),
    tolerance_mN: float | None = None,
    specimen: str | None = None,
    calibration: str | Path | None = None,
    progress: Progress = no_progress,
) -> Diagnosis:
    """Say where a campaign differs from the nominal model, which effect that is, and how far it closes the gap.

    Parameters
    ----------
    campaign
        A campaign's folder, or runs in memory. It need not be complete: `cannot_answer` says what these runs leave
        open.
    nominal
        What is expected: `capsule` (the friction model), `drive` (the stage alone), a friction model as TOML, a Python
        file with a model of one's own, or a model.
    without
        Effects of the catalogue that are not to be considered.
    tolerance_mN
        Root mean square below which a gap does not matter; the engine's own unless given.
    specimen
        Name or id, where the campaign holds several; the one with the most runs unless given.
    calibration
        What `dragrig gap calibrate --save` wrote; the shipped calibration unless given.

    Raises
    ------
    AnalysisError
        When there is no usable run, or the model says nothing of these runs.
    RunFileError, SettingsError
        When folder or model cannot be read, or an option is none.

    Examples
    --------
    >>> import dragrig
    >>> found = dragrig.diagnose("runs/first")  # doctest: +SKIP
    >>> found.verdict, found.effects, found.ranking[0].probability  # doctest: +SKIP
    >>> dragrig.simulate("drag", model=found.model)  # doctest: +SKIP
    """
    return diagnose_campaign(
        campaign,
        nominal=nominal,
        without=without,
        tolerance_mN=tolerance_mN,
        specimen=specimen,
        calibration=calibration,
        progress=progress,
    ).result


def diagnose_campaign(
    campaign: str | Path | Iterable[Run],
    *,
    nominal: str | Path | NominalModel = "capsule",
    without: Sequence[str] = (),
    tolerance_mN: float | None = None,
    specimen: str | None = None,
    calibration: str | Path | None = None,
    progress: Progress = no_progress,
) -> DiagnosedCampaign:
    """Do the same, and keep the runs that the diagnosis was made of."""
    from dragrig.analysis.gap.diagnose import diagnose as diagnose_selection

    options = diagnosis_options(without, tolerance_mN, calibration)
    model = find_model(str(nominal)) if isinstance(nominal, str | Path) else nominal
    source = str(campaign) if isinstance(campaign, str | Path) else "these runs"
    selection = choose_runs(Path(campaign) if isinstance(campaign, str | Path) else campaign, specimen)
    return DiagnosedCampaign(diagnose_selection(selection, model, options, progress), selection, source)


def gap_evaluate(
    model: str | Path | FrictionModelSettings, campaign: str | Path | Iterable[Run], *, specimen: str | None = None
) -> GapReduction:
    """Say how far an amended model closes the gap on fresh runs of the same specimen.

    Parameters
    ----------
    model
        The model that `gap diagnose --save-model` wrote, or `Diagnosis.model`.
    campaign
        Runs that took no part in the diagnosis, best at other speeds.

    Raises
    ------
    AnalysisError
        When there is no usable run.
    RunFileError, SettingsError
        When folder or model cannot be read.
    """
    from dragrig.analysis.gap.gap_reduction import evaluate

    given = (
        model if isinstance(model, FrictionModelSettings) else find_settings(FrictionModelSettings, "model", str(model))
    )
    return evaluate(choose_runs(Path(campaign) if isinstance(campaign, str | Path) else campaign, specimen), given)


def diagnosis_options(
    without: Sequence[str], tolerance_mN: float | None, calibration: str | Path | None = None
) -> "DiagnosisOptions":
    """Check what was asked for; raises `SettingsError` for an effect, a tolerance or a calibration that cannot be."""
    from dragrig.analysis.gap.diagnose import DiagnosisOptions
    from dragrig.sim_backend.effects.base import catalogue

    known = tuple(catalogue())
    for name in without:
        if name not in known:
            raise SettingsError(f"--without {name}: is not in the catalogue of effects; {suggestion(name, known)}")
    tolerance = DiagnosisOptions().tolerance_mN if tolerance_mN is None else tolerance_mN
    if not (isfinite(tolerance) and tolerance >= 0):
        raise SettingsError(f"--tolerance {tolerance:g}: a tolerance is a force in mN from 0 on.")
    learnt = None if calibration is None else _load_calibration(Path(calibration))
    return DiagnosisOptions(without=tuple(dict.fromkeys(without)), tolerance_mN=tolerance, calibration=learnt)


def _load_calibration(path: Path) -> "Calibration":
    from pydantic import ValidationError

    from dragrig.analysis.gap.features import Calibration

    try:
        return Calibration.model_validate_json(path.read_text("utf-8"))
    except OSError as error:
        raise SettingsError(f"--calibration {path}: cannot be read ({error.strerror}); name another file.") from error
    except (UnicodeDecodeError, ValidationError) as error:
        raise SettingsError(
            f"--calibration {path}: is not what dragrig gap calibrate --save writes; name such a file."
        ) from error


def save_amended_model(diagnosis: Diagnosis, path: Path, *, overwrite: bool = False) -> Path | None:
    """Write the amended model, which the simulator loads; None where the diagnosis gives none.

    Raises
    ------
    OutputError
        When the file is there already, or the folder refuses.
    """
    if diagnosis.model is None:
        return None
    return write_text(to_toml(diagnosis.model), path, overwrite=overwrite)


def save_gap_report(
    diagnosis: Diagnosis, path: Path, *, source: str = "", model: Path | None = None, overwrite: bool = False
) -> Path:
    """Write the report, one HTML file with its pictures inside; raises as `save_amended_model`."""
    from dragrig.present.diagnosis import diagnosis_page

    return write_text(
        diagnosis_page(diagnosis, source, None if model is None else str(model)), path, overwrite=overwrite
    )


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
class DiagnosisRequest:
    """What is asked of every campaign, as `dragrig.diagnose` takes it."""

    nominal: str = "capsule"
    without: tuple[str, ...] = ()
    tolerance_mN: float | None = None
    specimen: str | None = None
    calibration: str | None = None

    def diagnosed(self, campaign: Path, progress: Progress = no_progress) -> DiagnosedCampaign:
        """Diagnose one campaign; raises as `dragrig.diagnose`."""
        return diagnose_campaign(
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
        with open_executor(scheduler=scheduler) as some:
            return parallel_map(some, self.from_anywhere().diagnosed, [campaign.absolute()])[0]

    def from_anywhere(self) -> Self:
        """Return the same for processes with other working folders."""
        learnt = self.calibration
        return replace(
            self,
            nominal=absolute_if_file(self.nominal),
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
    progress: Progress = no_progress,
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
    diagnosis_options(without, tolerance_mN, calibration)
    learnt = None if calibration is None else str(calibration)
    asked = DiagnosisRequest(str(nominal), tuple(without), tolerance_mN, specimen, learnt).from_anywhere()
    folders = [Path(one).absolute() for one in campaigns]
    with open_executor(workers, scheduler, most=len(folders)) as some:
        found = parallel_map_with_progress(some, asked.diagnosed_or_told, folders, progress)
    return tuple(
        DiagnosedFolder(str(given), one.result, one.run_ids, one.why_not.replace(one.source, str(given)))
        for given, one in zip(campaigns, found, strict=True)
    )
