"""Identify a specimen's parameters from one campaign or many, and write model and pictures."""

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dragrig.analysis.computation import Progress, no_progress
from dragrig.analysis.identification.identification import Identification, JointFit
from dragrig.analysis.identification.identify import (
    determined_values,
    identified_settings,
    why_no_model,
    with_identified_wall,
)
from dragrig.analysis.identification.identify import identify_specimen as identify_selection
from dragrig.analysis.identification.relaxation_elements import identify_relaxation
from dragrig.analysis.models.capsule_model import CapsuleModel
from dragrig.analysis.models.catalogue import find_model
from dragrig.analysis.models.nominal_model import NominalModel
from dragrig.analysis.selection import RunSelection, select_loaded_runs, select_runs
from dragrig.config.errors import AnalysisError, DragrigError, OutputError, SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.settings import absolute_if_file, find_settings, to_toml
from dragrig.parallel import open_executor, parallel_map_with_progress
from dragrig.present.identification import identified_model_origin
from dragrig.rig.runfile.model import Run

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


WallChoice = Literal["scaled", "fitted"]


@dataclass(frozen=True, slots=True, eq=False)
class IdentifiedCampaign:
    """What was identified, and from which runs.

    Attributes
    ----------
    result
        All numbers, with uncertainty or the reason why there is none.
    selection
        The runs that were used.
    nominal
        The model that was fitted.
    source
        The campaign.
    """

    result: Identification
    selection: RunSelection
    nominal: NominalModel
    source: str

    @property
    def parameters(self) -> "pd.DataFrame":
        """The joint fit, a row for each parameter: value, standard_error, low, high, prior_low, prior_high, learnt.

        A parameter that is not `determined_values` has no more than what was known before.
        """
        import pandas as pd

        joint = _require_joint_fit(self.result)
        rows = [
            {
                "unit": one.unit,
                "value": one.value,
                "standard_error": one.standard_error,
                "low": one.interval[0],
                "high": one.interval[1],
                "prior_low": one.prior[0],
                "prior_high": one.prior[1],
                "learnt": one.learnt,
                "determined": one.determined,
                "meaning": one.meaning,
            }
            for one in joint.parameters
        ]
        return pd.DataFrame(rows, index=[one.name for one in joint.parameters])

    @property
    def why_no_model(self) -> str | None:
        """Why these runs give no model; None where they give one."""
        return why_no_model(_require_joint_fit(self.result))

    @property
    def model(self) -> FrictionModelSettings:
        """The friction model of this specimen, as the simulator takes it, its origin in `identified`.

        Raises
        ------
        AnalysisError
            When another nominal model was fitted, the fit did not converge, or no parameter is determined.
        """
        if not isinstance(self.nominal, CapsuleModel):
            raise AnalysisError(f"{self.source}: {self.nominal.name} is no friction model; only capsule is one.")
        joint = _require_model(self.result, self.source)
        settings = identified_settings(self.nominal, joint)
        told = {
            "name": f"{settings.name}-{self.result.specimen}",
            "identified": identified_model_origin(self.result, joint, self.source),
        }
        return settings.model_copy(update=told)

    def toml(self) -> str:
        """Return the file that the simulator loads (a user's own model: its values); raises `AnalysisError`."""
        import tomli_w

        if isinstance(self.nominal, CapsuleModel):
            return to_toml(self.model)
        joint = _require_model(self.result, self.source)
        known = {one.name: one.nominal for one in self.nominal.parameters} | determined_values(joint)
        return tomli_w.dumps(self.nominal.document(known))


