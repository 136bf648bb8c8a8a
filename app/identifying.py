"""From a campaign to a specimen's parameters, and to the files that hold them."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dragrig.analysis.identification.identify import determined, identified_settings, why_no_model, with_own_wall
from dragrig.analysis.identification.identify import identify as identify_selection
from dragrig.analysis.identification.relaxation import identify_relaxation
from dragrig.analysis.identification.results import Identification, JointFit
from dragrig.analysis.identification.selection import Selection, select, select_from
from dragrig.analysis.nominal.capsule import CapsuleModel
from dragrig.analysis.nominal.catalogue import find_model
from dragrig.analysis.nominal.protocol import NominalModel
from dragrig.analysis.progress import Progress, silent
from dragrig.config.errors import AnalysisError, OutputError, SettingsError
from dragrig.config.library import find
from dragrig.config.loading import to_toml
from dragrig.config.model import FrictionModelSettings
from dragrig.identification_origin import origin
from dragrig.rig.runfile.model import Run

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

Wall = Literal["scaled", "fitted"]


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
    selection: Selection
    nominal: NominalModel
    source: str

    @property
    def parameters(self) -> "pd.DataFrame":
        """The joint fit, a row for each parameter: value, standard_error, low, high, prior_low, prior_high, learnt.

        A parameter that is not `determined` has no more than what was known before.
        """
        import pandas as pd

        joint = _joint(self.result)
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
        return why_no_model(_joint(self.result))

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
        joint = _supported(self.result, self.source)
        settings = identified_settings(self.nominal, joint)
        told = {
            "name": f"{settings.name}-{self.result.specimen}",
            "identified": origin(self.result, joint, self.source),
        }
        return settings.model_copy(update=told)

    def toml(self) -> str:
        """Return the file that the simulator loads (a user's own model: its values); raises `AnalysisError`."""
        import tomli_w

        if isinstance(self.nominal, CapsuleModel):
            return to_toml(self.model)
        joint = _supported(self.result, self.source)
        known = {one.name: one.nominal for one in self.nominal.parameters} | determined(joint)
        return tomli_w.dumps(self.nominal.document(known))


def identify(
    campaign: str | Path | Iterable[Run],
    *,
    nominal: str | Path | NominalModel = "capsule",
    model: str | Path | FrictionModelSettings = "paper",
    wall: Wall = "scaled",
    specimen: str | None = None,
    progress: Progress = silent,
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
    chosen = select(Path(campaign), specimen) if isinstance(campaign, str | Path) else select_from(campaign, specimen)
    source = str(campaign) if isinstance(campaign, str | Path) else "these runs"
    fitted = _nominal(nominal, model)
    if wall == "fitted":
        if not isinstance(fitted, CapsuleModel):
            raise SettingsError(f"--wall fitted: the model {fitted.name} has no wall; leave it out.")
        fitted = CapsuleModel(with_own_wall(fitted.settings, identify_relaxation(chosen)))
    return IdentifiedCampaign(identify_selection(chosen, fitted, progress), chosen, fitted, source)


def save_model(found: IdentifiedCampaign, path: Path, *, overwrite: bool = False) -> Path:
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


def pictures(found: IdentifiedCampaign, folder: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Draw what was identified, each part that there is; yields each picture as it is written."""
    from dragrig.figures import coulomb_figure, joint_figure, relaxation_fit_figure, save_in

    result, runs = found.result, {one.file: one.run for one in found.selection.experiments}
    if result.joint is not None:
        yield save_in(folder, "joint-fit.png", joint_figure(result.joint), overwrite)
    if result.relaxation is not None and result.relaxation.fits:
        figure = relaxation_fit_figure(result.relaxation, found.selection)
        yield save_in(folder, "relaxation.png", figure, overwrite)
    if result.coulomb is not None and result.coulomb.runs:
        first = result.coulomb.runs[0]
        yield save_in(folder, "coulomb.png", coulomb_figure(runs[first.file], first), overwrite)
    if result.drag is not None and result.drag.points:
        yield save_in(folder, "drag.png", _drag_figure(found), overwrite)


def _drag_figure(found: IdentifiedCampaign) -> "Figure":
    from dragrig.figures import drag_figure

    drag, first = found.result.drag, found.selection.of_kind("drag")[0]
    if drag is None or not isinstance(found.nominal, CapsuleModel) or found.result.joint is None:
        raise AnalysisError(f"{found.source}: has no drag to draw.")
    model = identified_settings(found.nominal, found.result.joint)
    return drag_figure(drag, model, first.capsule, first.wall_thickness_mm)


def _nominal(nominal: str | Path | NominalModel, model: str | Path | FrictionModelSettings) -> NominalModel:
    if not isinstance(nominal, str | Path):
        return nominal
    found = find_model(str(nominal))
    if not isinstance(found, CapsuleModel):
        return found
    settings = found.settings
    if Path(nominal).suffix != ".toml":
        settings = (
            model if isinstance(model, FrictionModelSettings) else find(FrictionModelSettings, "model", str(model))
        )
    # The fit knows no effects, so that what it finds must not be simulated with them.
    return CapsuleModel(settings.model_copy(update={"effects": ()}))


def _joint(result: Identification) -> JointFit:
    if result.joint is None:
        raise AnalysisError("there was no joint fit, so that there are no parameters.")
    return result.joint


def _supported(result: Identification, source: str) -> JointFit:
    joint = _joint(result)
    if (reason := why_no_model(joint)) is not None:
        raise AnalysisError(f"{source}: {reason}.")
    return joint
