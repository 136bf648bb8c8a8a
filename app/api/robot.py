"""dragrig.robot: the reach of a capsule robot with an inner mass in the gut."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from dragrig.analysis import Progress, no_progress, parts_of
from dragrig.analysis.gap import Diagnosis
from dragrig.analysis.robot import RobotStudy, study_robot
from dragrig.api.gap import gap_diagnose
from dragrig.config import (
    AnalysisError,
    EffectSettings,
    FrictionModelSettings,
    RobotDrive,
    RobotSettings,
    Specimen,
    find_settings,
)
from dragrig.setup import with_effects
from dragrig.sim_backend.effects import find_effect

DIAGNOSIS_COST, STUDY_COST = 20, 60
"""User CPU time [s] of a campaign's diagnosis, and of a study."""


def robot(
    robot: str | Path | RobotSettings = "capsubot",
    *,
    model: str | Path | FrictionModelSettings = "paper",
    effects: Sequence[str | EffectSettings] = (),
    specimen: str | Path = "jejunum",
    drive: RobotDrive | None = None,
    diagnosis: str | Path | Diagnosis | None = None,
    sensitivity: bool = False,
    seed: int = 1,
    progress: Progress = no_progress,
) -> RobotStudy:
    """Simulate a capsule robot, choose its drive, and price effects in mm/s.

    Parameters
    ----------
    robot
        A file or a shipped name.
    effects
        Effects added to those of the model; each is priced too.
    drive
        To simulate; without it the best ones on the hard surface and in the gut are sought.
    diagnosis
        A campaign's folder, which is diagnosed, an amended model's file, or a diagnosis: its effects are priced.
    sensitivity
        Whether to vary the assumptions on the robot; not with a drive of one's own.
    seed
        Of the search.

    Raises
    ------
    SettingsError
        For unknown names, a drive beyond the actuator's limits, or a model that the robot cannot have.
    AnalysisError
        When the diagnosis has no model with effects, or a motion cannot be integrated.
    """
    settings = robot if isinstance(robot, RobotSettings) else find_settings(RobotSettings, "robot", str(robot))
    base = (
        model if isinstance(model, FrictionModelSettings) else find_settings(FrictionModelSettings, "model", str(model))
    )
    acting = with_effects(base, effects)
    diagnosing, studying = parts_of(progress, DIAGNOSIS_COST * (diagnosis is not None), STUDY_COST)
    priced, errors = (acting, {}) if diagnosis is None else _diagnosed(diagnosis, diagnosing)
    return study_robot(
        settings,
        acting,
        find_settings(Specimen, "specimen", str(specimen)),
        drive=drive,
        diagnosed=priced if priced.effects else None,
        errors=errors,
        sensitivity=sensitivity,
        seed=seed,
        progress=studying,
    )


def _diagnosed(
    diagnosis: str | Path | Diagnosis, progress: Progress
) -> tuple[FrictionModelSettings, Mapping[str, float]]:
    """Return the amended model of a diagnosis, and standard errors of its effects' sizes by id."""
    if isinstance(diagnosis, str | Path) and not Path(diagnosis).is_dir():
        model = find_settings(FrictionModelSettings, "model", str(diagnosis))
        if not model.effects:
            raise AnalysisError(f"{diagnosis}: has no effects to price; save a model by dragrig gap diagnose.")
        return model, {}
    result = diagnosis if isinstance(diagnosis, Diagnosis) else gap_diagnose(diagnosis, progress=progress)
    if not isinstance(result.model, FrictionModelSettings) or not result.model.effects:
        raise AnalysisError(
            f"{diagnosis if isinstance(diagnosis, str | Path) else result.specimen}: the diagnosis names no effect of "
            f"the friction model ({result.verdict}), so there is nothing to price."
        )
    errors: dict[str, float] = {}
    for entry in result.model.effects:
        size = find_effect(entry.id).size.name
        for parameter in result.ranking[0].parameters:
            if parameter.name in {size, f"{entry.id}.{size}"}:
                errors[entry.id] = parameter.standard_error
    return result.model, errors