def identify(
    campaign: str | Path | Iterable[Run],
    *,
    nominal: str | Path | NominalModel = "capsule",
    model: str | Path | FrictionModelSettings = "paper",
    wall: WallChoice = "scaled",
    specimen: str | None = None,
    progress: Progress = no_progress,
) -> IdentifiedCampaign:
    """Identify the parameters of a model from the runs of one specimen, with their uncertainty.

    Parameters
    ----------
    campaign
        A campaign's folder, or runs in memory.
    nominal
        What is fitted: `capsule` (the paper's friction model), `drive` (the stage alone, from its motor force), a
        Python file with a model of one's own, a friction model as TOML, or a model.
    model
        With `capsule`: the friction model that the specimen's scales count from.
    wall
        With `capsule`: `scaled` keeps that model's wall and scales its elements; `fitted` replaces it by polynomials
        through this specimen's own relaxations first.
    specimen
        Name or id, where the campaign holds several.

    Raises
    ------
    AnalysisError
        When there is no usable run, specimens are mixed, or the model says nothing of these runs.
    RunFileError, SettingsError
        When folder or model cannot be read.

    Examples
    --------
    >>> import dragrig
    >>> found = dragrig.identify("runs/first")  # doctest: +SKIP
    >>> found.parameters.loc["friction_coefficient"]  # doctest: +SKIP
    >>> dragrig.simulate("paper", model=found.model)  # doctest: +SKIP
    """
    chosen = (
        select_runs(Path(campaign), specimen)
        if isinstance(campaign, str | Path)
        else select_loaded_runs(campaign, specimen)
    )
    source = str(campaign) if isinstance(campaign, str | Path) else "these runs"
    fitted = _nominal_model(nominal, model)
    if wall == "fitted":
        if not isinstance(fitted, CapsuleModel):
            raise SettingsError(f"--wall fitted: the model {fitted.name} has no wall; leave it out.")
        fitted = CapsuleModel(with_identified_wall(fitted.settings, identify_relaxation(chosen)))
    return IdentifiedCampaign(identify_selection(chosen, fitted, progress), chosen, fitted, source)


def save_identified_model(found: IdentifiedCampaign, path: Path, *, overwrite: bool = False) -> Path:
    """Write the file that the simulator loads.

    Raises
    ------
    AnalysisError
        When the fit did not converge.
    OutputError
        When the file is there already, or the folder refuses.
    """
    text = found.toml()
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: is there already; name another file, or say --overwrite.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, "utf-8", newline="\n")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another place.") from error
    return path


