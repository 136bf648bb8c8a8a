"""Learn the verdict's thresholds and weights from exams, and cross-validate them."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dragrig.analysis.gap import DecisionInputs, TrainingCase, VerdictCalibration
from dragrig.config import AnalysisError

if TYPE_CHECKING:
    from dragrig.analysis.gap import Classification
    from dragrig.scoring import AnswerKey, Rate, ScoredCase


@dataclass(frozen=True, slots=True)
class _ReadExam:
    """The content of an exam's folder that is learnt from."""

    seed: int
    command: str
    answers: "Mapping[str, AnswerKey]"
    training: tuple[TrainingCase, ...]


def gap_calibrate(exams: Sequence[str | Path], tolerance_mN: float = 0.5) -> VerdictCalibration:
    """Learn thresholds and weights from exams; judge the result on exams with other seeds.

    Parameters
    ----------
    exams
        Folders that `dragrig gap blind --out` wrote.
    tolerance_mN
        Force change below which an effect does not matter.

    Raises
    ------
    AnalysisError
        When a folder holds no finished exam, or its campaigns are too few to learn from.
    """
    from dragrig.analysis.gap import calibrate

    read = [_read_exam(Path(exam)) for exam in exams]
    training = [case for exam in read for case in exam.training]
    names = " ".join(Path(exam).name for exam in exams)
    command = "; ".join([*(exam.command for exam in read), f"dragrig gap calibrate {names}"])
    try:
        return calibrate(training, tolerance_mN, [exam.seed for exam in read], command)
    except ValueError as error:
        raise AnalysisError(f"{names}: {error}; hold a larger exam with dragrig gap blind.") from error


def gap_cross_validate(exams: Sequence[str | Path], folds: int = 10, tolerance_mN: float = 0.5) -> "tuple[Rate, ...]":
    """Cross-validate the verdict on the campaigns of exams.

    Parameters
    ----------
    exams
        Folders that `dragrig gap blind --out` wrote.
    folds
        Number of folds; the campaigns of each are judged by the teaching of the others.
    tolerance_mN
        Force change below which an effect does not matter.

    Returns
    -------
    rates
        Those rates of an exam that need only the verdict, with their 95 % intervals.

    Raises
    ------
    AnalysisError
        When a folder holds no finished exam, or there are too few campaigns for this number of folds.
    """
    from dragrig.analysis.gap import cross_validate
    from dragrig.scoring import verdict_rates

    read = [_read_exam(Path(exam)) for exam in exams]
    training = [case for exam in read for case in exam.training]
    try:
        verdicts = cross_validate(training, tolerance_mN, folds)
    except ValueError as error:
        raise AnalysisError(f"{error}; hold a larger exam with dragrig gap blind, or use fewer folds.") from error
    answers = [answer for exam in read for answer in exam.answers.items()]
    return verdict_rates(
        [_scored_case(name, answer, verdict) for (name, answer), verdict in zip(answers, verdicts, strict=True)]
    )


def _scored_case(name: str, answer: "AnswerKey", result: "Classification") -> "ScoredCase":
    from dragrig.scoring import ScoredCase, ScoredDiagnosis, ScoredHypothesis

    ranking = tuple(
        ScoredHypothesis(hypothesis=hypothesis, probability=probability)
        for hypothesis, probability in result.probabilities.items()
    )
    diagnosis = ScoredDiagnosis(
        verdict=result.verdict.value, effects=result.effects, ranking=ranking, confusable_with=result.confusable_with
    )
    return ScoredCase(name, answer, diagnosis)


def _read_exam(folder: Path) -> _ReadExam:
    from pydantic import TypeAdapter, ValidationError

    from dragrig.scoring import AnswerKey

    inputs, evidence = TypeAdapter(DecisionInputs), {}
    try:
        exam = json.loads((folder / "exam.json").read_text("utf-8"))
        seed, numbers = int(exam["seed"]), f"--cases {exam['cases']} --seed {exam['seed']} --mix {exam['mix']}"
        if exam.get("plant", "written") != "written":
            raise AnalysisError(
                f"{folder}: is an exam by the plant {exam['plant']}, which judges; learn from one with --plant written."
            )
        answers = TypeAdapter(dict[str, AnswerKey]).validate_json((folder / "answers.json").read_text("utf-8"))
        for path in sorted((folder / "said").glob("*.json")):
            # None where a campaign could not be diagnosed.
            if document := json.loads(path.read_text("utf-8")).get("evidence"):
                evidence[path.stem] = inputs.validate_python(document)
    except (OSError, KeyError, ValueError, ValidationError) as error:
        raise AnalysisError(
            f"{folder}: holds no finished exam; hold one with dragrig gap blind --out {folder}."
        ) from error
    diagnosed = {name: answer for name, answer in answers.items() if name in evidence}
    training = tuple(
        TrainingCase(evidence[name], frozenset(answer.effects), answer.verdict == "unknown", answer.smallest_size)
        for name, answer in diagnosed.items()
    )
    return _ReadExam(seed, f"dragrig gap blind {numbers} --out {folder.name}", diagnosed, training)
