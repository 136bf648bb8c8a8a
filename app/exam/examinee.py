"""Diagnoses a campaign of an exam from its folder of runs alone.

This module and its imports know nothing of the plant.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class BlindTask:
    """A folder of runs, and the effects to remove from the catalogue."""

    campaign: Path
    without: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class BlindDiagnosis:
    """The diagnosis of a task."""

    document: Mapping[str, object]
    """The gap report's JSON; empty where there is none."""
    model: str | None = None
    """The amended model as TOML; None where no effect is named."""
    why_not: str = ""
    """Why there is no diagnosis; empty where there is one."""

    def json_or_failure(self) -> Mapping[str, object]:
        """Return the JSON to store."""
        return self.document or {"failed": self.why_not}


def diagnose_blind(task: BlindTask) -> BlindDiagnosis:
    """Diagnose a campaign; an error becomes part of the result, so that the exam goes on."""
    from dragrig.api import DiagnosisRequest
    from dragrig.config import to_toml
    from dragrig.present import diagnosis_json

    try:
        diagnosed = DiagnosisRequest(without=task.without, next_runs=None).diagnose(task.campaign)
    except Exception as error:  # noqa: BLE001  # whatever it is, the campaign counts as not diagnosed
        return BlindDiagnosis({}, None, f"{type(error).__name__}: {error}")
    result = diagnosed.result
    model = None if result.model is None else to_toml(result.model)
    return BlindDiagnosis(diagnosis_json(result, run_ids=diagnosed.run_ids), model)


def evaluate_blind(task: tuple[Path, Path]) -> Mapping[str, object]:
    """Evaluate a model file on a folder of fresh runs, as JSON; empty where the runs cannot be used."""
    from dragrig.api import gap_evaluate
    from dragrig.config import AnalysisError
    from dragrig.present import evaluation_json

    model, fresh = task
    try:
        return evaluation_json(gap_evaluate(model, fresh))
    except AnalysisError:
        return {}
