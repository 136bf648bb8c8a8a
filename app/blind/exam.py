"""An exam that was held, as a frozen value, and its page."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from dragrig.blind.sealing import FORMAT, VERSION
from dragrig.gap_scoring import Score
from dragrig.gap_scoring.document import score_document


@dataclass(frozen=True, slots=True)
class BlindExam:
    """An exam that was held.

    Attributes
    ----------
    cases, seed
        What it was drawn from.
    answers_sha256
        The seal.
    score
        How often the diagnosis was right.
    failed
        Why campaigns were not diagnosed, by their names; they are not in the score.
    timings_s
        Of this call; the only part that differs between two exams with one seed.
    """

    cases: int
    seed: int
    answers_sha256: str
    score: Score
    failed: Mapping[str, str] = field(default_factory=dict)
    timings_s: Mapping[str, float] = field(default_factory=dict)

    def document(self) -> Mapping[str, object]:
        """Return all that the exam says as JSON."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "cases": self.cases,
            "seed": self.seed,
            "answers_sha256": self.answers_sha256,
            **score_document(self.score),
            "failed": dict(self.failed),
            "timings_s": {name: round(seconds, 3) for name, seconds in self.timings_s.items()},
        }


def save_report(exam: BlindExam, path: Path, *, overwrite: bool = False) -> Path:
    """Write an exam as one HTML file with its pictures inside; raises `OutputError` as `diagnosing.save_report`."""
    from dragrig.reports.blind.page import page
    from dragrig.reports.files import write_text

    return write_text(page(exam.score, exam.cases, exam.seed, exam.answers_sha256), path, overwrite=overwrite)
