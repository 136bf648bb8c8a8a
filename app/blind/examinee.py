"""The diagnosis' side of an exam: what it is given is a folder of runs.

This module and what it imports know nothing of the plant.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Question:
    """A folder of runs, and effects that are not in the catalogue."""

    campaign: Path
    without: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Said:
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


def examine(question: Question) -> Said:
    """Diagnose a campaign; what goes wrong becomes a part of the answer, so that the exam goes on."""
    from dragrig.config.loading import to_toml
    from dragrig.diagnosing import diagnosed
    from dragrig.gap_json import gap_document

    try:
        found = diagnosed(question.campaign, without=question.without)
    except Exception as error:  # noqa: BLE001  # whatever it is, it is a campaign that was not diagnosed
        return Said({}, None, f"{type(error).__name__}: {error}")
    model = None if found.result.model is None else to_toml(found.result.model)
    return Said(gap_document(found.result, run_ids=found.run_ids), model)


def evaluate(asked: tuple[Path, Path]) -> Mapping[str, object]:
    """Return how far a model closes the gap on fresh runs, as JSON; empty where they cannot be used."""
    from dragrig.config.errors import AnalysisError
    from dragrig.diagnosing import gap_evaluate
    from dragrig.gap_json import shrink_document

    model, fresh = asked
    try:
        return shrink_document(gap_evaluate(model, fresh))
    except AnalysisError:
        return {}
