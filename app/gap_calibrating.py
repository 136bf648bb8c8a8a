"""Learn a verdict's thresholds and weights from exams, and write them as a file that a diagnosis loads."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dragrig.analysis.gap.calibration import Calibration
from dragrig.analysis.gap.evidence import Evidence
from dragrig.analysis.gap.learning import Lesson
from dragrig.config.errors import AnalysisError

if TYPE_CHECKING:
    from pydantic import TypeAdapter

VERSION = 1


@dataclass(frozen=True, slots=True)
class _Exam:
    """What is read of an exam's folder."""

    seed: int
    made_by: str
    lessons: tuple[Lesson, ...]


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
    from dragrig.analysis.gap.learning import learn_gate, learn_weights

    read = [_read(Path(one)) for one in exams]
    lessons = [lesson for one in read for lesson in one.lessons]
    names = " ".join(Path(one).name for one in exams)
    try:
        gate, weights = learn_gate(lessons, tolerance_mN), learn_weights(lessons, tolerance_mN)
    except ValueError as error:
        raise AnalysisError(f"{names}: {error}; hold a larger exam with dragrig gap blind.") from error
    return Calibration(
        version=VERSION,
        command="; ".join([*(one.made_by for one in read), f"dragrig gap calibrate {names}"]),
        seeds=tuple(one.seed for one in read),
        cases=len(lessons),
        gate=gate,
        weights=weights,
    )


def _read(folder: Path) -> _Exam:
    from pydantic import TypeAdapter, ValidationError

    from dragrig.gap_scoring.records import Answer

    try:
        told = json.loads((folder / "exam.json").read_text("utf-8"))
        seed, made = int(told["seed"]), f"--cases {told['cases']} --seed {told['seed']} --mix {told['mix']}"
        answers = TypeAdapter(dict[str, Answer]).validate_json((folder / "answers.json").read_text("utf-8"))
        evidence = dict(_said(folder, TypeAdapter(Evidence)))
    except (OSError, KeyError, ValueError, ValidationError) as error:
        raise AnalysisError(
            f"{folder}: holds no exam from which can be learnt; hold one with dragrig gap blind --out {folder}."
        ) from error
    lessons = [
        Lesson(evidence[name], frozenset(one.effects), one.verdict == "unknown", one.least)
        for name, one in answers.items()
        if name in evidence
    ]
    return _Exam(seed, f"dragrig gap blind {made} --out {folder.name}", tuple(lessons))


def _said(folder: Path, kind: "TypeAdapter[Evidence]") -> Iterator[tuple[str, Evidence]]:
    """Yield what each diagnosis was made of; there is none where a campaign could not be diagnosed."""
    for path in sorted((folder / "said").glob("*.json")):
        document = json.loads(path.read_text("utf-8"))
        if document.get("evidence"):
            yield path.stem, kind.validate_python(document["evidence"])
