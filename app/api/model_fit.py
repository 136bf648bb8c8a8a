"""Identify a specimen's parameters from one campaign or many, and write model and pictures."""

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypedDict

from dragrig import present
from dragrig.analysis import (
    CapsuleModel,
    Exclusion,
    Identification,
    JointFit,
    NominalModel,
    ParameterEstimate,
    PooledCampaign,
    Population,
    Progress,
    RunSelection,
    SpecimenFit,
    determined_values,
    find_model,
    identified_settings,
    identify_relaxation,
    no_progress,
    parts_of,
    pool_campaigns,
    pool_specimens,
    printable,
    select_loaded_runs,
    select_runs,
    why_no_model,
    with_identified_wall,
)
from dragrig.analysis import identify_specimen as identify_selection
from dragrig.config import (
    UNSTATED,
    AnalysisError,
    DragrigError,
    FrictionModelSettings,
    IdentificationSummary,
    IdentifiedValue,
    SettingsError,
    absolute_if_file,
    reason_of,
    to_toml,
)
from dragrig.parallel import map_tasks
from dragrig.present import unused_path, write_text
from dragrig.rig import Campaign, Run, as_html, session_record_of_run, software_version
from dragrig.setup import friction_model

if TYPE_CHECKING:
    import pandas as pd


WallChoice = Literal["scaled", "fitted"]


class FitChoices(TypedDict):
    """The choices of an identification, as in `dragrig.identify`."""

    nominal: str
    model: str
    wall: WallChoice
    specimen: str | None


