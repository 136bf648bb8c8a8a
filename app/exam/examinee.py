"""Diagnoses a campaign of an exam from its folder of runs alone.

This module and what it imports know nothing of the plant.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class BlindTask:
    """A folder of runs, and effects that are not in the catalogue."""

    campaign: Path
    without: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class BlindDiagnosis:
    """The answer to a question.

    Attributes
    ----------
    document
        The gap report's JSON; empty where there is none.
    model
        The amended model as TOML; None where no effect is named.
    why_not
        Why there is no diagnosis; empty where there is one.
    """

    document: Mapping[str, object]
    model: str | None = None
    why_not: str = ""


def diagnose_blind(question: BlindTask) -> BlindDiagnosis:
    """Diagnose a campaign; what goes wrong becomes a part of the answer, so that the exam goes on."""
    from dragrig.api.diagnose import DiagnosisRequest
    from dragrig.config.settings import to_toml
    from dragrig.present.diagnosis import diagnosis_json

    try:
        found = DiagnosisRequest(without=question.without).diagnose(question.campaign)
    except Exception as error:  # noqa: BLE001  # whatever it is, it is a campaign that was not diagnosed
        return BlindDiagnosis({}, None, f"{type(error).__name__}: {error}")
    model = None if found.result.model is None else to_toml(found.result.model)
    return BlindDiagnosis(diagnosis_json(found.result, run_ids=found.run_ids), model)


def evaluate_blind(asked: tuple[Path, Path]) -> Mapping[str, object]:
    """Return how far a model closes the gap on fresh runs, as JSON; empty where they cannot be used."""
    from dragrig.api.diagnose import gap_evaluate
    from dragrig.config.errors import AnalysisError
    from dragrig.present.diagnosis import shrink_report_json

    model, fresh = asked
    try:
        return shrink_report_json(gap_evaluate(model, fresh))
    except AnalysisError:
        return {}
