"""The whole identification of one specimen from a campaign."""

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

from dragrig.analysis.computation import Progress, no_progress
from dragrig.analysis.identification.coulomb_friction import identify_coulomb
from dragrig.analysis.identification.identification import Identification, JointFit, RelaxationResult
from dragrig.analysis.identification.joint_posterior import fit_jointly
from dragrig.analysis.identification.relaxation_elements import identify_relaxation, wall_polynomials
from dragrig.analysis.identification.steady_drag import identify_drag
from dragrig.analysis.models.capsule_model import FORCE_CHANNEL, CapsuleModel
from dragrig.analysis.models.nominal_model import NominalModel
from dragrig.analysis.selection import RunSelection
from dragrig.config.errors import AnalysisError, SettingsError
from dragrig.config.friction_model import FrictionModelSettings

ResultT = TypeVar("ResultT")

MISSING_KIND_REMARKS = {
    "relaxation": "no usable relaxation: the elements are known from the drag alone, if at all",
    "coulomb": "no usable Coulomb run: the friction coefficient is known from the drag alone, if at all",
    "drag": "no usable drag run: nothing is known of the contact angle and of steady drag",
}
PROGRESS_STEPS = 4


def identify_specimen(
    selection: RunSelection, nominal: NominalModel, progress: Progress = no_progress
) -> Identification:
    """Identify a specimen.

    The joint fit of the nominal model is always made. With the friction model of the capsule the relaxations, the
    Coulomb test and the drag are evaluated on their own too, the drag beside the model from the joint fit.

    Raises
    ------
    AnalysisError
        Where the model predicts nothing of these runs, or a run lacks what it needs.
    """
    progress(0, PROGRESS_STEPS)
    joint = fit_jointly(selection, nominal)
    progress(1, PROGRESS_STEPS)
    identification = Identification(
        specimen=selection.specimen,
        used=tuple(experiment.file for experiment in selection.experiments),
        left_out=selection.left_out,
        joint=joint,
        relaxation=None,
        coulomb=None,
        drag=None,
        remarks=selection.remarks,
    )
    if isinstance(nominal, CapsuleModel):
        identification = _with_parts(identification, joint, selection, nominal, progress)
    progress(PROGRESS_STEPS, PROGRESS_STEPS)
    return identification


def _with_parts(
    identification: Identification,
    joint: JointFit,
    selection: RunSelection,
    nominal: CapsuleModel,
    progress: Progress,
) -> Identification:
    """Add the relaxations, the Coulomb test and the drag, evaluated on their own."""
    remarks = [remark for kind, remark in MISSING_KIND_REMARKS.items() if not selection.of_kind(kind)]

    def attempt(evaluate: Callable[[], ResultT], what: str) -> ResultT | None:
        try:
            return evaluate()
        except (AnalysisError, SettingsError) as error:
            remarks.append(f"{what}: {error}")
            return None

    model = identified_settings(nominal, joint)
    zeros = {run.file: run.zero for run in joint.runs if run.channel == FORCE_CHANNEL} if joint.converged else None
    relaxation = attempt(lambda: identify_relaxation(selection), "relaxation")
    progress(2, PROGRESS_STEPS)
    coulomb = attempt(lambda: identify_coulomb(selection, model), "Coulomb test")
    drag = attempt(lambda: identify_drag(selection, model, zeros), "drag")
    progress(3, PROGRESS_STEPS)
    return replace(
        identification,
        relaxation=relaxation,
        coulomb=coulomb,
        drag=drag,
        remarks=(*identification.remarks, *remarks),
    )


def determined_values(joint: JointFit) -> dict[str, float]:
    """Return the values of the parameters that the runs determine; the others keep their nominal values."""
    return {parameter.name: parameter.value for parameter in joint.parameters if parameter.determined}


def why_no_model(joint: JointFit) -> str | None:
    """Return why a joint fit gives no model of the runs, None where it gives one."""
    if not joint.converged:
        return "the joint fit did not converge, so that there is no model; see its remarks"
    if not determined_values(joint):
        return "these runs determine no parameter, so that there is no model of them"
    return None


def identified_settings(nominal: CapsuleModel, joint: JointFit) -> FrictionModelSettings:
    """Return the friction model with the determined values, the rest nominal."""
    return nominal.settings_of(determined_values(joint)) if joint.converged else nominal.settings


def with_identified_wall(settings: FrictionModelSettings, relaxation: RelaxationResult) -> FrictionModelSettings:
    """Return the friction model with polynomials through the specimen's own relaxations for its wall.

    Raises
    ------
    AnalysisError
        Where the relaxations do not support them.
    """
    if not relaxation.laws:
        reasons = "; ".join(relaxation.remarks) or "there is no usable relaxation"
        raise AnalysisError(f"the wall cannot be taken from these relaxations ({reasons}); leave out --wall fitted.")
    try:
        polynomials = wall_polynomials(relaxation.laws)
    except SettingsError as error:
        raise AnalysisError(f"the wall cannot be taken from these relaxations: {error}") from error
    return settings.model_copy(update={"wall": "polynomial", "wall_polynomials": polynomials})