READING_COST, FITTING_COST = 1, 14
"""Relative times of reading a campaign's runs and of what is made of them."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class IdentifiedCampaign:
    """The numbers identified, the runs that were used, the model that was fitted, and the campaign."""

    result: Identification
    selection: RunSelection
    nominal: NominalModel
    source: str

    def __repr__(self) -> str:
        learnt = [] if self.result.joint is None else [each for each in self.result.joint.parameters if each.determined]
        values = ", ".join(
            f"{each.name} {each.value:.3g} ± {each.standard_error:.2g}{f' {each.unit}' * (each.unit != '1')}"
            for each in learnt
        )
        return f"<identified {self.source}: {values or 'no parameter is determined'}>"

    def _repr_html_(self) -> str:
        return as_html(self.result)

    @property
    def parameters(self) -> "pd.DataFrame":
        """The joint fit, a row for each parameter: value, standard_error, low, high, prior_low, prior_high, learnt.

        A parameter that is not `determined` keeps its prior.
        """
        import pandas as pd

        parameters = _require_joint_fit(self.result).parameters
        rows = [
            {
                **present.attributes_json(parameter, "unit", "value", "standard_error"),
                **dict(zip(("low", "high"), parameter.interval, strict=True)),
                **dict(zip(("prior_low", "prior_high"), parameter.prior, strict=True)),
                **present.attributes_json(parameter, "learnt", "determined", "meaning"),
            }
            for parameter in parameters
        ]
        return pd.DataFrame(rows, index=[parameter.name for parameter in parameters])

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
        joint = self._require_model()
        settings = identified_settings(self.nominal, joint)
        changes = {
            "name": f"{settings.name}-{self.result.specimen}",
            "identified": _model_origin(self.result, joint, self.source),
        }
        return settings.model_copy(update=changes)

    def toml(self) -> str:
        """Return the file that the simulator loads (a user's own model: its values); raises `AnalysisError`."""
        import tomli_w

        if isinstance(self.nominal, CapsuleModel):
            return to_toml(self.model)
        values = {parameter.name: parameter.nominal for parameter in self.nominal.parameters}
        return tomli_w.dumps(self.nominal.document(values | determined_values(self._require_model())))

    def _require_model(self) -> JointFit:
        if (reason := self.why_no_model) is not None:
            raise AnalysisError(f"{self.source}: {reason}.")
        return _require_joint_fit(self.result)


def _model_origin(result: Identification, joint: JointFit, campaign: str) -> IdentificationSummary:
    """Return the origin of the values of an identified model, as its file states it."""
    return IdentificationSummary(
        campaign=printable(campaign),
        specimen=result.specimen,
        runs=len(result.used),
        software=software_version(),
        converged=joint.converged,
        chi2_per_degree=joint.chi2 / joint.degrees,
        parameters=tuple(_identified_value(parameter) for parameter in joint.parameters),
        combinations=tuple(_identified_value(product) for product in joint.combinations),
        correlation=tuple(tuple(row) for row in joint.correlation.round(4).tolist()),
    )


def _identified_value(parameter: ParameterEstimate) -> IdentifiedValue:
    low, high = parameter.interval
    same = present.attributes_json(parameter, "name", "unit", "value", "standard_error", "learnt", "determined")
    return IdentifiedValue.model_validate({**same, "low": low, "high": high})


def identify(
    campaign: str | Path | Campaign | Iterable[Run],
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
        A campaign's folder or its listing, or runs in memory.
    nominal
        The model to fit: `capsule` (the paper's friction model), `drive` (the stage alone, from its motor force), a
        Python file with a model of your own, a friction model as TOML, or a model.
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
        When there is no usable run, specimens are mixed, or the model predicts nothing for these runs.
    RunFileError, SettingsError
        When folder or model cannot be read.

    Examples
    --------
    >>> import dragrig
    >>> identified = dragrig.identify("runs/first")  # doctest: +SKIP
    >>> identified.parameters.loc["friction_coefficient"]  # doctest: +SKIP
    >>> dragrig.simulate("paper", model=identified.model)  # doctest: +SKIP
    """
    reading, fitting = parts_of(progress, READING_COST, FITTING_COST)
    if isinstance(campaign, str | Path):
        source, selection = str(campaign), select_runs(Path(campaign), specimen, reading)
    elif isinstance(campaign, Campaign):
        source, selection = str(campaign.folder), select_runs(campaign, specimen, reading)
    else:
        source, selection = "these runs", select_loaded_runs(campaign, specimen)
    fitted = _nominal_model(nominal, model)
    if wall == "fitted":
        if not isinstance(fitted, CapsuleModel):
            raise SettingsError(f"wall fitted: the model {fitted.name} has no wall; leave it out.")
        fitted = CapsuleModel(with_identified_wall(fitted.settings, identify_relaxation(selection)))
    return IdentifiedCampaign(identify_selection(selection, fitted, fitting), selection, fitted, source)


def save_identified_model(identified: IdentifiedCampaign, path: Path, *, overwrite: bool = False) -> Path:
    """Write the file that the simulator loads.

    Raises
    ------
    AnalysisError
        When the fit did not converge.
    OutputError
        When the file exists, or the folder cannot be written.
    """
    return write_text(identified.toml(), path, overwrite=overwrite, make_folder=True)


def save_identification_pictures(
    identified: IdentifiedCampaign, folder: Path, *, overwrite: bool = False
) -> Iterator[Path]:
    """Draw every part that was identified; yields each picture as it is written."""
    from dragrig.present import identification_document, save_figure_in, save_figures

    relaxation = identified.result.relaxation
    yield from save_figures(identification_document(identified.result), folder, overwrite=overwrite)
    if relaxation is not None and relaxation.fits:
        figure = present.relaxation_fit_figure(relaxation, identified.selection)
        yield save_figure_in(folder, "relaxation", figure, overwrite)


def _nominal_model(nominal: str | Path | NominalModel, model: str | Path | FrictionModelSettings) -> NominalModel:
    if not isinstance(nominal, str | Path):
        return nominal
    fitted = find_model(str(nominal))
    if not isinstance(fitted, CapsuleModel):
        return fitted
    settings = fitted.settings if Path(nominal).suffix == ".toml" else friction_model(model)
    # The fit knows no effects, so its result must not be simulated with them.
    return CapsuleModel(settings.model_copy(update={"effects": ()}))


def _require_joint_fit(result: Identification) -> JointFit:
    if result.joint is None:
        raise AnalysisError("there was no joint fit, so that there are no parameters.")
    return result.joint


@dataclass(frozen=True, slots=True, eq=False)
class IdentifiedFolder:
    """The identification of one of many campaigns."""

    source: str
    """Its folder."""
    result: Identification | None
    """None where nothing could be identified."""
    files: tuple[Path, ...] = ()
    """The files written."""
    why_not: str = ""
    """Why there is no result, or no model, a sentence; empty where there is one."""

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
    """Identify campaigns in parallel, each as `dragrig.identify` does; one that fails does not stop the others.

    Parameters
    ----------
    campaigns
        Their folders. The workers of a cluster must see the same folders.
    nominal, model, wall, specimen
        As in `dragrig.identify`, for all.
    write
        Whether model and pictures are written, into a folder `identified` beside each campaign's runs.
    out
        Folder to use in their place; each campaign gets a folder of its own name in it.
    workers, scheduler
        As in `dragrig.gap_diagnose_many`.

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
    folders = [Path(campaign).absolute() for campaign in campaigns]
    outputs = _output_folders(folders, out) if write else [None] * len(folders)
    nominal_name, model_name = absolute_if_file(str(nominal)), absolute_if_file(str(model))
    choices: FitChoices = {"nominal": nominal_name, "model": model_name, "wall": wall, "specimen": specimen}
    tasks = list(zip(map(str, campaigns), folders, outputs, strict=True))
    return map_tasks(partial(_identify_folder, choices, overwrite), tasks, workers, scheduler, progress)


def _identify_folder(choices: FitChoices, overwrite: bool, campaign: tuple[str, Path, Path | None]) -> IdentifiedFolder:
    """Identify one of many campaigns (name, folder, output folder); an error becomes part of the result."""
    name, folder, output = campaign
    try:
        identified = identify(folder, **choices)
        files: tuple[Path, ...] = ()
        why_not = identified.why_no_model or ""
        if output is not None:
            files = write_identified_files(identified, output, with_model=not why_not, overwrite=overwrite)
    except DragrigError as error:
        return IdentifiedFolder(name, None, (), str(error).replace(str(folder), name))
    return IdentifiedFolder(name, identified.result, files, why_not.replace(str(folder), name))


def _specimen_fit(choices: FitChoices, task: tuple[str, PooledCampaign]) -> SpecimenFit | Exclusion:
    """Identify one of the campaigns of a population; an error is the reason why it takes no part."""
    name, pooled = task
    campaign = pooled.campaign
    try:
        identified = identify(campaign, **choices)
    except DragrigError as error:
        return Exclusion(name, reason_of(error).removeprefix(f"{campaign.folder}: "))
    infos = [experiment.run.info for experiment in identified.selection.experiments]
    serials = {str(info.header.entry.get("sensor_serial", "")) for info in infos} - {"", UNSTATED}
    result = identified.result
    has_id = str(infos[0].header.specimen.get("id") or UNSTATED) != UNSTATED
    return SpecimenFit(
        source=name,
        # Without an id nobody said that it is the piece of another campaign.
        specimen=result.specimen if has_id else f"{result.specimen} in {name}",
        identification=replace(result, left_out=(*pooled.copies, *result.left_out)),
        rig=_rig_of(infos[0].path),
        sensor=", ".join(sorted(serials)),
    )


def _rig_of(run_file: Path) -> str:
    """Return the name of a run's rig, "" where its file does not say."""
    try:
        record = session_record_of_run(run_file)
    except DragrigError:
        return ""
    return f"{record.rig.name} ({'double of ' if record.double else ''}{record.backend})"


def identify_together(
    campaigns: Sequence[str | Path],
    *,
    nominal: str | Path = "capsule",
    model: str | Path = "paper",
    wall: WallChoice = "scaled",
    specimen: str | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress = no_progress,
) -> Population:
    """Identify campaigns of one rig together: parameters of the rig once, those of specimens with mean and spread.

    Each campaign is identified in parallel, as `dragrig.identify` does; a run that lies in several counts once.

    Parameters
    ----------
    campaigns, nominal, model, wall, specimen, workers, scheduler
        As in `dragrig.identify_many`.

    Raises
    ------
    RunFileError
        When a folder is missing.
    AnalysisError
        When fewer than two specimens can be identified, or the campaigns are of several rigs.

    Examples
    --------
    >>> import dragrig
    >>> population = dragrig.identify_together(["runs/p7", "runs/p8", "runs/p9"])  # doctest: +SKIP
    >>> population.parameters[6].next_specimen  # doctest: +SKIP
    """
    names = {Path(campaign).resolve(): str(campaign) for campaign in reversed(campaigns)}
    pooled = pool_campaigns([Path(campaign).absolute() for campaign in campaigns])
    nominal_name, model_name = absolute_if_file(str(nominal)), absolute_if_file(str(model))
    choices: FitChoices = {"nominal": nominal_name, "model": model_name, "wall": wall, "specimen": specimen}
    tasks = [(names[each.campaign.folder.resolve()], each) for each in pooled]
    fits = map_tasks(partial(_specimen_fit, choices), tasks, workers, scheduler, progress)
    identified = [fit for fit in fits if isinstance(fit, SpecimenFit)]
    left_out = [fit for fit in fits if isinstance(fit, Exclusion)]
    copies = [replace(copy, item=f"{name}/{copy.item}") for name, each in tasks for copy in each.copies]
    parameters = _nominal_model(nominal_name, model_name).parameters
    return pool_specimens(identified, parameters, (*left_out, *copies))


def identified_folder(campaign: Path) -> Path:
    """Return a new folder for results: in the campaign, or in the working folder where the campaign is read-only."""
    in_campaign = os.access(campaign, os.W_OK)
    return unused_path(campaign / "identified" if in_campaign else Path(f"{campaign.resolve().name}-identified"))


def write_identified_files(
    identified: IdentifiedCampaign,
    folder: Path,
    *,
    with_model: bool,
    overwrite: bool,
    progress: Progress = no_progress,
) -> tuple[Path, ...]:
    """Write model and pictures into a folder; raises `OutputError`."""
    written = []
    if with_model:
        name = "model.toml" if identified.nominal.name == "capsule" else f"{identified.nominal.name}.toml"
        written.append(save_identified_model(identified, folder / name, overwrite=overwrite))
    result = identified.result
    pictures = sum(part is not None for part in (result.joint, result.relaxation, result.coulomb, result.drag))
    for picture in save_identification_pictures(identified, folder, overwrite=overwrite):
        written.append(picture)
        progress(len(written), pictures + with_model)
    return tuple(written)


def _output_folders(campaigns: Sequence[Path], out: Path | None) -> list[Path | None]:
    """Return a separate output folder for each campaign."""
    folders: list[Path | None] = []
    for campaign in campaigns:
        first = identified_folder(campaign) if out is None else out.absolute() / campaign.name
        numbered = (first.with_name(f"{first.name}-{number}") for number in count(2))
        folders.append(next(folder for folder in chain([first], numbered) if folder not in folders))
    return folders
