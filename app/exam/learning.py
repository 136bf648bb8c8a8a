"""Learn the verdict's thresholds and weights from exams, and cross-validate them."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dragrig.analysis.gap.classifier import TrainingCase
from dragrig.analysis.gap.features import Calibration, DecisionInputs
from dragrig.config.errors import AnalysisError

if TYPE_CHECKING:
    from pydantic import TypeAdapter

    from dragrig.analysis.gap.classifier import Classification
    from dragrig.scoring import AnswerKey, Rate, ScoredCase

CALIBRATION_VERSION = 1


@dataclass(frozen=True, slots=True)
class _ReadExam:
    """What is read of an exam's folder."""

    seed: int
    made_by: str
    answers: "Mapping[str, AnswerKey]"
    lessons: tuple[TrainingCase, ...]


def gap_calibrate(exams: Sequence[str | Path], tolerance_mN: float = 0.5) -> Calibration:
    """Learn from exams that `dragrig gap blind --out` kept; judge the result on exams with other seeds.

    Parameters
    ----------
    exams
        Their folders.
    tolerance_mN
        What an effect must change to matter.

    Raises
    ------
    AnalysisError
        When a folder holds no exam that was held, or nothing is to be learnt from them.
    """
    from dragrig.analysis.gap.classifier import fit_gate, fit_weights

    read = [_read_exam(Path(one)) for one in exams]
    lessons = [lesson for one in read for lesson in one.lessons]
    names = " ".join(Path(one).name for one in exams)
    try:
        gate, weights = fit_gate(lessons, tolerance_mN), fit_weights(lessons, tolerance_mN)
    except ValueError as error:
        raise AnalysisError(f"{names}: {error}; hold a larger exam with dragrig gap blind.") from error
    return Calibration(
        version=CALIBRATION_VERSION,
        command="; ".join([*(one.made_by for one in read), f"dragrig gap calibrate {names}"]),
        seeds=tuple(one.seed for one in read),
        cases=len(lessons),
        gate=gate,
        weights=weights,
    )


def gap_cross_validate(exams: Sequence[str | Path], folds: int = 10, tolerance_mN: float = 0.5) -> "tuple[Rate, ...]":
    """Say how often verdicts on the campaigns of exams are right, each learnt on the others.

    Parameters
    ----------
    exams
        Folders that `dragrig gap blind --out` kept.
    folds
        Into so many parts all campaigns are divided; each part is judged by what the others teach.
    tolerance_mN
        What an effect must change to matter.

    Returns
    -------
    rates
        With their 95 % intervals, those of an exam that ask for nothing but a verdict.

    Raises
    ------
    AnalysisError
        When a folder holds no exam that was held, or there are too few campaigns for so many parts.
    """
    from dragrig.analysis.gap.classifier import cross_validate
    from dragrig.scoring import verdict_rates

    read = [_read_exam(Path(one)) for one in exams]
    lessons = [lesson for one in read for lesson in one.lessons]
    try:
        judged = cross_validate(lessons, tolerance_mN, folds)
    except ValueError as error:
        raise AnalysisError(f"{error}; hold a larger exam with dragrig gap blind, or ask for fewer parts.") from error
    answers = [pair for one in read for pair in one.answers.items()]
    return verdict_rates([_scored_case(*pair, said) for pair, said in zip(answers, judged, strict=True)])


def _scored_case(name: str, answer: "AnswerKey", judged: "Classification") -> "ScoredCase":
    from dragrig.scoring import ScoredCase, ScoredDiagnosis, ScoredHypothesis

    ranking = tuple(ScoredHypothesis(hypothesis=one, probability=each) for one, each in judged.probabilities.items())
    verdict, confusable = judged.verdict.value, judged.confusable_with
    said = ScoredDiagnosis(verdict=verdict, effects=judged.effects, ranking=ranking, confusable_with=confusable)
    return ScoredCase(name, answer, said)


def _read_exam(folder: Path) -> _ReadExam:
    from pydantic import TypeAdapter, ValidationError

    from dragrig.scoring import AnswerKey

    try:
        told = json.loads((folder / "exam.json").read_text("utf-8"))
        seed, made = int(told["seed"]), f"--cases {told['cases']} --seed {told['seed']} --mix {told['mix']}"
        answers = TypeAdapter(dict[str, AnswerKey]).validate_json((folder / "answers.json").read_text("utf-8"))
        evidence = dict(_read_evidence(folder, TypeAdapter(DecisionInputs)))
    except (OSError, KeyError, ValueError, ValidationError) as error:
        raise AnalysisError(
            f"{folder}: holds no exam from which can be learnt; hold one with dragrig gap blind --out {folder}."
        ) from error
    told_of = {name: one for name, one in answers.items() if name in evidence}
    lessons = [
        TrainingCase(evidence[name], frozenset(one.effects), one.verdict == "unknown", one.least)
        for name, one in told_of.items()
    ]
    return _ReadExam(seed, f"dragrig gap blind {made} --out {folder.name}", told_of, tuple(lessons))


def _read_evidence(folder: Path, kind: "TypeAdapter[DecisionInputs]") -> Iterator[tuple[str, DecisionInputs]]:
    """Yield what each diagnosis was made of; there is none where a campaign could not be diagnosed."""
    for path in sorted((folder / "said").glob("*.json")):
        document = json.loads(path.read_text("utf-8"))
        if document.get("evidence"):
            yield path.stem, kind.validate_python(document["evidence"])