def save_identification_pictures(found: IdentifiedCampaign, folder: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Draw what was identified, each part that there is; yields each picture as it is written."""
    from dragrig.present.figure_files import save_figure_in
    from dragrig.present.identification_figures import coulomb_figure, joint_fit_figure, relaxation_fit_figure

    result, runs = found.result, {one.file: one.run for one in found.selection.experiments}
    if result.joint is not None:
        yield save_figure_in(folder, "joint-fit.png", joint_fit_figure(result.joint), overwrite)
    if result.relaxation is not None and result.relaxation.fits:
        figure = relaxation_fit_figure(result.relaxation, found.selection)
        yield save_figure_in(folder, "relaxation.png", figure, overwrite)
    if result.coulomb is not None and result.coulomb.runs:
        first = result.coulomb.runs[0]
        yield save_figure_in(folder, "coulomb.png", coulomb_figure(runs[first.file], first), overwrite)
    if result.drag is not None and result.drag.points:
        yield save_figure_in(folder, "drag.png", _drag_figure(found), overwrite)


def _drag_figure(found: IdentifiedCampaign) -> "Figure":
    from dragrig.present.identification_figures import drag_figure

    drag, first = found.result.drag, found.selection.of_kind("drag")[0]
    if drag is None or not isinstance(found.nominal, CapsuleModel) or found.result.joint is None:
        raise AnalysisError(f"{found.source}: has no drag to draw.")
    model = identified_settings(found.nominal, found.result.joint)
    return drag_figure(drag, model, first.capsule, first.wall_thickness_mm)


def _nominal_model(nominal: str | Path | NominalModel, model: str | Path | FrictionModelSettings) -> NominalModel:
    if not isinstance(nominal, str | Path):
        return nominal
    found = find_model(str(nominal))
    if not isinstance(found, CapsuleModel):
        return found
    settings = found.settings
    if Path(nominal).suffix != ".toml":
        settings = (
            model
            if isinstance(model, FrictionModelSettings)
            else find_settings(FrictionModelSettings, "model", str(model))
        )
    # The fit knows no effects, so that what it finds must not be simulated with them.
    return CapsuleModel(settings.model_copy(update={"effects": ()}))


def _require_joint_fit(result: Identification) -> JointFit:
    if result.joint is None:
        raise AnalysisError("there was no joint fit, so that there are no parameters.")
    return result.joint


def _require_model(result: Identification, source: str) -> JointFit:
    joint = _require_joint_fit(result)
    if (reason := why_no_model(joint)) is not None:
        raise AnalysisError(f"{source}: {reason}.")
    return joint


@dataclass(frozen=True, slots=True, eq=False)
class IdentifiedFolder:
    """What was identified from one of many campaigns.

    Attributes
    ----------
    source
        Its folder.
    result
        All numbers; None where there could be none.
    files
        What was written.
    why_not
        Why there is no result, or no model, a sentence; empty where there is one.
    """

    source: str
    result: Identification | None
    files: tuple[Path, ...] = ()
    why_not: str = ""

    @property
    def failed(self) -> bool:
        """Whether there is no result, or the fit did not converge."""
        return self.result is None or (self.result.joint is not None and not self.result.joint.converged)


def identify_many(
    campaigns: Sequence[str | Path],
    *,
    nominal: str | Path = "capsule",
    model: str | Path = "paper",
    wall: WallChoice = "scaled",
    specimen: str | None = None,
    write: bool = False,
    out: Path | None = None,
    overwrite: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress = no_progress,
) -> tuple[IdentifiedFolder, ...]:
    """Identify many campaigns, each as `dragrig.identify` does it; one that cannot be is told, the others go on.

    Parameters
    ----------
    campaigns
        Their folders. On a cluster its workers must see the same ones.
    nominal, model, wall, specimen
        As in `dragrig.identify`, for all.
    write
        Whether model and pictures are written, into a folder `identified` beside each campaign's runs.
    out
        Folder in whose place: each campaign has one in it, of its own name.
    workers
        Processes that share the campaigns; as many as there are cores unless given.
    scheduler
        Address of a Dask cluster that does the work in their place.

    Returns
    -------
    tuple of IdentifiedFolder
        In the order of the campaigns, the same for any number of workers.

    Raises
    ------
    SettingsError
        When the cluster cannot be used.
    WorkerError
        When processes end before the work is done.
    """
    folders = [Path(one).absolute() for one in campaigns]
    places = _output_folders(folders, out) if write else [None] * len(folders)
    asked = _IdentificationRequest(
        absolute_if_file(str(nominal)), absolute_if_file(str(model)), wall, specimen, overwrite
    )
    with open_executor(workers, scheduler, most=len(folders)) as some:
        found = parallel_map_with_progress(some, asked.identified, list(zip(folders, places, strict=True)), progress)
    return tuple(
        IdentifiedFolder(str(given), one.result, one.files, one.why_not.replace(one.source, str(given)))
        for given, one in zip(campaigns, found, strict=True)
    )


def identified_folder(campaign: Path) -> Path:
    """Return a new folder for what was identified; measured data often lie where nothing may be added."""
    first = campaign / "identified" if os.access(campaign, os.W_OK) else Path(f"{campaign.resolve().name}-identified")
    folder, number = first, 1
    while folder.exists():
        number += 1
        folder = first.with_name(f"{first.name}-{number}")
    return folder


def write_identified_files(
    found: IdentifiedCampaign, folder: Path, *, with_model: bool, overwrite: bool
) -> tuple[Path, ...]:
    """Write model and pictures into a folder; raises `OutputError`."""
    written = []
    if with_model:
        name = "model.toml" if found.nominal.name == "capsule" else f"{found.nominal.name}.toml"
        written.append(save_identified_model(found, folder / name, overwrite=overwrite))
    return (*written, *save_identification_pictures(found, folder, overwrite=overwrite))


def _output_folders(folders: Sequence[Path], out: Path | None) -> list[Path | None]:
    """Return where the files of each campaign go: never two into one folder."""
    places: list[Path | None] = []
    for one in folders:
        first = identified_folder(one) if out is None else out.absolute() / one.name
        taken = [place for place in places if place is not None]
        place, number = first, 1
        while place in taken:
            number += 1
            place = first.with_name(f"{first.name}-{number}")
        places.append(place)
    return places


@dataclass(frozen=True, slots=True)
class _IdentificationRequest:
    nominal: str
    model: str
    wall: WallChoice
    specimen: str | None
    overwrite: bool

    def identified(self, piece: tuple[Path, Path | None]) -> IdentifiedFolder:
        campaign, place = piece
        try:
            found = identify(campaign, nominal=self.nominal, model=self.model, wall=self.wall, specimen=self.specimen)
            files: tuple[Path, ...] = ()
            if place is not None:
                with_model = found.why_no_model is None
                files = write_identified_files(found, place, with_model=with_model, overwrite=self.overwrite)
            return IdentifiedFolder(str(campaign), found.result, files, found.why_no_model or "")
        except DragrigError as error:
            return IdentifiedFolder(str(campaign), None, (), str(error))
