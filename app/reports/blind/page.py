"""The page of an exam."""

from dragrig.gap_scoring import Score
from dragrig.gap_scoring.words import calibration_sentences, exam_sentences, promise_sentences
from dragrig.reports.blind.pictures import pictures
from dragrig.reports.blind.tables import tables
from dragrig.reports.rendering import render
from dragrig.rig.header import software


def page(score: Score, cases: int, seed: int, answers_sha256: str) -> str:
    """Return the report on an exam as one HTML page."""
    summary, *honestly = exam_sentences(score, cases, seed, answers_sha256)
    return render(
        "blind.html",
        {
            "title": f"Exam of the gap diagnosis: {cases} campaigns",
            "software": software(),
            "summary": summary,
            "honestly": honestly,
            "settings": {"Campaigns": str(cases), "Seed": str(seed), "Answers' sha256": answers_sha256},
            "calibration": list(calibration_sentences(score.calibration)),
            "promises": list(promise_sentences(score.promises)) if score.promises.kept else [],
            "tables": tables(score),
            "pictures": pictures(score),
        },
    )
