"""The page of a gap report: honest words first."""

from dragrig.analysis.gap.results import Diagnosis, Verdict
from dragrig.analysis.gap.sentences import (
    meaning_of_probabilities,
    sentence,
    shrink_sentences,
    verdict_sentences,
    what_it_is,
    would_have_seen,
)
from dragrig.analysis.gap.where_words import where_sentence
from dragrig.reports.gap.pictures import pictures
from dragrig.reports.gap.tables import tables
from dragrig.reports.rendering import render


def page(diagnosis: Diagnosis, source: str = "", model: str | None = None) -> str:
    """Return the report as one HTML page.

    Parameters
    ----------
    source
        The campaign.
    model
        The file that the amended model was written to; None where there is none.
    """
    verdict, *more = verdict_sentences(diagnosis)
    return render(
        "gap.html",
        {
            "title": f"Gap diagnosis: {diagnosis.specimen}",
            "verdict": verdict,
            "more": more,
            "effects": [what_it_is(one) for one in diagnosis.effects],
            "meaning": meaning_of_probabilities(diagnosis),
            "seen": "" if diagnosis.verdict is Verdict.NO_GAP else would_have_seen(diagnosis),
            "cannot_answer": [sentence(one) for one in diagnosis.cannot_answer],
            "settings": _settings(diagnosis, source),
            "where": where_sentence(diagnosis.where),
            "shrink": ()
            if diagnosis.shrink is None
            else shrink_sentences(diagnosis.shrink, named=bool(diagnosis.effects)),
            "unknown": diagnosis.unknown,
            "remarks_": diagnosis.remarks,
            "model": model,
            "diagnosis": diagnosis,
            "tables": tables(diagnosis),
            "pictures": pictures(diagnosis),
        },
    )


def _settings(diagnosis: Diagnosis, source: str) -> dict[str, str]:
    used = len({*diagnosis.used_for_fit, *diagnosis.held_out})
    told = {
        "Campaign": source,
        "Specimen": diagnosis.specimen,
        "Nominal model": diagnosis.nominal,
        "Runs": f"{used} used, {len(diagnosis.left_out)} left out",
        "Too small to matter": f"below {diagnosis.tolerance_mN:g} mN (--tolerance)",
    }
    return {name: value for name, value in told.items() if value}
